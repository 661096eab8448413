"""The IPM and the extrinsic: round trips, and the extrinsic nearest to an inexact IPM."""

import numpy as np
import pytest

from tests.adjust.scene import mounted
from v2hdm.geometry.ipm import (
    apply_homography,
    apply_in_front,
    direction_covariance,
    extrinsic_from_ipm,
    facing_ipm,
    flat_motion,
    ground_from_pinhole_px,
    homography_jacobian,
    ipm_from_extrinsic,
    project_ground,
)
from v2hdm.geometry.rigid import camera_centre, exp
from v2hdm.records import CameraInfo

INFO = CameraInfo("front", 1280, 720, np.array([[900.0, 0, 639.5], [0, 880, 359.5], [0, 0, 1]]))
MOUNTS = np.stack([mounted(1.5, 2.4, 18), mounted(-1, 2.6, 40, rear=True), mounted(2, 1.7, 1)])
ROI = np.array([[4.0, -2], [4, 2], [12, 4], [12, -4], [8, 0]])


@pytest.mark.parametrize("factor", [1.0, -1.0, 250.0, -1e-3])
@pytest.mark.parametrize("mount", range(3))
def test_the_extrinsic_comes_back_from_its_ipm_whatever_its_scale_and_sign(factor, mount):
    ipm = factor * ipm_from_extrinsic(INFO, MOUNTS[mount])
    np.testing.assert_allclose(extrinsic_from_ipm(INFO, ipm), MOUNTS[mount], atol=1e-9)


def test_an_inexact_ipm_yields_the_rigid_camera_above_the_ground_whose_columns_are_nearest():
    rng = np.random.default_rng(0)
    ipm = ipm_from_extrinsic(INFO, MOUNTS[0]) * (1 + 0.02 * rng.normal(size=(3, 3)))
    found = extrinsic_from_ipm(INFO, ipm)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)
    assert camera_centre(found)[2] > 0
    columns = np.linalg.solve(INFO.intrinsic, np.linalg.inv(ipm))
    scale = (columns[:, 2] @ found[:3, 3]) / (found[:3, 3] @ found[:3, 3])

    def misfit(matrix, scale):
        return np.linalg.norm(columns[:, :2] / scale - matrix[:3, :2])

    nearest = misfit(found, scale)
    for tangent in rng.normal(0, 1e-3, (20, 6)):
        assert misfit(exp(tangent * [0, 0, 0, 1, 1, 1]) @ found, scale) > nearest
    assert all(
        np.linalg.norm(columns[:, :2] - f * scale * found[:3, :2])
        > np.linalg.norm(columns[:, :2] - scale * found[:3, :2])
        for f in (0.99, 1.01)
    )


@pytest.mark.parametrize("mount", range(3))
@pytest.mark.parametrize("tangent", [np.zeros(6), np.array([12.0, -5.0, 0.02, -0.01, 0.02, 0.7])])
def test_ground_points_return_from_their_pixels_under_a_tilted_pose_too(mount, tangent):
    pose = exp(tangent)
    cam_from_map = MOUNTS[mount] @ np.linalg.inv(pose)
    back = ground_from_pinhole_px(INFO.intrinsic, cam_from_map)
    ahead = (ROI * [-1, 1] if mount == 1 else ROI) @ pose[:2, :2].T + pose[:2, 3]
    pixels, depth_m = project_ground(INFO.intrinsic, cam_from_map, ahead)
    assert (depth_m > 0).all()
    np.testing.assert_allclose(apply_in_front(back, pixels), ahead, atol=1e-9)


def test_for_a_level_vehicle_the_plain_route_is_the_posed_one():
    pose, pixels = exp(np.array([3.0, 4.0, 0, 0, 0, 1.1])), np.array([[500.0, 500.0], [800.0, 420.0]])
    posed = ground_from_pinhole_px(INFO.intrinsic, MOUNTS[0] @ np.linalg.inv(pose))
    plain = flat_motion(pose) @ facing_ipm(-ipm_from_extrinsic(INFO, MOUNTS[0]), np.array([8.0, 0.0]))
    np.testing.assert_allclose(apply_in_front(plain, pixels), apply_in_front(posed, pixels), atol=1e-9)


def test_a_pitch_error_moves_a_point_along_its_ray_as_the_formula_says():
    """At h = 2.4 m and r = 10 m, one milliradian of pitch is (100 + 5.76) / 2.4 mm = 44 mm."""
    covariance = direction_covariance(np.array([10.0, 0.0]), np.array(2.4), 1e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [0.04407, 0.010], rtol=1e-3)


def test_a_batch_of_cameras_projects_as_each_of_them_does():
    points = np.stack([ROI, ROI * [-1, 1], ROI])
    pixels, depth_m = project_ground(INFO.intrinsic, MOUNTS, points)
    for mount, own, at, depth in zip(MOUNTS, points, pixels, depth_m, strict=True):
        single_px, single_m = project_ground(INFO.intrinsic, mount, own)
        np.testing.assert_allclose(at, single_px, rtol=1e-13)
        np.testing.assert_allclose(depth, single_m, rtol=1e-13)


def test_an_ipm_of_either_sign_faces_the_ground_that_the_camera_sees():
    ipm, below = ipm_from_extrinsic(INFO, MOUNTS[0]), np.array([[639.5, 700.0], [639.5, 0.0]])
    for sign in (1.0, -1.0):
        ground = apply_in_front(facing_ipm(sign * ipm, np.array([8.0, 0.0])), below)
        np.testing.assert_allclose(ground[0], apply_homography(ipm, below)[0], rtol=1e-13)
        assert np.isnan(ground[1]).all()


def test_the_homography_jacobian_is_the_slope_of_the_homography_and_nan_above_the_horizon():
    ipm, step = facing_ipm(ipm_from_extrinsic(INFO, MOUNTS[0]), np.array([8.0, 0.0])), 1e-4
    points = np.array([[300.0, 450.0], [500.0, 640.0]])
    slopes = [
        (apply_homography(ipm, points + d) - apply_homography(ipm, points - d)) / (2 * step)
        for d in step * np.eye(2)
    ]
    numeric = np.stack(slopes, axis=2)
    np.testing.assert_allclose(homography_jacobian(ipm, points), numeric, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        homography_jacobian(np.stack([ipm, ipm]), points)[1], numeric, rtol=1e-6, atol=1e-9
    )
    assert np.isnan(homography_jacobian(ipm, np.array([[640.0, 0.0]]))).all()


def test_a_motion_in_the_plane_is_the_homography_of_that_plane():
    motion = exp(np.array([3.0, -2.0, 0, 0, 0, 0.7]))
    moved = (np.column_stack([ROI, np.zeros(5), np.ones(5)]) @ motion.T)[:, :2]
    np.testing.assert_allclose(apply_homography(flat_motion(motion), ROI), moved, atol=1e-12)
