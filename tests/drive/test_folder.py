"""Drive folders: written and read, their files, and what the documents say of them."""

import logging
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tests.docs.blocks import blocks, document
from tests.drive.bags import messages_of, write_ros2
from tests.drive.example import (
    ORIGIN,
    camera_info,
    looking_forward,
    make_drive,
    make_truth,
    straight_trajectory,
)
from v2hdm.cli.main import run
from v2hdm.errors import DriveError
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.io.calibration.reading import ipm_from_guess, read_camera_info, take_ipm, take_roi
from v2hdm.io.calibration.writing import write_camera_info
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.drive.sources import IMAGE_SOURCES
from v2hdm.io.drive.truth import read_truth
from v2hdm.io.drive.writing import write_drive
from v2hdm.io.image_lists import read_image_list
from v2hdm.io.importers.poses import COMMON_KEYS, POSE_FORMATS, TOPIC_KEYS
from v2hdm.io.importers.readings import NAMES
from v2hdm.io.trajectory import read_tum, write_tum
from v2hdm.records import DISTORTION_COEFFICIENTS, CameraInfo, PoseNoise, unstated_clock_drift_s
from v2hdm.safe.pixels import read_header


def test_a_drive_that_was_written_is_read_back_as_it_was(tmp_path):
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
        np.testing.assert_array_equal(got.centre_prior.sigma_m, [0.02] * 3)


def test_a_read_out_time_comes_back_and_is_0_where_none_is_stated(tmp_path):
    written = make_drive(tmp_path)
    front = replace(written.cameras["front"], read_out_s=0.03)
    write_drive(tmp_path, replace(written, cameras=written.cameras | {"front": front}), straight_trajectory())
    read = read_drive(tmp_path).cameras
    assert (read["front"].read_out_s, read["rear"].read_out_s) == (0.03, 0.0)


def test_images_get_the_pose_at_their_time(tmp_path):
    make_drive(tmp_path)
    for image in read_drive(tmp_path).images:
        passed_s = image.stamp_s - 100.0
        np.testing.assert_allclose(image.map_from_vehicle[:3, 3], [5.0 * passed_s, 0.0, 0.0], atol=1e-9)
        yaw_rad = np.arctan2(image.map_from_vehicle[1, 0], image.map_from_vehicle[0, 0])
        assert yaw_rad == pytest.approx(0.1 * passed_s, abs=1e-9)


def test_the_truth_comes_back_in_the_order_of_the_images(tmp_path):
    written = make_truth(make_drive(tmp_path))
    truth = read_truth(read_drive(tmp_path))
    np.testing.assert_allclose(truth.map_from_vehicle, written.map_from_vehicle, atol=1e-9)
    np.testing.assert_array_equal(truth.visibility, written.visibility)
    np.testing.assert_array_equal(truth.lane_visible[0], [True, False, True])
    np.testing.assert_array_equal(truth.cam_from_vehicle["rear"], written.cam_from_vehicle["rear"])
    assert truth.disturbances == {"jitter_deg": 0.1}


def test_the_truth_of_one_camera_alone_has_its_own_rows_only(tmp_path):
    make_drive(tmp_path)
    drive = read_drive(tmp_path, ReadOptions(cameras=["rear"]))
    assert {image.camera for image in drive.images} == {"rear"}
    # Images alternate front, rear; rows 1 and 3 of the whole drive are the first two of the rear.
    np.testing.assert_array_equal(read_truth(drive).visibility[:, 0], [0.25, 0.5, 0.0])


def test_images_outside_the_poses_are_dropped_and_counted(tmp_path, caplog):
    make_drive(tmp_path, stamps=(99.0, 100.5, 103.0))
    with caplog.at_level(logging.WARNING):
        drive = read_drive(tmp_path)
    assert [image.stamp_s for image in drive.images] == [100.5, 100.5]
    assert "dropped 2 of 3 images of camera 'front'" in caplog.text


