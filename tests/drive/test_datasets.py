"""KITTI's drives."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from v2hdm.errors import DriveError
from v2hdm.geometry.geodetic import geodetic_from_enu
from v2hdm.io.drive import KittiOptions, ReadOptions, read_drive
from v2hdm.records import GeodeticOrigin

START = GeodeticOrigin(49.0, 8.4, 115.0)
STEP_M = 2.0
GRADE, CROSS_FALL_RAD, MOUNT_PITCH_RAD = 0.03, 0.025, 0.01
CAMERA_IN_IMU = np.array([1.1, -0.25, 0.7])

CAM_TO_CAM = """calib_time: 09-Jan-2012 13:57:47
R_rect_00: 1 0 0 0 1 0 0 0 1
S_rect_02: 64 48
P_rect_02: 50 0 31.5 -12.5 0 50 23.5 0 0 0 1 0
"""
# Camera 0 looks along the IMU's x; camera 2 is 0.25 m to its right.
VELO_TO_CAM = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n"
IMU_TO_VELO = "R: 1 0 0 0 1 0 0 0 1\nT: -1.1 0 -0.7\n"


def straight_up_a_hill(length):
    """Position (P, 3) and roll, pitch, yaw (P, 3) of an IMU on a road that climbs to the north-east."""
    along_m = STEP_M * np.arange(length)
    yaw = np.pi / 4
    position = np.column_stack([along_m * np.cos(yaw), along_m * np.sin(yaw), GRADE * along_m])
    attitude = np.tile([CROSS_FALL_RAD, MOUNT_PITCH_RAD - np.arctan(GRADE), yaw], (length, 1))
    return position, attitude


def make_kitti(date, length=40, suffix=".png"):
    """A KITTI raw folder with one camera, up a straight hill; returns the drive's folder."""
    drive = date / f"{date.name}_drive_0001_sync"
    for folder in ("image_02/data", "oxts/data"):
        (drive / folder).mkdir(parents=True)
    (date / "calib_cam_to_cam.txt").write_text(CAM_TO_CAM)
    (date / "calib_velo_to_cam.txt").write_text(VELO_TO_CAM)
    (date / "calib_imu_to_velo.txt").write_text(IMU_TO_VELO)
    position, attitude = straight_up_a_hill(length)
    for k, geodetic in enumerate(geodetic_from_enu(START, position)):
        values = [*(repr(float(v)) for v in geodetic), *(repr(float(v)) for v in attitude[k]), *["0"] * 24]
        (drive / "oxts/data" / f"{k:010d}.txt").write_text(" ".join(values) + "\n")
        cv2.imwrite(str(drive / "image_02/data" / f"{k:010d}{suffix}"), np.zeros((48, 64, 3), np.uint8))
    stamps = "".join(f"2011-09-26 13:10:{k // 10:02d}.{k % 10}00000000\n" for k in range(length))
    (drive / "image_02/timestamps.txt").write_text(stamps)
    (drive / "oxts/timestamps.txt").write_text(stamps)
    return drive


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_kitti_drive_is_recognised_and_laid_flat(tmp_path, suffix):
    drive = read_drive(make_kitti(tmp_path / "2011_09_26", suffix=suffix))
    assert len(drive.images) == 40
    poses = np.array([image.map_from_vehicle for image in drive.images])
    np.testing.assert_array_equal(poses[:, 2, 3], 0.0)
    # Neither the hill nor the cross-fall nor the sensor's mount is left in the attitude.
    np.testing.assert_allclose(poses[:, 2, 2], 1.0, atol=1e-8)
    # On the cross-fall, the vehicle's axis and that of a sensor pitched on it have not quite one heading.
    heading = np.pi / 4 - MOUNT_PITCH_RAD * CROSS_FALL_RAD
    np.testing.assert_allclose(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]), heading, atol=1e-5)
    steps = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps, STEP_M, atol=1e-5)


def test_the_road_has_the_recorded_height_above_the_map_s_origin(tmp_path):
    road = read_drive(make_kitti(tmp_path / "2011_09_26")).road
    along_m = STEP_M * np.arange(40)
    np.testing.assert_allclose(road.height_m, GRADE * along_m, atol=0.01)
    np.testing.assert_allclose(road.slope @ [np.sqrt(0.5), np.sqrt(0.5)], GRADE, atol=1e-4)


