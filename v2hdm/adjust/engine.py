"""The engine ``torch``: the model on any device, the reference of the kernels and the interface of engines.

An engine evaluates and linearises one problem and eliminates its corners. This one takes every observation
from :mod:`v2hdm.adjust.model` and differentiates it in closed form (:class:`View`): a left tangent (t, w) of
its pair moves the point p in the camera by t + w x p, a motion of the corner moves it along the pair's first
two axes, and the projection's derivative is two numbers. Autograd carries gradients on from pairs, which are
few, to cameras, frames and clocks.

Numbers of observations are columns, (..., k): torch is several times faster along them than across.

:class:`v2hdm.adjust.kernels.engine.KernelEngine` inherits all of this and replaces the passes over the
observations by compiled ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust import model
from v2hdm.adjust.arrays import Arrays, Run
from v2hdm.adjust.model import Estimate, Gradient, Loss
from v2hdm.adjust.reduced import (
    CornerFactor,
    Coupled,
    Plan,
    PriorBlocks,
    ReducedSystem,
    Spread,
    cholesky_2x2,
    factorise_corners,
    frames_per_tile,
)
from v2hdm.adjust.tiles import TIP, TiledCholesky, find_pattern
from v2hdm.geometry.tensors import NEAR_M, inverse_depth
from v2hdm.records import BoolArray, FloatArray

WEIGHT_FLOOR = 1e-6
"""Least weight of an observation in the Hessian: keeps a corner of outliers definite."""

_BLOCK = 512  # observations per dense product of the Schur complement: neighbours share their frames


class Report(NamedTuple):
    """The observations (K,) at an estimate, in the problem's order."""

    residual_px: FloatArray  # (K, 2) projected minus observed
    mahalanobis2: FloatArray  # (K,) squared Mahalanobis distances
    behind: BoolArray  # (K,) whether the corner lies behind the camera


@dataclass(frozen=True)
class Evaluated:
    """Cost and gradient after a step."""

    estimate: Estimate  # after the step
    terms: dict[str, float]  # its cost, by name
    gradient: Gradient  # with respect to the step
    whitened: Tensor  # L^-1 g of the corners, see :meth:`Linearised.carry`
    coupled: Coupled


class Factorised(NamedTuple):
    """A whitening that an engine makes at once, see :class:`v2hdm.adjust.whitening.Whitening`."""

    linearised: Linearised
    reduced_factor: TiledCholesky
    smallest_pivot: float
    gradient: Tensor


class Reached(NamedTuple):
    """The estimate, cost and gradient that whitened variables lead to."""

    estimate: Estimate
    terms: dict[str, float]  # its cost, by name
    gradient: Tensor  # of the cost there by the whitened variables


def jacobians(residual: Tensor, leaves: Sequence[Tensor]) -> list[Tensor]:
    """Derivatives (..., m, w) of residuals (..., m), each by its own row of leaves (..., w)."""
    rows = [
        torch.autograd.grad(column.sum(), leaves, retain_graph=True, materialize_grads=True)
        for column in residual.unbind(-1)
    ]
    return [torch.stack(by_leaf, dim=-2) for by_leaf in zip(*rows, strict=True)]


def leaf(values: Tensor) -> Tensor:
    """A differentiable copy of ``values``."""
    return values.detach().clone().requires_grad_()


