"""Laws of the rigid motions, and agreement of torch, numpy and kornia."""

import numpy as np
import pytest
import torch
from kornia.geometry.liegroup import Se3
from scipy.linalg import expm

from tests.cameras import apply
from v2hdm.geometry import ipm, lens, rigid, tensors
from v2hdm.geometry.tensors import inverse_depth
from v2hdm.records import CameraInfo

BATCHES = [(), (1,), (3, 2)]


def tangents(batch, size=1.0, seed=0):
    return size * np.random.default_rng(seed).normal(size=(*batch, 6))


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_motion_times_its_inverse_is_the_identity(batch, dtype):
    motion = torch.as_tensor(rigid.exp(tangents(batch)), dtype=dtype)
    identity = torch.eye(4, dtype=dtype).expand(*batch, 4, 4)
    atol = {torch.float32: 2e-5, torch.float64: 1e-12}[dtype]
    torch.testing.assert_close(motion @ tensors.inverse(motion), identity, atol=atol, rtol=0)
    agree(rigid.inverse(motion.numpy()), tensors.inverse(motion), atol)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 1.0])
@pytest.mark.parametrize("batch", BATCHES)
def test_log_undoes_exp(batch, size):
    tangent = tangents(batch, size=size)
    np.testing.assert_allclose(rigid.log(rigid.exp(tangent)), tangent, atol=1e-12, rtol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-4, 0.3, 3.1])
def test_exp_agrees_with_the_matrix_exponential_and_with_kornia(angle):
    tangent = tangents((4,), seed=3)
    tangent[:, 3:] *= angle / np.linalg.norm(tangent[:, 3:], axis=1, keepdims=True)
    generator = np.zeros((4, 4, 4))
    generator[:, :3, :3], generator[:, :3, 3] = rigid.hat(tangent[:, 3:]), tangent[:, :3]
    np.testing.assert_allclose(
        rigid.exp(tangent), np.stack([expm(matrix) for matrix in generator]), atol=1e-12
    )
    agree(rigid.exp(tangent), Se3.exp(torch.as_tensor(tangent)).matrix(), atol=1e-12)
    np.testing.assert_allclose(rigid.log(rigid.exp(tangent)), tangent, atol=1e-9)


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.1, 1.5])
def test_the_left_jacobian_is_the_derivative_of_exp(size):
    tangent = tangents((), size=size, seed=4)

    def perturbation(other):
        return rigid.log(rigid.exp(other) @ rigid.inverse(rigid.exp(tangent)))

    step = 1e-6
    columns = [
        (perturbation(tangent + step * e) - perturbation(tangent - step * e)) / (2 * step) for e in np.eye(6)
    ]
    np.testing.assert_allclose(rigid.left_jacobian(tangent), np.stack(columns, -1), atol=1e-8)


@pytest.mark.parametrize("batch", BATCHES)
def test_the_adjoint_carries_a_tangent_through_a_motion(batch):
    motion, tangent = rigid.exp(tangents(batch, seed=5)), tangents(batch, size=0.3, seed=6)
    carried = (rigid.adjoint(motion) @ tangent[..., None])[..., 0]
    np.testing.assert_allclose(motion @ rigid.exp(tangent), rigid.exp(carried) @ motion, atol=1e-12)


def test_pitch_lowers_the_nose_and_heading_turns_left():
    nose = np.array([[1.0, 0.0, 0.0]])
    pitched, turned = (apply(rigid.exp(0.1 * np.eye(6)[k]), nose) for k in (4, 5))
    assert pitched[0, 2] < 0
    assert turned[0, 1] > 0


LENSES = {
    "pinhole": ("plumb_bob", (0.0,) * 5),
    "plumb_bob": ("plumb_bob", (-0.12, 0.03, 5e-4, -4e-4, 0.0)),
    "rational_polynomial": ("rational_polynomial", (0.2, -0.05, 4e-4, 3e-4, 0.01, 0.3, -0.02, 5e-3)),
    "equidistant": ("equidistant", (0.02, -0.01, 0.004, -0.001)),
}
K = np.array([[700.0, 0, 630], [0, 690, 350], [0, 0, 1]])
GRID_PX = np.stack(np.meshgrid(np.linspace(0, 1279, 13), np.linspace(0, 719, 9)), axis=-1).reshape(-1, 2)


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


def test_a_half_turn_has_a_logarithm():
    tangent = np.array([1.0, 2.0, 3.0, 0.0, np.pi, 0.0])
    np.testing.assert_allclose(np.abs(rigid.log(rigid.exp(tangent))[3:]), [0, np.pi, 0], atol=1e-7)


def test_ground_points_and_their_derivatives_agree_below_the_horizon_and_are_nan_above_it():
    homographies = ipm.ground_from_pinhole_px(K, cameras())
    pixels = np.random.default_rng(3).uniform([0, -300], [1280, 720], (12, 40, 2))
    pixels[0, 0] = np.nan
    as_torch = torch.as_tensor(homographies), torch.as_tensor(pixels)
    points, jacobian = tensors.back_project_with_jacobian(*as_torch)
    expected = ipm.apply_in_front(homographies, pixels)
    assert 0.1 < np.isnan(expected[..., 0]).mean() < 0.9
    is_near = np.isnan(expected) | (np.abs(expected) < 100)
    agree(np.where(is_near, expected, 0), torch.where(torch.as_tensor(is_near), points, 0.0))
    agree(
        np.where(is_near, expected, 0),
        torch.where(torch.as_tensor(is_near), tensors.back_project(*as_torch), 0),
    )
    agree(ipm.homography_jacobian(homographies, pixels), jacobian)


@pytest.mark.parametrize("name", LENSES)
def test_the_lenses_agree_to_a_thousandth_of_a_pixel_over_the_whole_image(name):
    info = CameraInfo("camera", 1280, 720, K, *LENSES[name])
    pinhole = lens.undistort_points(info, GRID_PX)
    twin = tensors.distort_points(info, torch.as_tensor(pinhole)).numpy()
    assert np.abs(lens.distort_points(info, pinhole) - twin).max() < 1e-4


@pytest.mark.parametrize("depth", [5.0, 0.2, 0.05, -0.001, -3.0])
def test_the_inverse_depth_is_smooth_through_the_camera_plane(depth):
    depth_m = torch.tensor([depth], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda z: inverse_depth(z)[0], (depth_m,), eps=1e-7, rtol=1e-4)
    (by_autograd,) = torch.autograd.grad(inverse_depth(depth_m)[0].sum(), depth_m)
    torch.testing.assert_close(inverse_depth(depth_m)[1].detach(), by_autograd)


def test_a_point_moving_behind_the_camera_moves_off_the_image_and_not_to_its_mirror_point():
    reciprocal, _ = inverse_depth(torch.tensor([1.0, 0.1, 0.0, -1.0, -10.0], dtype=torch.float64))
    assert (reciprocal.diff() > 0).all()