def test_a_drive_without_any_posed_image_is_refused(tmp_path):
    make_drive(tmp_path, stamps=(5.0, 6.0))
    with pytest.raises(DriveError, match="no image of camera 'front'"):
        read_drive(tmp_path)


def test_a_drift_that_is_not_stated_takes_half_of_its_variance():
    noise = PoseNoise.from_stated(position_m=0.01, heading_drift_rad=0.0)
    assert noise.position_drift_m == pytest.approx(0.01 / np.sqrt(2))
    assert noise.heading_drift_rad == 0.0
    assert noise.roll_pitch_drift_rad == pytest.approx(noise.roll_pitch_rad / np.sqrt(2))


def test_noise_that_is_not_stated_counts_by_its_mean_square():
    usual, noise = PoseNoise(), PoseNoise.from_stated(position_m=0.02)
    factor = np.exp(np.random.default_rng(0).uniform(np.log(1 / 3), np.log(3), 100_000))
    assert noise.position_m == usual.position_m
    assert noise.heading_rad == pytest.approx(usual.heading_rad * np.sqrt(np.mean(factor**2)), rel=0.01)
    assert noise.roll_pitch_rad / usual.roll_pitch_rad == noise.heading_rad / usual.heading_rad


def test_clocks_that_nobody_states_are_unknown_and_stated_ones_drift_no_more_than_they_are_off():
    unknown, stated = PoseNoise.from_stated(), PoseNoise.from_stated(clock_s=0.001)
    assert 0.01 < unknown.clock_s < unknown.clock_drift_s < 0.1
    assert (stated.clock_s, stated.clock_drift_s) == (0.001, 0.001)
    assert PoseNoise.from_stated(clock_s=0.001, clock_drift_s=0.0).clock_drift_s == 0.0


def test_uneven_stamps_were_read_from_a_clock_and_even_ones_may_have_been_counted():
    even_s = 0.1 * np.arange(100)
    uneven_s = even_s + np.random.default_rng(0).normal(0.0, 0.004, 100)
    counted_s = PoseNoise.from_stated().clock_drift_s
    assert unstated_clock_drift_s([even_s]) == counted_s
    assert unstated_clock_drift_s([np.round(even_s * 1.0037, 3)]) == counted_s
    assert unstated_clock_drift_s([np.delete(even_s, [20, 21, 60])]) == counted_s
    assert unstated_clock_drift_s([uneven_s]) == pytest.approx(0.005, rel=0.02)
    assert unstated_clock_drift_s([uneven_s, even_s]) == counted_s
    assert unstated_clock_drift_s([even_s[:2], np.empty(0)]) == counted_s
    assert unstated_clock_drift_s([20 * uneven_s]) == counted_s


def test_a_drive_with_uneven_stamps_drifts_less_unless_it_says_otherwise(tmp_path):
    make_drive(tmp_path, stamps=(100.05, 100.15, 100.29, 100.35, 100.48, 100.55))
    description = tmp_path / "drive.yaml"
    described = yaml.safe_load(description.read_text())
    for stated, drift_s in (
        ({}, 0.5 * 5e-4),
        ({"position_m": 0.01}, 0.5 * 5e-4),
        ({"clock_drift_s": 0.02}, 0.02),
        ({"clock_s": 0.01}, 0.01),
    ):
        description.write_text(yaml.safe_dump(described | {"pose_noise": stated}))
        assert read_drive(tmp_path).pose_noise.clock_drift_s == pytest.approx(drift_s)


def test_a_mask_of_the_vehicle_is_read_and_one_of_another_size_refused(tmp_path):
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
    with pytest.raises(DriveError, match=r"mask: .*bonnet\.png is not an image of 64 x 48 px"):
        read_drive(tmp_path)


