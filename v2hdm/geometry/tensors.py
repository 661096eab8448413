"""The twins in torch of :mod:`~v2hdm.geometry.rigid`, :mod:`~v2hdm.geometry.ipm` and the lens.

Functions take any leading ``*batch`` dimensions, float32 or float64, and are differentiable everywhere
within their stated domain, the identity included. Homographies, projection, lenses, warps and logarithms
are kornia's. :func:`exp`, :func:`inverse`, :func:`adjoint`, :func:`left_jacobian` and
:func:`inverse_depth` stand in the solver's inner loop and are written in closed form.
"""

from __future__ import annotations

import torch
from kornia.geometry import calibration as brown_conrady
from kornia.geometry.camera.distortion_kannala_brandt import (
    distort_points_kannala_brandt,
    undistort_points_kannala_brandt,
)
from kornia.geometry.camera.perspective import project_points
from kornia.geometry.liegroup import Se3
from kornia.geometry.linalg import transform_points
from kornia.geometry.transform import remap
from torch import Tensor

from v2hdm.geometry.rigid import EXP_SERIES, LEFT_JACOBIAN_SERIES
from v2hdm.records import CameraInfo

UNDISTORT_STEPS = 50
"""Fixed-point steps of :func:`undistort_points`, as many as :func:`v2hdm.geometry.lens.undistort_points`
takes; kornia's default of 5 errs by tenths of a pixel near the corners."""

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


def apply(dst_from_src: Tensor, points_src: Tensor) -> Tensor:
    """Points (*batch, n, 3) of ``src`` in ``dst``."""
    return points_src @ dst_from_src[..., :3, :3].mT + dst_from_src[..., None, :3, 3]


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


def log(dst_from_src: Tensor) -> Tensor:
    """The tangent (*batch, 6) of a rigid motion, with a rotation of at most pi."""
    matrices = dst_from_src.reshape(-1, 4, 4)
    tangent: Tensor = Se3.from_matrix(matrices).log()
    return tangent.reshape(*dst_from_src.shape[:-2], 6)


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


def ipm_from_extrinsic(intrinsic: Tensor, cam_from_vehicle: Tensor) -> Tensor:
    """The IPM ``vehicle_from_pinhole_px`` (*batch, 3, 3), of unit norm, of a camera's pose.

    Args:
        intrinsic: K, (*batch, 3, 3), px.
        cam_from_vehicle: (*batch, 4, 4).
    """
    ipm: Tensor = torch.linalg.inv(intrinsic @ cam_from_vehicle[..., :3, [0, 1, 3]])
    norm: Tensor = torch.linalg.matrix_norm(ipm, keepdim=True)
    return ipm / norm


def apply_homography(dst_from_src: Tensor, points_src: Tensor) -> Tensor:
    """Points (*batch, n, 2) mapped by a homography (*batch, 3, 3), not at infinity."""
    mapped: Tensor = transform_points(dst_from_src, points_src)
    return mapped


def project(intrinsic: Tensor, points_cam: Tensor) -> Tensor:
    """Pinhole pixels (*batch, n, 2) of points (*batch, n, 3) in front of the camera; K is (*batch, 3, 3)."""
    pinhole_px: Tensor = project_points(points_cam, intrinsic[..., None, :, :])
    return pinhole_px


def undistort_points(info: CameraInfo, points_px: Tensor) -> Tensor:
    """Recorded pixels (n, 2) to pinhole pixels (n, 2) of the same intrinsic matrix."""
    intrinsic, coefficients = _lens(info, points_px)
    if info.distortion_model == "equidistant":
        parameters = torch.cat([_focal_and_centre(intrinsic), coefficients])
        at_depth_one = undistort_points_kannala_brandt(points_px, parameters)
        return at_depth_one @ intrinsic[:2, :2].mT + intrinsic[:2, 2]
    pinhole_px: Tensor = brown_conrady.undistort_points(
        points_px, intrinsic, coefficients, num_iters=UNDISTORT_STEPS
    )
    return pinhole_px


def distort_points(info: CameraInfo, points_pinhole_px: Tensor) -> Tensor:
    """Pinhole pixels (n, 2) to recorded pixels (n, 2): the inverse of :func:`undistort_points`."""
    intrinsic, coefficients = _lens(info, points_pinhole_px)
    points_px: Tensor
    if info.distortion_model == "equidistant":
        centred = points_pinhole_px - intrinsic[:2, 2]
        at_depth_one = torch.linalg.solve(intrinsic[:2, :2], centred.mT).mT
        parameters = torch.cat([_focal_and_centre(intrinsic), coefficients])
        points_px = distort_points_kannala_brandt(at_depth_one, parameters)
    else:
        points_px = brown_conrady.distort_points(points_pinhole_px, intrinsic, coefficients)
    return points_px


def warp_to_ground(image: Tensor, pinhole_px_from_ground: Tensor, points_ground: Tensor) -> Tensor:
    """Values (*batch, channels, rows, columns) that undistorted images show at a grid of ground points.

    Points outside an image are zero. Ground behind the camera is not told apart from ground before it.

    Args:
        image: (*batch, channels, height, width) without lens distortion.
        pinhole_px_from_ground: K [r1 r2 t], (*batch, 3, 3).
        points_ground: (rows, columns, 2) m.
    """
    rows, columns = points_ground.shape[:2]
    batch = image.shape[:-3]
    at_px = apply_homography(pinhole_px_from_ground, points_ground.reshape(-1, 2).expand(*batch, -1, 2))
    at_px = at_px.reshape(-1, rows, columns, 2)
    values: Tensor = remap(
        image.reshape(-1, *image.shape[-3:]), at_px[..., 0], at_px[..., 1], align_corners=True
    )
    return values.reshape(*batch, -1, rows, columns)


def _lens(info: CameraInfo, like: Tensor) -> tuple[Tensor, Tensor]:
    """K (3, 3) and the distortion coefficients of a camera, of the kind of another tensor."""
    return torch.as_tensor(info.intrinsic).to(like), torch.tensor(info.distortion).to(like)


def _focal_and_centre(intrinsic: Tensor) -> Tensor:
    """fx, fy, cx and cy (4,) of K (3, 3)."""
    return torch.stack([intrinsic[0, 0], intrinsic[1, 1], intrinsic[0, 2], intrinsic[1, 2]])
