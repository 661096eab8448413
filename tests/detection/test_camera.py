"""The camera as the detector sees it: the lens, its fast table, and the ground in view."""

import numpy as np
import pytest

from tests.detection.pictures import LENSES, extrinsic, make_camera
from v2hdm.detection.camera import FARTHEST_M, RoadCamera
from v2hdm.geometry.ipm import (
    apply_homography,
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
    np.testing.assert_allclose(RoadCamera(camera).undistort(GRID_PX + 0.37), exact, atol=1e-2)


def test_the_principal_point_is_left_alone_by_a_radial_lens():
    info = make_camera("equidistant").info
    centre = info.intrinsic[None, :2, 2]
    np.testing.assert_allclose(undistort_points(info, centre), centre, atol=1e-9)


def test_points_above_the_horizon_have_no_place_on_the_ground():
    view = RoadCamera(make_camera("pinhole"))
    ground = view.ground(np.array([[320.0, 5.0], [320.0, 300.0]]))
    assert np.isnan(ground[0]).all()
    assert np.isfinite(ground[1]).all()


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


def test_the_lens_jacobian_is_near_identity_for_a_mild_lens():
    view = RoadCamera(make_camera("plumb_bob"))
    jacobian = view.distort_jacobian(np.array([[320.0, 200.0], [500.0, 300.0]]))
    np.testing.assert_allclose(jacobian, np.broadcast_to(np.eye(2), (2, 2, 2)), atol=0.08)