def test_a_camera_is_called_as_the_drive_calls_it_whatever_its_calibration_says(tmp_path):
    make_drive(tmp_path)
    for name in ("front", "rear"):
        path = tmp_path / name / "camera_info.yaml"
        path.write_text(path.read_text().replace(f"camera_name: {name}", "camera_name: narrow_stereo"))
        assert "narrow_stereo" in path.read_text()
    assert {name: camera.info.name for name, camera in read_drive(tmp_path).cameras.items()} == {
        "front": "front",
        "rear": "rear",
    }


def test_a_trajectory_survives_its_file(tmp_path):
    written = straight_trajectory()
    write_tum(written, tmp_path / "poses.tum")
    got = read_tum(tmp_path / "poses.tum")
    np.testing.assert_array_equal(got.stamp_s, np.round(written.stamp_s, 9))
    np.testing.assert_allclose(got.map_from_vehicle, written.map_from_vehicle, atol=1e-9)


def test_comments_blank_lines_commas_and_rounded_quaternions_are_fine(tmp_path):
    path = tmp_path / "poses.tum"
    path.write_text("# stamp ...\n\n1,1,2,3,0,0,0.7071,0.7071\n2.5 1 2 3 0 0 0 -1\n")
    poses = read_tum(path).map_from_vehicle
    np.testing.assert_allclose(poses[0, :2, :2], [[0, -1], [1, 0]], atol=1e-12)
    np.testing.assert_allclose(poses[1, :3, :3], np.eye(3), atol=1e-12)


POSES = [(1.4e9 + k / 10, k / 2, -0.25 * k, 0.5, 0.0, 0.0, 0.6, 0.8) for k in range(21)]
"""Rows of times, places and quaternions xyzw."""

WAYS = {
    "tum": ("", lambda row: " ".join(f"{value:.9f}" for value in row)),
    "scientific, with tabs": ("", lambda row: "\t".join(f"{value:.18e}" for value in row)),
    "double and trailing blanks": (
        "# a\r\n",
        lambda row: "  ".join(f"{value:.9f}" for value in row) + "  \r",
    ),
    "semicolons and decimal commas": ("", lambda row: "; ".join(f"{v:.9f}" for v in row).replace(".", ",")),
    "blanks and decimal commas": (
        "",
        lambda row: " ".join(f"{value:.9f}" for value in row).replace(".", ","),
    ),
    "a byte order mark": ("\ufeff", lambda row: ",".join(f"{value:.9f}" for value in row)),
    "a line of names": (
        "timestamp tx ty tz qx qy qz qw\n",
        lambda row: " ".join(f"{value:.9f}" for value in row),
    ),
    "EuRoC": (
        "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n",
        lambda row: ",".join([f"{row[0] * 1e9:.0f}", *map(str, [*row[1:4], row[7], *row[4:7]])]),
    ),
    "EuRoC with velocities": (
        "#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v\n",
        lambda row: ",".join([f"{row[0] * 1e9:.0f}", *map(str, [*row[1:4], row[7], *row[4:7], 9.9])]),
    ),
    "nanoseconds": ("", lambda row: " ".join([f"{row[0] * 1e9:.0f}", *map(str, row[1:])])),
    "microseconds": ("", lambda row: " ".join([f"{row[0] * 1e6:.0f}", *map(str, row[1:])])),
}


@pytest.mark.parametrize(("title", "line"), WAYS.values(), ids=WAYS)
def test_trajectories_as_tools_write_them_are_the_same(title, line, tmp_path):
    path = tmp_path / "poses.tum"
    path.write_bytes((title + "\n".join(line(row) for row in POSES)).encode())
    got = read_tum(path)
    table = np.array(POSES)
    np.testing.assert_allclose(got.stamp_s, table[:, 0], atol=1e-6)
    np.testing.assert_allclose(got.map_from_vehicle[:, :3, 3], table[:, 1:4], atol=1e-9)
    yaw = 2 * np.arctan2(0.6, 0.8)
    np.testing.assert_allclose(got.map_from_vehicle[:, 0, 0], np.cos(yaw), atol=1e-9)
    np.testing.assert_allclose(got.map_from_vehicle[:, 1, 0], np.sin(yaw), atol=1e-9)


