"""Whether a camera has moved is told by both calibrations' covariances."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.cameras import mounted
from v2hdm.calibration.compare import FALSE_ALARM, movement
from v2hdm.cli.main import run
from v2hdm.errors import MapFileError
from v2hdm.geometry.rigid import exp
from v2hdm.io.calibration import write_calibration
from v2hdm.records import Calibration, CameraInfo

INFO = CameraInfo("front", 1280, 720, np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]))
SIGMA = np.array([0.006, 0.002, 0.007, 0.0003, 0.0006, 0.0003])


def looking_ahead(info: CameraInfo = INFO) -> Calibration:
    """2.5 m above the ground, 1.8 m ahead of the axle, 12 degrees down."""
    return Calibration(info, mounted([1.8, 0.1, 2.5], pitch_deg=12), np.diag(SIGMA**2))


def measured(true: Calibration, rng: np.random.Generator) -> Calibration:
    """The same with an error of its covariance."""
    return replace(true, cam_from_vehicle=exp(SIGMA * rng.standard_normal(6)) @ true.cam_from_vehicle)


def turned(true: Calibration, pitch_deg: float, yaw_deg: float, up_m: float = 0.0) -> Calibration:
    """The camera pitched down, turned left about its own centre, and raised."""
    p, y = np.deg2rad([pitch_deg, yaw_deg])
    down = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    left = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
    rotation = true.cam_from_vehicle[:3, :3]
    centre = -rotation.T @ true.cam_from_vehicle[:3, 3] + [0, 0, up_m]
    out = np.eye(4)
    out[:3, :3] = rotation @ (left @ down).T
    out[:3, 3] = -out[:3, :3] @ centre
    return replace(true, cam_from_vehicle=out)


def test_a_camera_that_stays_is_said_to_have_moved_as_seldom_as_stated() -> None:
    rng = np.random.default_rng(0)
    true = looking_ahead()
    found = [movement(measured(true, rng), measured(true, rng)).probability for _ in range(2000)]
    assert np.mean(np.array(found) < 0.05) == pytest.approx(0.05, abs=0.015)
    assert np.mean(np.array(found) < FALSE_ALARM) < 0.004


def test_a_movement_is_told_along_and_about_the_vehicles_axes() -> None:
    true = looking_ahead()
    found = movement(true, turned(true, 0.4, -0.3, 0.02))
    assert found.moved
    assert np.degrees(found.turn_rad) == pytest.approx([0, 0.4, -0.3], abs=0.005)
    assert found.shift_m == pytest.approx([0, 0, 0.02], abs=1e-9)


def test_the_stated_errors_of_a_movement_hold() -> None:
    rng = np.random.default_rng(1)
    true, after = looking_ahead(), turned(looking_ahead(), 2.0, 1.0)
    off = []
    for _ in range(400):
        found = movement(measured(true, rng), measured(after, rng))
        error = np.concatenate([found.shift_m, found.turn_rad - movement(true, after).turn_rad])
        off.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(off) == pytest.approx(6.0, abs=0.6)


def test_a_detectable_turn_is_hardly_ever_missed() -> None:
    rng = np.random.default_rng(2)
    true = looking_ahead()
    pitch_deg = float(np.degrees(movement(true, true).detectable[4]))
    moved = [
        movement(measured(true, rng), measured(turned(true, pitch_deg, 0), rng)).moved for _ in range(300)
    ]
    assert np.mean(moved) == pytest.approx(0.95, abs=0.04)


def test_calibrations_of_other_lenses_are_not_compared() -> None:
    other = replace(INFO, intrinsic=INFO.intrinsic * [[1.01], [1.01], [1.0]])
    with pytest.raises(MapFileError, match="intrinsics differ"):
        movement(looking_ahead(), looking_ahead(other))
    with pytest.raises(MapFileError, match="no covariance"):
        movement(looking_ahead(), replace(looking_ahead(), covariance=None))


def test_the_door_tells_which_camera_has_moved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rear = replace(INFO, name="rear")
    for folder, pitch_deg in (("before", 0.0), ("after", 0.5)):
        (tmp_path / folder).mkdir()
        write_calibration(looking_ahead(), tmp_path / folder / "calibration_front.yaml")
        moved = turned(looking_ahead(rear), pitch_deg, 0)
        write_calibration(moved, tmp_path / folder / "calibration_rear.yaml")
    assert run(["calibrate", "compare", str(tmp_path / "before"), str(tmp_path / "after")]) == 3
    front, rear_line = capsys.readouterr().out.splitlines()
    assert front.startswith("front: not moved")
    assert rear_line.startswith("rear: MOVED")
    assert "pitch +0.50 +- " in rear_line


def test_cameras_that_turn_alike_blame_the_heading(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder, yaw_deg in (("before", 0.0), ("after", 2.0)):
        (tmp_path / folder).mkdir()
        for name in ("front", "rear"):
            one = turned(looking_ahead(replace(INFO, name=name)), 0, yaw_deg)
            write_calibration(one, tmp_path / folder / f"calibration_{name}.yaml")
    assert run(["calibrate", "compare", str(tmp_path / "before"), str(tmp_path / "after")]) == 3
    assert "all cameras have turned alike" in capsys.readouterr().out


def test_a_failed_drive_is_not_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "calibration_front.yaml"
    write_calibration(looking_ahead(), path, verdict={"status": "FAIL"})
    assert run(["calibrate", "compare", str(path), str(path)]) == 2
    assert "verdict on its drive is FAIL" in capsys.readouterr().err
