"""The recorded path is one that a vehicle drives, in metres; the stated noise has its unit and scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.verdict.drives import NOISE, motion, poses, raised
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.records import PoseNoise
from v2hdm.verdict import Finding, Status
from v2hdm.verdict.inputs.drive import causes
from v2hdm.verdict.inputs.poses import check_attitude, check_jumps, check_noise, check_path


@pytest.mark.parametrize(
    ("factor", "check", "says"),
    [
        (1e3, "speed", "millimetres"),
        (1e2, "speed", "centimetres"),
        (1e-3, "path length", "kilometres"),
        (1 / 111_320, "path length", "degrees"),
    ],
)
def test_the_unit_of_positions_is_told(factor: float, check: str, says: str) -> None:
    recorded = poses()
    recorded.map_from_vehicle[:, :3, 3] *= factor
    told = raised(check_path(motion(recorded)))
    assert list(told) == [check]
    assert says in told[check]


def test_a_vehicle_that_stands_is_told_from_one_in_degrees() -> None:
    recorded = poses()
    recorded.map_from_vehicle[:, :3, 3] = np.random.default_rng(0).normal(0, 0.01, (len(recorded.stamp_s), 3))
    told = raised(check_path(motion(recorded)))
    assert "nowhere moves" in told["path length"]


def test_good_poses_do_not_jump() -> None:
    assert not raised(check_jumps(motion(poses()), NOISE))


def test_a_lost_fix_is_told_with_its_size_and_place() -> None:
    recorded = poses()
    recorded.map_from_vehicle[100:, 1, 3] += 0.5  # at 5 s
    told = raised(check_jumps(motion(recorded), NOISE))
    assert list(told) == ["position jumps"]
    assert "jumps by 0.48 m" in told["position jumps"]
    assert "at 4.95 s" in told["position jumps"] or "at 5.00 s" in told["position jumps"]


def test_a_height_that_jumps_is_told_apart() -> None:
    recorded = poses()
    recorded.map_from_vehicle[100:, 2, 3] += 0.8
    assert list(raised(check_jumps(motion(recorded), NOISE))) == ["height jumps"]


def test_hard_braking_at_a_low_rate_is_no_jump() -> None:
    recorded = poses(turn_s=0.0, rate_hz=2.0)
    stamp_s = recorded.stamp_s
    braking_s = np.maximum(stamp_s - 4, 0)
    recorded.map_from_vehicle[:, 0, 3] = 30 * stamp_s - 3 * braking_s**2
    assert not raised(check_jumps(motion(recorded), NOISE))


@pytest.mark.parametrize(("sign", "status"), [(1.0, Status.PASS), (-1.0, Status.FAIL)])
def test_a_pitch_that_counts_nose_up_goes_against_the_grade(sign: float, status: Status) -> None:
    recorded = poses(turn_s=0.0)
    x = recorded.map_from_vehicle[:, 0, 3]
    grade = 0.05 * np.sin(x / 6)
    recorded.map_from_vehicle[:, 2, 3] = -0.05 * 6 * np.cos(x / 6)
    zero = np.zeros(len(x))
    recorded.map_from_vehicle[:, :3, :3] = rotation_from_euler(zero, -sign * np.arctan(grade), zero)
    found = {finding.check: finding for finding in check_attitude(motion(recorded))}
    assert found["pitch sign"].status is status


def test_poses_that_scatter_as_stated_pass() -> None:
    findings = check_noise(motion(poses()), NOISE)
    assert not raised(findings)
    scatter = [finding.value for finding in findings if finding.check == "pose scatter"]
    assert scatter == pytest.approx([1.0, 1.0], abs=0.2)


@pytest.mark.parametrize(
    ("stated", "says"),
    [
        ({"heading_rad": 0.15}, "8.6 deg; if degrees were meant, it is 0.0026 rad"),
        ({"roll_pitch_rad": 0.2}, "11.5 deg"),
        ({"position_m": 2.0}, "no RTK position"),
        ({"position_m": 12.0}, "if millimetres were meant, it is 0.012 m"),
        ({"position_m": 0.0}, "0, which no receiver reaches"),
    ],
)
def test_a_noise_in_another_unit_is_told(stated: dict[str, float], says: str) -> None:
    told = raised(check_noise(motion(poses()), replace(NOISE, **stated)))
    assert list(told) == ["pose noise"]
    assert says in told["pose noise"]


@pytest.mark.parametrize(("factor", "status"), [(6.0, Status.WARN), (30.0, Status.FAIL)])
def test_poses_noisier_than_stated_are_told(factor: float, status: Status) -> None:
    recorded = poses()
    rng = np.random.default_rng(1)
    recorded.map_from_vehicle[:, :2, 3] += rng.normal(0, factor * NOISE.position_m, (320, 2))
    (found,) = [f for f in check_noise(motion(recorded), NOISE) if f.status is not Status.PASS]
    assert found.status is status
    assert found.value == pytest.approx(factor, rel=0.2)


def test_slow_poses_say_nothing_of_their_noise() -> None:
    slow = motion(poses(straight_s=40.0, rate_hz=2.0))
    assert not [finding for finding in check_noise(slow, PoseNoise()) if finding.check == "pose scatter"]


def test_noise_in_the_wrong_unit_stands_for_ground_that_cannot_be_matched_under_it() -> None:
    unit = Finding("pose noise", Status.WARN, 0.15, 0.01, "rad", "8.6 deg", "pose_noise.heading_rad")
    ground = Finding("ground match", Status.FAIL, 0.0, None, "", "no match", "front")
    told = causes([ground, unit])
    assert [(one.check, one.status) for one in told] == [("pose noise", Status.FAIL)]
