"""Pixels on the ground with their covariance, against differences and against drawn errors."""

import numpy as np
import pytest
import torch

from tests.detection.pictures import extrinsic, make_camera, to_image
from v2hdm.detection.camera import GroundPoints, RoadCamera, camera_from_calibration, rough_calibration
from v2hdm.errors import MapFileError
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.tensors import exp
from v2hdm.records import Calibration, Camera, CameraInfo

CORNERS = np.array([[6.0, 1.0], [7.0, 1.5], [6.5, 2.0], [5.5, 1.5]])


def calibrated(lens: str = "plumb_bob", covariance: np.ndarray | None = None) -> Calibration:
    return Calibration(make_camera(lens).info, extrinsic(), covariance)


def footprint(calibration: Calibration, points_px: np.ndarray) -> GroundPoints:
    return RoadCamera(camera_from_calibration(calibration)).footprint(points_px, calibration)


def moved(calibration: Calibration, tangent: np.ndarray) -> Calibration:
    """The calibration perturbed on the left, as its covariance means it."""
    step = exp(torch.as_tensor(tangent)).numpy()
    return Calibration(calibration.info, step @ calibration.cam_from_vehicle)


@pytest.mark.parametrize("lens", ["pinhole", "plumb_bob", "equidistant"])
def test_corners_land_where_they_are_on_the_ground(lens):
    points_px = to_image(make_camera(lens), CORNERS)
    found = footprint(calibrated(lens), points_px)
    np.testing.assert_allclose(found.points_vehicle, CORNERS, atol=2e-3)
    np.testing.assert_array_equal(found.joint_covariance(np.zeros((8, 8))), np.zeros((8, 8)))


@pytest.mark.parametrize("lens", ["pinhole", "equidistant"])
def test_the_share_of_the_pixels_is_that_of_differences(lens):
    calibration = calibrated(lens)
    points_px = to_image(make_camera(lens), CORNERS)
    spread = np.random.default_rng(0).normal(0, 0.1, (8, 8))
    covariance_px = spread @ spread.T
    covariance = footprint(calibration, points_px).joint_covariance(covariance_px)
    jacobian = np.zeros((8, 8))
    view = RoadCamera(camera_from_calibration(calibration))
    for column in range(8):
        step = np.zeros(8)
        step[column] = 0.5
        ends = [
            view.ground(view.undistort(points_px + sign * step.reshape(4, 2))).ravel() for sign in (1, -1)
        ]
        jacobian[:, column] = ends[0] - ends[1]
    np.testing.assert_allclose(covariance, jacobian @ covariance_px @ jacobian.T, rtol=0.03, atol=1e-7)


def test_the_share_of_the_calibration_is_that_of_differences():
    sigma = np.array([0.02, 0.01, 0.03, 0.002, 0.003, 0.001])
    calibration = calibrated("pinhole", np.diag(sigma**2))
    points_px = to_image(make_camera("pinhole"), CORNERS)
    covariance = footprint(calibration, points_px).joint_covariance(np.zeros((8, 8)))
    jacobian = np.zeros((8, 6))
    for column, step in enumerate(1e-5 * np.eye(6)):
        ends = [
            footprint(moved(calibration, sign * step), points_px).points_vehicle.ravel() for sign in (1, -1)
        ]
        jacobian[:, column] = (ends[0] - ends[1]) / 2e-5
    np.testing.assert_allclose(covariance, jacobian @ np.diag(sigma**2) @ jacobian.T, rtol=1e-4, atol=1e-9)


def test_points_of_a_line_have_the_covariance_of_single_corners():
    calibration = calibrated(covariance=np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6]))
    points_px = to_image(make_camera(), CORNERS)
    found = footprint(calibration, points_px)
    single, together = found.single_covariances(0.5), found.joint_covariance(0.25 * np.eye(8))
    for n in range(4):
        np.testing.assert_allclose(single[n], together[2 * n : 2 * n + 2, 2 * n : 2 * n + 2], rtol=1e-9)


def test_a_point_above_the_horizon_spoils_no_other():
    points_px = to_image(make_camera(), CORNERS)
    points_px[2] = [320.0, 5.0]
    found = footprint(calibrated(), points_px)
    covariance = found.joint_covariance(np.eye(8))
    assert np.isnan(found.points_vehicle[2]).all()
    others = [0, 1, 2, 3, 6, 7]
    assert np.isfinite(covariance[np.ix_(others, others)]).all()
    assert np.isnan(covariance[4:6]).all()


def test_a_rough_description_gives_the_camera_that_it_says():
    calibration = rough_calibration("c", 1280, 720, height_m=1.5, pitch_deg=10.0, fov_deg=90.0)
    assert calibration.info.intrinsic[0, 0] == pytest.approx(640.0)
    ipm = ipm_from_extrinsic(calibration.info, calibration.cam_from_vehicle)
    ahead = ipm @ [639.5, 359.5, 1.0]
    np.testing.assert_allclose(ahead[:2] / ahead[2], [1.5 / np.tan(np.deg2rad(10.0)), 0.0], atol=1e-9)
    left = ipm @ [300.0, 500.0, 1.0]
    assert left[1] / left[2] > 0
    assert isinstance(camera_from_calibration(calibration), Camera)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"distortion_model": "fisheye"}, "unknown distortion_model 'fisheye'"),
        ({"distortion": (0.1,)}, "plumb_bob has 5 coefficients, not 1"),
        ({"width": 0}, "must be positive"),
        ({"rotation": 1.1 * np.eye(3)}, "no rotation"),
        ({"height_m": -0.5}, "under the ground"),
        ({"pitch_deg": -60.0}, "above the horizon"),
    ],
)
def test_a_calibration_that_cannot_be_right_is_refused(change, words):
    info = vars(calibrated().info) | {key: change[key] for key in change if key in CameraInfo.__annotations__}
    mounting = {key: change[key] for key in ("height_m", "pitch_deg") if key in change}
    cam_from_vehicle = extrinsic(**mounting)
    cam_from_vehicle[:3, :3] = change.get("rotation", cam_from_vehicle[:3, :3])
    with pytest.raises(MapFileError, match=words):
        camera_from_calibration(Calibration(CameraInfo(**info), cam_from_vehicle))
