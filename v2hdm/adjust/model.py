r"""The complete model: every residual, in torch and kornia, float64.

The paper (*Monocular Camera Mapping with Pose-Guided Optimization*, IROS 2023) projects the ground corners l
of markings through the extrinsic T = ``cam_from_vehicle`` and the recorded pose P = ``map_from_vehicle``, and
minimises the reprojection error over extrinsics and corners. The whitened residual of observation k, of
corner n by camera c in frame j, is

.. math:: r_k = \Sigma_k^{-1/2} (\pi(T_c\,e^{-q_c v_j}\,e^{-s_j}\,P_j^{-1}\,l_n) - u_k)

which is the paper's for s = 0 and q = 0. In addition, frames have states s (errors of the recorded pose, some
drifting) and cameras clock offsets q (late images, vehicle moving with the twist v). A rolling shutter
reads the first row r / 2 before the image's stamp and the last r / 2 after it: q_c becomes q_c + r_c rho_k,
with rho_k from -1/2 to 1/2 by the observation's row. Lanes are splines whose knots are points l like corners,
observed as lines: of :math:`\Sigma_k^{-1/2}` the row across the line remains. A knot moves across its lane
alone, since t'(l - l0) along it is held at zero. The cost is half the sum of squares, those of observations
under a robust loss.

Tangents are (translation, rotation), as in kornia's ``Se3``, and act from the left: exp(x) T.
Derivatives are those of :mod:`v2hdm.adjust.engine`, against which :mod:`v2hdm.adjust.kernels` are tested.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from kornia.geometry.camera.perspective import project_points
from kornia.geometry.liegroup import Se3, So3
from kornia.geometry.linalg import inverse_transformation, transform_points
from torch import Tensor
from torch.nn.functional import one_hot, pad

from v2hdm.adjust.arrays import Arrays
from v2hdm.geometry.tensors import NEAR_M, inverse

MIN_DEPRESSION_SINE = 0.01
"""Least sine of a ray's depression: below, its ground point is too far away to be determined."""


@dataclass(frozen=True)
class Estimate:
    """A value of all unknowns.

    Extrinsics (C, 4, 4), frame states (J, S), corners (N, 2), and clock offsets (C, Q), s, with the error of
    the stated read-out time in the last column, if estimated.
    """

    cam_from_vehicle: Tensor
    frame_state: Tensor
    corners_map: Tensor
    clock_s: Tensor


@dataclass(frozen=True)
class Gradient:
    """A gradient: by extrinsic (left tangent, (C, 6)), frame state (J, S), corner (N, 2) and clock (C, Q)."""

    extrinsic: Tensor
    frame_state: Tensor
    corners_map: Tensor
    clock_s: Tensor


@dataclass(frozen=True)
class Loss:
    """A robust loss, by name and scale."""

    name: str
    scale: float


def rigid(tangent: Tensor) -> Tensor:
    """Rigid motions exp(x) (*batch, 4, 4) of tangents x (*batch, 6)."""
    motion: Tensor = Se3.exp(tangent.reshape(-1, 6)).matrix()
    return motion.view(*tangent.shape[:-1], 4, 4)


def left_tangent(moved: Tensor, base: Tensor) -> Tensor:
    """The tangent x (*batch, 6) of moved = exp(x) base, to first order in x."""
    motion = moved @ inverse(base)
    return torch.cat([motion[..., :3, 3], So3.vee(motion[..., :3, :3])], dim=-1)


def frame_tangent(arrays: Arrays, frame_state: Tensor) -> Tensor:
    """Tangents s (..., J, 6) of the frames from their states (..., J, S); two states may share an axis."""
    axis = torch.tensor(arrays.states, dtype=torch.int64, device=frame_state.device)
    return frame_state @ one_hot(axis, 6).to(frame_state.dtype)


def cam_from_map(arrays: Arrays, cam_from_vehicle: Tensor, frame_state: Tensor, clock_s: Tensor) -> Tensor:
    """Poses T exp(-(q + r rho) v) exp(-s) P^-1 (C, M, 4, 4) of every pair of a camera and a moment.

    ``cam_from_vehicle`` is (C, 4, 4), ``frame_state`` (J, S) or by pair (C, M, S), ``clock_s`` (C, Q) or by
    pair (C, M, Q).
    """
    camera = cam_from_vehicle[:, None]
    vehicle_from_map = arrays.vehicle_from_map
    by_pair = frame_state.ndim == 3
    if by_pair:
        vehicle_from_map = arrays.at_moments(vehicle_from_map)
    if arrays.states:
        vehicle_from_map = rigid(-frame_tangent(arrays, frame_state)) @ vehicle_from_map
    if not by_pair:
        vehicle_from_map = arrays.at_moments(vehicle_from_map)
    if arrays.moves:
        camera = camera @ rigid(-moved(arrays, clock_s))
    return camera @ vehicle_from_map


