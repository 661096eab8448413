"""A vehicle goes where it points; each usual mistake about its heading is told by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.verdict.drives import motion, poses, raised, trajectory, with_yaw, yaw_of
from v2hdm.geometry.rigid import quaternion_from_rotation, rotation_from_euler, rotation_from_quaternion
from v2hdm.records import FloatArray, Trajectory
from v2hdm.verdict import Status
from v2hdm.verdict.inputs.heading import Path, check_heading
from v2hdm.verdict.inputs.poses import check_attitude

Spoil = Callable[[Trajectory], Trajectory]


def turned(change: Callable[[FloatArray], FloatArray]) -> Spoil:
    return lambda recorded: with_yaw(recorded, change(yaw_of(recorded)))


def with_matrices(recorded: Trajectory, matrices: FloatArray) -> Trajectory:
    return Trajectory(recorded.stamp_s, matrices)


def swap_axes(recorded: Trajectory) -> Trajectory:
    position = recorded.map_from_vehicle[:, [1, 0, 2], 3]
    return trajectory(recorded.stamp_s, position, yaw_of(recorded))


def w_first(recorded: Trajectory) -> Trajectory:
    xyzw = quaternion_from_rotation(recorded.map_from_vehicle[:, :3, :3])
    matrices = recorded.map_from_vehicle.copy()
    matrices[:, :3, :3] = rotation_from_quaternion(xyzw[:, [3, 0, 1, 2]])
    return with_matrices(recorded, matrices)


def camera_axes(recorded: Trajectory) -> Trajectory:
    vehicle_from_cam = np.eye(4)
    vehicle_from_cam[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    return with_matrices(recorded, recorded.map_from_vehicle @ vehicle_from_cam)


WRONG: dict[str, tuple[Spoil, str]] = {
    "from north": (turned(lambda yaw: np.pi / 2 - yaw), "clockwise from north"),
    "clockwise": (turned(lambda yaw: -yaw), "yaw counts clockwise; write it with the other sign"),
    "90 too large": (turned(lambda yaw: yaw + np.pi / 2), "90 deg too large"),
    "90 too small": (turned(lambda yaw: yaw - np.pi / 2), "90 deg too small"),
    "37 too small": (turned(lambda yaw: yaw - np.deg2rad(37)), "drives 37 deg to the left"),
    "degrees": (turned(np.rad2deg), "degrees were taken for radians"),
    "axes": (swap_axes, "x and y of the positions are swapped"),
    "quaternions": (w_first, "order qw qx qy qz"),
    "inverse": (lambda r: with_matrices(r, np.linalg.inv(r.map_from_vehicle)), "vehicle_from_map"),
    "z down": (lambda r: with_matrices(r, r.map_from_vehicle @ np.diag([1.0, -1, -1, 1])), "z axis points"),
    "camera": (camera_axes, "those of a camera"),
}


def test_right_poses_pass() -> None:
    findings = check_heading(motion(poses()))
    assert not raised(findings)
    assert {finding.check for finding in findings} == {"heading", "heading offset", "origin"}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_convention_is_told_by_name(name: str) -> None:
    spoil, says = WRONG[name]
    told = raised(check_heading(motion(spoil(poses()))))
    assert list(told) == ["heading"]
    assert says in told["heading"]


def test_the_ground_tells_swapped_axes_from_a_yaw_from_north() -> None:
    spoilt = motion(swap_axes(poses()))
    told = raised(check_heading(spoilt, Path.MIRRORED))["heading"]
    assert "swapped" in told
    assert "north;" not in told
    told = raised(check_heading(spoilt, Path.RIGHT_YAW_WRONG))["heading"]
    assert "swapped" not in told
    assert "from north" in told


def test_a_vehicle_that_reverses_a_third_of_the_way_is_fine() -> None:
    recorded = poses(turn_s=0.0)
    there = recorded.map_from_vehicle[:, :3, 3]
    third = len(there) // 3
    position = np.concatenate([there, there[::-1][1 : third + 1]])
    stamp_s = np.arange(len(position)) / 20
    findings = check_heading(motion(trajectory(stamp_s, position, np.zeros(len(position)))))
    assert not raised(findings)
    assert "drives backwards on" in findings[0].says


def test_only_the_ground_can_tell_reversing_all_the_time_from_a_yaw_turned_by_180_deg() -> None:
    spoilt = motion(turned(lambda yaw: yaw + np.pi)(poses()))
    (doubted, *_) = check_heading(spoilt)
    assert doubted.status is Status.WARN
    assert "180 deg" in doubted.says
    assert check_heading(spoilt, Path.AS_GIVEN)[0].status is Status.PASS
    assert check_heading(spoilt, Path.RIGHT_YAW_WRONG)[0].status is Status.FAIL


def test_a_heading_three_degrees_off_is_a_misaligned_antenna() -> None:
    told = raised(check_heading(motion(turned(lambda yaw: yaw + np.deg2rad(3))(poses()))))
    assert list(told) == ["heading offset"]
    assert "3.0 deg to the right" in told["heading offset"]


@pytest.mark.parametrize("ahead_m", [1.2, -0.9])
def test_the_lever_from_the_axle_to_the_antenna_is_measured_in_turns(ahead_m: float) -> None:
    recorded = poses()
    recorded.map_from_vehicle[:, :3, 3] += ahead_m * recorded.map_from_vehicle[:, :3, 0]
    found = {finding.check: finding for finding in check_heading(motion(recorded))}["origin"]
    assert found.status is Status.WARN
    assert found.value == pytest.approx(ahead_m, abs=0.1)


def test_a_straight_route_cannot_tell_where_the_origin_is() -> None:
    found = {finding.check: finding for finding in check_heading(motion(poses(turn_s=0.0)))}
    assert found["origin"].is_unobservable
    assert found["mirrored"].is_unobservable


def test_roll_and_pitch_in_degrees_are_no_vehicle_s() -> None:
    recorded = poses()
    roll = 0.5 * np.sin(recorded.stamp_s)  # .5 deg, taken for radians
    recorded.map_from_vehicle[:, :3, :3] = rotation_from_euler(roll, 0 * roll, yaw_of(recorded))
    found = motion(recorded)
    told = raised([*check_heading(found), *check_attitude(found)])
    assert list(told) == ["attitude"]
    assert "degrees taken for radians" in told["attitude"]
