"""Every function of the torch twin agrees with that of the numpy floor, within 1e-9 of what it returns."""

import numpy as np
import pytest
import torch

from v2hdm.geometry import ipm, lens, rigid, tensors
from v2hdm.records import CameraInfo

LENSES = {
    "pinhole": ("plumb_bob", (0.0,) * 5),
    "plumb_bob": ("plumb_bob", (-0.12, 0.03, 5e-4, -4e-4, 0.0)),
    "rational_polynomial": ("rational_polynomial", (0.2, -0.05, 4e-4, 3e-4, 0.01, 0.3, -0.02, 5e-3)),
    "equidistant": ("equidistant", (0.02, -0.01, 0.004, -0.001)),
}
K = np.array([[700.0, 0, 630], [0, 690, 350], [0, 0, 1]])
GRID_PX = np.stack(np.meshgrid(np.linspace(0, 1279, 13), np.linspace(0, 719, 9)), axis=-1).reshape(-1, 2)


def tangents(seed=0, count=12):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.normal(0, 5, (count, 3)), rng.normal(0, 1, (count, 3))])


def cameras(seed=0, count=12):
    """Poses (count, 4, 4) of cameras 1 to 3 m above the ground that look down by 10 to 40 deg."""
    rng = np.random.default_rng(seed)
    down, yaw = rng.uniform(0.2, 0.7, count), rng.uniform(-3, 3, count)
    vehicle_from_level = rigid.rotation_from_euler(np.zeros(count), down, yaw)
    optical = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3] = np.swapaxes(vehicle_from_level @ optical, 1, 2)
    centre = np.column_stack([rng.normal(0, 1, (count, 2)), rng.uniform(1, 3, count)])
    out[:, :3, 3] = -(out[:, :3, :3] @ centre[..., None])[..., 0]
    return out


def agree(ours, twin, atol=1e-9):
    np.testing.assert_allclose(ours, twin.detach().numpy(), atol=atol, rtol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, 3.1])
def test_tangents_and_motions_agree(angle):
    tangent = tangents()
    tangent[:, 3:] *= angle / np.linalg.norm(tangent[:, 3:], axis=1, keepdims=True)
    motion = rigid.exp(tangent)
    as_torch = torch.as_tensor(tangent)
    agree(motion, tensors.exp(as_torch))
    agree(rigid.log(motion), tensors.log(torch.as_tensor(motion)), atol=1e-7)
    np.testing.assert_allclose(rigid.log(motion), tangent, atol=1e-9)
    agree(rigid.inverse(motion), tensors.inverse(torch.as_tensor(motion)))
    agree(rigid.adjoint(motion), tensors.adjoint(torch.as_tensor(motion)))
    agree(rigid.left_jacobian(tangent), tensors.left_jacobian(as_torch))
    agree(rigid.hat(tangent[:, :3]), tensors.hat(as_torch[:, :3]))
    points = np.random.default_rng(1).normal(size=(12, 5, 3))
    agree(rigid.apply(motion, points), tensors.apply(torch.as_tensor(motion), torch.as_tensor(points)))


def test_a_half_turn_has_a_logarithm():
    tangent = np.array([1.0, 2.0, 3.0, 0.0, np.pi, 0.0])
    np.testing.assert_allclose(np.abs(rigid.log(rigid.exp(tangent))[3:]), [0, np.pi, 0], atol=1e-7)


def test_the_ipm_and_its_homography_agree():
    pose = cameras()
    intrinsic = torch.as_tensor(K).expand(12, 3, 3)
    twin = tensors.ipm_from_extrinsic(intrinsic, torch.as_tensor(pose))
    info = CameraInfo("camera", 1280, 720, K)
    agree(np.stack([ipm.ipm_from_extrinsic(info, one) for one in pose]), twin)
    below = np.stack([np.linspace(100, 1200, 6), np.full(6, 719.0)], axis=-1)
    below = np.broadcast_to(below, (12, 6, 2)).copy()
    agree(ipm.apply_homography(twin.numpy(), below), tensors.apply_homography(twin, torch.as_tensor(below)))


def test_the_projection_of_ground_agrees():
    pose = cameras()
    lowest = np.broadcast_to([[300.0, 700.0], [640.0, 719.0], [900.0, 600.0]], (12, 3, 2))
    ground = ipm.apply_in_front(ipm.ground_from_pinhole_px(K, pose), lowest)
    flat = np.concatenate([ground, np.zeros((12, 3, 1))], axis=-1)
    points_cam = tensors.apply(torch.as_tensor(pose), torch.as_tensor(flat))
    pixels, _ = ipm.project_ground(K, pose, ground)
    agree(pixels, tensors.project(torch.as_tensor(K).expand(12, 3, 3), points_cam), atol=1e-6)
    np.testing.assert_allclose(pixels, lowest, atol=1e-8)


@pytest.mark.parametrize("name", LENSES)
def test_the_lenses_agree_to_a_thousandth_of_a_pixel_over_the_whole_image(name):
    info = CameraInfo("camera", 1280, 720, K, *LENSES[name])
    pinhole = lens.undistort_points(info, GRID_PX)
    agree(pinhole, tensors.undistort_points(info, torch.as_tensor(GRID_PX)), atol=1e-3)
    agree(
        lens.distort_points(info, pinhole), tensors.distort_points(info, torch.as_tensor(pinhole)), atol=1e-4
    )


def test_a_picture_of_the_ground_shows_what_lies_there():
    pose = cameras(count=1)[0]
    homography = ipm.pinhole_px_from_ground(K, pose)
    v, u = np.mgrid[0:720, 0:1280].astype(np.float64)
    image = torch.as_tensor(np.stack([u, v]))
    seen = ipm.apply_in_front(ipm.ground_from_pinhole_px(K, pose), np.array([[640.0, 600.0]]))
    grid = seen + np.stack(np.meshgrid(np.linspace(0, 0.2, 4), np.linspace(0, 0.3, 5)), axis=-1)
    shown = tensors.warp_to_ground(image, torch.as_tensor(homography), torch.as_tensor(grid))
    expected = ipm.apply_homography(homography, grid.reshape(-1, 2)).reshape(5, 4, 2)
    agree(np.moveaxis(expected, -1, 0), shown, atol=1e-6)
