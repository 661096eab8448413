"""Projection: numbers a reader can verify, derivatives, and points behind the camera."""

import pytest
import torch

from v2hdm.geometry import camera

K = torch.tensor([[900.0, 0, 640], [0, 800, 360], [0, 0, 1]], dtype=torch.float64)


def test_a_point_one_metre_right_at_nine_metres_lands_a_hundred_pixels_right():
    point = torch.tensor([[1.0, 0.0, 9.0]], dtype=torch.float64)
    torch.testing.assert_close(camera.project(K, point), torch.tensor([[740.0, 360.0]], dtype=torch.float64))


@pytest.mark.parametrize("batch", [(), (1,), (3, 2)])
def test_unproject_undoes_project_up_to_depth(batch):
    points = torch.rand(*batch, 7, 3, dtype=torch.float64) + 0.5
    rays = camera.unproject(K.expand(*batch, 3, 3), camera.project(K.expand(*batch, 3, 3), points))
    torch.testing.assert_close(rays * points[..., 2:], points)


@pytest.mark.parametrize("depth", [5.0, 0.2, 0.05, -0.001, -3.0])
def test_the_projection_is_smooth_through_the_camera_plane(depth):
    point = torch.tensor([[0.4, -0.3, depth]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: camera.project(K, p), (point,), eps=1e-7, rtol=1e-4)
    by_hand = camera.project_jacobian(K, point.detach())[0]
    by_autograd = torch.autograd.functional.jacobian(lambda p: camera.project(K, p), point.detach())
    torch.testing.assert_close(by_hand, by_autograd[0, :, 0])


def test_a_point_moving_behind_the_camera_moves_off_the_image_and_not_to_its_mirror_point():
    depths = torch.tensor([1.0, 0.1, 0.0, -1.0, -10.0], dtype=torch.float64)
    points = torch.stack([torch.ones(5), torch.zeros(5), depths], dim=-1)
    u = camera.project(K, points)[:, 0]
    assert (u.diff() > 0).all()
    assert camera.in_front(points).tolist() == [True, False, False, False, False]
