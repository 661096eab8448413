"""The recorded path is one that a vehicle drives, in metres."""

from __future__ import annotations

import numpy as np
import pytest

from tests.verdict.drives import NOISE, motion, poses, raised
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.verdict import Status
from v2hdm.verdict.inputs.poses import check_attitude, check_jumps, check_path


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
