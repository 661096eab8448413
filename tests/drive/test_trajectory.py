from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from tests.drive.example import straight_trajectory
from v2hdm.geometry.rigid import (
    quaternion_from_rotation,
    rotation_from_euler,
    rotation_from_quaternion,
    slerp,
)
from v2hdm.geometry.trajectory import interpolate
from v2hdm.records import FloatArray, Trajectory

SEEDS = st.integers(0, 2**32 - 1)


def random_trajectory(seed: int, length: int = 6) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (length, 1, 1))
    poses[:, :3, :3] = Rotation.random(length, rng).as_matrix()
    poses[:, :3, 3] = rng.normal(scale=50.0, size=(length, 3))
    return Trajectory(np.cumsum(rng.uniform(0.05, 0.2, length)), poses)


@given(SEEDS)
def test_quaternions_agree_with_scipy_and_return_to_the_same_rotation(seed: int) -> None:
    rotation = Rotation.random(20, np.random.default_rng(seed)).as_matrix()
    quaternion = quaternion_from_rotation(rotation)
    np.testing.assert_allclose(quaternion, Rotation.from_matrix(rotation).as_quat(canonical=True), atol=1e-12)
    np.testing.assert_allclose(rotation_from_quaternion(quaternion), rotation, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_survive_the_way_through_a_quaternion(axis: int) -> None:
    half_turn = -np.eye(3)
    half_turn[axis, axis] = 1.0
    np.testing.assert_allclose(
        rotation_from_quaternion(quaternion_from_rotation(half_turn[None]))[0], half_turn, atol=1e-15
    )


@given(SEEDS)
def test_euler_angles_mean_what_scipy_means_by_fixed_axes(seed: int) -> None:
    angles = np.random.default_rng(seed).uniform(-1.5, 1.5, (5, 3))
    np.testing.assert_allclose(
        rotation_from_euler(*angles.T), Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-14
    )


@given(SEEDS, st.floats(0.0, 1.0))
def test_slerp_agrees_with_scipy_whatever_the_signs(seed: int, fraction: float) -> None:
    rng = np.random.default_rng(seed)
    ends = Rotation.random(2, rng)
    first, second = ends.as_quat()[:1], ends.as_quat()[1:] * rng.choice([-1.0, 1.0])
    got = rotation_from_quaternion(slerp(first, second, np.array([fraction])))
    np.testing.assert_allclose(got[0], Slerp([0, 1], ends)(fraction).as_matrix(), atol=1e-9)


@given(SEEDS)
def test_recorded_times_return_the_recorded_poses(seed: int) -> None:
    trajectory = random_trajectory(seed)
    poses, inside = interpolate(trajectory, trajectory.stamp_s, max_gap_s=0.001)
    assert inside.all()
    np.testing.assert_allclose(poses, trajectory.map_from_vehicle, atol=1e-9)


@given(SEEDS, st.floats(0.01, 0.99))
def test_interpolating_does_not_depend_on_the_map_frame(seed: int, fraction: float) -> None:
    trajectory = random_trajectory(seed)
    stamp_s = np.array([trajectory.stamp_s[0] * (1 - fraction) + trajectory.stamp_s[-1] * fraction])
    other_from_map = random_trajectory(seed + 1).map_from_vehicle[0]
    moved = Trajectory(trajectory.stamp_s, other_from_map @ trajectory.map_from_vehicle)
    expected = other_from_map @ interpolate(trajectory, stamp_s, 1.0)[0]
    np.testing.assert_allclose(interpolate(moved, stamp_s, 1.0)[0], expected, atol=1e-8)


def test_a_third_of_the_way_is_a_third_of_the_shift_and_of_the_turn() -> None:
    trajectory = straight_trajectory(end_s=0.3, rate_hz=10.0)
    pose = interpolate(trajectory, np.array([100.0 + 0.1 / 3]), 1.0)[0][0]
    assert pose[0, 3] == pytest.approx(0.5 / 3, abs=1e-9)
    assert np.arctan2(pose[1, 0], pose[0, 0]) == pytest.approx(0.01 / 3, abs=1e-9)


def without_middle() -> Trajectory:
    """Poses at 100.0 to 100.5 s and, after a gap, at 101.5 to 102.0 s."""
    whole = straight_trajectory()
    keep = np.abs(whole.stamp_s - 101.0) > 0.45
    return Trajectory(whole.stamp_s[keep], whole.map_from_vehicle[keep])


@pytest.mark.parametrize(
    ("stamp_s", "expected"),
    [
        (99.999, False),
        (100.0, True),
        (100.5, True),
        (100.51, False),
        (101.0, False),
        (101.5, True),
        (102.0, True),
        (102.001, False),
    ],
)
def test_nothing_is_extrapolated_nor_carried_across_a_gap(stamp_s: float, expected: bool) -> None:
    poses, inside = interpolate(without_middle(), np.array([stamp_s]), max_gap_s=0.5)
    assert bool(inside[0]) is expected
    assert np.isfinite(poses).all()


def test_a_generous_limit_bridges_the_gap() -> None:
    poses, inside = interpolate(without_middle(), np.array([101.0]), max_gap_s=1.01)
    assert inside.all()
    np.testing.assert_allclose(poses[0, 0, 3], 5.0, atol=1e-6)


def test_a_single_pose_serves_its_own_time_only() -> None:
    one = Trajectory(np.array([7.0]), np.eye(4)[None])
    times: FloatArray = np.array([6.0, 7.0, 8.0])
    assert interpolate(one, times, 1.0)[1].tolist() == [False, True, False]
