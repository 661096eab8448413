"""The residuals and the cost with its gradient: pure functions of an estimate.

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
forces and of their moments p x force. Both are sums over f, x f and y f, the gradient by A, which is what is
added up (see :func:`wrenches`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, CameraQuadratic, Run
from v2hdm.adjust.robust import loss
from v2hdm.geometry.rigid import left_jacobian as rigid_left_jacobian
from v2hdm.geometry.rigid import log
from v2hdm.geometry.tensors import adjoint, exp, inverse, inverse_depth, left_jacobian


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
    """The observations of a run under one estimate; each entry holds k columns.

    ``ground``: (2, k), the points of the map. ``axes``: the first two columns of A, each (3, k).
    ``point``: p. ``inverse_depth`` and its ``slope``. ``off``: (2, k), projected minus measured, at depth 1.
    ``residual``: (2, k), the same whitened.
    """

    ground: Tensor
    axes: tuple[Tensor, Tensor]
    point: Tensor
    inverse_depth: Tensor
    slope: Tensor
    off: Tensor
    residual: Tensor

    @property
    def squared(self) -> Tensor:
        """Squared Mahalanobis distance (k,) of each observation."""
        return self.residual.square().sum(0)

    def force(self, by_off: Tensor) -> Tensor:
        """The gradient (3, k) by p of what has the gradient ``by_off`` (2, k)."""
        along = (by_off * self.point[:2]).sum(0) * self.slope
        return torch.cat([by_off * self.inverse_depth, along[None]])

    def by_table(self, force: Tensor) -> Tensor:
        """The gradient (9, k) by the columns of A."""
        return torch.cat([force * self.ground[0], force * self.ground[1], force])

    def along_axes(self, force: Tensor) -> Tensor:
        """The gradient (2, k) by the observed corner."""
        return torch.stack([(self.axes[0] * force).sum(0), (self.axes[1] * force).sum(0)])


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


def cam_from_map(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Of every pair, (C, J, 4, 4)."""
    vehicle_from_map = arrays.vehicle_from_map
    if arrays.states:
        vehicle_from_map = exp(-frame_tangent(arrays, estimate.frame_state)) @ vehicle_from_map
    cameras = _cam_from_vehicle_then(arrays, estimate)
    if cameras.shape[1] > 1:
        return cameras @ vehicle_from_map
    # One product of two matrices, instead of many of four rows each.
    product = cameras.reshape(-1, 4) @ vehicle_from_map.transpose(0, 1).reshape(4, -1)
    return product.view(len(cameras), 4, -1, 4).transpose(1, 2).contiguous()


def pair_table(arrays: Arrays, estimate: Estimate) -> Tensor:
    """The columns of A of every pair, one below the other, (9, P)."""
    return columns_of(cam_from_map(arrays, estimate))


def columns_of(transforms: Tensor) -> Tensor:
    """The first, second and fourth column of transforms (C, J, 4, 4), one below the other, (9, P)."""
    return transforms[..., :3, [0, 1, 3]].permute(3, 2, 0, 1).reshape(9, -1)


def wrenches(table: Tensor, by_table: Tensor) -> Tensor:
    """Gradients (6, P) by the pairs' left tangents, from those (9, P) by their columns."""
    shift = by_table[6:]
    columns, forces = table.view(3, 3, -1), by_table.view(3, 3, -1)
    return torch.cat([shift, torch.linalg.cross(columns, forces, dim=1).sum(0)])


def by_camera_and_frame(arrays: Arrays, by_pair: Tensor) -> Tensor:
    """Values (n, P) of the pairs as (C, J, n)."""
    return by_pair.T.reshape(arrays.camera_count, arrays.frame_count, -1)


def moved_columns(table: Tensor, tangents: Tensor) -> Tensor:
    """Derivative (9, P) of the pairs' columns along left tangents (6, P)."""
    shift, turn = tangents.chunk(2)
    moved: Tensor = torch.linalg.cross(turn.expand(3, -1, -1), table.view(3, 3, -1), dim=1)
    moved[2] += shift
    return moved.reshape(9, -1)