class TorchEngine:
    """The model over the ``arrays`` of one problem."""

    def __init__(self, arrays: Arrays) -> None:
        self.arrays = arrays

    def over(self, arrays: Arrays) -> TorchEngine:
        """The same engine over another problem."""
        return type(self)(arrays)

    def keeping(self, frames: Tensor, corners: Tensor) -> TorchEngine:
        """The same engine, which eliminates a border of ``frames`` and ``corners`` last if it can."""
        return self

    @cached_property
    def _tiles(self) -> list[tuple[int, ...]]:
        """Tiles that each block of observations touches; none if frames have no states."""
        arrays = self.arrays
        per_tile = frames_per_tile(arrays)
        blocks = arrays.runs(_BLOCK) if arrays.states else ()
        return [tuple(torch.unique(arrays.frame_of(run.pair) // per_tile).tolist()) for run in blocks]

    def plan(self) -> Plan:
        """The division of the reduced system into tiles; all corners are eliminated before the frames."""
        arrays = self.arrays
        per_tile = frames_per_tile(arrays)
        count = -(-arrays.frame_count // per_tile) if arrays.states else 0
        along = pairwise(range(count)) if bool(arrays.state_transition.any()) else ()
        pattern = find_pattern(count, [*self._tiles, *along])
        return Plan(per_tile, per_tile * len(arrays.states), count, pattern, arrays.corner_order[:0])

    def poses(self, estimate: Estimate) -> Tensor:
        """``cam_from_map`` of every pair, (C, M, 4, 4)."""
        with torch.no_grad():
            return model.cam_from_map(
                self.arrays, estimate.cam_from_vehicle, estimate.frame_state, estimate.clock_s
            )

    def residuals(self, cam_from_map: Tensor, corners_map: Tensor) -> Tensor:
        """Whitened residuals (2, K) of the observations, for pairs (C, M, 4, 4)."""
        pairs = Pairs.of(cam_from_map)
        views = (View.of(run, pairs, corners_map[run.corners]) for run in self.arrays.runs())
        return torch.cat([view.residual for view in views], dim=1)

    def report(self, estimate: Estimate, focal_px: FloatArray) -> Report:
        """The observations at an estimate, under focal lengths (C, 2), px."""
        arrays = self.arrays
        poses = self.poses(estimate).flatten(0, 1)
        corners_map = estimate.corners_map[arrays.corner.long()]
        order = arrays.order.cpu().numpy()
        points = model.points_in_camera(poses[arrays.pair.long()], corners_map)
        off = model.reprojection_error(points, arrays.measured).cpu().numpy()
        squared = self.residuals(poses[None], estimate.corners_map).square().sum(0).cpu().numpy()
        camera = arrays.camera_of(arrays.pair).cpu().numpy()
        report = Report(np.empty((len(order), 2)), np.empty(len(order)), np.empty(len(order), dtype=np.bool_))
        report.residual_px[order] = off * focal_px[camera]
        report.mahalanobis2[order] = squared
        report.behind[order] = (points[:, 2] <= NEAR_M).cpu().numpy()
        return report

    def back_project(
        self, cam_from_vehicle: Tensor, frame_state: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Corners (N, 2) by weighted back-projection, and which (N,) are determined.

        Poses are as recorded, or of states (J, S). A corner is the mean of the ground points of its rays,
        each weighted by its observation.
        """
        arrays = self.arrays
        state = torch.zeros_like(arrays.state_information_root) if frame_state is None else frame_state
        start = Estimate(cam_from_vehicle, state, arrays.control, arrays.no_clock())
        return self.meet_ground(model.ground_from_ray(self.poses(start).flatten(0, 1)))

    def meet_ground(self, ground_from_ray: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`back_project` by the inverse homographies (P, 3, 3) of all pairs."""
        arrays = self.arrays
        homographies = ground_from_ray.flatten(1).T.contiguous()
        corners = torch.empty_like(arrays.control)
        is_determined = torch.empty_like(arrays.joined)
        for run in arrays.runs():
            of_ray = _of_each(homographies, run.pair)
            of_rays = model.back_projected(of_ray, run.measured, run.root_information)
            xx, yx, yy, x, y = _sums_by_corner(run, of_rays)
            is_met = xx > 0
            unit = is_met.logical_not().to(xx.dtype)
            factor = CornerFactor(cholesky_2x2(xx + unit, yx, yy + unit), ())
            corners[run.corners] = factor.solve_transposed(factor.solve(torch.stack([x, y], dim=1)))
            is_determined[run.corners] = is_met
        return corners, is_determined

    def terms(self, estimate: Estimate, robust: Loss) -> dict[str, float]:
        """The cost by name."""
        squared = self.residuals(self.poses(estimate), estimate.corners_map).square().sum(0)
        with torch.no_grad():
            priors = model.prior_terms(self.arrays, estimate)
            observations = float(model.robustified(robust, squared)[0].sum()) / 2
            return {"observations": observations, **{name: float(term) for name, term in priors.items()}}

    def cost_and_gradient(
        self, base: Estimate, step: Tensor, robust: Loss
    ) -> tuple[Estimate, dict[str, float], Gradient]:
        """Extrinsics moved by tangents (C, 6), the cost there by name, and its gradient by ``step``."""
        observations = base.corners_map.new_zeros(())

        def weighted(run: Run, residual: Tensor) -> Tensor:
            loss, weight = model.robustified(robust, residual.square().sum(0))
            observations.add_(loss.sum() / 2)
            return residual * weight

        unknowns = _Unknowns.of(self.arrays, base, step)
        priors = model.prior_terms(self.arrays, unknowns.estimate)
        gradient = self._gradient(unknowns, weighted, torch.stack(list(priors.values())).sum())
        terms = {"observations": float(observations)} | {name: term.item() for name, term in priors.items()}
        cameras = unknowns.estimate.cam_from_vehicle.detach()
        moved = Estimate(cameras, base.frame_state, base.corners_map, base.clock_s)
        return moved, terms, gradient

    def pull(self, estimate: Estimate, spread: Spread, by_residual: Tensor) -> Gradient:
        """Gradient of a scalar from that by the whitened residuals (2, K); :meth:`spread` at the estimate."""
        step = estimate.cam_from_vehicle.new_zeros(self.arrays.camera_count, 6)
        unknowns = _Unknowns.of(self.arrays, estimate, step)
        return self._gradient(unknowns, lambda run, _: by_residual[:, run.observations])

    def _gradient(
        self, unknowns: _Unknowns, by_residual: Callable[[Run, Tensor], Tensor], priors: Tensor | None = None
    ) -> Gradient:
        """Gradient of ``priors`` and of what has the gradient ``by_residual`` (2, k) by a run's residuals."""
        pairs = Pairs.of(unknowns.poses.detach())
        corners_map = unknowns.estimate.corners_map.detach()
        # Summed over runs by the first, second and last columns of the poses and by corner.
        by_column = corners_map.new_zeros(9, self.arrays.pair_count)
        by_corner = torch.empty_like(corners_map)
        for run in self.arrays.runs():
            view = View.of(run, pairs, corners_map[run.corners])
            force = view.force(by_residual(run, view.residual))
            x, y = view.ground
            by_column.index_add_(1, run.pair, torch.cat([force * x, force * y, force]))
            by_corner[run.corners] = _sums_by_corner(run, (view.axes * force).sum(1)).T
        by_pose = torch.zeros_like(pairs.poses)
        by_pose[:, :3, [0, 1, 3]] = by_column.T.view(-1, 3, 3).mT
        # Then carried back to the unknowns once, by a product: given gradients of its own, autograd first
        # loads torch's symbolic shapes, for two seconds.
        product = (unknowns.poses * by_pose).sum() + (unknowns.estimate.corners_map * by_corner).sum()
        if priors is not None:
            product = product + priors
        return Gradient(*torch.autograd.grad(product, unknowns.leaves, materialize_grads=True))

    def spread(self, estimate: Estimate) -> Spread:
        """Jacobians of the pairs by frame states and clock offsets."""
        arrays = self.arrays
        shape = (arrays.camera_count, arrays.moment_count)
        state = leaf(arrays.at_moments(estimate.frame_state).expand(*shape, -1))
        clock = leaf(estimate.clock_s[:, None].expand(*shape, -1))
        poses = model.cam_from_map(arrays, estimate.cam_from_vehicle, state, clock)
        if not poses.requires_grad:
            return Spread(arrays, poses.new_zeros(*shape, 6, 0), poses.new_zeros(*shape, 6, 0))
        by_state, by_clock = jacobians(model.left_tangent(poses, poses.detach()), [state, clock])
        return Spread(arrays, by_state, by_clock)

    def prior_blocks(self, estimate: Estimate) -> PriorBlocks:
        """Gauss-Newton Hessian of the priors by the reduced unknowns."""
        arrays = self.arrays
        count = arrays.camera_count
        unknowns = arrays.camera_unknowns
        # A left tangent moves the centre by minus its translation, in the vehicle's axes.
        turned = estimate.cam_from_vehicle[:, :3, :3] * arrays.centre_information_root[:, None]
        by_camera = arrays.centre.new_zeros(count, unknowns, count, unknowns)
        blocks = by_camera.diagonal(dim1=0, dim2=2)
        blocks[:3, :3] = (turned @ turned.mT).permute(1, 2, 0)
        by_ground = arrays.ground_root @ model.by_ground_planes(estimate.cam_from_vehicle)
        blocks[:6, :6] += (by_ground.mT @ by_ground).permute(1, 2, 0)
        if unknowns > 6:
            blocks[6:, 6:] = arrays.clock_information_root.square().diag()[..., None]
        cameras = by_camera.view(count * unknowns, -1)
        root = arrays.state_information_root
        if not arrays.states:
            empty = root.new_zeros(arrays.frame_count, 0, 0)
            return PriorBlocks(cameras, empty, empty)
        by_before = -root[..., None] * arrays.state_transition
        frame = torch.diag_embed(root.square())
        frame[:-1] += (by_before.mT @ by_before)[1:]
        return PriorBlocks(cameras, frame, root[..., None] * by_before)

    def factorised(self, estimate: Estimate, robust: Loss, hold_cameras: bool) -> Factorised | None:
        """The whitening at an estimate, if this engine makes it at once and its Hessian is definite."""
        return None

    def linearise(self, run: Run, pairs: Pairs, corners_map: Tensor, robust: Loss) -> tuple[Tensor, Tensor]:
        """Jacobians (2, 6, k) and (2, 2, k) of a run's residuals by pair and corner, times root weights."""
        view = View.of(run, pairs, corners_map)
        _, weight = model.robustified(robust, view.residual.square().sum(0))
        by_point = view.by_point() * weight.clamp(min=WEIGHT_FLOOR).sqrt()
        turned = torch.linalg.cross(view.point.expand(2, -1, -1), by_point, dim=1)
        by_corner = (by_point[:, None] * view.axes).sum(2)
        return torch.cat([by_point, turned], dim=1), by_corner

    def eliminate(self, system: ReducedSystem, estimate: Estimate, robust: Loss) -> Linearised:
        """Linearise and eliminate the corners; raises AdjustError if a block of joined ones is singular."""
        arrays = self.arrays
        pairs = Pairs.of(self.poses(estimate))
        of_pairs = pairs.poses.new_zeros(36, arrays.pair_count)
        corner = leaf(estimate.corners_map)
        couplings = of_pairs.new_empty(2, 6, len(arrays.pair))
        (surveyed,) = jacobians(model.control_residual(arrays, corner), [corner])
        blocks = surveyed.mT @ surveyed
        for run in arrays.runs():
            by_pair, by_corner = self.linearise(run, pairs, estimate.corners_map[run.corners], robust)
            of_pairs.index_add_(1, run.pair, _products(by_pair, by_pair).flatten(0, 1))
            of_corners = _sums_by_corner(run, _products(by_corner, by_corner).flatten(0, 1))
            blocks[run.corners] += of_corners.T.view(-1, 2, 2)
            couplings[:, :, run.observations] = _products(by_corner, by_pair)
        factor = factorise_corners(arrays, blocks, self._by_length(estimate))
        of_pairs = of_pairs.T.reshape(arrays.camera_count, -1, 6, 6)
        tip = of_pairs.new_zeros(system.tip, system.tip)
        for n, run in enumerate(arrays.runs(_BLOCK if arrays.states else None)):
            of_run = factor.part(run.corners)
            part = couplings[:, :, run.observations].permute(2, 0, 1).contiguous()
            by_camera = of_run.solve(system.spread.by_camera(run, part)).flatten(0, 1)
            tip.addmm_(by_camera.mT, by_camera)
            if arrays.states:
                by_frame = _by_frame(system, run, self._tiles[n], system.spread.by_state(run, part))
                _subtract_block(system, self._tiles[n], of_run.solve(by_frame).flatten(0, 1), by_camera)
        system.add(of_pairs if system.by_pair else of_pairs.sum(1, keepdim=True), tip)
        step = estimate.clock_s.new_zeros(arrays.camera_count, 6)
        _, terms, gradient = self.cost_and_gradient(estimate, step, robust)
        whitened, coupled = _carry(arrays, system.spread, factor, couplings, gradient.corners_map)
        return Linearised(
            engine=self,
            estimate=estimate,
            robust=robust,
            spread=system.spread,
            terms=terms,
            gradient=gradient,
            corner_factor=factor,
            whitened=whitened,
            coupled=coupled,
            couplings=couplings,
        )

    def _by_length(self, estimate: Estimate) -> tuple[Tensor, Tensor]:
        """Derivatives (M, 2) of the lengths' residuals by first and second corner."""
        lengths = self.arrays.lengths
        first = leaf(estimate.corners_map[lengths.first])
        second = leaf(estimate.corners_map[lengths.second])
        residual = model.length_residual(self.arrays, first, second)
        by_first, by_second = jacobians(residual[:, None], [first, second])
        return by_first[:, 0], by_second[:, 0]


@dataclass(frozen=True)
class Linearised:
    """A problem linearised at an estimate, its corners eliminated."""

    engine: TorchEngine
    estimate: Estimate  # the point of linearisation, under ``robust``
    robust: Loss
    spread: Spread  # Jacobians of the pairs there
    terms: dict[str, float]  # the cost there, by name
    gradient: Gradient
    corner_factor: CornerFactor  # L, the factor of the corners' own block
    whitened: Tensor  # L^-1 g of the corners, see :meth:`carry`
    coupled: Coupled
    couplings: Tensor  # (2, 6, K) W'; kernels compute it anew, and keep (2, 6, 0)

    def evaluate(self, step: Gradient, tangents: Tensor, whitened_corners: Tensor) -> Evaluated:
        """Evaluate after a step of the reduced unknowns, the corners following: x_c = L^-T (y_c - B x_r).

        ``tangents`` (C, M, 6) are the pairs' under the step, ``own`` (N, 2) the corners' whitened variables.
        """
        motion = tangents.flatten(0, 1).T.contiguous()
        base = self.estimate
        factor = self.corner_factor
        pushed = [
            _sums_by_corner(run, (self.couplings[:, :, run.observations] * _of_each(motion, run.pair)).sum(1))
            for run in self.engine.arrays.runs()
        ]
        push = torch.cat(pushed, dim=1).T
        corners = base.corners_map + factor.solve_transposed(whitened_corners - factor.solve(push))
        state = base.frame_state + step.frame_state
        clock = base.clock_s + step.clock_s
        moved = Estimate(base.cam_from_vehicle, state, corners, clock)
        estimate, terms, gradient = self.engine.cost_and_gradient(moved, step.extrinsic, self.robust)
        whitened, coupled = self.carry(gradient.corners_map)
        return Evaluated(estimate, terms, gradient, whitened, coupled)

    def reach(self, whitened: Tensor) -> Reached | None:
        """The estimate, cost and gradient at variables of the whitening, if the engine evaluates at once."""
        return None

    def camera_step(self, whitened: Tensor) -> Tensor | None:
        """The step (C, 6) of the cameras by variables of the whitening, if the engine made it at once."""
        return None

    def by_cameras(self) -> Tensor | None:
        """L^-1 W' (N, 2, D) of all corners, if frames have no states and the engine keeps it."""
        return None

    def carry(self, by_corner: Tensor) -> tuple[Tensor, Coupled]:
        """L^-1 g (N, 2) and W V^-1 g of a gradient g (N, 2) by the corners."""
        return _carry(self.engine.arrays, self.spread, self.corner_factor, self.couplings, by_corner)

    def coupling(self, run: Run, corners_map: Tensor) -> Tensor:
        """W' (k, 2, 6) of a run's observations, of corners (n, 2), by the left tangents of their pairs."""
        pairs = Pairs.of(self.engine.poses(self.estimate))
        by_pair, by_corner = self.engine.linearise(run, pairs, corners_map, self.robust)
        return _products(by_corner, by_pair).permute(2, 0, 1).contiguous()


class Pairs(NamedTuple):
    """The poses ``cam_from_map`` of all pairs."""

    poses: Tensor  # (P, 4, 4)
    axes: Tensor  # (6, P) axes of the ground in the camera: the first columns of the rotation, in turn

    @classmethod
    def of(cls, cam_from_map: Tensor) -> Pairs:
        """The pairs of poses (..., 4, 4)."""
        poses = cam_from_map.reshape(-1, 4, 4)
        return cls(poses, poses[:, :3, :2].permute(2, 1, 0).reshape(6, -1))


class View(NamedTuple):
    """A run's observations under some poses and corners, and the derivative of what the camera sees."""

    root_information: Tensor  # (3, k)
    ground: Tensor  # (2, k) the observed corners
    axes: Tensor  # (2, 3, k) axes of the ground in the camera: motions of the point by those of the corner
    point: Tensor  # (3, k) the corner in the camera
    residual: Tensor  # (2, k) whitened

    @classmethod
    def of(cls, run: Run, pairs: Pairs, corners_map: Tensor) -> View:
        """The view of a run, of its corners (n, 2)."""
        with torch.no_grad():
            corners = corners_map.index_select(0, run.corner)
            points = model.points_in_camera(pairs.poses.index_select(0, run.pair), corners)
            residual = model.corner_residual(points, run.measured, run.root_information)
            axes = _of_each(pairs.axes, run.pair).view(2, 3, -1)
            return cls(run.root_information, corners.T, axes, points.T.contiguous(), residual.T.contiguous())

    def by_point(self) -> Tensor:
        """Derivative (2, 3, k) of the residual by the point."""
        x, y, depth = self.point
        reciprocal, slope = inverse_depth(depth)
        a, b, c = self.root_information
        by_depth = a * x * slope, (b * x + c * y) * slope
        rows = [a * reciprocal, torch.zeros_like(a), by_depth[0], b * reciprocal, c * reciprocal, by_depth[1]]
        return torch.stack(rows).view(2, 3, -1)

    def force(self, by_residual: Tensor) -> Tensor:
        """Gradient (3, k) by the point of what has the gradient ``by_residual`` (2, k) by the residual."""
        x, y, depth = self.point
        reciprocal, slope = inverse_depth(depth)
        a, b, c = self.root_information
        first, second = by_residual
        along_u = a * first + b * second
        along_v = c * second
        return torch.stack([along_u * reciprocal, along_v * reciprocal, (along_u * x + along_v * y) * slope])


def _of_each(table: Tensor, index: Tensor) -> Tensor:
    """Columns (m, k) of a table (m, n)."""
    return table.gather(1, index.expand(len(table), -1))


def _sums_by_corner(run: Run, columns: Tensor) -> Tensor:
    """Sums (m, n) over each corner's observations of values (m, k)."""
    return columns.new_zeros(len(columns), run.corner_count).index_add_(1, run.corner, columns)


def _products(left: Tensor, right: Tensor) -> Tensor:
    """Products J'K (a, b, k) of each observation's Jacobians J (2, a, k) and K (2, b, k)."""
    return torch.addcmul(left[0][:, None] * right[0], left[1][:, None], right[1])


class _Unknowns(NamedTuple):
    """An estimate as a differentiable function of a step about it, with the poses of its pairs."""

    leaves: list[Tensor]  # tangents of the cameras (C, 6), frame states, corners and clock offsets
    estimate: Estimate
    poses: Tensor  # (P, 4, 4)

    @classmethod
    def of(cls, arrays: Arrays, base: Estimate, step: Tensor) -> _Unknowns:
        """At a step (C, 6) of the cameras from ``base``."""
        leaves = list(map(leaf, (step, base.frame_state, base.corners_map, base.clock_s)))
        tangent, state, corners_map, clock_s = leaves
        cameras = model.rigid(tangent) @ base.cam_from_vehicle
        poses = model.cam_from_map(arrays, cameras, state, clock_s).flatten(0, 1)
        return cls(leaves, Estimate(cameras, state, corners_map, clock_s), poses)


def _carry(
    arrays: Arrays, spread: Spread, factor: CornerFactor, couplings: Tensor, by_corner: Tensor
) -> tuple[Tensor, Coupled]:
    whitened = factor.solve(by_corner)
    step = factor.solve_transposed(whitened).T.contiguous()
    by_pair = step.new_zeros(6, arrays.pair_count)
    for run in arrays.runs():
        x, y = _of_each(step[:, run.corners], run.corner)
        by_x, by_y = couplings[:, :, run.observations]
        by_pair.index_add_(1, run.pair, torch.addcmul(by_x * x, by_y, y))
    return whitened, spread.gather(by_pair.T.reshape(arrays.camera_count, -1, 6))


def _by_frame(system: ReducedSystem, run: Run, tiles: tuple[int, ...], by_state: Tensor) -> Tensor:
    """W' of a block by the frame states of its tiles, (n, 2, tiles * F * S)."""
    per_tile = system.plan.frames_per_tile
    frame = system.arrays.frame_of(run.pair)
    index = torch.tensor(tiles, device=frame.device)
    slots = per_tile * len(tiles)
    slot = torch.searchsorted(index, frame // per_tile) * per_tile + frame % per_tile
    rows = by_state.new_zeros(run.corner_count * slots, *by_state.shape[1:])
    rows.index_add_(0, run.corner * slots + slot, by_state)
    return rows.view(run.corner_count, slots, 2, -1).transpose(1, 2).flatten(2)


def _subtract_block(system: ReducedSystem, tiles: tuple[int, ...], columns: Tensor, tip: Tensor) -> None:
    """Subtract the products of a block's frames (2 n, tiles * F * S) with each other and the cameras."""
    matrix = system.matrix.tiles
    position = system.plan.pattern.position
    parts = zip((position[tile] for tile in tiles), columns.chunk(len(tiles), dim=1), strict=True)
    placed = sorted(parts, key=lambda part: part[0])
    for n, (column, first) in enumerate(placed):
        matrix[TIP, column].addmm_(tip.mT, first, alpha=-1)
        for row, second in placed[n:]:
            matrix[row, column].addmm_(second.mT, first, alpha=-1)
