from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.example import camera_info, looking_forward, straight_trajectory
from v2hdm.errors import DriveError
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.io.calibration import read_camera_info, write_camera_info
from v2hdm.io.calibration.mounting import ipm_from_guess, take_ipm, take_roi
from v2hdm.io.safe.pixels import read_header
from v2hdm.io.trajectory import read_image_list, read_tum, write_tum
from v2hdm.records import DISTORTION_COEFFICIENTS, CameraInfo


def test_a_trajectory_survives_its_file(tmp_path: Path) -> None:
    written = straight_trajectory()
    write_tum(written, tmp_path / "poses.tum")
    got = read_tum(tmp_path / "poses.tum")
    np.testing.assert_array_equal(got.stamp_s, np.round(written.stamp_s, 9))
    np.testing.assert_allclose(got.map_from_vehicle, written.map_from_vehicle, atol=1e-9)


def test_comments_blank_lines_commas_and_rounded_quaternions_are_fine(tmp_path: Path) -> None:
    path = tmp_path / "poses.tum"
    path.write_text("# stamp ...\n\n1,1,2,3,0,0,0.7071,0.7071\n2.5 1 2 3 0 0 0 -1\n")
    poses = read_tum(path).map_from_vehicle
    np.testing.assert_allclose(poses[0, :2, :2], [[0, -1], [1, 0]], atol=1e-12)
    np.testing.assert_allclose(poses[1, :3, :3], np.eye(3), atol=1e-12)


def test_file_names_may_hold_blanks(tmp_path: Path) -> None:
    (tmp_path / "images.txt").write_text("1.5 images/my picture.png\n")
    assert read_image_list(tmp_path / "images.txt")[1] == ["images/my picture.png"]


@pytest.mark.parametrize("model", DISTORTION_COEFFICIENTS)
def test_intrinsics_survive_their_file_with_every_lens(tmp_path: Path, model: str) -> None:
    coefficients = tuple(0.1 / (n + 3) for n in range(DISTORTION_COEFFICIENTS[model]))
    written = CameraInfo("left", 640, 480, camera_info().intrinsic / 3 * [[3], [3], [3]], model, coefficients)
    write_camera_info(written, tmp_path / "camera_info.yaml")
    got = read_camera_info(tmp_path / "camera_info.yaml")
    np.testing.assert_array_equal(got.intrinsic, written.intrinsic)
    assert (got.name, got.width, got.height, got.distortion_model) == ("left", 640, 480, model)
    assert got.distortion == coefficients


def test_a_progressive_jpeg_with_a_comment_has_a_size_too(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    cv2.imwrite(str(path), np.zeros((17, 19, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    jpeg = path.read_bytes()
    # A comment segment that holds something like a start of frame.
    path.write_bytes(jpeg[:2] + b"\xff\xfe\x00\x0b\xff\xc0\x00\x11\x08\x00\x01\x00\x01" + jpeg[2:])
    assert (read_header(path).width, read_header(path).height) == (19, 17)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@given(kept=st.floats(0.0, 0.999))
def test_every_truncation_is_noticed(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, kept: float
) -> None:
    path = tmp_path_factory.mktemp("image") / f"image{suffix}"
    noise = np.random.default_rng(1).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    assert cv2.imwrite(str(path), noise)
    content = path.read_bytes()
    path.write_bytes(content[: max(8, int(kept * (len(content) - 12)))])
    with pytest.raises(DriveError, match="truncated"):
        read_header(path)


def test_other_formats_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    assert cv2.imwrite(str(path.with_suffix(".jp2")), np.zeros((64, 64, 3), np.uint8))
    path.with_suffix(".jp2").rename(path)
    with pytest.raises(DriveError, match="not a PNG"):
        read_header(path)


def test_a_guess_of_the_extrinsic_gives_the_ipm_of_that_camera() -> None:
    info, guess = camera_info(), looking_forward(1.8, 0.25)
    ipm = ipm_from_guess(info, guess.tolist(), "here")
    np.testing.assert_allclose(ipm, ipm_from_extrinsic(info, guess), atol=1e-15)
    # By hand: the optical axis meets the ground at height / tan(pitch) ahead.
    centre = ipm @ [info.intrinsic[0, 2], info.intrinsic[1, 2], 1.0]
    np.testing.assert_allclose(centre[:2] / centre[2], [1.8 / np.tan(0.25), 0.0], atol=1e-12)


@given(st.floats(-6, 6))
def test_the_scale_of_an_ipm_is_of_no_matter(exponent: float) -> None:
    ipm = ipm_from_extrinsic(camera_info(), looking_forward())
    np.testing.assert_allclose(take_ipm((ipm * 10.0**exponent).tolist(), "here"), ipm, rtol=1e-9)


@given(st.integers(3, 12), st.booleans())
def test_convex_polygons_pass_and_come_out_counter_clockwise(corners: int, clockwise: bool) -> None:
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False) * (-1 if clockwise else 1)
    polygon = np.column_stack([10 + 4 * np.cos(angle), 2 * np.sin(angle)])
    roi = take_roi(polygon.tolist(), "here")
    x, y = roi.T
    assert x @ np.roll(y, -1) - y @ np.roll(x, -1) > 0


def test_a_star_turns_one_way_but_is_not_convex() -> None:
    angle = np.arange(5) * 4 * np.pi / 5
    with pytest.raises(DriveError, match="not convex"):
        take_roi(np.column_stack([np.cos(angle), np.sin(angle)]).tolist(), "here")
