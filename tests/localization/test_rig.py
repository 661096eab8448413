"""The sequential test of a mounting: what does not change is never said to, what changes is named."""

import numpy as np
import pytest

from v2hdm.localization.belief import CREEP_RAD
from v2hdm.localization.rig import Estimate, MountingTest

CALIBRATION = np.deg2rad(0.03) ** 2 * np.eye(3)
STEP_S = 0.2
_SIGMA_RAD = np.deg2rad(0.02)  # of what one image says of a mounting


def _filtered(true_rad, rng):
    """Estimates of a mounting (T, 3), of which each image says something, by a Kalman filter."""
    mean = np.zeros(3)
    variance = CALIBRATION[0, 0]
    for number, turn in enumerate(true_rad):
        variance += CREEP_RAD**2 * STEP_S
        gain = variance / (variance + _SIGMA_RAD**2)
        mean = mean + gain * (turn + _SIGMA_RAD * rng.standard_normal(3) - mean)
        variance *= 1 - gain
        yield Estimate(number * STEP_S, mean, variance * np.eye(3))


def _changes(true_rad, rng):
    test = MountingTest(CALIBRATION, CREEP_RAD**2)
    return [test.note(estimate) for estimate in _filtered(true_rad, rng)]


@pytest.mark.parametrize("seed", range(4))
def test_a_mounting_that_creeps_as_it_may_is_right(seed):
    rng = np.random.default_rng(seed)
    steps = np.sqrt(STEP_S) * CREEP_RAD * rng.standard_normal((1200, 3))
    true = np.sqrt(CALIBRATION[0, 0]) * rng.standard_normal(3) + np.cumsum(steps, axis=0)
    assert not any(_changes(true, rng))


@pytest.mark.parametrize(("axis", "angle"), [(0, "pitch"), (1, "yaw"), (2, "roll")])
def test_a_slow_turn_is_named_with_its_angle_and_its_beginning(axis, angle):
    rng = np.random.default_rng(axis)
    stamps_s = np.arange(0, 120, STEP_S)
    rate_rad_s = np.deg2rad(0.5) / 60
    true = np.outer(np.clip(stamps_s - 40, 0, None) * rate_rad_s, np.eye(3)[axis])
    changes = _changes(true, rng)
    first = next(number for number, change in enumerate(changes) if change)
    assert changes[first].angle == angle
    assert changes[first].is_slow
    assert changes[first].since_s == pytest.approx(40, abs=8)
    assert stamps_s[first] < 40 + 0.25 / np.degrees(rate_rad_s)
    assert all(changes[first:])


def test_what_turns_at_once_is_not_slow_and_forgotten_when_it_is_put_right():
    rng = np.random.default_rng(5)
    stamps_s = np.arange(0, 400, STEP_S)
    true = np.zeros((len(stamps_s), 3))
    true[(stamps_s > 30) & (stamps_s < 100), 1] = np.deg2rad(-0.8)
    test = MountingTest(CALIBRATION, CREEP_RAD**2)
    changes = []
    for estimate in _filtered(true, rng):
        # As when a push was noticed: the filter has let the mounting turn.
        was_turned = 30 < estimate.stamp_s < 100
        turn = np.where(was_turned, true[300], 0.0)
        changes.append(test.note(Estimate(estimate.stamp_s, turn, estimate.covariance_rad2)))
    assert changes[200].angle == "yaw"
    assert not changes[200].is_slow
    assert changes[200].since_s == pytest.approx(30, abs=1)
    assert not any(changes[:150])
    assert changes[-1] is None


def test_old_estimates_are_thinned_and_still_say_when():
    test = MountingTest(CALIBRATION, CREEP_RAD**2)
    sharp = np.deg2rad(0.005) ** 2 * np.eye(3)
    for number in range(4000):
        test.note(Estimate(0.5 * number, np.zeros(3), sharp))
    assert len(test.estimates) <= 240
    assert test.estimates[0].covariance_rad2 is CALIBRATION
    change = test.note(Estimate(2000.0, np.deg2rad([0.3, 0.0, 0.0]), sharp))
    assert change.angle == "pitch"
    assert change.since_s > 1990
