"""The engine ``torch``: the model on any device, the reference of the kernels and the interface of engines.

An engine evaluates and linearises one problem and eliminates its corners. This one takes every observation
from :mod:`v2hdm.adjust.model` and differentiates it by its point in the camera, in one backward pass over a
run of observations per pixel coordinate. The rest of the chain is short: a left tangent (t, w) of the pair
moves the point p by t + w x p, a motion of the corner on the ground moves it along the pair's first two axes.
Pairs themselves are few, and autograd carries gradients from them to cameras, frames and clocks.

:class:`v2hdm.adjust.kernels.engine.NumbaEngine` inherits all of this and replaces the passes over the
observations by compiled closed forms.
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
from torch.nn.functional import pad

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
from v2hdm.adjust.tiles import TIP, find_pattern
from v2hdm.geometry.tensors import NEAR_M
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
        poses = cam_from_map.flatten(0, 1)
        with torch.no_grad():
            return torch.cat([_residual(run, poses, corners_map) for run in self.arrays.runs()]).T

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

    def back_project(self, cam_from_vehicle: Tensor) -> tuple[Tensor, Tensor]:
        """Corners (N, 2) by weighted back-projection from recorded poses, and which (N,) are determined.

        A corner is the mean of the ground points of its rays, each weighted by its observation.
        """
        arrays = self.arrays
        state = torch.zeros_like(arrays.state_information_root)
        start = Estimate(cam_from_vehicle, state, arrays.control, arrays.no_clock())
        return self.meet_ground(model.ground_from_ray(self.poses(start).flatten(0, 1)))

    def meet_ground(self, ground_from_ray: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`back_project` by the inverse homographies (P, 3, 3) of all pairs."""
        arrays = self.arrays
        homographies = ground_from_ray.flatten(1).T.contiguous()
        corners = torch.empty_like(arrays.control)
        is_determined = torch.empty_like(arrays.joined)
        for run in arrays.runs():
            of_ray = homographies.gather(1, run.pair.expand(9, -1))
            sums = run.sum_by_corner(model.back_projected(of_ray, run.measured, run.root_information).T)
            xx, yx, yy, x, y = sums.unbind(1)
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
            loss, weight = model.robustified(robust, residual.square().sum(1))
            observations.add_(loss.sum() / 2)
            return residual * weight[:, None]

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
        return self._gradient(unknowns, lambda run, _: by_residual[:, run.observations].T)

    def _gradient(
        self, unknowns: _Unknowns, by_residual: Callable[[Run, Tensor], Tensor], priors: Tensor | None = None
    ) -> Gradient:
        """Gradient of ``priors`` and of what has the gradient ``by_residual`` (k, 2) by a run's residuals."""
        arrays = self.arrays
        poses = unknowns.poses.detach()
        corners_map = unknowns.estimate.corners_map.detach()
        # Summed over runs by pose and corner, then carried back to their unknowns once.
        by_pose = poses.new_zeros(arrays.pair_count, 9)
        by_corner = torch.empty_like(corners_map)
        for run in arrays.runs():
            view = View.of(run, poses, corners_map[run.corners])
            force = view.force(by_residual(run, view.residual.detach()))
            ground = pad(view.corners_map, (0, 1), value=1.0)
            by_pose.index_add_(0, run.pair, (force[:, :, None] * ground[:, None]).flatten(1))
            by_corner[run.corners] = run.sum_by_corner((view.axes * force[:, :, None]).sum(1))
        by_matrix = torch.zeros_like(poses)
        by_matrix[:, :3, [0, 1, 3]] = by_pose.view(-1, 3, 3)
        ends = [unknowns.poses, unknowns.estimate.corners_map]
        by_end: list[Tensor | None] = [by_matrix, by_corner]
        if priors is not None:
            ends.append(priors)
            by_end.append(None)
        return Gradient(*torch.autograd.grad(ends, unknowns.leaves, by_end, materialize_grads=True))

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
        each = arrays.camera_unknowns
        rotation = estimate.cam_from_vehicle[:, :3, :3]
        blocks = rotation.new_zeros(arrays.camera_count, each, each)
        # A left tangent moves the centre by minus its translation, in the vehicle's axes.
        information = arrays.centre_information_root.square()
        blocks[:, :3, :3] = (rotation * information[:, None]) @ rotation.mT
        blocks[:, 6:, 6:] = arrays.clock_information_root.square().diag()
        cameras = torch.block_diag(*blocks)  # type: ignore[no-untyped-call]
        root = arrays.state_information_root
        by_before = -root[..., None] * arrays.state_transition
        frame = torch.diag_embed(root.square())
        frame[:-1] += (by_before.mT @ by_before)[1:]
        return PriorBlocks(cameras, frame, root[..., None] * by_before)

    def linearise(self, run: Run, poses: Tensor, corners_map: Tensor, robust: Loss) -> tuple[Tensor, Tensor]:
        """Jacobians (k, 2, 6) and (k, 2, 2) of a run's residuals by pair and corner, times root weights."""
        view = View.of(run, poses, corners_map)
        _, weight = model.robustified(robust, view.residual.detach().square().sum(1))
        root = weight.clamp(min=WEIGHT_FLOOR).sqrt()
        (by_point,) = jacobians(view.residual, [view.points_cam])
        by_point = by_point * root[:, None, None]
        turned = torch.linalg.cross(view.points_cam.detach()[:, None], by_point)
        return torch.cat([by_point, turned], dim=2), by_point @ view.axes

    def eliminate(self, system: ReducedSystem, estimate: Estimate, robust: Loss) -> Linearised:
        """Linearise and eliminate the corners; raises AdjustError if a block of joined ones is singular."""
        arrays = self.arrays
        poses = self.poses(estimate).flatten(0, 1)
        of_pairs = poses.new_zeros(arrays.pair_count, 6, 6)
        corner = leaf(estimate.corners_map)
        coupling = poses.new_empty(len(arrays.pair), 2, 6)
        (surveyed,) = jacobians(model.control_residual(arrays, corner), [corner])
        blocks = surveyed.mT @ surveyed
        for run in arrays.runs():
            by_pair, by_corner = self.linearise(run, poses, estimate.corners_map[run.corners], robust)
            of_pairs.index_add_(0, run.pair, by_pair.mT @ by_pair)
            blocks[run.corners] += run.sum_by_corner(by_corner.mT @ by_corner)
            coupling[run.observations] = by_corner.mT @ by_pair
        factor = factorise_corners(arrays, blocks, self._by_length(estimate))
        of_pairs = of_pairs.view(arrays.camera_count, -1, 6, 6)
        tip = of_pairs.new_zeros(system.tip, system.tip)
        for n, run in enumerate(arrays.runs(_BLOCK if arrays.states else None)):
            of_run = factor.part(run.corners)
            part = coupling[run.observations]
            by_camera = of_run.solve(system.spread.by_camera(run, part)).flatten(0, 1)
            tip.addmm_(by_camera.mT, by_camera)
            if arrays.states:
                by_frame = _by_frame(system, run, self._tiles[n], system.spread.by_state(run, part))
                _subtract_block(system, self._tiles[n], of_run.solve(by_frame).flatten(0, 1), by_camera)
        system.add(of_pairs if system.by_pair else of_pairs.sum(1, keepdim=True), tip)
        step = estimate.clock_s.new_zeros(arrays.camera_count, 6)
        _, terms, gradient = self.cost_and_gradient(estimate, step, robust)
        whitened, coupled = _carry(arrays, system.spread, factor, coupling, gradient.corners_map)
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
            couplings=coupling,
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
    couplings: Tensor  # (K, 2, 6) W'; kernels compute it anew, and keep (0, 2, 6)

    def evaluate(self, step: Gradient, tangents: Tensor, own: Tensor) -> Evaluated:
        """Evaluate after a step of the reduced unknowns, the corners following: x_c = L^-T (y_c - B x_r).

        ``tangents`` (C, M, 6) are the pairs' under the step, ``own`` (N, 2) the corners' whitened variables.
        """
        motion = tangents.flatten(0, 1)
        base = self.estimate
        factor = self.corner_factor
        pushed = [
            run.sum_by_corner((self.couplings[run.observations] * motion[run.pair][:, None]).sum(2))
            for run in self.engine.arrays.runs()
        ]
        corners = base.corners_map + factor.solve_transposed(own - factor.solve(torch.cat(pushed)))
        state = base.frame_state + step.frame_state
        clock = base.clock_s + step.clock_s
        moved = Estimate(base.cam_from_vehicle, state, corners, clock)
        estimate, terms, gradient = self.engine.cost_and_gradient(moved, step.extrinsic, self.robust)
        whitened, coupled = self.carry(gradient.corners_map)
        return Evaluated(estimate, terms, gradient, whitened, coupled)

    def carry(self, by_corner: Tensor) -> tuple[Tensor, Coupled]:
        """L^-1 g (N, 2) and W V^-1 g of a gradient g (N, 2) by the corners."""
        return _carry(self.engine.arrays, self.spread, self.corner_factor, self.couplings, by_corner)

    def coupling(self, run: Run, corners_map: Tensor) -> Tensor:
        """W' (k, 2, 6) of a run's observations, of corners (n, 2), by the left tangents of their pairs."""
        poses = self.engine.poses(self.estimate).flatten(0, 1)
        by_pair, by_corner = self.engine.linearise(run, poses, corners_map, self.robust)
        return by_corner.mT @ by_pair


