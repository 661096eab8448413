"""Poses between poses, several drives as one, and clocks that are off."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from tests.drive.example import make_drive, straight_trajectory
from v2hdm.association.sightings import frames_of
from v2hdm.errors import DriveError
from v2hdm.geometry.geodetic import enu_from_geodetic, geodetic_from_enu
from v2hdm.geometry.rigid import (
    heading_rad,
    interpolate,
    quaternion_from_rotation,
    rotation_from_euler,
    rotation_from_quaternion,
)
from v2hdm.io.drive import join_drives, read_drive, with_clock_offsets
from v2hdm.io.trajectory import check_trajectory
from v2hdm.records import FloatArray, GeodeticOrigin, PoseNoise, Trajectory

SEEDS = st.integers(0, 2**32 - 1)


def random_trajectory(seed, length=6):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (length, 1, 1))
    poses[:, :3, :3] = Rotation.random(length, rng).as_matrix()
    poses[:, :3, 3] = rng.normal(scale=50.0, size=(length, 3))
    return Trajectory(np.cumsum(rng.uniform(0.05, 0.2, length)), poses)


@given(SEEDS)
def test_quaternions_agree_with_scipy_and_return_to_the_same_rotation(seed):
    rotation = Rotation.random(20, np.random.default_rng(seed)).as_matrix()
    quaternion = quaternion_from_rotation(rotation)
    np.testing.assert_allclose(quaternion, Rotation.from_matrix(rotation).as_quat(canonical=True), atol=1e-12)
    np.testing.assert_allclose(rotation_from_quaternion(quaternion), rotation, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_survive_the_way_through_a_quaternion(axis):
    half_turn = -np.eye(3)
    half_turn[axis, axis] = 1.0
    np.testing.assert_allclose(
        rotation_from_quaternion(quaternion_from_rotation(half_turn[None]))[0], half_turn, atol=1e-15
    )


@given(SEEDS)
def test_euler_angles_mean_what_scipy_means_by_fixed_axes(seed):
    angles = np.random.default_rng(seed).uniform(-1.5, 1.5, (5, 3))
    np.testing.assert_allclose(
        rotation_from_euler(*angles.T), Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-14
    )


@given(SEEDS, st.floats(0.0, 1.0))
def test_between_two_poses_rotations_agree_with_scipy_s_slerp_and_places_lie_on_a_line(seed, fraction):
    ends = Rotation.random(2, np.random.default_rng(seed))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, :3] = ends.as_matrix()
    poses[1, :3, 3] = 3.0, -6.0, 9.0
    got, _ = interpolate(Trajectory(np.arange(2.0), poses), np.array([fraction]), max_gap_s=2.0)
    np.testing.assert_allclose(got[0, :3, 3], fraction * poses[1, :3, 3], atol=1e-12)
    np.testing.assert_allclose(got[0, :3, :3], Slerp([0, 1], ends)(fraction).as_matrix(), atol=1e-9)


@given(SEEDS)
def test_recorded_times_return_the_recorded_poses(seed):
    trajectory = random_trajectory(seed)
    poses, inside = interpolate(trajectory, trajectory.stamp_s, max_gap_s=0.001)
    assert inside.all()
    np.testing.assert_allclose(poses, trajectory.map_from_vehicle, atol=1e-9)


@given(SEEDS, st.floats(0.01, 0.99))
def test_interpolating_does_not_depend_on_the_map_frame(seed, fraction):
    trajectory = random_trajectory(seed)
    stamp_s = np.array([trajectory.stamp_s[0] * (1 - fraction) + trajectory.stamp_s[-1] * fraction])
    other_from_map = random_trajectory(seed + 1).map_from_vehicle[0]
    moved = Trajectory(trajectory.stamp_s, other_from_map @ trajectory.map_from_vehicle)
    expected = other_from_map @ interpolate(trajectory, stamp_s, 1.0)[0]
    np.testing.assert_allclose(interpolate(moved, stamp_s, 1.0)[0], expected, atol=1e-8)


def without_middle():
    """Poses at 100.0 to 100.5 s and, after a gap, at 101.5 to 102.0 s."""
    whole = straight_trajectory()
    keep = np.abs(whole.stamp_s - 101.0) > 0.45
    return Trajectory(whole.stamp_s[keep], whole.map_from_vehicle[keep])


def test_nothing_is_extrapolated_nor_carried_across_a_gap():
    stamps_s = np.array([99.999, 100.0, 100.5, 100.51, 101.0, 101.5, 102.0, 102.001])
    poses, inside = interpolate(without_middle(), stamps_s, max_gap_s=0.5)
    assert inside.tolist() == [False, True, True, False, False, True, True, False]
    assert np.isfinite(poses).all()


def test_a_generous_limit_bridges_the_gap():
    poses, inside = interpolate(without_middle(), np.array([101.0]), max_gap_s=1.01)
    assert inside.all()
    np.testing.assert_allclose(poses[0, 0, 3], 5.0, atol=1e-6)


@pytest.mark.parametrize("is_on_earth", [True, False])
def test_poses_that_change_their_utm_zone_on_the_way_are_refused_with_the_place(is_on_earth):
    """As drivers of receivers do at 12 degrees east, from zone 32 to 33; a ferry goes as far in hours."""
    poses = straight_trajectory()
    moved = poses.map_from_vehicle.copy()
    moved[3:, 0, 3] -= 397_000.0
    origin = GeodeticOrigin(53.5, 12.0, 10.0) if is_on_earth else None
    with pytest.raises(DriveError, match=r"leap by 397 km at .* s, as where coordinates change"):
        check_trajectory(replace(poses, map_from_vehicle=moved), origin, "here")
    later_s = poses.stamp_s + np.where(np.arange(len(moved)) >= 3, 7200.0, 0.0)
    check_trajectory(Trajectory(later_s, moved), None, "here")


def test_a_single_pose_serves_its_own_time_only():
    single = Trajectory(np.array([7.0]), np.eye(4)[None])
    times: FloatArray = np.array([6.0, 7.0, 8.0])
    assert interpolate(single, times, 1.0)[1].tolist() == [False, True, False]


ORIGIN = GeodeticOrigin(50.0, 8.0, 120.0)


@pytest.fixture
def drives(tmp_path):
    """One drive, recorded twice."""
    out = []
    for name in ("monday", "friday"):
        (tmp_path / name).mkdir()
        make_drive(tmp_path / name)
        out.append(replace(read_drive(tmp_path / name), name=name, origin=ORIGIN))
    return out


def test_a_drive_alone_stays_as_it_is(drives):
    assert join_drives(drives[:1]) is drives[0]


def test_drives_of_one_rig_share_its_cameras_and_no_frame(drives):
    drives[1] = replace(drives[1], pose_noise=PoseNoise(0.05, 1e-4, 0.004))
    joined = join_drives(drives)
    assert list(joined.cameras) == list(drives[0].cameras)
    assert joined.name == "monday+friday"
    frames = frames_of(joined)
    alone = len(frames_of(drives[0]).stamp_s)
    assert frames.session.tolist() == [0] * alone + [1] * alone
    assert [image.session for image in joined.images] == sorted(image.session for image in joined.images)
    assert joined.noises == (drives[0].pose_noise, drives[1].pose_noise)
    assert joined.pose_noise.position_m == 0.05
    assert joined.pose_noise.heading_rad == max(drives[0].pose_noise.heading_rad, 1e-4)


def test_a_frame_of_another_origin_is_moved_to_its_place_on_the_earth(drives):
    far_origin = GeodeticOrigin(50.002, 8.003, 121.0)
    here_from_there = enu_from_geodetic(ORIGIN, np.array([[50.002, 8.003, 121.0]]))[0]
    image = drives[1].images[0].map_from_vehicle
    # The same place, written in the other frame.
    geodetic = geodetic_from_enu(ORIGIN, image[:3, 3][None])
    local = enu_from_geodetic(far_origin, geodetic)[0]
    moved = [
        replace(later, map_from_vehicle=_shifted(later.map_from_vehicle, local[:2] - image[:2, 3]))
        for later in drives[1].images
    ]
    joined = join_drives([drives[0], replace(drives[1], origin=far_origin, images=moved)])
    back = next(image for image in joined.images if image.session == 1).map_from_vehicle
    assert back[:2, 3] == pytest.approx(image[:2, 3], abs=2e-3)
    # The meridians converge by the difference of longitude times the sine of the latitude.
    convergence = np.radians(0.003) * np.sin(np.radians(50.0))
    turned = heading_rad(back[None])[0] - heading_rad(image[None])[0]
    assert turned == pytest.approx(convergence, rel=0.01)
    assert np.linalg.norm(here_from_there[:2]) > 200


def _shifted(pose, by_m):
    out = pose.copy()
    out[:2, 3] += by_m
    return out


def test_a_camera_with_another_lens_or_mounting_is_another_camera(drives, caplog):
    name, camera = next(iter(drives[1].cameras.items()))
    intrinsic = camera.info.intrinsic * np.array([[1.01, 1, 1], [1, 1.01, 1], [1, 1, 1]])
    zoomed = replace(camera, info=replace(camera.info, intrinsic=intrinsic))
    joined = join_drives([drives[0], replace(drives[1], cameras={**drives[1].cameras, name: zoomed})])
    assert f"{name}@friday" in joined.cameras
    assert joined.cameras[f"{name}@friday"].info.name == f"{name}@friday"
    assert {image.camera for image in joined.images if image.session == 1} >= {f"{name}@friday"}
    assert f"calibrated separately, as {name}@friday" in caplog.text
    joined_apart = join_drives(drives, [(1, name)])
    assert f"{name}@friday" in joined_apart.cameras


def test_drives_that_have_nothing_in_common_are_refused(drives):
    with pytest.raises(DriveError, match="given twice"):
        join_drives([drives[0], drives[0]])
    with pytest.raises(DriveError, match="friday: has no origin, but other drives have"):
        join_drives([drives[0], replace(drives[1], origin=None)])
    with pytest.raises(DriveError, match="several datums"):
        join_drives([drives[0], replace(drives[1], origin=replace(ORIGIN, datum="ETRS89"))])
    with pytest.raises(DriveError, match=r"comes no nearer than .* m to the other"):
        join_drives([drives[0], replace(drives[1], origin=replace(ORIGIN, latitude_deg=50.1))])


def test_drives_without_origins_are_taken_to_share_a_frame(drives, caplog):
    join_drives([replace(drive, origin=None) for drive in drives])
    assert "assumed to share one frame" in caplog.text


def test_each_session_has_clocks_of_its_own(drives):
    joined = join_drives(drives)
    name = next(iter(joined.cameras))
    moved = with_clock_offsets(joined, {name: 0.05}, max_gap_s=1.0, session=1)
    offsets = {(image.session, image.camera): image.clock_offset_s for image in moved.images}
    assert offsets[0, name] == 0.0
    assert offsets[1, name] == 0.05


def test_images_taken_later_than_stamped_lie_further_along_the_route(tmp_path):
    make_drive(tmp_path)
    drive = read_drive(tmp_path)
    late = with_clock_offsets(drive, {"front": 0.1}, 0.5)
    before = [image for image in drive.images if image.camera == "front"]
    after = [image for image in late.images if image.camera == "front"]
    moved_m = [
        b.map_from_vehicle[0, 3] - a.map_from_vehicle[0, 3] for a, b in zip(before, after, strict=True)
    ]
    np.testing.assert_allclose(moved_m, 0.5, atol=1e-9)  # 5 m/s for 0.1 s
    assert [image.stamp_s for image in after] == [image.stamp_s for image in before]


def test_cameras_of_one_stamp_but_two_clocks_are_frames_of_their_own(tmp_path):
    make_drive(tmp_path)
    drive = read_drive(tmp_path)
    late = with_clock_offsets(drive, {"front": 0.1}, 0.5)
    assert len(frames_of(late).stamp_s) == 2 * len(frames_of(drive).stamp_s)


def test_without_an_offset_nothing_changes(tmp_path):
    make_drive(tmp_path)
    drive = read_drive(tmp_path)
    same = with_clock_offsets(drive, {}, 0.5)
    assert [image.path for image in same.images] == [image.path for image in drive.images]


def test_an_offset_beyond_the_recorded_poses_is_refused_by_the_cameras_name(tmp_path):
    make_drive(tmp_path)
    with pytest.raises(DriveError, match="'front'"):
        with_clock_offsets(read_drive(tmp_path), {"front": 60.0}, 0.5)
