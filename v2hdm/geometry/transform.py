"""Frames, conventions and rigid motions: the one place where they are written down.

Frames
    - ``map``: local east-north-up, metres, z up, the ground near z = 0, origin near the site (ROS
      REP-105). A geodetic origin, where there is one, only matters to the exports.
    - ``vehicle``: x forward, y left, z up; the origin on the ground under the rear axle (REP-103,
      ``base_link``). Roll, pitch and heading turn about x, y and z by the right-hand rule: a positive
      pitch lowers the nose, a positive heading turns left.
    - ``cam``: optical frame, z forward through the lens, x right, y down.
    - ``px``: image, u right, v down; the *centre* of the top-left pixel is (0, 0) (OpenCV's rule).
      ``pinhole_px`` are the same points on the image without lens distortion, of the same intrinsic K.

Names
    - A transform is ``dst_from_src``, a 4 x 4 matrix that takes points of ``src`` to ``dst``; chains
      read by their touching names: ``cam_from_map = cam_from_vehicle @ vehicle_from_map``. Inverting
      swaps the words. The paper's [R_cb | t_cb] is ``cam_from_vehicle``, its [R_wb | t_wb]
      ``map_from_vehicle``, its H ``vehicle_from_pinhole_px``.
    - Points end in their frame (``corners_map``), scalars in their unit (``_px``, ``_m``, ``_rad``, ``_s``).
    - Index letters: ``i`` image, ``j`` marking, ``k`` corner observation.

Tangents
    - A tangent of SE(3) is (..., 6): **translation first (m), then rotation (rad)**.
    - Perturbations act from the **left**, ``exp(tangent) @ dst_from_src``: they are expressed in ``dst``.
      The translation part of a perturbed ``cam_from_vehicle`` is then minus the motion of the camera's
      centre in its own axes, whatever the rotation part.

All functions take any leading ``*batch`` dimensions, float32 or float64, and are differentiable
everywhere within their stated domain, the identity included.
"""

from __future__ import annotations

from math import factorial

import torch
from kornia.geometry.liegroup import Se3
from torch import Tensor

# Enough for machine precision up to |rotation| = pi: pi^(2 * 15) / 31! is below 1e-18.
_SERIES_TERMS = 15

# Coefficients (terms, series) of (-theta^2)^n in sin(theta) / theta, (1 - cos(theta)) / theta^2 and
# (theta - sin(theta)) / theta^3.
_EXP_SERIES = torch.tensor(
    [[1 / factorial(2 * n + offset) for offset in (1, 2, 3)] for n in range(_SERIES_TERMS)],
    dtype=torch.float64,
)

# The same of the powers ad, ad^2, ad^3, ad^4 in the sum of ad^n / (n + 1)!, see left_jacobian.
_LEFT_JACOBIAN_SERIES = torch.tensor(
    [
        [(1 - n) / factorial(2 * n + offset) for offset in (2, 3)]
        + [(n + 1) / factorial(2 * n + 2 + offset) for offset in (2, 3)]
        for n in range(_SERIES_TERMS)
    ],
    dtype=torch.float64,
)


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


def rotation_angle(rotation: Tensor) -> Tensor:
    """Angle in radians (*batch) of a rotation (*batch, 3, 3), accurate for small angles too."""
    skew = rotation - rotation.mT
    sine_vector = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1) / 2
    cosine = (rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.atan2(sine_vector.norm(dim=-1), cosine)
