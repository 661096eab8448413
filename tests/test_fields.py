"""Cameras that files describe: which of them can be."""

from __future__ import annotations

import numpy as np
import pytest

from v2hdm.errors import MapFileError
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.io.safe.fields import check_camera, lens_reach
from v2hdm.records import CameraInfo

INTRINSIC = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
KITTI = np.array([[984.2, 0.0, 690.0], [0.0, 980.8, 233.2], [0.0, 0.0, 1.0]])


def camera(model: str, distortion: tuple[float, ...]) -> CameraInfo:
    return CameraInfo("front", 640, 480, INTRINSIC, model, distortion)


GOOD = [
    camera("plumb_bob", (0.0, 0.0, 0.0, 0.0, 0.0)),
    camera("plumb_bob", (-0.3, 0.1, 0.001, 0.001, 0.0)),
    CameraInfo(
        "kitti", 1392, 512, KITTI, "plumb_bob", (-0.3728755, 0.2037299, 0.0022190, 0.0013836, -0.0723)
    ),
    camera("rational_polynomial", (0.5, 0.1, 0.0, 0.0, 0.0, 0.6, 0.1, 0.0)),
    camera("equidistant", (0.05, -0.01, 0.002, 0.0)),
]
FOLDED = [
    camera("plumb_bob", (-0.6, 0.0, 0.0, 0.0, 0.0)),
    camera("plumb_bob", (0.0, 0.0, 0.0, 0.0, -5.0)),
    camera("rational_polynomial", (-0.9, 0.0, 0.0, 0.0, 0.0, -0.2, 0.0, 0.0)),
    camera("equidistant", (-0.9, 0.0, 0.0, 0.0)),
]


@pytest.mark.parametrize("info", GOOD, ids=lambda info: info.distortion_model)
def test_a_lens_that_is_taken_can_be_undone_up_to_the_corners(info: CameraInfo) -> None:
    check_camera(info, "front.yaml", MapFileError)
    u, v = np.meshgrid(np.linspace(0, info.width - 1, 9), np.linspace(0, info.height - 1, 9))
    points = np.column_stack([u.ravel(), v.ravel()])
    np.testing.assert_allclose(distort_points(info, undistort_points(info, points)), points, atol=0.01)


@pytest.mark.parametrize("info", FOLDED, ids=lambda info: f"{info.distortion_model} {info.distortion[0]:g}")
def test_a_lens_that_folds_over_itself_within_the_image_is_refused(info: CameraInfo) -> None:
    message = r"front\.yaml: distortion_coefficients: this lens folds over itself \d+ px .* reaches 40\d px"
    with pytest.raises(MapFileError, match=message):
        check_camera(info, "front.yaml", MapFileError)


def test_a_lens_that_folds_in_the_corners_only_is_warned_of(caplog) -> None:
    check_camera(camera("plumb_bob", (-0.35, 0.0, 0.0, 0.0, 0.0)), "front.yaml", MapFileError)
    (record,) = caplog.records
    assert "front.yaml: distortion_coefficients: this lens folds over itself 325 px" in record.getMessage()


def test_the_reach_of_a_lens_is_where_it_turns() -> None:
    # r - 0.6 r^3 is greatest at r = 1 / sqrt(1.8).
    turn = 1 / np.sqrt(1.8)
    assert lens_reach(FOLDED[0]) == pytest.approx(turn - 0.6 * turn**3, rel=1e-5)
    assert lens_reach(GOOD[0]) == np.inf
