"""A vehicle whose odometry comes late finds that out, and blames no camera for it."""

from dataclasses import replace

import numpy as np
import pytest

from tests.localization.driven import MOUNT, drive, follow, mapped, tracked, yard
from v2hdm.localization import belief
from v2hdm.localization.motion import Motion, MotionLog, MotionNoise


def late_by(driven, late_s):
    """A drive whose odometry is stamped late."""
    stamped = [sample._replace(stamp_s=sample.stamp_s + late_s) for part in driven.motion for sample in part]
    begins_s = [-np.inf, *driven.stamp_s[:-1]]
    motion = [
        [sample for sample in stamped if begin_s < sample.stamp_s <= end_s]
        for begin_s, end_s in zip(begins_s, driven.stamp_s, strict=True)
    ]
    return replace(driven, motion=motion)


@pytest.mark.parametrize("late_s", [0.0, 0.05, 0.1])
def test_an_odometry_that_comes_late_is_known_to_and_no_camera_is_blamed(late_s):
    painted = yard(6)
    driven = drive(painted, 6, seconds=16.0, swerve_rad=0.15)
    poses = follow(late_by(driven, late_s), mapped(painted, 6))
    errors, bounds = tracked(driven, poses)
    assert poses[-1].motion[2] == pytest.approx(late_s, abs=0.012)
    assert (np.abs(errors) < bounds).all()
    assert not poses[-1].turned


@pytest.mark.parametrize("late_s", [0.1, 0.2])
def test_a_sharp_bend_under_a_late_odometry_is_no_turned_mounting(late_s):
    painted = yard(6)
    driven = drive(painted, 6, seconds=10.0, swerve_rad=0.5)
    poses = follow(late_by(driven, late_s), mapped(painted, 6))
    errors, bounds = tracked(driven, poses)
    assert len(errors) > 80
    assert (np.abs(errors) < bounds).all()
    assert not any(pose.turned for pose in poses)
    reasons = {reason for pose in poses for reason in pose.reasons}
    assert all("not told apart" in reason for reason in reasons)


def test_a_camera_that_is_pushed_is_named_under_a_late_odometry_too():
    painted = yard(8)
    turned = ("front", 8.0, np.deg2rad([0.0, 0.8, 0.0]))
    driven = drive(painted, 8, seconds=14.0, swerve_rad=0.15, turned=turned)
    poses = follow(late_by(driven, 0.1), mapped(painted, 8))
    assert [turned.camera for turned in poses[-1].turned] == ["front"]


def test_what_a_late_odometry_has_not_told_yet_is_open():
    noise = MotionNoise()
    log = MotionLog()
    for k in range(20):
        log.add(Motion(0.05 * k, 4.0, 0.0))
    state = belief.start(0.0, np.zeros(3), np.array([0.01, 0.01, 1e-4]), [MOUNT], noise)
    for late_s in (0.0, 0.2):
        mean = state.mean.copy()
        mean[belief.LATE] = late_s
        late = belief.replace(state, mean=mean)
        measured = belief.predict(late, log.pieces(0.0, 0.1), noise).covariance([0, 1, 2])
        all_of_it = belief.predict(late, log.pieces(0.0, 0.1), noise, has_untold=True).covariance([0, 1, 2])
        # Half the acceleration by the time squared: of the lateness, and of its own sigma of 50 ms. Within a
        # tenth of a second an acceleration that lasts for one changes by 0.44 of its sigma.
        squared_s2 = (late_s**2 + noise.late_s**2) * np.sqrt(2 * (1 - np.exp(-0.1)))
        sigmas = np.array([0.5 * 1.5 * squared_s2, 0.0, 0.5 * 0.3 * squared_s2])
        np.testing.assert_allclose(np.diag(all_of_it - measured), sigmas**2, rtol=1e-3, atol=1e-9)
