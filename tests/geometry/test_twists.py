"""How a vehicle moved is told by the poses around each of its poses, not by the errors of two."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cameras import level
from v2hdm.geometry.twists import vehicle_twists
from v2hdm.records import FloatArray

SPEED_MPS = 4.0

# Two cameras in turn, every 125 ms and 37 ms later, on a straight road along x.
IN_TURN_S = np.sort(np.concatenate([np.arange(0.0, 10.0, 0.125), np.arange(0.037, 10.0, 0.125)]))
MIDDLE = len(IN_TURN_S) // 2


def straight(forward_error_m: FloatArray) -> FloatArray:
    return level(SPEED_MPS * IN_TURN_S + forward_error_m, np.zeros(len(IN_TURN_S)), np.zeros(len(IN_TURN_S)))


def response_of_speed() -> FloatArray:
    """Change of the speed, m/s, in the middle by an error of one metre of each pose."""
    change = []
    for number in range(len(IN_TURN_S)):
        error_m = np.zeros(len(IN_TURN_S))
        error_m[number] = 1.0
        change.append(vehicle_twists(straight(error_m), IN_TURN_S)[MIDDLE, 0] - SPEED_MPS)
    return np.array(change)


def test_a_steady_turn_has_one_twist_everywhere():
    """5 m/s on a circle of 10 m radius: half a radian a second to the left."""
    stamp_s = np.array([0.0, 0.2, 0.5, 0.6, 1.0])
    heading = 0.5 * stamp_s
    poses = level(10 * np.sin(heading), 10 * (1 - np.cos(heading)), heading)
    expected = np.tile([5.0, 0.0, 0.0, 0.0, 0.0, 0.5], (5, 1))
    np.testing.assert_allclose(vehicle_twists(poses, stamp_s), expected, atol=1e-9)


def test_a_single_pose_stands_still():
    np.testing.assert_array_equal(vehicle_twists(np.eye(4)[None], np.zeros(1)), np.zeros((1, 6)))


def test_a_poses_own_error_has_hardly_a_part_in_its_twist():
    response = response_of_speed()
    is_same_pose = np.abs(IN_TURN_S - IN_TURN_S[MIDDLE]) < 0.05
    assert np.abs(response[is_same_pose]).max() < 0.05  # 1 / s; the difference of the neighbours has 8


def test_white_errors_of_poses_average_out_in_a_twist():
    assert np.linalg.norm(response_of_speed()) < 0.8  # 1 / s; the difference of the neighbours has 11


def test_a_twist_follows_a_bend_that_begins():
    """The yaw rate rises within two seconds, as on a clothoid, to 0.3 rad/s."""
    stamp_s = np.arange(0.0, 8.0, 0.1)
    rate = 0.3 * np.clip((stamp_s - 3.0) / 2.0, 0.0, 1.0)
    heading = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * 0.1)])
    moved = SPEED_MPS * 0.1 * np.column_stack([np.cos(heading), np.sin(heading)])
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)[:-1]])
    twists = vehicle_twists(level(place[:, 0], place[:, 1], heading), stamp_s)
    assert np.abs(twists[:, 5] - rate).max() < 0.02


@pytest.mark.parametrize("gap_s", [0.0, 100.0])
def test_sessions_do_not_take_part_in_each_others_twists(gap_s):
    stamp_s = np.arange(0.0, 4.0, 0.125)
    ahead = level(SPEED_MPS * stamp_s, np.zeros(len(stamp_s)), np.zeros(len(stamp_s)))
    back = level(-SPEED_MPS * stamp_s, np.zeros(len(stamp_s)), np.zeros(len(stamp_s)))
    session = np.repeat([0, 1], len(stamp_s))
    twists = vehicle_twists(np.concatenate([ahead, back]), np.tile(stamp_s, 2) + gap_s * session, session)
    np.testing.assert_allclose(twists[:, 0], np.where(session == 0, SPEED_MPS, -SPEED_MPS), atol=1e-9)


def test_images_that_are_seconds_apart_are_told_by_their_neighbours():
    stamp_s = np.array([0.0, 3.0, 6.0, 9.0])
    poses = level(SPEED_MPS * stamp_s, np.zeros(4), np.zeros(4))
    np.testing.assert_allclose(vehicle_twists(poses, stamp_s)[:, 0], SPEED_MPS, atol=1e-9)
