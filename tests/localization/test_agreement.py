"""How much a detection speaks for or against a map, by where it lies from its marking."""

import numpy as np
import pytest

from tests.localization.driven import drive, mapped, moved, yard
from v2hdm.localization.agreement import offset_likelihood
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.pose import Status

SHARP_M2 = 0.02**2 * np.eye(2)


def test_a_detection_on_its_marking_speaks_for_the_map():
    assert offset_likelihood(np.zeros(2), SHARP_M2).gain == pytest.approx(np.log(0.5 / 0.85), abs=0.02)


def test_a_detection_30_cm_beside_its_marking_speaks_for_paint_that_was_moved():
    assert offset_likelihood(np.array([0.3, 0.0]), SHARP_M2).gain > 2.0


def test_a_detection_far_from_any_marking_says_little():
    assert offset_likelihood(np.array([5.0, 0.0]), SHARP_M2).gain == pytest.approx(
        np.log(0.2 / 0.13), abs=0.05
    )


def test_what_is_known_to_half_a_metre_says_nothing_of_30_cm():
    assert offset_likelihood(np.array([0.3, 0.0]), 0.5**2 * np.eye(2)).gain < 0


@pytest.mark.parametrize("angle_rad", [0.3, 1.2, 2.9])
def test_the_direction_of_north_plays_no_part(angle_rad):
    turn = np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])
    off_m = np.array([0.2, 0.05])
    covariance_m2 = np.diag([0.1, 0.02]) ** 2
    turned = offset_likelihood(turn @ off_m, turn @ covariance_m2 @ turn.T).gain
    assert turned == pytest.approx(offset_likelihood(off_m, covariance_m2).gain)


@pytest.mark.parametrize("seed", range(4))
def test_a_start_on_a_map_that_was_half_repainted_is_said_within_a_second(seed):
    painted = yard(seed)
    driven = drive(painted, seed, seconds=1.3, begin_m=30.0)
    localizer = Localizer(
        moved(mapped(painted, seed), 0.5, 0.3, seed),
        driven.calibrations,
        driven.rough(np.random.default_rng(seed)),
    )
    moments = zip(driven.looks, driven.motion, strict=True)
    poses = [localizer.update(looks, motion) for looks, motion in moments]
    first = next(number for number, pose in enumerate(poses) if pose.reasons)
    assert driven.stamp_s[first] - driven.stamp_s[0] <= 1.0
    assert not any(np.isfinite(pose.protection_m).all() for pose in poses[first:])


@pytest.mark.parametrize("seed", range(4))
def test_a_right_map_is_never_called_repainted_while_the_start_is_sought(seed):
    painted = yard(seed)
    driven = drive(painted, seed, seconds=2.5, begin_m=30.0)
    localizer = Localizer(
        mapped(painted, seed), driven.calibrations, driven.rough(np.random.default_rng(seed))
    )
    moments = zip(driven.looks, driven.motion, strict=True)
    poses = [localizer.update(looks, motion) for looks, motion in moments]
    assert not any(pose.reasons for pose in poses)
    assert poses[-1].status == Status.TRACKING
