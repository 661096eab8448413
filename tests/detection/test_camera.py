"""The camera as the detector sees it: lens, ground and covariances."""

import numpy as np
import pytest

from tests.detection.pictures import LENSES, extrinsic, make_camera, to_image
from v2hdm.detection.camera import FARTHEST_M, RoadCamera, camera_from_calibration, rough_calibration
from v2hdm.errors import MapFileError
from v2hdm.geometry.ipm import apply_homography, ipm_from_extrinsic
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.rigid import exp
from v2hdm.records import Calibration, Camera, CameraInfo

GRID_PX = np.stack(np.meshgrid(np.linspace(0, 639, 17), np.linspace(0, 359, 11)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("lens", LENSES)
def test_distorting_undoes_undistorting_over_the_whole_image(lens):
    info = make_camera(lens).info
    back_px = distort_points(info, undistort_points(info, GRID_PX))
    np.testing.assert_allclose(back_px, GRID_PX, atol=1e-6)


@pytest.mark.parametrize("lens", LENSES)
def test_the_lens_table_agrees_with_the_lens_to_a_hundredth_of_a_pixel(lens):
    camera = make_camera(lens)
    exact = undistort_points(camera.info, GRID_PX + 0.37)
    np.testing.assert_allclose(RoadCamera(camera).undistort(GRID_PX + 0.37), exact, atol=1e-2)


def test_the_band_begins_just_above_the_horizon_and_ends_with_the_image():
    camera = make_camera("pinhole")
    view = RoadCamera(camera)
    horizon = 179.0 - 522.0 * np.tan(np.deg2rad(14.0))
    assert 0 <= view.top < camera.info.height
    assert (camera.info.height - view.top) % 16 == 0
    assert horizon - 16 - 16 <= view.top <= horizon


def test_looking_begins_a_little_above_the_farthest_ground_of_use():
    view = RoadCamera(make_camera("pinhole"))
    (ahead_px,) = apply_homography(view.pinhole_px_from_vehicle, view.foot_vehicle[None] + [FARTHEST_M, 0.0])
    assert (view.far_row - view.top) % 16 == 0
    assert ahead_px[1] - 24 - 16 <= view.far_row <= ahead_px[1] - 24


def test_a_rear_camera_sees_the_ground_behind_the_vehicle():
    backwards = np.diag([-1.0, -1.0, 1.0, 1.0])
    camera = make_camera("pinhole")
    ipm = ipm_from_extrinsic(camera.info, extrinsic() @ backwards)
    rear = type(camera)(camera.info, {"estimated": ipm}, "estimated", -camera.roi_vehicle)
    view = RoadCamera(rear)
    assert view.ground(np.array([[320.0, 300.0]]))[0, 0] < -3
    np.testing.assert_allclose(view.foot_vehicle, [-1.0, 0.0], atol=1e-9)


CORNERS = np.array([[6.0, 1.0], [7.0, 1.5], [6.5, 2.0], [5.5, 1.5]])


def calibrated(lens="plumb_bob", covariance=None):
    return Calibration(make_camera(lens).info, extrinsic(), covariance)


def footprint(calibration, points_px):
    return RoadCamera(camera_from_calibration(calibration)).footprint(points_px, calibration)


def moved(calibration, tangent):
    """The calibration perturbed on the left, as its covariance means it."""
    return Calibration(calibration.info, exp(np.asarray(tangent)) @ calibration.cam_from_vehicle)


@pytest.mark.parametrize("lens", ["pinhole", "plumb_bob", "equidistant"])
def test_corners_land_where_they_are_on_the_ground(lens):
    points_px = to_image(make_camera(lens), CORNERS)
    on_ground = footprint(calibrated(lens), points_px)
    np.testing.assert_allclose(on_ground.points_vehicle, CORNERS, atol=2e-3)
    np.testing.assert_array_equal(on_ground.joint_covariance(np.zeros((8, 8))), np.zeros((8, 8)))


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
    on_ground = footprint(calibration, points_px)
    single, together = on_ground.single_covariances(0.5), on_ground.joint_covariance(0.25 * np.eye(8))
    for n in range(4):
        np.testing.assert_allclose(single[n], together[2 * n : 2 * n + 2, 2 * n : 2 * n + 2], rtol=1e-9)


def test_a_point_above_the_horizon_spoils_no_other():
    points_px = to_image(make_camera(), CORNERS)
    points_px[2] = [320.0, 5.0]
    on_ground = footprint(calibrated(), points_px)
    covariance = on_ground.joint_covariance(np.eye(8))
    assert np.isnan(on_ground.points_vehicle[2]).all()
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
        ({"rotation": 1.1 * np.eye(3)}, "not a rotation"),
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


def test_half_resolution_begins_where_a_pixel_is_seven_millimetres_of_ground():
    view = RoadCamera(camera_from_calibration(rough_calibration("front", 1280, 720, 2.0, 10.0, 60.0)), 32)
    assert view.fine_row is not None
    ends = view.unproject(np.array([[639.0, view.fine_row], [640.0, view.fine_row]]))
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(0.007, rel=0.02)
