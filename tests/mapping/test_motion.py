"""The vehicle's motion from its poses."""

from __future__ import annotations

import numpy as np

from v2hdm.mapping.bundle import vehicle_twists


def test_a_steady_turn_has_one_twist_everywhere() -> None:
    """5 m/s on a circle of 10 m radius: half a radian a second to the left."""
    stamp_s = np.array([0.0, 0.2, 0.5, 0.6, 1.0])
    heading = 0.5 * stamp_s
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 0], poses[:, 0, 1] = np.cos(heading), -np.sin(heading)
    poses[:, 1, 0], poses[:, 1, 1] = np.sin(heading), np.cos(heading)
    poses[:, 0, 3], poses[:, 1, 3] = 10 * np.sin(heading), 10 * (1 - np.cos(heading))
    expected = np.tile([5.0, 0.0, 0.0, 0.0, 0.0, 0.5], (5, 1))
    np.testing.assert_allclose(vehicle_twists(poses, stamp_s), expected, atol=1e-9)


def test_a_single_pose_stands_still() -> None:
    np.testing.assert_array_equal(vehicle_twists(np.eye(4)[None], np.zeros(1)), np.zeros((1, 6)))
