"""The IPM and the lens: laws, and the fast table against the exact model."""

import numpy as np
import pytest

from tests.detection.pictures import LENSES, extrinsic, make_camera
from v2hdm.detection.camera.view import FARTHEST_M, CameraView
from v2hdm.geometry.ipm import (
    apply_homography,
    extrinsic_from_ipm,
    homography_jacobian,
    ipm_from_extrinsic,
)
from v2hdm.geometry.lens import distort_points, undistort_points

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
    np.testing.assert_allclose(CameraView(camera).undistort(GRID_PX + 0.37), exact, atol=1e-2)


def test_the_principal_point_is_left_alone_by_a_radial_lens():
    info = make_camera("equidistant").info
    centre = info.intrinsic[None, :2, 2]
    np.testing.assert_allclose(undistort_points(info, centre), centre, atol=1e-9)


def test_the_ipm_takes_the_projection_of_a_ground_point_back_to_it():
    camera, cam_from_vehicle = make_camera("pinhole"), extrinsic()
    point_cam = cam_from_vehicle @ [7.0, 1.5, 0.0, 1.0]
    px = (camera.info.intrinsic @ point_cam[:3])[:2] / point_cam[2]
    np.testing.assert_allclose(apply_homography(camera.ipm["calibrated"], px[None]), [[7.0, 1.5]], atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, -3.0])
def test_an_extrinsic_comes_back_from_its_ipm_at_any_scale_and_sign(scale):
    info = make_camera("pinhole").info
    ipm = scale * ipm_from_extrinsic(info, extrinsic())
    np.testing.assert_allclose(extrinsic_from_ipm(info, ipm), extrinsic(), atol=1e-9)


def test_an_extrinsic_from_a_disturbed_ipm_is_still_a_rigid_motion():
    info = make_camera("pinhole").info
    ipm = ipm_from_extrinsic(info, extrinsic()) * (1 + 1e-3 * np.random.default_rng(0).normal(size=(3, 3)))
    rotation = extrinsic_from_ipm(info, ipm)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_the_homography_jacobian_is_the_slope_of_the_homography():
    ipm, points, step = make_camera().ipm["calibrated"], np.array([[300.0, 250.0], [500.0, 340.0]]), 1e-4
    numeric = np.stack(
        [
            (apply_homography(ipm, points + d) - apply_homography(ipm, points - d)) / (2 * step)
            for d in step * np.eye(2)
        ],
        axis=2,
    )
    np.testing.assert_allclose(homography_jacobian(ipm, points), numeric, rtol=1e-6, atol=1e-9)


def test_points_above_the_horizon_have_no_place_on_the_ground():
    view = CameraView(make_camera("pinhole"))
    ground = view.ground(np.array([[320.0, 5.0], [320.0, 300.0]]))
    assert np.isnan(ground[0]).all()
    assert np.isfinite(ground[1]).all()


def test_the_band_begins_just_above_the_horizon_and_ends_with_the_image():
    camera = make_camera("pinhole")
    view = CameraView(camera)
    horizon = 179.0 - 522.0 * np.tan(np.deg2rad(14.0))
    assert view.top + view.height == camera.info.height
    assert view.height % 16 == 0
    assert horizon - 16 - 16 <= view.top <= horizon


def test_looking_begins_a_little_above_the_farthest_ground_of_use():
    view = CameraView(make_camera("pinhole"))
    (ahead_px,) = apply_homography(view.pinhole_px_from_vehicle, view.foot_vehicle[None] + [FARTHEST_M, 0.0])
    assert (view.far_row - view.top) % 16 == 0
    assert ahead_px[1] - 24 - 16 <= view.far_row <= ahead_px[1] - 24


def test_a_rear_camera_sees_the_ground_behind_the_vehicle():
    backwards = np.diag([-1.0, -1.0, 1.0, 1.0])
    camera = make_camera("pinhole")
    ipm = ipm_from_extrinsic(camera.info, extrinsic() @ backwards)
    rear = type(camera)(camera.info, {"estimated": ipm}, "estimated", -camera.roi_vehicle)
    view = CameraView(rear)
    assert view.ground(np.array([[320.0, 300.0]]))[0, 0] < -3
    np.testing.assert_allclose(view.foot_vehicle, [-1.0, 0.0], atol=1e-9)


def test_the_lens_jacobian_is_near_identity_for_a_mild_lens():
    view = CameraView(make_camera("plumb_bob"))
    jacobian = view.distort_jacobian(np.array([[320.0, 200.0], [500.0, 300.0]]))
    np.testing.assert_allclose(jacobian, np.broadcast_to(np.eye(2), (2, 2, 2)), atol=0.08)
