"""``v2hdm calibrate ground``: a mounting, its picture and a verdict, and no foreign file touched."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.ground.scene import extrinsic, make_drive
from v2hdm.cli.main import run
from v2hdm.io.calibration import read_calibration
from v2hdm.io.drive.writing import write_drive


def test_the_door_writes_a_mounting_and_its_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    true = extrinsic(roll_deg=0.5, yaw_deg=-1.0)
    drive = make_drive(tmp_path / "drive", 40.0, true)
    assert drive.trajectory is not None
    write_drive(tmp_path / "drive", drive, drive.trajectory)
    output = tmp_path / "mounting"
    assert run(
        ["calibrate", "ground", str(tmp_path / "drive"), "--output", str(output), "--workers", "1"]
    ) in (0, 3)
    found = read_calibration(output / "calibration_front.yaml")
    np.testing.assert_allclose(found.cam_from_vehicle[:3, :3], true[:3, :3], atol=0.005)
    assert (output / "ground_front.png").stat().st_size > 0
    shown = capsys.readouterr().out
    assert shown.startswith("front: roll 0.")
    assert "verdict: " in shown


def test_a_folder_with_other_files_is_refused_and_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = make_drive(tmp_path / "drive", 0.0, extrinsic())
    assert drive.trajectory is not None
    write_drive(tmp_path / "drive", drive, drive.trajectory)
    mine = tmp_path / "mine" / "calibration_front.yaml"
    mine.parent.mkdir()
    mine.write_text("mine")
    assert run(["calibrate", "ground", str(tmp_path / "drive"), "--output", str(mine.parent)]) == 2
    assert "no results of ours" in capsys.readouterr().err
    assert mine.read_text() == "mine"
