"""Checks of the recorded path, its heading and the stated noise."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.verdict.drives import NOISE, motion, poses, raised, trajectory, with_yaw, yaw_of
from v2hdm.geometry.rigid import quaternion_from_rotation, rotation_from_euler, rotation_from_quaternion
from v2hdm.records import PoseNoise, Trajectory
from v2hdm.verdict import Finding, Status
from v2hdm.verdict.inputs.drive import causes
from v2hdm.verdict.inputs.heading import Path, check_heading
from v2hdm.verdict.inputs.poses import check_attitude, check_jumps, check_noise, check_path

Spoil = Callable[[Trajectory], Trajectory]


def turned(change):
    return lambda recorded: with_yaw(recorded, change(yaw_of(recorded)))


def with_matrices(recorded, matrices):
    return Trajectory(recorded.stamp_s, matrices)


def swap_axes(recorded):
    position = recorded.map_from_vehicle[:, [1, 0, 2], 3]
    return trajectory(recorded.stamp_s, position, yaw_of(recorded))


def w_first(recorded):
    xyzw = quaternion_from_rotation(recorded.map_from_vehicle[:, :3, :3])
    matrices = recorded.map_from_vehicle.copy()
    matrices[:, :3, :3] = rotation_from_quaternion(xyzw[:, [3, 0, 1, 2]])
    return with_matrices(recorded, matrices)


def camera_axes(recorded):
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


def test_right_poses_pass():
    findings = check_heading(motion(poses()))
    assert not raised(findings)
    assert {finding.check for finding in findings} == {"heading", "origin"}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_convention_is_told_by_name(name):
    spoil, says = WRONG[name]
    told = raised(check_heading(motion(spoil(poses()))))
    assert list(told) == ["heading"]
    assert says in told["heading"]


def test_the_ground_tells_swapped_axes_from_a_yaw_from_north():
    spoilt = motion(swap_axes(poses()))
    told = raised(check_heading(spoilt, Path.MIRRORED))["heading"]
    assert "swapped" in told
    assert "north;" not in told
    told = raised(check_heading(spoilt, Path.RIGHT_YAW_WRONG))["heading"]
    assert "swapped" not in told
    assert "from north" in told


def test_a_vehicle_that_reverses_a_third_of_the_way_is_fine():
    recorded = poses(turn_s=0.0)
    there = recorded.map_from_vehicle[:, :3, 3]
    third = len(there) // 3
    position = np.concatenate([there, there[::-1][1 : third + 1]])
    stamp_s = np.arange(len(position)) / 20
    findings = check_heading(motion(trajectory(stamp_s, position, np.zeros(len(position)))))
    assert not raised(findings)
    assert "drives backwards on" in findings[0].says


def test_only_the_ground_can_tell_reversing_all_the_time_from_a_yaw_turned_by_180_deg():
    spoilt = motion(turned(lambda yaw: yaw + np.pi)(poses()))
    (doubted, *_) = check_heading(spoilt)
    assert doubted.status is Status.WARN
    assert "180 deg" in doubted.says
    assert check_heading(spoilt, Path.AS_GIVEN)[0].status is Status.PASS
    assert check_heading(spoilt, Path.RIGHT_YAW_WRONG)[0].status is Status.FAIL


@pytest.mark.parametrize("ahead_m", [1.2, -0.9])
def test_the_lever_from_the_axle_to_the_antenna_is_measured_in_turns(ahead_m):
    recorded = poses()
    recorded.map_from_vehicle[:, :3, 3] += ahead_m * recorded.map_from_vehicle[:, :3, 0]
    found = {finding.check: finding for finding in check_heading(motion(recorded))}["origin"]
    assert found.status is Status.WARN
    assert found.value == pytest.approx(ahead_m, abs=0.1)


def test_a_straight_route_cannot_tell_where_the_origin_is():
    found = {finding.check: finding for finding in check_heading(motion(poses(turn_s=0.0)))}
    assert found["origin"].is_unobservable
    assert found["mirrored"].is_unobservable


def test_roll_and_pitch_in_degrees_are_no_vehicle_s():
    recorded = poses()
    roll = 0.5 * np.sin(recorded.stamp_s)  # .5 deg, taken for radians
    recorded.map_from_vehicle[:, :3, :3] = rotation_from_euler(roll, 0 * roll, yaw_of(recorded))
    found = motion(recorded)
    told = raised([*check_heading(found), *check_attitude(found)])
    assert list(told) == ["attitude"]
    assert "degrees taken for radians" in told["attitude"]


@pytest.mark.parametrize(
    ("factor", "check", "says"),
    [
        (1e3, "speed", "millimetres"),
        (1e2, "speed", "centimetres"),
        (1e-3, "path length", "kilometres"),
        (1 / 111_320, "path length", "degrees"),
    ],
)
def test_the_unit_of_positions_is_told(factor, check, says):
    recorded = poses()
    recorded.map_from_vehicle[:, :3, 3] *= factor
    told = raised(check_path(motion(recorded)))
    assert list(told) == [check]
    assert says in told[check]


def test_a_vehicle_that_stands_is_told_from_one_in_degrees():
    recorded = poses()
    recorded.map_from_vehicle[:, :3, 3] = np.random.default_rng(0).normal(0, 0.01, (len(recorded.stamp_s), 3))
    told = raised(check_path(motion(recorded)))
    assert "nowhere moves" in told["path length"]


def test_a_lost_fix_is_told_with_its_size_and_place():
    recorded = poses()
    recorded.map_from_vehicle[100:, 1, 3] += 0.5  # at 5 s
    told = raised(check_jumps(motion(recorded), NOISE))
    assert list(told) == ["position jumps"]
    assert "jumps by 0.48 m" in told["position jumps"]
    assert "at 4.95 s" in told["position jumps"] or "at 5.00 s" in told["position jumps"]


def test_stamps_that_jitter_are_no_lost_fix():
    recorded = poses()
    late_s = np.random.default_rng(0).normal(0.0, 0.2, len(recorded.stamp_s))
    stamp_s = np.maximum.accumulate(recorded.stamp_s + late_s) + 1e-6 * np.arange(len(late_s))
    told = raised(check_jumps(motion(Trajectory(stamp_s, recorded.map_from_vehicle)), NOISE))
    assert list(told) == ["pose stamps"]
    assert "as much along the path as across it" in told["pose stamps"]


def test_a_height_that_jumps_is_told_apart():
    recorded = poses()
    recorded.map_from_vehicle[100:, 2, 3] += 0.8
    assert list(raised(check_jumps(motion(recorded), NOISE))) == ["height jumps"]


def test_hard_braking_at_a_low_rate_is_no_jump():
    recorded = poses(turn_s=0.0, rate_hz=2.0)
    stamp_s = recorded.stamp_s
    braking_s = np.maximum(stamp_s - 4, 0)
    recorded.map_from_vehicle[:, 0, 3] = 30 * stamp_s - 3 * braking_s**2
    assert not raised(check_jumps(motion(recorded), NOISE))


@pytest.mark.parametrize(("sign", "status"), [(1.0, Status.PASS), (-1.0, Status.FAIL)])
def test_a_pitch_that_counts_nose_up_goes_against_the_grade(sign, status):
    recorded = poses(turn_s=0.0)
    x = recorded.map_from_vehicle[:, 0, 3]
    grade = 0.05 * np.sin(x / 6)
    recorded.map_from_vehicle[:, 2, 3] = -0.05 * 6 * np.cos(x / 6)
    zero = np.zeros(len(x))
    recorded.map_from_vehicle[:, :3, :3] = rotation_from_euler(zero, -sign * np.arctan(grade), zero)
    found = {finding.check: finding for finding in check_attitude(motion(recorded))}
    assert found["pitch sign"].status is status


@pytest.mark.parametrize("ahead", [0, 1])
def test_a_heading_made_from_positions_is_told_from_a_noisy_one(ahead):
    recorded = poses()
    step = np.diff(recorded.map_from_vehicle[:, :2, 3], axis=0)
    course = np.arctan2(step[:, 1], step[:, 0])
    followed = np.concatenate([course, course[-1:]] if ahead else [course[:1], course])
    off = np.random.default_rng(0).normal(0.0, np.std(np.diff(course)), len(followed))
    assert list(raised(check_noise(motion(with_yaw(recorded, followed)), NOISE))) == ["heading"]
    noisy = with_yaw(recorded, yaw_of(recorded) + off)
    assert list(raised(check_noise(motion(noisy), NOISE))) == ["pose scatter"]


def test_poses_that_scatter_as_stated_pass():
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
def test_a_noise_in_another_unit_is_told(stated, says):
    told = raised(check_noise(motion(poses()), replace(NOISE, **stated)))
    assert list(told) == ["pose noise"]
    assert says in told["pose noise"]


@pytest.mark.parametrize(("factor", "status"), [(6.0, Status.WARN), (30.0, Status.FAIL)])
def test_poses_noisier_than_stated_are_told(factor, status):
    recorded = poses()
    rng = np.random.default_rng(1)
    recorded.map_from_vehicle[:, :2, 3] += rng.normal(0, factor * NOISE.position_m, (320, 2))
    (found,) = [f for f in check_noise(motion(recorded), NOISE) if f.status is not Status.PASS]
    assert found.status is status
    assert found.value == pytest.approx(factor, rel=0.2)


def test_slow_poses_say_nothing_of_their_noise():
    slow = motion(poses(straight_s=40.0, rate_hz=2.0))
    assert not [finding for finding in check_noise(slow, PoseNoise()) if finding.check == "pose scatter"]


def test_noise_in_the_wrong_unit_stands_for_ground_that_cannot_be_matched_under_it():
    unit = Finding("pose noise", Status.WARN, 0.15, 0.01, "rad", "8.6 deg", "pose_noise.heading_rad")
    ground = Finding("ground match", Status.FAIL, 0.0, None, "", "no match", "front")
    told = causes([ground, unit])
    assert [(one.check, one.status) for one in told] == [("pose noise", Status.FAIL)]