def moved(arrays: Arrays, clock_s: Tensor) -> Tensor:
    """Motion of the vehicle since the stamps, tangents (C, M, 6), for offsets (C, Q) or (C, M, Q)."""
    late = clock_s if clock_s.ndim == 3 else clock_s[:, None]
    by_clock: Tensor = (arrays.clock_twist @ late[..., None])[..., 0]
    return by_clock if arrays.read_out is None else by_clock + arrays.read_out


def before_camera(points_cam: Tensor) -> Tensor:
    """Points (k, 3) for projection: below the depth ``NEAR_M``, 1 / z continues as in ``inverse_depth``."""
    depth = points_cam[:, 2:]
    if bool((depth >= NEAR_M).all()):
        return points_cam
    at_least = depth.clamp(min=NEAR_M)
    return torch.cat([points_cam[:, :2] * (1 + (at_least - depth) / NEAR_M), at_least], dim=1)


def points_in_camera(cam_from_map: Tensor, corners_map: Tensor) -> Tensor:
    """Points (k, 3) in the camera of corners (k, 2) on the ground z = 0, one transform per corner."""
    points_cam: Tensor = transform_points(cam_from_map, pad(corners_map, (0, 1))[:, None])[:, 0]
    return points_cam


def reprojection_error(points_cam: Tensor, measured: Tensor) -> Tensor:
    """Projected points (k, 3) minus the measured ones (2, k), at depth 1: (k, 2)."""
    error: Tensor = project_points(before_camera(points_cam), _at_depth_one(points_cam.device)) - measured.T
    return error


@lru_cache(maxsize=8)
def _at_depth_one(device: torch.device) -> Tensor:
    return torch.eye(3, dtype=torch.float64, device=device)


def corner_residual(points_cam: Tensor, measured: Tensor, root_information: Tensor) -> Tensor:
    """The paper's reprojection error (k, 2), whitened; ``measured`` (2, k) is at depth 1."""
    x, y = reprojection_error(points_cam, measured).unbind(1)
    a, b, c = root_information
    return torch.stack([a * x, b * x + c * y], dim=1)


def ground_from_ray(cam_from_map: Tensor) -> Tensor:
    """The inverse homographies (P, 3, 3) of pairs (P, 4, 4), the IPM: from rays (u, v, 1) to the ground.

    The third coordinate is the drop of the ray, positive below the horizon.
    """
    map_from_cam: Tensor = inverse_transformation(cam_from_map)
    level = map_from_cam[:, :2, :3]
    drop = -map_from_cam[:, 2:3, :3]
    centre = map_from_cam[:, :2, 3:]
    height = map_from_cam[:, 2:3, 3:]
    return torch.cat([height * level + centre * drop, drop], dim=1)


def back_projected(ground_from_ray: Tensor, measured: Tensor, root_information: Tensor) -> Tensor:
    """Information (5, k) of rays (2, k) on where they meet the ground, 0 at and above the horizon.

    Its rows are xx, yx and yy of J'J, with the derivative J of the whitened residual by the corner, and x and
    y of J'J times the ground point. ``ground_from_ray`` (9, k) are the rays' homographies, row by row.
    """
    u, v = measured
    xu, xv, x, yu, yv, y, du, dv, drop = ground_from_ray
    drop = drop + du * u + dv * v
    x = (x + xu * u + xv * v) / drop
    y = (y + yu * u + yv * v) / drop
    # A homography's derivative: of the ground point by the ray, times the drop.
    xu = xu - x * du
    xv = xv - x * dv
    yu = yu - y * du
    yv = yv - y * dv
    # Its inverse is the residual's derivative, before whitening.
    share = drop / (xu * yv - xv * yu)
    a, b, c = root_information * share
    first_x = a * yv
    first_y = -a * xv
    second_x = b * yv - c * yu
    second_y = c * xu - b * xv
    xx = first_x.square() + second_x.square()
    yx = first_x * first_y + second_x * second_y
    yy = first_y.square() + second_y.square()
    is_met = drop > MIN_DEPRESSION_SINE * (1 + u.square() + v.square()).sqrt()
    return torch.where(is_met, torch.stack([xx, yx, yy, xx * x + yx * y, yx * x + yy * y]), 0.0)


def depression_sine(cam_from_map: Tensor, measured: Tensor) -> Tensor:
    """Sines (k,) of the depression of rays (2, k) at depth 1: negative above the horizon."""
    ray = pad(measured.T, (0, 1), value=1.0)
    sine: Tensor = -(ray * cam_from_map[:, :3, 2]).sum(1) / ray.norm(dim=1)
    return sine


def centre_residual(arrays: Arrays, cam_from_vehicle: Tensor) -> Tensor:
    """Camera centres o = -R' t minus the surveyed ones, (C, 3)."""
    rotation = cam_from_vehicle[:, :3, :3]
    translation = cam_from_vehicle[:, :3, 3:]
    return (-(rotation.mT @ translation)[..., 0] - arrays.centre) * arrays.centre_information_root


