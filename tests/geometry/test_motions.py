"""Laws of the rigid motions, then agreement with kornia's."""

import pytest
import torch
from kornia.geometry.liegroup import Se3
from kornia.geometry.linalg import transform_points

from v2hdm.geometry import tensors as tf

BATCHES = [(), (1,), (3, 2)]
TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-12}


def log(motion):
    return Se3.from_matrix(motion.reshape(-1, 4, 4)).log().reshape(*motion.shape[:-2], 6)


def apply(motion, points):
    motions, batched = motion.reshape(-1, 4, 4), points.reshape(-1, *points.shape[-2:])
    return transform_points(motions, batched).reshape(points.shape)


def tangents(batch, dtype=torch.float64, size=1.0, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return size * torch.randn(*batch, 6, generator=generator, dtype=torch.float64).to(dtype)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("dtype", TOLERANCE)
def test_a_motion_times_its_inverse_is_the_identity(batch, dtype):
    motion = tf.exp(tangents(batch, dtype))
    identity = torch.eye(4, dtype=dtype).expand(*batch, 4, 4)
    torch.testing.assert_close(motion @ tf.inverse(motion), identity, atol=TOLERANCE[dtype], rtol=0)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 1.0])
@pytest.mark.parametrize("batch", BATCHES)
def test_log_undoes_exp(batch, size):
    tangent = tangents(batch, size=size)
    torch.testing.assert_close(log(tf.exp(tangent)), tangent, atol=1e-12, rtol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.3, 3.14])
def test_exp_agrees_with_the_matrix_exponential_and_with_kornia(angle):
    tangent = tangents((4,), seed=3)
    tangent[:, 3:] *= angle / tangent[:, 3:].norm(dim=1, keepdim=True)
    generator = torch.zeros(4, 4, 4, dtype=torch.float64)
    generator[:, :3, :3], generator[:, :3, 3] = tf.hat(tangent[:, 3:]), tangent[:, :3]
    torch.testing.assert_close(tf.exp(tangent), torch.linalg.matrix_exp(generator), atol=1e-12, rtol=0)
    torch.testing.assert_close(tf.exp(tangent), Se3.exp(tangent).matrix().detach(), atol=1e-12, rtol=0)


@pytest.mark.parametrize("size", [0.0, 1e-7, 1.0])
def test_exp_has_correct_derivatives_at_the_identity_too(size):
    tangent = tangents((2,), size=size).requires_grad_()
    assert torch.autograd.gradcheck(tf.exp, (tangent,), eps=1e-6)


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.1, 1.5])
def test_the_left_jacobian_is_the_derivative_of_exp(size):
    tangent = tangents((), size=size, seed=4)

    def perturbation(other):
        return log(tf.exp(other) @ tf.inverse(tf.exp(tangent)))

    step = 1e-6
    columns = [
        (perturbation(tangent + step * e) - perturbation(tangent - step * e)) / (2 * step)
        for e in torch.eye(6, dtype=torch.float64)
    ]
    torch.testing.assert_close(tf.left_jacobian(tangent), torch.stack(columns, -1), atol=1e-8, rtol=0)


@pytest.mark.parametrize("batch", BATCHES)
def test_the_adjoint_carries_a_tangent_through_a_motion(batch):
    motion, tangent = tf.exp(tangents(batch, seed=5)), tangents(batch, size=0.3, seed=6)
    carried = (tf.adjoint(motion) @ tangent[..., None])[..., 0]
    torch.testing.assert_close(motion @ tf.exp(tangent), tf.exp(carried) @ motion)


def test_pitch_lowers_the_nose_and_heading_turns_left():
    nose = torch.tensor([[1.0, 0.0, 0.0]])
    pitched = apply(tf.exp(torch.tensor([0.0, 0, 0, 0, 0.1, 0])), nose)
    turned = apply(tf.exp(torch.tensor([0.0, 0, 0, 0, 0, 0.1])), nose)
    assert pitched[0, 2] < 0
    assert turned[0, 1] > 0