def of_each(table: Tensor, index: Tensor) -> Tensor:
    """Columns (m, k) of a table (m, n)."""
    # Faster than index_select, whose rows lie apart.
    return table.gather(1, index.expand(len(table), -1))


def project(run: Run, table: Tensor, ground: Tensor) -> View:
    """Project a ground point (2, k) for each observation; ``table`` is the :func:`pair_table`."""
    first, second, origin = of_each(table, run.pair).chunk(3)
    point = torch.addcmul(torch.addcmul(origin, first, ground[0]), second, ground[1])
    reciprocal, slope = inverse_depth(point[2])
    off = torch.addcmul(-run.measured, point[:2], reciprocal)
    a, b, c = run.root_information
    residual = torch.stack([a * off[0], torch.addcmul(c * off[1], b, off[0])])
    return View(ground, (first, second), point, reciprocal, slope, off, residual)


def observe(run: Run, table: Tensor, corners_map: Tensor) -> View:
    """Project the run's own of the corners (N, 2) of the map into every image that saw them."""
    return project(run, table, of_each(corners_map[run.corners].T, run.corner))


def squared_residuals(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Squared Mahalanobis distance (K,) of each observation."""
    if arrays.passes is not None:
        return arrays.passes.squared_residuals(estimate)
    table = pair_table(arrays, estimate)
    return torch.cat([observe(run, table, estimate.corners_map).squared for run in arrays.runs()])


def _cam_from_vehicle_then(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Cameras from where the vehicle is at each frame's stated time, (C, J or 1, 4, 4)."""
    cam_from_vehicle = estimate.cam_from_vehicle[:, None]
    if not arrays.clock_twist.shape[-1]:
        return cam_from_vehicle
    moved = (arrays.clock_twist @ estimate.clock_s[:, None, :, None])[..., 0]
    return cam_from_vehicle @ exp(-moved)


def pair_from_state(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Derivative (C, J, 6, S) of each pair's left tangent by the states of its frame."""
    if not arrays.states:
        return arrays.centre.new_zeros(arrays.camera_count, arrays.frame_count, 6, 0)
    by_tangent = left_jacobian(-frame_tangent(arrays, estimate.frame_state))[..., list(arrays.states)]
    return -adjoint(_cam_from_vehicle_then(arrays, estimate)) @ by_tangent


def pair_from_clock(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Derivative (C, J, 6, Q) of each pair's left tangent by the clock offset of its camera."""
    if not arrays.clock_twist.shape[-1]:
        return arrays.centre.new_zeros(arrays.camera_count, arrays.frame_count, 6, 0)
    return -adjoint(estimate.cam_from_vehicle)[:, None] @ arrays.clock_twist


def centre_residual(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Whitened residual (C, 3) of the prior on the camera centres, o = -R' t."""
    rotation, translation = estimate.cam_from_vehicle[:, :3, :3], estimate.cam_from_vehicle[:, :3, 3:]
    centre_vehicle = -(rotation.mT @ translation)[..., 0]
    return (centre_vehicle - arrays.centre) * arrays.centre_information_root


def state_residual(arrays: Arrays, frame_state: Tensor) -> Tensor:
    """Whitened innovations (J, S) of the frame states."""
    if not arrays.states:
        return frame_state
    before = torch.cat([torch.zeros_like(frame_state[:1]), frame_state[:-1]])
    expected = (arrays.state_transition @ before[..., None])[..., 0]
    return (frame_state - expected) * arrays.state_information_root


def length_residual(arrays: Arrays, corners_map: Tensor) -> tuple[Tensor, Tensor]:
    """Whitened residuals (M,) of the known lengths, and their derivatives (M, 2) by the first corner.

    Those by the second are the opposite.
    """
    known = arrays.lengths
    apart = corners_map[known.first] - corners_map[known.second]
    distance = apart.norm(dim=1)
    # Two corners in one place have no direction; the derivative is then 0.
    direction = apart / distance.clamp(min=torch.finfo(apart.dtype).tiny)[:, None]
    return (distance - known.length_m) * known.information_root, direction * known.information_root[:, None]


def corner_priors(arrays: Arrays, corners_map: Tensor) -> tuple[Tensor, Tensor]:
    """What the survey and what the known lengths cost."""
    off = corners_map - arrays.control
    length, _ = length_residual(arrays, corners_map)
    return (off.square() * arrays.control_information).sum() / 2, length.square().sum() / 2


def by_corner_priors(arrays: Arrays, estimate: Estimate, corners: slice) -> Tensor:
    """The gradient (n, 2), by some corners, of what the survey and the known lengths cost.

    Corners that lengths join are all among them, or none.
    """
    off = estimate.corners_map[corners] - arrays.control[corners]
    gradient = off * arrays.control_information[corners]
    if bool(arrays.joined[corners].any()):
        known = arrays.lengths
        residual, by_first = length_residual(arrays, estimate.corners_map)
        inside = (known.first >= corners.start) & (known.first < corners.stop)
        pull = (by_first * residual[:, None])[inside]
        gradient.index_add_(0, known.first[inside] - corners.start, pull)
        gradient.index_add_(0, known.second[inside] - corners.start, pull, alpha=-1)
    return gradient


@dataclass(frozen=True)
class Sums:
    """What is added up over observations and corners: costs, and gradients by pair and by corner.

    Attributes:
        observations, control, lengths: the costs of the observations, the survey and the known lengths.
        wrench: (C, J, 6) the observations' gradient by the pairs' left tangents.
        by_corner: (N, 2) the gradient by the corners, priors included; (0, 2) where it is whitened already.
    """

    observations: Tensor
    control: Tensor
    lengths: Tensor
    wrench: Tensor
    by_corner: Tensor


class Tally:
    """The observations' cost, added up run by run, and its gradient by the pairs' columns and by corner."""

    def __init__(self, arrays: Arrays) -> None:
        self.cost = arrays.centre.new_zeros(())
        self.by_table = arrays.centre.new_zeros(9, arrays.pair_count)
        self.by_corner = arrays.centre.new_zeros(arrays.corner_count, 2)

    def add(self, run: Run, view: View, robust: Loss) -> Tensor:
        """Add a run; returns the weights (k,) that the loss gives its observations."""
        rho, weight = loss(robust.name, view.squared, robust.scale)
        self.cost += rho.sum() / 2
        self.pull(run, view, view.residual * weight)
        return weight

    def pull(self, run: Run, view: View, by_residual: Tensor) -> None:
        """Add the gradient of what has the gradient ``by_residual`` (2, k) by the whitened residuals."""
        a, b, c = run.root_information
        first, second = by_residual
        force = view.force(torch.stack([torch.addcmul(a * first, b, second), c * second]))
        self.by_table.index_add_(1, run.pair, view.by_table(force))
        self.by_corner[run.corners] = run.sum_by_corner(view.along_axes(force))

    def sums(self, arrays: Arrays, estimate: Estimate, table: Tensor) -> Sums:
        """All of it, once all runs are in; ``table`` is the :func:`pair_table`."""
        control, lengths = corner_priors(arrays, estimate.corners_map)
        by_corner = self.by_corner + by_corner_priors(arrays, estimate, slice(0, arrays.corner_count))
        wrench = by_camera_and_frame(arrays, wrenches(table, self.by_table))
        return Sums(self.cost, control, lengths, wrench, by_corner)


def cost_and_gradient(arrays: Arrays, estimate: Estimate, robust: Loss) -> tuple[dict[str, Tensor], Gradient]:
    """The named terms of the cost, and the gradient of their sum."""
    tally, table = Tally(arrays), pair_table(arrays, estimate)
    for run in arrays.runs():
        tally.add(run, observe(run, table, estimate.corners_map), robust)
    return with_priors(arrays, estimate, tally.sums(arrays, estimate, table))


def with_priors(arrays: Arrays, estimate: Estimate, sums: Sums) -> tuple[dict[str, Tensor], Gradient]:
    """The named terms of the cost, and the gradient of their sum, from what is added up."""
    centre = centre_residual(arrays, estimate)
    state = state_residual(arrays, estimate.frame_state)
    clock = estimate.clock_s * arrays.clock_information_root
    terms = {
        "observations": sums.observations,
        "camera_centre": centre.square().sum() / 2,
        "frame_states": state.square().sum() / 2,
        "clock_offsets": clock.square().sum() / 2,
        "control_points": sums.control,
        "known_lengths": sums.lengths,
    }
    priors = Priors(centre, state, clock)
    gradient = by_unknowns(arrays, estimate, sums.wrench, sums.by_corner, priors)
    if arrays.camera_prior is not None:
        earlier = earlier_markings(arrays, estimate, arrays.camera_prior)
        terms["earlier_markings"] = earlier.cost
        gradient.extrinsic.add_(earlier.gradient[:, :6])
        gradient.clock_s.add_(earlier.gradient[:, 6:])
    return terms, gradient


@dataclass(frozen=True)
class Earlier:
    """Cost of the prior by earlier markings, its gradient (C, 6 + Q) and Gauss-Newton Hessian."""

    cost: Tensor
    gradient: Tensor
    hessian: Tensor


def earlier_markings(arrays: Arrays, estimate: Estimate, prior: CameraQuadratic) -> Earlier:
    """What earlier markings say of the cameras at ``estimate``, by left tangents and clock offsets."""
    each, like = arrays.camera_unknowns, prior.mean
    tangent = log((estimate.cam_from_vehicle @ inverse(prior.base)).cpu().numpy())
    turned = np.eye(like.numel())
    for camera, jacobian in enumerate(np.linalg.inv(rigid_left_jacobian(tangent))):
        part = slice(each * camera, each * camera + 6)
        turned[part, part] = jacobian
    chart, moved = (torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in (turned, tangent))
    off = (torch.cat([moved, estimate.clock_s], dim=1) - like).flatten()
    pulled = prior.information @ off
    return Earlier(
        off @ pulled / 2,
        (chart.mT @ pulled).view(-1, each),
        chart.mT @ prior.information @ chart,
    )


@dataclass(frozen=True)
class Priors:
    """Whitened residuals of the priors on centres (C, 3), frame states (J, S) and clock offsets (C, Q)."""

    centre: Tensor
    state: Tensor
    clock: Tensor


def by_unknowns(
    arrays: Arrays, estimate: Estimate, wrench: Tensor, by_corner: Tensor, priors: Priors
) -> Gradient:
    """The gradient by all that is estimated, from that by the pairs (C, J, 6) and by corner (N, 2)."""
    by_extrinsic = wrench.sum(1)
    # A left perturbation moves the centre by minus its translation part, turned into the vehicle.
    rotation = estimate.cam_from_vehicle[:, :3, :3]
    by_extrinsic[:, :3] -= (rotation @ (priors.centre * arrays.centre_information_root)[..., None])[..., 0]
    by_state, by_clock = priors.state, priors.clock * arrays.clock_information_root
    if arrays.states:
        innovation = priors.state * arrays.state_information_root
        by_state = (pair_from_state(arrays, estimate).mT @ wrench[..., None])[..., 0].sum(0) + innovation
        by_state[:-1] -= (arrays.state_transition.mT @ innovation[..., None])[1:, :, 0]
    if arrays.clock_twist.shape[-1]:
        by_clock = (pair_from_clock(arrays, estimate).mT @ wrench[..., None])[..., 0].sum(1) + by_clock
    return Gradient(by_extrinsic, by_state, by_corner, by_clock)
