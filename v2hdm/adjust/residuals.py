"""The residuals, their derivatives and the cost: pure functions of an estimate.

With ``A = [r1 r2 t]`` of a pair's ``cam_from_map`` a corner l lies at p = A (l_x, l_y, 1) in the
camera and is seen at (p_x / p_z, p_y / p_z). Let a (2 x 3) be the whitened derivative of that with
respect to p. Then the residual's derivative is a [r1 r2] with respect to the corner and
[a, p x a] with respect to a left perturbation (translation, rotation) of the pair's ``cam_from_map``,
and that is what extrinsics and frame states act through:

- extrinsic c: a left perturbation of ``cam_from_vehicle`` is one of every pair of c;
- state s of frame j: ``cam_from_vehicle exp(-s) vehicle_from_map``, so ds perturbs the pair by
  -Ad(cam_from_vehicle) J_l(-s) ds (see :func:`pair_from_state`);
- clock offset q of camera c: ``cam_from_vehicle exp(-q v_j) exp(-s) vehicle_from_map`` with the vehicle's
  twist v_j, so dq perturbs the pair by -Ad(cam_from_vehicle) v_j dq (see :func:`pair_from_clock`).

A gradient of the cost with respect to p is a force, so that of a pair is its *wrench*: the sums of the
forces and of their moments p x force.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.robust import loss
from v2hdm.geometry.camera import inverse_depth
from v2hdm.geometry.transform import adjoint, exp, left_jacobian


@dataclass(frozen=True)
class Estimate:
    """A point in the space of unknowns.

    Extrinsics (C, 4, 4), frame states (J, S), corners (N, 2), clock offsets (C, Q) in s.
    """

    cam_from_vehicle: Tensor
    frame_state: Tensor
    corners_map: Tensor
    clock_s: Tensor


@dataclass(frozen=True)
class Gradient:
    """Of a scalar: by extrinsic (left tangent, (C, 6)), frame state (J, S), corner (N, 2), clock (C, Q)."""

    extrinsic: Tensor
    frame_state: Tensor
    corners_map: Tensor
    clock_s: Tensor


@dataclass(frozen=True)
class View:
    """All observations under one estimate; each entry holds K columns.

    ``axes``: the three columns of A, each (3, K). ``point``: p. ``inverse_depth`` and its ``slope``.
    ``residual``: (2, K), whitened.
    """

    axes: tuple[Tensor, Tensor, Tensor]
    point: Tensor
    inverse_depth: Tensor
    slope: Tensor
    residual: Tensor

    @property
    def squared(self) -> Tensor:
        """Squared Mahalanobis distance (K,) of each observation."""
        return self.residual.square().sum(0)


@dataclass(frozen=True)
class Loss:
    """A robust loss by name and scale."""

    name: str
    scale: float


def frame_tangent(arrays: Arrays, frame_state: Tensor) -> Tensor:
    """The full tangents (J, 6) of the frames, zero where nothing is estimated."""
    tangent = frame_state.new_zeros(arrays.frame_count, 6)
    columns = torch.tensor(arrays.states, dtype=torch.int64, device=tangent.device)
    return tangent.index_add(1, columns, frame_state)


def pair_table(arrays: Arrays, estimate: Estimate) -> Tensor:
    """The columns of A of every pair, (P, 9)."""
    vehicle_from_map = arrays.vehicle_from_map
    if arrays.states:
        vehicle_from_map = exp(-frame_tangent(arrays, estimate.frame_state)) @ vehicle_from_map
    cam_from_map = _cam_from_vehicle_then(arrays, estimate) @ vehicle_from_map
    return cam_from_map[..., :3, [0, 1, 3]].mT.reshape(arrays.pair_count, 9)


def observe(arrays: Arrays, estimate: Estimate, table: Tensor | None = None) -> View:
    """Project every corner into every image that saw it; ``table`` is the :func:`pair_table`, if known."""
    table = pair_table(arrays, estimate) if table is None else table
    first, second, origin = table.index_select(0, arrays.pair).T.contiguous().chunk(3)
    x, y = estimate.corners_map.index_select(0, arrays.corner).T.contiguous()
    point = torch.addcmul(torch.addcmul(origin, first, x), second, y)
    reciprocal, slope = inverse_depth(point[2])
    dx, dy = torch.addcmul(-arrays.measured, point[:2], reciprocal)
    a, b, c = arrays.root_information
    residual = torch.stack([a * dx, b * dx + c * dy])
    return View((first, second, origin), point, reciprocal, slope, residual)


def squared_residuals(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Squared Mahalanobis distance (K,) of each observation."""
    table = pair_table(arrays, estimate)
    return torch.cat([observe(part, estimate, table).squared for _, part in arrays.parts()])


