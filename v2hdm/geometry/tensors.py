"""IPM, rigid motions and lenses in torch and kornia, for the mapping, the adjustment and the mosaic.

Functions take any leading ``*batch`` dimensions, float32 or float64, and are differentiable everywhere
within their stated domain, the identity included. Points on the ground and their derivatives, and lenses,
are kornia's. :func:`exp`, :func:`inverse`, :func:`adjoint`, :func:`left_jacobian` and
:func:`inverse_depth` stand in the solver's inner loop and are written in closed form.
"""

from __future__ import annotations

import torch
from kornia.geometry import calibration as brown_conrady
from kornia.geometry.camera.distortion_kannala_brandt import distort_points_kannala_brandt
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.linalg import transform_points
from torch import Tensor

from v2hdm.geometry.rigid import EXP_SERIES, LEFT_JACOBIAN_SERIES
from v2hdm.records import CameraInfo

_EXP_SERIES = torch.tensor(EXP_SERIES, dtype=torch.float64)
_LEFT_JACOBIAN_SERIES = torch.tensor(LEFT_JACOBIAN_SERIES, dtype=torch.float64)

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


def _even_series(rotation: Tensor, coefficients: Tensor) -> tuple[Tensor, ...]:
    """Power series in -theta^2 by Horner's rule, theta = |rotation|, each (*batch, 1, 1)."""
    x = -rotation.square().sum(-1)[..., None, None, None]
    terms = coefficients.to(rotation)
    total = terms[-1]
    for term in reversed(terms[:-1].unbind()):
        total = torch.addcmul(term, total, x)
    return total.unbind(-1)


def hat(vector: Tensor) -> Tensor:
    """Skew matrix (*batch, 3, 3) of a vector (*batch, 3): ``hat(a) @ b == cross(a, b)``."""
    x, y, z = vector.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).reshape(*vector.shape[:-1], 3, 3)


def make_transform(rotation: Tensor, translation: Tensor) -> Tensor:
    """The 4 x 4 transform (*batch, 4, 4) of a rotation (*batch, 3, 3) and a translation (*batch, 3)."""
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def inverse(dst_from_src: Tensor) -> Tensor:
    """The inverse (*batch, 4, 4) of a rigid transform, by transposing its rotation."""
    src_from_dst_rotation = dst_from_src[..., :3, :3].mT
    return make_transform(src_from_dst_rotation, -(src_from_dst_rotation @ dst_from_src[..., :3, 3:])[..., 0])


def exp(tangent: Tensor) -> Tensor:
    """The rigid motion (*batch, 4, 4) of a tangent (*batch, 6), for rotations up to pi.

    Rodrigues' formula with its coefficients as power series of theta^2: one smooth expression, hence
    exact derivatives at the identity.

    >>> exp(torch.zeros(6)).equal(torch.eye(4))
    True
    """
    translation, rotation = tangent[..., :3], tangent[..., 3:]
    omega = hat(rotation)
    omega_squared = omega @ omega
    eye = torch.eye(3, dtype=tangent.dtype, device=tangent.device)
    sine, cosine, third = _even_series(rotation, _EXP_SERIES)
    moved = (eye + cosine * omega + third * omega_squared) @ translation[..., None]
    return make_transform(eye + sine * omega + cosine * omega_squared, moved[..., 0])


def adjoint(dst_from_src: Tensor) -> Tensor:
    """The matrix (*batch, 6, 6) that takes tangents of ``src`` to ``dst``.

    ``dst_from_src @ exp(x) == exp(adjoint(dst_from_src) @ x) @ dst_from_src``.
    """
    rotation, translation = dst_from_src[..., :3, :3], dst_from_src[..., :3, 3]
    top = torch.cat([rotation, hat(translation) @ rotation], dim=-1)
    bottom = torch.cat([torch.zeros_like(rotation), rotation], dim=-1)
    return torch.cat([top, bottom], dim=-2)


def left_jacobian(tangent: Tensor) -> Tensor:
    """Derivative (*batch, 6, 6) of :func:`exp`: ``exp(x + dx) = exp(left_jacobian(x) @ dx) @ exp(x)``.

    The series sum of ad^n / (n + 1)!, closed by ad^5 = -2 theta^2 ad^3 - theta^4 ad (Barfoot, State
    Estimation for Robotics, 2nd ed., section 8.1.5), for rotations up to pi.
    """
    omega = hat(tangent[..., 3:])
    top = torch.cat([omega, hat(tangent[..., :3])], dim=-1)
    ad = torch.cat([top, torch.cat([torch.zeros_like(omega), omega], dim=-1)], dim=-2)
    first, second, third, fourth = _even_series(tangent[..., 3:], _LEFT_JACOBIAN_SERIES)
    eye = torch.eye(6, dtype=tangent.dtype, device=tangent.device)
    return eye + ad @ (first * eye + ad @ (second * eye + ad @ (third * eye + fourth * ad)))


def back_project(ground_from_pinhole_px: Tensor, pinhole_px: Tensor) -> Tensor:
    """Ground points (N, K, 2) of pixels (N, K, 2) by IPMs (N, 3, 3); nan at and above the horizon.

    Below the horizon the third homogeneous coordinate is positive, as :mod:`v2hdm.geometry.ipm` has it.
    """
    third = convert_points_to_homogeneous(pinhole_px) @ ground_from_pinhole_px[:, 2, :, None]
    return torch.where(third > 0, transform_points(ground_from_pinhole_px, pinhole_px), torch.nan)


def back_project_with_jacobian(ground_from_pinhole_px: Tensor, pinhole_px: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`back_project`, and its derivative (N, K, 2, 2) by the pixels, nan where it is nan itself.

    Each point depends on its own pixel alone, so that one backward pass per coordinate gives all of it.
    """
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
    """Pinhole pixels (n, 2) to recorded pixels (n, 2): as :func:`v2hdm.geometry.lens.distort_points`."""
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
