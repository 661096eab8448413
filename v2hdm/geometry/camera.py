"""The pinhole camera, without lens distortion (see :mod:`v2hdm.detection.camera.lens` for that)."""

from __future__ import annotations

import torch
from torch import Tensor

NEAR_M = 0.1
"""Depth below which :func:`inverse_depth` leaves 1 / z: nothing a vehicle maps is that close."""


def inverse_depth(depth_m: Tensor) -> tuple[Tensor, Tensor]:
    """1 / z and its derivative, continued below :data:`NEAR_M` by the tangent line.

    An optimiser that throws a point behind the camera so meets a large, finite cost whose gradient
    leads back to the front, instead of a pole and a mirror image.
    """
    reciprocal = 1 / depth_m.clamp(min=NEAR_M)
    slope = -reciprocal.square()
    return reciprocal + slope * (depth_m - depth_m.clamp(min=NEAR_M)), slope


def in_front(points_cam: Tensor) -> Tensor:
    """Whether points (*batch, 3) lie before the camera, where :func:`project` is a true projection."""
    return points_cam[..., 2] > NEAR_M


def project(intrinsic: Tensor, points_cam: Tensor) -> Tensor:
    """Pinhole pixels (*batch, n, 2) of points (*batch, n, 3); ``intrinsic`` is K (*batch, 3, 3).

    Points behind :data:`NEAR_M` come out finite and far off (see :func:`inverse_depth`); ask
    :func:`in_front` which they are.

    >>> project(torch.eye(3), torch.tensor([[2.0, 4.0, 2.0]]))
    tensor([[1., 2.]])
    """
    reciprocal, _ = inverse_depth(points_cam[..., 2:])
    return (points_cam[..., :2] * reciprocal) @ intrinsic[..., :2, :2].mT + intrinsic[..., None, :2, 2]


def project_jacobian(intrinsic: Tensor, points_cam: Tensor) -> Tensor:
    """Derivative (*batch, n, 2, 3) of :func:`project` with respect to the points."""
    reciprocal, slope = inverse_depth(points_cam[..., 2])
    direct = torch.eye(2, dtype=points_cam.dtype, device=points_cam.device) * reciprocal[..., None, None]
    rows = torch.cat([direct, points_cam[..., :2, None] * slope[..., None, None]], dim=-1)
    return intrinsic[..., None, :2, :2] @ rows


def unproject(intrinsic: Tensor, points_pinhole_px: Tensor) -> Tensor:
    """Rays (*batch, n, 3) in the camera frame, of depth 1, through pinhole pixels (*batch, n, 2)."""
    centred = points_pinhole_px - intrinsic[..., None, :2, 2]
    rays = torch.linalg.solve(intrinsic[..., :2, :2], centred.mT).mT
    return torch.cat([rays, torch.ones_like(rays[..., :1])], dim=-1)
