"""One RTK antenna: its course tells the heading, its positions hold the pose."""

import numpy as np
import pytest

from tests.localization.driven import MOUNT, drive, mapped, yard
from v2hdm.localization.antenna import Antenna, Fix, with_fix
from v2hdm.localization.belief import HEADING, start
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.motion import MotionNoise
from v2hdm.localization.places import Prior
from v2hdm.localization.pose import Status

AHEAD_LEFT_M = np.array([1.2, -0.3])
SIGMA_M = 0.02


def antenna_at(pose):
    """Where the antenna of a vehicle at a pose (4, 4) is in the map."""
    return pose[:2, 3] + pose[:2, :2] @ AHEAD_LEFT_M


def fixes_of(driven, rng, late_s=0.0):
    """A position for each moment."""
    noise = SIGMA_M * rng.standard_normal((len(driven.poses), 2))
    pairs = zip(driven.stamp_s, driven.poses, noise, strict=True)
    return [Fix(stamp_s + late_s, antenna_at(pose) + off, SIGMA_M) for stamp_s, pose, off in pairs]


def localizer_of(painted, seed, driven, prior=None):
    """A localiser of a vehicle with one antenna, on the map of a yard."""
    antenna_m = tuple(AHEAD_LEFT_M.tolist())
    return Localizer(mapped(painted, seed), driven.calibrations, prior, antenna_m=antenna_m)


@pytest.mark.parametrize("turn_rad", [0.0, 1.0, -2.5])
def test_a_course_tells_the_heading_whatever_it_is(turn_rad):
    rng = np.random.default_rng(0)
    antenna = Antenna(AHEAD_LEFT_M)
    turn = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    for number in range(30):
        local = np.array([0.4 * number, 0.0, 0.0])
        place = np.array([7.0, 5.0]) + turn @ (local[:2] + AHEAD_LEFT_M) + SIGMA_M * rng.standard_normal(2)
        antenna.note(Fix(0.1 * number, place, SIGMA_M), local)
    prior = antenna.prior(local, None)
    off_rad = (prior.pose[2] - turn_rad + np.pi) % (2 * np.pi) - np.pi
    assert abs(off_rad) < 3 * prior.sigma_rad < np.deg2rad(5)
    assert np.linalg.norm(prior.pose[:2] - [7.0, 5.0] - turn @ local[:2]) < prior.sigma_m


def test_a_vehicle_that_stands_has_no_course():
    antenna = Antenna(AHEAD_LEFT_M)
    for number in range(30):
        antenna.note(Fix(0.1 * number, np.array([7.0, 5.0]), SIGMA_M), np.zeros(3))
    assert antenna.prior(np.zeros(3), None).sigma_rad == np.pi
    stated = Prior(np.array([0.0, 0.0, 0.7]), 5.0, 0.3)
    prior = antenna.prior(np.zeros(3), stated)
    assert prior.pose[2] == pytest.approx(0.7)
    assert prior.sigma_rad == pytest.approx(0.3)


def test_a_position_beside_the_origin_turns_the_heading_as_its_derivative_says():
    belief = start(0.0, np.array([3.0, 2.0, 0.4]), np.array([0.001, 0.001, 0.1]), [MOUNT], MotionNoise())
    arm = np.array([2.0, 0.0])
    true_rad = 0.45
    place = belief.mean[:2] + 2.0 * np.array([np.cos(true_rad), np.sin(true_rad)])
    after, problem = with_fix(belief, Fix(0.0, place, 0.002), arm, 0.0)
    assert problem is None
    assert after.mean[HEADING] == pytest.approx(true_rad, abs=0.003)
    assert after.covariance([HEADING])[0, 0] < 0.1 * belief.covariance([HEADING])[0, 0]


def test_one_antenna_and_a_gyro_find_the_vehicle_without_a_stated_start():
    painted = yard(21)
    driven = drive(painted, 21, begin_m=60.0)
    localizer = localizer_of(painted, 21, driven)
    fixes = fixes_of(driven, np.random.default_rng(1))
    for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
        pose = localizer.update(looks, motion, [fixes[frame]])
        if pose.status == Status.TRACKING:
            assert (np.abs(driven.errors(pose, frame)[:2]) < pose.protection_m).all()
    assert pose.status == Status.TRACKING
    assert pose.reasons == ()


def test_positions_that_come_before_the_images_of_their_time_leave_these_in_use():
    painted = yard(22)
    driven = drive(painted, 22, seconds=6.0)
    prior = driven.rough(np.random.default_rng(2))
    localizer = localizer_of(painted, 22, driven, prior)
    fixes = fixes_of(driven, np.random.default_rng(3))
    matched = []
    for frame in range(1, len(driven.looks)):
        # The images of the moment before come with this moment's position.
        pose = localizer.update(driven.looks[frame - 1], driven.motion[frame], [fixes[frame]])
        matched.append(pose.matched)
    assert pose.status == Status.TRACKING
    assert min(matched[-20:]) > 0
    assert (np.abs(driven.errors(pose, frame)[:2]) < pose.protection_m).all()


def test_positions_hold_the_pose_where_no_image_comes():
    painted = yard(23)
    driven = drive(painted, 23, seconds=16.0)
    prior = driven.rough(np.random.default_rng(4))
    localizer = localizer_of(painted, 23, driven, prior)
    fixes = fixes_of(driven, np.random.default_rng(5))
    for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
        pose = localizer.update(looks if frame < 40 else [], motion, [fixes[frame]])
    assert pose.status == Status.TRACKING
    assert (np.abs(driven.errors(pose, frame)[:2]) < pose.protection_m).all()


def test_an_antenna_that_is_elsewhere_is_said():
    painted = yard(24)
    driven = drive(painted, 24, seconds=5.0)
    localizer = Localizer(mapped(painted, 24), driven.calibrations, driven.rough(np.random.default_rng(6)))
    fixes = fixes_of(driven, np.random.default_rng(7))
    for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
        pose = localizer.update(looks, motion, [fixes[frame]] if frame > 20 else [])
    assert "the antenna where it is stated" in pose.reasons[0]
    assert np.hypot(*driven.errors(pose, frame)[:2]) < 0.05