def test_times_are_those_of_the_images(tmp_path):
    drive = read_drive(make_kitti(tmp_path / "2011_09_26"))
    # 2011-09-26 13:10:00 UTC
    assert drive.images[13].stamp_s == pytest.approx(1317042600 + 1.3, abs=1e-6)


def test_the_camera_sits_where_the_chain_and_the_height_put_it(tmp_path):
    options = ReadOptions(kitti=KittiOptions(camera_height_m=1.7))
    camera = read_drive(make_kitti(tmp_path / "2011_09_26"), options).cameras["image_02"]
    expected = CAMERA_IN_IMU.copy()
    expected[0] += np.sin(MOUNT_PITCH_RAD) * CAMERA_IN_IMU[2]
    expected[2] = 1.7
    np.testing.assert_allclose(camera.centre_prior.centre_vehicle, expected, atol=1e-4)
    # The axis points down by the mount's pitch: it meets the road at height / tan(pitch) ahead.
    centre = camera.ipm["estimated"] @ [31.5, 23.5, 1.0]
    ahead_m = 1.7 / np.tan(MOUNT_PITCH_RAD)
    np.testing.assert_allclose(centre[:2] / centre[2], [expected[0] + ahead_m, -0.25], rtol=1e-3)


def test_the_origin_lies_on_the_road_below_the_first_pose(tmp_path):
    origin = read_drive(make_kitti(tmp_path / "2011_09_26")).origin
    assert origin.altitude_m == pytest.approx(START.altitude_m - (1.65 - 0.7), abs=0.02)


def test_without_its_own_times_line_k_of_oxts_belongs_to_image_k(tmp_path):
    drive = make_kitti(tmp_path / "2011_09_26")
    (drive / "oxts/timestamps.txt").unlink()
    assert len(read_drive(drive).images) == 40


def test_images_may_begin_in_the_middle_of_the_recording(tmp_path):
    path = make_kitti(tmp_path / "2011_09_26")
    for k in range(15):
        (path / "image_02/data" / f"{k:010d}.png").unlink()
    images = read_drive(path).images
    assert len(images) == 25
    assert images[0].map_from_vehicle[0, 3] == pytest.approx(15 * STEP_M * np.cos(np.pi / 4), abs=0.05)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("../calib_cam_to_cam.txt", None, "calib_cam_to_cam.txt: no such file"),
        ("../calib_cam_to_cam.txt", "R_rect_00: 1", "no entry 'P_rect_02'"),
        ("../calib_imu_to_velo.txt", "R: 1 2\nT: 0 0 0\n", "R: expected 9 numbers"),
        ("oxts/data/0000000003.txt", "1 2 3", "0000000003.txt: expected 30 finite numbers, got 3"),
        ("oxts/data/0000000003.txt", "nan " * 30, "expected 30 finite numbers"),
        ("oxts/timestamps.txt", "yesterday\n", "line 1: expected 'YYYY-MM-DD"),
        ("image_02/timestamps.txt", "2011-09-26 13:10:04.7\n", "1 lines, but image 39 exists"),
    ],
)
def test_damage_is_named(tmp_path, file, content, message):
    drive = make_kitti(tmp_path / "2011_09_26")
    if content is None:
        (drive / file).unlink()
    else:
        (drive / file).write_text(content)
    with pytest.raises(DriveError, match=message):
        read_drive(drive)


def real_drive():
    beside = Path(__file__).parents[2].parent / "shared/data/kitti_raw/2011_09_26/2011_09_26_drive_0011_sync"
    return Path(os.environ.get("V2HDM_KITTI", beside))


@pytest.mark.skipif(
    not real_drive().is_dir(), reason="KITTI raw drive 0011 is absent; V2HDM_KITTI names its folder"
)
def test_the_real_drive_reads_as_its_data_sheet_says():
    drive = read_drive(real_drive())
    camera = drive.cameras["image_02"]
    assert (camera.info.width, camera.info.height) == (1242, 375)
    assert camera.info.intrinsic[0, 0] == pytest.approx(721.5377)
    track = np.array([image.map_from_vehicle[:3, 3] for image in drive.images])
    assert np.linalg.norm(np.diff(track, axis=0), axis=1).sum() == pytest.approx(98.0, abs=1.5)
    np.testing.assert_allclose(camera.centre_prior.centre_vehicle, [1.08, -0.25, 1.65], atol=0.02)
