"""The stated noise: its unit, and against the poses' own scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.verdict.drives import NOISE, motion, poses, raised
from v2hdm.records import PoseNoise
from v2hdm.verdict import Finding, Status
from v2hdm.verdict.inputs.drive import causes
from v2hdm.verdict.inputs.poses import check_noise


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