class View(NamedTuple):
    """A run's observations under some poses and corners, differentiable by the points in the cameras."""

    corners_map: Tensor  # (k, 2) the observed corners
    axes: Tensor  # (k, 3, 2) axes of the ground in the camera: motions of the point by those of the corner
    points_cam: Tensor  # (k, 3), a leaf
    residual: Tensor  # (k, 2) whitened

    @classmethod
    def of(cls, run: Run, poses: Tensor, corners_map: Tensor) -> View:
        """The view of a run, of its corners (n, 2), under the poses (P, 4, 4) of all pairs."""
        cam_from_map = poses.index_select(0, run.pair)
        corners = corners_map.index_select(0, run.corner)
        points = model.points_in_camera(cam_from_map, corners).detach().requires_grad_()
        residual = model.corner_residual(points, run.measured, run.root_information)
        return cls(corners, cam_from_map[:, :3, :2], points, residual)

    def force(self, by_residual: Tensor) -> Tensor:
        """Gradient (k, 3) by the points of what has the gradient ``by_residual`` (k, 2) by the residuals."""
        (force,) = torch.autograd.grad(self.residual, [self.points_cam], by_residual)
        return force


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
    step = factor.solve_transposed(whitened)
    by_pair = step.new_zeros(arrays.pair_count, 6)
    for run in arrays.runs():
        motion = step[run.corners].index_select(0, run.corner)
        by_pair.index_add_(0, run.pair, (couplings[run.observations] * motion[:, :, None]).sum(1))
    return whitened, spread.gather(by_pair.view(arrays.camera_count, -1, 6))


def _residual(run: Run, poses: Tensor, corners_map: Tensor) -> Tensor:
    """Whitened residuals (k, 2) of a run, for pairs (P, 4, 4) and all corners (N, 2)."""
    return View.of(run, poses, corners_map[run.corners]).residual.detach()


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