def test_poses_without_numbers_and_of_equal_times_are_left_out_and_counted(tmp_path, caplog):
    lines = [" ".join(map(str, row)) for row in POSES]
    lines[3] = f"{POSES[3][0]} NaN NaN NaN NaN NaN NaN NaN"
    lines[7] = lines[6]
    lines[9], lines[10] = lines[10], lines[9]
    path = tmp_path / "poses.tum"
    path.write_text("\n".join(lines))
    got = read_tum(path)
    rows = np.delete(np.array(POSES), (3, 7), axis=0)
    np.testing.assert_allclose(got.stamp_s, rows[:, 0], atol=1e-6)
    np.testing.assert_allclose(got.map_from_vehicle[:, 0, 3], rows[:, 1])
    assert "left out 1 of 21 poses that are not numbers" in caplog.text
    assert "left out 1 of 20 poses of equal or stray times" in caplog.text
    assert "sorted its poses by time: 1 came late" in caplog.text


def test_a_zero_time_among_good_ones_is_left_out_and_counted(tmp_path, caplog):
    rows = [list(row) for row in POSES]
    rows[5][0] = 0.0
    path = tmp_path / "poses.tum"
    path.write_text("\n".join(" ".join(map(str, row)) for row in rows))
    np.testing.assert_allclose(read_tum(path).stamp_s, np.delete(np.array(POSES)[:, 0], 5))
    assert "left out 1 of 21 times that are out of order" in caplog.text


def test_file_names_may_hold_blanks(tmp_path):
    (tmp_path / "images.txt").write_text("1.5 images/my picture.png\n")
    assert read_image_list(tmp_path / "images.txt")[1] == ["images/my picture.png"]


@pytest.mark.parametrize("model", DISTORTION_COEFFICIENTS)
def test_intrinsics_survive_their_file_with_every_lens(tmp_path, model):
    coefficients = tuple(0.1 / (n + 3) for n in range(DISTORTION_COEFFICIENTS[model]))
    written = CameraInfo("left", 640, 480, camera_info().intrinsic / 3 * [[3], [3], [3]], model, coefficients)
    write_camera_info(written, tmp_path / "camera_info.yaml")
    got = read_camera_info(tmp_path / "camera_info.yaml")
    np.testing.assert_array_equal(got.intrinsic, written.intrinsic)
    assert (got.name, got.width, got.height, got.distortion_model) == ("left", 640, 480, model)
    assert got.distortion == coefficients