def _cam_from_vehicle_then(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Cameras from where the vehicle is at each frame's stated time, (C, J or 1, 4, 4)."""
    cam_from_vehicle = estimate.cam_from_vehicle[:, None]
    if not arrays.clock_twist.shape[-1]:
        return cam_from_vehicle
    moved = (arrays.clock_twist @ estimate.clock_s[:, None, :, None])[..., 0]
    return cam_from_vehicle @ exp(-moved)


def _pull_back(arrays: Arrays, view: View, by_residual: Tensor, wrench: Tensor, by_corner: Tensor) -> None:
    """Carry a gradient by the residuals (2, K) back to pairs and corners.

    It is added to the ``wrench`` (6, P) of every pair and the gradient ``by_corner`` (2, N).
    """
    a, b, c = arrays.root_information
    by_dx, by_dy = a * by_residual[0] + b * by_residual[1], c * by_residual[1]
    x, y, z = view.point
    fx, fy = by_dx * view.inverse_depth, by_dy * view.inverse_depth
    fz = (by_dx * x + by_dy * y) * view.slope
    force = torch.stack([fx, fy, fz])
    rows = torch.stack([fx, fy, fz, y * fz - z * fy, z * fx - x * fz, x * fy - y * fx])
    wrench.index_add_(1, arrays.pair, rows)
    along = torch.stack([(view.axes[0] * force).sum(0), (view.axes[1] * force).sum(0)])
    by_corner.index_add_(1, arrays.corner, along)


def jacobians(arrays: Arrays, view: View) -> tuple[Tensor, Tensor]:
    """Derivatives of the whitened residuals by pair (K, 2, 6) and by corner (K, 2, 2)."""
    a, b, c = arrays.root_information
    x, y = view.point[:2]
    direct, across = view.inverse_depth, view.slope
    o = torch.zeros_like(a)
    top = torch.stack([a * direct, o, a * x * across])
    low = torch.stack([b * direct, c * direct, (b * x + c * y) * across])
    by_point = torch.stack([top, low]).permute(2, 0, 1)
    position = view.point.T[:, None].expand_as(by_point)
    by_pair = torch.cat([by_point, torch.linalg.cross(position, by_point)], dim=-1)
    by_corner = by_point @ torch.stack([view.axes[0], view.axes[1]], dim=-1).permute(1, 0, 2)
    return by_pair, by_corner


def pair_from_state(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Derivative (C, J, 6, S) of each pair's left tangent by the states of its frame."""
    by_tangent = left_jacobian(-frame_tangent(arrays, estimate.frame_state))[..., list(arrays.states)]
    return -adjoint(_cam_from_vehicle_then(arrays, estimate)) @ by_tangent


def pair_from_clock(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Derivative (C, J, 6, Q) of each pair's left tangent by the clock offset of its camera."""
    return -adjoint(estimate.cam_from_vehicle)[:, None] @ arrays.clock_twist


def centre_residual(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Whitened residual (C, 3) of the prior on the camera centres, o = -R' t."""
    rotation, translation = estimate.cam_from_vehicle[:, :3, :3], estimate.cam_from_vehicle[:, :3, 3:]
    centre_vehicle = -(rotation.mT @ translation)[..., 0]
    return (centre_vehicle - arrays.centre) * arrays.centre_information_root


def state_residual(arrays: Arrays, frame_state: Tensor) -> Tensor:
    """Whitened innovations (J, S) of the frame states."""
    before = torch.cat([torch.zeros_like(frame_state[:1]), frame_state[:-1]])
    expected = (arrays.state_transition @ before[..., None])[..., 0]
    return (frame_state - expected) * arrays.state_information_root


def _observed_cost(arrays: Arrays, estimate: Estimate, robust: Loss) -> tuple[Tensor, Tensor, Tensor]:
    """The observations' cost, and its gradient: wrenches (C, J, 6) and by corner (N, 2)."""
    table = pair_table(arrays, estimate)
    cost, wrench = table.new_zeros(()), table.new_zeros(6, arrays.pair_count)
    by_corner = table.new_zeros(2, arrays.corner_count)
    for _, part in arrays.parts():
        view = observe(part, estimate, table)
        rho, weight = loss(robust.name, view.squared, robust.scale)
        cost = cost + rho.sum() / 2
        _pull_back(part, view, view.residual * weight, wrench, by_corner)
    return cost, wrench.T.reshape(arrays.camera_count, arrays.frame_count, 6), by_corner.T


def cost_and_gradient(arrays: Arrays, estimate: Estimate, robust: Loss) -> tuple[dict[str, Tensor], Gradient]:
    """The named terms of the cost, and the gradient of their sum."""
    observed, wrench, by_corner = _observed_cost(arrays, estimate, robust)
    centre = centre_residual(arrays, estimate)
    state = state_residual(arrays, estimate.frame_state)
    clock = estimate.clock_s * arrays.clock_information_root
    off_control = estimate.corners_map - arrays.control
    by_control = off_control * arrays.control_information[:, None]
    terms = {
        "observations": observed,
        "camera_centre": centre.square().sum() / 2,
        "frame_states": state.square().sum() / 2,
        "clock_offsets": clock.square().sum() / 2,
        "control_points": (off_control * by_control).sum() / 2,
    }
    by_extrinsic = wrench.sum(1)
    # A left perturbation moves the centre by minus its translation part, turned into the vehicle.
    rotation = estimate.cam_from_vehicle[:, :3, :3]
    by_extrinsic[:, :3] -= (rotation @ (centre * arrays.centre_information_root)[..., None])[..., 0]
    by_state = (pair_from_state(arrays, estimate).mT @ wrench[..., None])[..., 0].sum(0)
    innovation = state * arrays.state_information_root
    by_state += innovation
    by_state[:-1] -= (arrays.state_transition.mT @ innovation[..., None])[1:, :, 0]
    by_clock = (pair_from_clock(arrays, estimate).mT @ wrench[..., None])[..., 0].sum(1)
    by_clock += clock * arrays.clock_information_root
    return terms, Gradient(by_extrinsic, by_state, by_corner + by_control, by_clock)