def ground_planes(cam_from_vehicle: Tensor) -> Tensor:
    """The vehicle's ground in cameras (C, 4, 4): its normal, upwards, and the height above it, (C, 4)."""
    normal = cam_from_vehicle[:, :3, 2]
    height = -(normal * cam_from_vehicle[:, :3, 3]).sum(dim=1, keepdim=True)
    return torch.cat([normal, height], dim=1)


def by_ground_planes(cam_from_vehicle: Tensor) -> Tensor:
    """Derivatives (C, 4, 6) of :func:`ground_planes` by left tangents of the extrinsics."""
    normal = cam_from_vehicle[:, :3, 2]
    out = normal.new_zeros(len(normal), 4, 6)
    out[:, :3, 3:] = -So3.hat(normal)
    out[:, 3, :3] = -normal
    return out


def ground_residual(arrays: Arrays, cam_from_vehicle: Tensor) -> Tensor:
    """The vehicle's ground in the cameras minus the plane that texture shows, (C, 3)."""
    off = ground_planes(cam_from_vehicle) - arrays.ground_plane
    residual: Tensor = (arrays.ground_root @ off[..., None])[..., 0]
    return residual


def state_residual(arrays: Arrays, frame_state: Tensor, before: Tensor | None = None) -> Tensor:
    """Innovations (J, S) of the frame states: s_j - A_j s_(j-1).

    A white state has A = 0; a drift is a Gauss-Markov process with A = exp(-d / D) over the driven distance
    d. ``before`` (J, S) overrides the states of the previous frames.
    """
    if before is None:
        before = torch.cat([torch.zeros_like(frame_state[:1]), frame_state[:-1]])
    expected = (arrays.state_transition @ before[..., None])[..., 0]
    return (frame_state - expected) * arrays.state_information_root


def clock_residual(arrays: Arrays, clock_s: Tensor) -> Tensor:
    """Clock offsets (C, Q), and read-out times minus the stated ones."""
    return clock_s * arrays.clock_information_root


def control_residual(arrays: Arrays, corners_map: Tensor) -> Tensor:
    """Corners (N, 2) minus their surveyed positions; knots of lanes are held along their line."""
    x, y = (corners_map - arrays.control).unbind(1)
    a, b, c = arrays.control_root.unbind(1)
    return torch.stack([a * x, b * x + c * y], dim=1)


def length_residual(arrays: Arrays, first_map: Tensor, second_map: Tensor) -> Tensor:
    """Distances (M,) of corners (M, 2) minus the known lengths."""
    lengths = arrays.lengths
    distance_m: Tensor = torch.linalg.vector_norm(first_map - second_map, dim=1)
    return (distance_m - lengths.length_m) * lengths.information_root


def prior_residuals(arrays: Arrays, estimate: Estimate) -> dict[str, Tensor]:
    """All residuals except those of observations, by name."""
    corners = estimate.corners_map
    lengths = arrays.lengths
    return {
        "camera_centre": centre_residual(arrays, estimate.cam_from_vehicle),
        "ground_planes": ground_residual(arrays, estimate.cam_from_vehicle),
        "frame_states": state_residual(arrays, estimate.frame_state),
        "clock_offsets": clock_residual(arrays, estimate.clock_s),
        "control_points": control_residual(arrays, corners),
        "known_lengths": length_residual(arrays, corners[lengths.first], corners[lengths.second]),
    }


def prior_terms(arrays: Arrays, estimate: Estimate) -> dict[str, Tensor]:
    """The cost except that of observations, by name."""
    residuals = prior_residuals(arrays, estimate)
    return {name: residual.square().sum() / 2 for name, residual in residuals.items()}


def robustified(robust: Loss, squared: Tensor) -> tuple[Tensor, Tensor]:
    """The loss rho(s) of squared residuals s, and its derivative, the IRLS weight.

    All losses equal s near 0 and depart from it at the scale (Barron, A General and Adaptive Robust Loss
    Function, CVPR 2019, alpha = 2, 1, 0, -2, up to the convention of the scale).
    """
    if robust.name == "none":
        return squared, torch.ones_like(squared)
    cut = robust.scale * robust.scale
    if robust.name == "huber":
        norm = squared.clamp(min=cut).sqrt()
        return torch.where(squared <= cut, squared, 2 * robust.scale * norm - cut), robust.scale / norm
    ratio = squared / cut
    if robust.name == "cauchy":
        return cut * torch.log1p(ratio), 1 / (1 + ratio)
    if robust.name == "geman_mcclure":
        return squared / (1 + ratio), (1 + ratio).square().reciprocal()
    raise ValueError(f"unknown loss '{robust.name}'")
