"""Pixels to the ground, checked by projecting the other way."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tests.mapping.scene import MOUNTS, SceneOptions, extrinsic, make_scene
from v2hdm.geometry.ipm import (
    apply_in_front,
    direction_covariance,
    facing_ipm,
    flat_motion,
    ground_from_pinhole_px,
    homography_jacobian,
    ipm_from_extrinsic,
    project_ground,
)

INTRINSIC = np.array([[900.0, 0, 640], [0, 900, 350], [0, 0, 1]])


def tilted_pose() -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", [0.7, 0.02, -0.01]).as_matrix()
    pose[:3, 3] = 12.0, -5.0, 0.02
    return pose


def test_projecting_and_back_projecting_under_a_tilted_pose_is_the_identity() -> None:
    cam_from_vehicle = extrinsic(*MOUNTS["front"])
    pose = tilted_pose()
    points = (np.array([[8.0, 1.0], [12.0, -2.0]]) @ pose[:2, :2].T + pose[:2, 3])[None]
    pixel, depth = project_ground(INTRINSIC[None], (cam_from_vehicle @ np.linalg.inv(pose))[None], points)
    assert (depth > 0).all()
    back = ground_from_pinhole_px(INTRINSIC[None], (cam_from_vehicle @ np.linalg.inv(pose))[None])
    np.testing.assert_allclose(apply_in_front(back, pixel), points, atol=1e-9)


def test_for_a_level_vehicle_the_plain_route_is_the_posed_one() -> None:
    cam_from_vehicle = extrinsic(*MOUNTS["front"])
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("Z", 1.1).as_matrix()
    pose[:2, 3] = 3.0, 4.0
    scene = make_scene(SceneOptions(length_m=2.0))
    info = scene.drive.cameras["front"].info
    ipm = facing_ipm(-ipm_from_extrinsic(info, cam_from_vehicle), np.array([8.0, 0.0]))
    pixels = np.array([[[500.0, 500.0], [800.0, 420.0]]])
    posed = ground_from_pinhole_px(info.intrinsic[None], (cam_from_vehicle @ np.linalg.inv(pose))[None])
    plain = flat_motion(pose[None]) @ ipm
    np.testing.assert_allclose(apply_in_front(plain, pixels), apply_in_front(posed, pixels), atol=1e-9)


def test_a_pixel_above_the_horizon_has_no_ground_point() -> None:
    back = ground_from_pinhole_px(INTRINSIC[None], extrinsic(*MOUNTS["front"])[None])
    assert np.isnan(apply_in_front(back, np.array([[[640.0, 10.0]]]))).all()


def test_jacobians_agree_with_differences() -> None:
    back = ground_from_pinhole_px(INTRINSIC[None], extrinsic(*MOUNTS["front"])[None])
    pixel, step = np.array([[[600.0, 480.0]]]), 1e-4
    jacobian = homography_jacobian(back, pixel)[0, 0]
    for axis in range(2):
        ahead, behind = pixel.copy(), pixel.copy()
        ahead[..., axis] += step
        behind[..., axis] -= step
        change = (apply_in_front(back, ahead) - apply_in_front(back, behind)) / (2 * step)
        np.testing.assert_allclose(jacobian[:, axis], change[0, 0], rtol=1e-6)


def test_a_pitch_error_moves_a_point_along_its_ray_as_the_formula_says() -> None:
    """At h = 2.4 m and r = 10 m, one milliradian of pitch is (100 + 5.76) / 2.4 mm = 44 mm."""
    covariance = direction_covariance(np.array([10.0, 0.0]), np.array(2.4), 1e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [0.04407, 0.010], rtol=1e-3)
