"""The projection's continuation behind the camera: smooth, and away from the mirror image."""

import pytest
import torch

from v2hdm.geometry.tensors import inverse_depth


@pytest.mark.parametrize("depth", [5.0, 0.2, 0.05, -0.001, -3.0])
def test_the_inverse_depth_is_smooth_through_the_camera_plane(depth):
    depth_m = torch.tensor([depth], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda z: inverse_depth(z)[0], (depth_m,), eps=1e-7, rtol=1e-4)
    (by_autograd,) = torch.autograd.grad(inverse_depth(depth_m)[0].sum(), depth_m)
    torch.testing.assert_close(inverse_depth(depth_m)[1].detach(), by_autograd)


def test_a_point_moving_behind_the_camera_moves_off_the_image_and_not_to_its_mirror_point():
    reciprocal, _ = inverse_depth(torch.tensor([1.0, 0.1, 0.0, -1.0, -10.0], dtype=torch.float64))
    assert (reciprocal.diff() > 0).all()