def test_a_progressive_jpeg_with_a_comment_has_a_size_too(tmp_path):
    path = tmp_path / "image.jpg"
    cv2.imwrite(str(path), np.zeros((17, 19, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    jpeg = path.read_bytes()
    # A comment segment that holds something like a start of frame.
    path.write_bytes(jpeg[:2] + b"\xff\xfe\x00\x0b\xff\xc0\x00\x11\x08\x00\x01\x00\x01" + jpeg[2:])
    assert (read_header(path).width, read_header(path).height) == (19, 17)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@given(share=st.floats(0.0, 0.999))
def test_every_truncation_is_noticed(tmp_path_factory, suffix, share):
    path = tmp_path_factory.mktemp("image") / f"image{suffix}"
    noise = np.random.default_rng(1).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    assert cv2.imwrite(str(path), noise)
    content = path.read_bytes()
    path.write_bytes(content[: max(8, int(share * (len(content) - 12)))])
    with pytest.raises(DriveError, match="truncated"):
        read_header(path)


def test_a_guess_of_the_extrinsic_gives_the_ipm_of_that_camera():
    info, guess = camera_info(), looking_forward(1.8, 0.25)
    ipm = ipm_from_guess(info, guess.tolist(), "here")
    np.testing.assert_allclose(ipm, ipm_from_extrinsic(info, guess), atol=1e-15)
    # By hand: the optical axis meets the ground at height / tan(pitch) ahead.
    centre = ipm @ [info.intrinsic[0, 2], info.intrinsic[1, 2], 1.0]
    np.testing.assert_allclose(centre[:2] / centre[2], [1.8 / np.tan(0.25), 0.0], atol=1e-12)


@given(st.floats(-6, 6))
def test_the_scale_of_an_ipm_is_of_no_matter(exponent):
    ipm = ipm_from_extrinsic(camera_info(), looking_forward())
    np.testing.assert_allclose(take_ipm((ipm * 10.0**exponent).tolist(), "here"), ipm, rtol=1e-9)


@given(st.integers(3, 12), st.booleans())
def test_convex_polygons_pass_and_come_out_counter_clockwise(corners, clockwise):
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False) * (-1 if clockwise else 1)
    polygon = np.column_stack([10 + 4 * np.cos(angle), 2 * np.sin(angle)])
    roi = take_roi(polygon.tolist(), "here")
    x, y = roi.T
    assert x @ np.roll(y, -1) - y @ np.roll(x, -1) > 0


def test_a_star_turns_one_way_but_is_not_convex():
    angle = np.arange(5) * 4 * np.pi / 5
    with pytest.raises(DriveError, match="not convex"):
        take_roi(np.column_stack([np.cos(angle), np.sin(angle)]).tolist(), "here")


BLOCKS = [block.text for block in blocks("docs/drive-format.md", "yaml")]


def test_the_documented_drive_reads_and_its_cameras_look_at_their_rois(tmp_path):
    make_drive(tmp_path)
    (tmp_path / "drive.yaml").write_text(BLOCKS[0])
    for name in ("front", "rear"):
        (tmp_path / name / "camera_info.yaml").write_text(BLOCKS[1])
        for image in (tmp_path / name / "images").iterdir():
            cv2.imwrite(str(image), np.zeros((720, 1280, 3), np.uint8))
    drive = read_drive(tmp_path)
    assert drive.name == "quay-7"
    for camera in drive.cameras.values():
        pinhole_px = np.linalg.inv(camera.ipm["estimated"]) @ [*camera.roi_vehicle.mean(axis=0), 1.0]
        u, v = pinhole_px[:2] / pinhole_px[2]
        assert 500 < u < 780
        assert 300 < v < 720


TEXT = document("docs/bags.md")


@pytest.fixture
def site(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    make_drive(folder)
    return write_ros2(tmp_path / "site", messages_of(folder))


def test_the_documented_listing_ends_in_a_description_that_is_read(site, capsys, monkeypatch):
    monkeypatch.chdir(site.parent)
    assert run(["check", "site", "--list-topics"]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"/odom +21  nav_msgs/msg/Odometry", printed)
    Path("drive.yaml").write_text(printed.split("# drive.yaml\n")[1])
    assert len(read_drive(site.parent).images) == 6


def test_the_documented_description_reads(site):
    (block,) = blocks("docs/bags.md", "yaml")
    (site.parent / "drive.yaml").write_text(block.text)
    shutil.rmtree(site.parent / "folder")
    drive = read_drive(site.parent, ReadOptions(cache=str(site.parent / "cache")))
    assert [image.camera for image in drive.images] == ["front"] * 3


def test_every_key_and_column_is_documented():
    described: list[Any] = [yaml.safe_load(text) for text in re.findall(r"`(\{.*?\})`", TEXT)]
    used = {key for entry in described for key in entry}
    assert {*POSE_FORMATS, *IMAGE_SOURCES, *TOPIC_KEYS} - {"stamps"} <= used
    for name in (*COMMON_KEYS, *NAMES):
        assert f"`{name}`" in TEXT, name
