"""IPM, depths and lenses in torch and kornia, for mapping, adjustment and the mosaic.

Functions take any leading ``*batch`` dimensions, float32 or float64, and are differentiable on their domain.
:func:`inverse` and :func:`inverse_depth` run in the solver's inner loop, so they use the closed form.
"""

from __future__ import annotations

import torch
from kornia.geometry import calibration as brown_conrady
from kornia.geometry.camera.distortion_kannala_brandt import distort_points_kannala_brandt
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.linalg import transform_points
from torch import Tensor

from v2hdm.records import CameraInfo

NEAR_M = 0.1  # depth below which :func:`inverse_depth` leaves 1 / z: nothing a vehicle maps is that close


def inverse_depth(depth_m: Tensor) -> tuple[Tensor, Tensor]:
    """1 / z and its derivative, continued below :data:`NEAR_M` by the tangent line.

    A point that a step puts behind the camera then has a large, finite cost whose gradient leads back to the
    front, without pole and mirror image.
    """
    reciprocal = 1 / depth_m.clamp(min=NEAR_M)
    slope = -reciprocal.square()
    return reciprocal + slope * (depth_m - depth_m.clamp(min=NEAR_M)), slope


def inverse(dst_from_src: Tensor) -> Tensor:
    """The inverse (*batch, 4, 4) of a rigid transform, by transposing its rotation."""
    turn = dst_from_src[..., :3, :3].mT
    top = torch.cat([turn, -(turn @ dst_from_src[..., :3, 3:])], dim=-1)
    return torch.cat([top, top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)], dim=-2)


def back_project(ground_from_pinhole_px: Tensor, pinhole_px: Tensor) -> Tensor:
    """Ground points (N, K, 2) of pixels (N, K, 2) by IPMs (N, 3, 3); nan at and above the horizon."""
    third = convert_points_to_homogeneous(pinhole_px) @ ground_from_pinhole_px[:, 2, :, None]
    return torch.where(third > 0, transform_points(ground_from_pinhole_px, pinhole_px), torch.nan)


def back_project_with_jacobian(ground_from_pinhole_px: Tensor, pinhole_px: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`back_project` and its Jacobian (N, K, 2, 2) by the pixels, nan where the point is."""
    with torch.enable_grad():
        leaves = pinhole_px.detach().requires_grad_()
        points = back_project(ground_from_pinhole_px, leaves)
        x, y = (
            torch.autograd.grad(points[..., axis].nansum(), leaves, retain_graph=axis == 0)[0]
            for axis in (0, 1)
        )
    points = points.detach()
    return points, torch.where(points[..., None].isfinite(), torch.stack([x, y], dim=-2), torch.nan)


def distort_points(info: CameraInfo, points_pinhole_px: Tensor) -> Tensor:
    """Pinhole to recorded pixels (n, 2): see :func:`v2hdm.geometry.lens.distort_points`."""
    intrinsic = torch.as_tensor(info.intrinsic).to(points_pinhole_px)
    coefficients = torch.tensor(info.distortion).to(points_pinhole_px)
    points_px: Tensor
    if info.distortion_model == "equidistant":
        centred = points_pinhole_px - intrinsic[:2, 2]
        at_depth_one = torch.linalg.solve(intrinsic[:2, :2], centred.mT).mT
        focal_and_centre = torch.cat([intrinsic.diagonal()[:2], intrinsic[:2, 2]])
        points_px = distort_points_kannala_brandt(at_depth_one, torch.cat([focal_and_centre, coefficients]))
    else:
        points_px = brown_conrady.distort_points(points_pinhole_px, intrinsic, coefficients)
    return points_px
