"""Every function in torch agrees with its counterpart in numpy, within 1e-9 of what it returns."""

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
    np.testing.assert_allclose(rigid.log(motion), tangent, atol=1e-9)
    agree(rigid.inverse(motion), tensors.inverse(torch.as_tensor(motion)))
    agree(rigid.adjoint(motion), tensors.adjoint(torch.as_tensor(motion)))
    agree(rigid.left_jacobian(tangent), tensors.left_jacobian(as_torch))
    agree(rigid.hat(tangent[:, :3]), tensors.hat(as_torch[:, :3]))


def test_a_half_turn_has_a_logarithm():
    tangent = np.array([1.0, 2.0, 3.0, 0.0, np.pi, 0.0])
    np.testing.assert_allclose(np.abs(rigid.log(rigid.exp(tangent))[3:]), [0, np.pi, 0], atol=1e-7)


def test_the_mounting_of_an_ipm_agrees_whatever_its_scale_and_sign():
    info = CameraInfo("camera", 1280, 720, K)
    rng = np.random.default_rng(2)
    ipms = np.stack([ipm.ipm_from_extrinsic(info, pose) for pose in cameras()])
    ipms *= rng.uniform(0.1, 10, (12, 1, 1)) * rng.choice([-1, 1], (12, 1, 1))
    ipms += 1e-4 * rng.normal(size=ipms.shape) * np.abs(ipms)
    twin = tensors.extrinsic_from_ipm(torch.as_tensor(K).expand(12, 3, 3), torch.as_tensor(ipms))
    agree(np.stack([ipm.extrinsic_from_ipm(info, one) for one in ipms]), twin)


def test_ground_points_and_their_derivatives_agree_below_the_horizon_and_are_nan_above_it():
    homographies = ipm.ground_from_pinhole_px(K, cameras())
    pixels = np.random.default_rng(3).uniform([0, -300], [1280, 720], (12, 40, 2))
    pixels[0, 0] = np.nan
    as_torch = torch.as_tensor(homographies), torch.as_tensor(pixels)
    points, jacobian = tensors.back_project_with_jacobian(*as_torch)
    expected = ipm.apply_in_front(homographies, pixels)
    assert 0.1 < np.isnan(expected[..., 0]).mean() < 0.9
    near = np.isnan(expected) | (np.abs(expected) < 100)
    agree(np.where(near, expected, 0), torch.where(torch.as_tensor(near), points, 0.0))
    agree(np.where(near, expected, 0), torch.where(torch.as_tensor(near), tensors.back_project(*as_torch), 0))
    agree(ipm.homography_jacobian(homographies, pixels), jacobian)


@pytest.mark.parametrize("name", LENSES)
def test_the_lenses_agree_to_a_thousandth_of_a_pixel_over_the_whole_image(name):
    info = CameraInfo("camera", 1280, 720, K, *LENSES[name])
    pinhole = lens.undistort_points(info, GRID_PX)
    agree(
        lens.distort_points(info, pinhole), tensors.distort_points(info, torch.as_tensor(pinhole)), atol=1e-4
    )
