from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.drive.example import ORIGIN, make_drive, make_truth
from v2hdm.errors import DriveError
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.records import PoseNoise


def test_a_drive_that_was_written_is_read_back_as_it_was(tmp_path: Path) -> None:
    written = make_drive(tmp_path)
    drive = read_drive(tmp_path)
    assert drive.name == "example"
    assert drive.origin == ORIGIN
    assert drive.pose_noise == written.pose_noise
    assert drive.truth_dir == tmp_path / "truth"
    assert [image.path for image in drive.images] == [image.path for image in written.images]
    assert [image.stamp_s for image in drive.images] == [image.stamp_s for image in written.images]
    for name, camera in written.cameras.items():
        got = drive.cameras[name]
        np.testing.assert_array_equal(got.info.intrinsic, camera.info.intrinsic)
        assert got.info.distortion == camera.info.distortion
        assert (got.info.width, got.info.height, got.info.name) == (64, 48, name)
        for key, ipm in camera.ipm.items():
            np.testing.assert_allclose(got.ipm[key], ipm, rtol=1e-12)
        np.testing.assert_array_equal(got.roi_vehicle, camera.roi_vehicle)
        assert got.centre_prior is not None
        np.testing.assert_array_equal(got.centre_prior.sigma_m, [0.02] * 3)


def test_images_get_the_pose_at_their_time(tmp_path: Path) -> None:
    make_drive(tmp_path)
    for image in read_drive(tmp_path).images:
        passed_s = image.stamp_s - 100.0
        np.testing.assert_allclose(image.map_from_vehicle[:3, 3], [5.0 * passed_s, 0.0, 0.0], atol=1e-9)
        yaw_rad = np.arctan2(image.map_from_vehicle[1, 0], image.map_from_vehicle[0, 0])
        assert yaw_rad == pytest.approx(0.1 * passed_s, abs=1e-9)


def test_the_truth_comes_back_in_the_order_of_the_images(tmp_path: Path) -> None:
    written = make_truth(make_drive(tmp_path))
    truth = read_truth(read_drive(tmp_path))
    np.testing.assert_allclose(truth.map_from_vehicle, written.map_from_vehicle, atol=1e-9)
    np.testing.assert_array_equal(truth.visibility, written.visibility)
    np.testing.assert_array_equal(truth.lane_visible[0], [True, False, True])
    np.testing.assert_array_equal(truth.cam_from_vehicle["rear"], written.cam_from_vehicle["rear"])
    assert truth.disturbances == {"jitter_deg": 0.1}


def test_the_truth_of_one_camera_alone_has_its_own_rows_only(tmp_path: Path) -> None:
    make_drive(tmp_path)
    drive = read_drive(tmp_path, ReadOptions(cameras=["rear"]))
    assert {image.camera for image in drive.images} == {"rear"}
    # Images alternate front, rear; rows 1 and 3 of the whole drive are the first two of the rear.
    np.testing.assert_array_equal(read_truth(drive).visibility[:, 0], [0.25, 0.5, 0.0])


def test_images_outside_the_poses_are_dropped_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    make_drive(tmp_path, stamps=(99.0, 100.5, 103.0))
    with caplog.at_level(logging.WARNING):
        drive = read_drive(tmp_path)
    assert [image.stamp_s for image in drive.images] == [100.5, 100.5]
    assert "dropped 2 of 3 images of camera 'front'" in caplog.text


def test_a_drive_without_any_posed_image_is_refused(tmp_path: Path) -> None:
    make_drive(tmp_path, stamps=(5.0, 6.0))
    with pytest.raises(DriveError, match="no image of camera 'front'"):
        read_drive(tmp_path)


def test_a_drift_that_is_not_stated_takes_half_of_its_variance() -> None:
    noise = PoseNoise.as_far_as_stated(position_m=0.01, heading_drift_rad=0.0)
    assert noise.position_drift_m == pytest.approx(0.01 / np.sqrt(2))
    assert noise.heading_drift_rad == 0.0
    assert noise.roll_pitch_drift_rad == pytest.approx(0.003 / np.sqrt(2))


def test_a_mask_of_the_vehicle_is_read_and_one_of_another_size_refused(tmp_path: Path) -> None:
    make_drive(tmp_path)
    mask = np.zeros((48, 64), dtype=np.uint8)
    mask[40:] = 255
    cv2.imwrite(str(tmp_path / "front" / "bonnet.png"), mask)
    description = tmp_path / "drive.yaml"
    text = description.read_text()
    description.write_text(text.replace("  front:\n", "  front:\n    mask: front/bonnet.png\n"))
    camera = read_drive(tmp_path).cameras["front"]
    assert camera.own_vehicle is not None
    np.testing.assert_array_equal(camera.own_vehicle, mask > 0)
    cv2.imwrite(str(tmp_path / "front" / "bonnet.png"), mask[:20])
    with pytest.raises(DriveError, match=r"mask: .*bonnet\.png is no image of 64 x 48 px"):
        read_drive(tmp_path)


def test_a_camera_is_called_as_the_drive_calls_it_whatever_its_calibration_says(tmp_path: Path) -> None:
    make_drive(tmp_path)
    for name in ("front", "rear"):
        path = tmp_path / name / "camera_info.yaml"
        path.write_text(path.read_text().replace(f"camera_name: {name}", "camera_name: narrow_stereo"))
        assert "narrow_stereo" in path.read_text()
    assert {name: camera.info.name for name, camera in read_drive(tmp_path).cameras.items()} == {
        "front": "front",
        "rear": "rear",
    }
