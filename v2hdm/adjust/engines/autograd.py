"""The engine ``torch``: the model differentiated by autograd on any device, the reference of the kernels.

Runs of observations have leaves of their own, a left tangent of the pair and the corner, so that one backward
pass per pixel coordinate yields all blocks. The linearisation keeps the couplings W' of corners and pairs: 12
numbers per observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust import model
from v2hdm.adjust.arrays import Arrays, Run
from v2hdm.adjust.engine import WEIGHT_FLOOR, Engine, Evaluated, Linearised
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

_BLOCK = 512  # observations per dense product of the Schur complement: neighbours share their frames


def jacobians(residual: Tensor, leaves: Sequence[Tensor]) -> list[Tensor]:
    """Derivatives (..., m, w) of residuals (..., m), each by its own row of leaves (..., w)."""
    rows = [
        torch.autograd.grad(column.sum(), leaves, retain_graph=True, materialize_grads=True)
        for column in residual.unbind(-1)
    ]
    return [torch.stack(one, dim=-2) for one in zip(*rows, strict=True)]


def leaf(values: Tensor) -> Tensor:
    """A differentiable copy of ``values``."""
    return values.detach().clone().requires_grad_()


class TorchEngine(Engine):
    """The engine ``torch`` for one problem's arrays."""

    @cached_property
    def _tiles(self) -> list[tuple[int, ...]]:
        """Tiles that each block of observations touches; none if frames have no states."""
        arrays, per_tile = self.arrays, frames_per_tile(self.arrays)
        blocks = arrays.runs(_BLOCK) if arrays.states else ()
        return [tuple(torch.unique(arrays.frame_of(run.pair) // per_tile).tolist()) for run in blocks]

    def plan(self) -> Plan:
        """The division of the reduced system into tiles; all corners are eliminated before the frames."""
        arrays, per_tile = self.arrays, frames_per_tile(self.arrays)
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
        """Whitened residuals (2, K) of the observations."""
        with torch.no_grad():
            return torch.cat(
                [_residual(run, cam_from_map.flatten(0, 1), corners_map) for run in self.arrays.runs()]
            ).T

    def report(self, estimate: Estimate, focal_px: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """In problem order: residuals (K, 2), px, squared Mahalanobis distances, points behind."""
        arrays = self.arrays
        poses = self.poses(estimate).flatten(0, 1)
        corners_map = estimate.corners_map[arrays.corner.long()]
        order = arrays.order.cpu().numpy()
        points = model.points_in_camera(poses[arrays.pair.long()], corners_map)
        none = torch.tensor([[1.0], [0.0], [1.0]], dtype=points.dtype, device=points.device)
        off = model.corner_residual(points, arrays.measured, none).cpu().numpy()
        squared = self.residuals(poses[None], estimate.corners_map).square().sum(0).cpu().numpy()
        camera = arrays.camera_of(arrays.pair).cpu().numpy()
        out = np.empty((len(order), 2)), np.empty(len(order)), np.empty(len(order), dtype=np.bool_)
        out[0][order] = off * focal_px[camera]
        out[1][order] = squared
        out[2][order] = (points[:, 2] <= NEAR_M).cpu().numpy()
        return out

    def back_project(self, cam_from_vehicle: Tensor) -> tuple[Tensor, Tensor]:
        """Corners (N, 2) by weighted back-projection from recorded poses, and which (N,) are determined."""
        arrays = self.arrays
        state = torch.zeros_like(arrays.state_information_root)
        at = Estimate(cam_from_vehicle, state, arrays.control, arrays.no_clock())
        poses = self.poses(at).flatten(0, 1)
        corners = torch.empty_like(arrays.control)
        fixed = torch.empty_like(arrays.joined)
        for run in arrays.runs():
            usable = model.depression_sine(poses[run.pair], run.measured) > model.MIN_DEPRESSION_SINE
            ground = model.ground_points(poses[run.pair], run.measured)
            ground = leaf(torch.where(usable[:, None], ground, 0.0))
            points = model.points_in_camera(poses[run.pair], ground)
            residual = model.corner_residual(points, run.measured, run.root_information)
            (by_corner,) = jacobians(residual, [ground])
            block = torch.where(usable[:, None, None], by_corner.mT @ by_corner, 0.0)
            information = run.sum_by_corner(block)
            weighted = run.sum_by_corner((block @ ground.detach()[..., None])[..., 0])
            some = information[:, 0, 0] > 0
            information[~some] = torch.eye(2, dtype=information.dtype, device=information.device)
            lower = cholesky_2x2(information[:, 0, 0], information[:, 1, 0], information[:, 1, 1])
            factor = CornerFactor(lower, ())
            corners[run.corners] = factor.solve_transposed(factor.solve(weighted))
            fixed[run.corners] = some
        return corners, fixed

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
        arrays = self.arrays
        leaves = [leaf(one) for one in (step, base.frame_state, base.corners_map, base.clock_s)]
        tangent, state, corners_map, clock_s = leaves
        estimate = Estimate(model.rigid(tangent) @ base.cam_from_vehicle, state, corners_map, clock_s)
        poses = model.cam_from_map(arrays, estimate.cam_from_vehicle, state, clock_s).flatten(0, 1)
        # The gradient by poses and corners is summed over runs and carried back to their unknowns once.
        pose = leaf(poses)
        corner = leaf(corners_map)
        observations = poses.new_zeros(())
        for run in arrays.runs():
            squared = _residual(run, pose, corner).square().sum(1)
            cost = model.robustified(robust, squared)[0].sum() / 2
            torch.autograd.backward([cost], inputs=[pose, corner])
            observations += cost.detach()
        priors = model.prior_terms(arrays, estimate)
        ends = [torch.stack(list(priors.values())).sum(), poses, corners_map]
        gradient = torch.autograd.grad(ends, leaves, [None, pose.grad, corner.grad], materialize_grads=True)
        terms = {"observations": float(observations)} | {name: term.item() for name, term in priors.items()}
        moved = Estimate(estimate.cam_from_vehicle.detach(), base.frame_state, base.corners_map, base.clock_s)
        return moved, terms, Gradient(*gradient)

    def pull(self, estimate: Estimate, spread: Spread, by_residual: Tensor) -> Gradient:
        """Gradient of a scalar from that by the whitened residuals (2, K)."""
        arrays = self.arrays
        tangent = estimate.cam_from_vehicle.new_zeros(arrays.camera_count, 6)
        leaves = list(map(leaf, (tangent, estimate.frame_state, estimate.corners_map, estimate.clock_s)))
        cameras = model.rigid(leaves[0]) @ estimate.cam_from_vehicle
        poses = model.cam_from_map(arrays, cameras, leaves[1], leaves[3]).flatten(0, 1)
        residual = torch.cat([_residual(run, poses, leaves[2]) for run in arrays.runs()])
        return Gradient(*torch.autograd.grad(residual, leaves, by_residual.T, materialize_grads=True))

    def spread(self, estimate: Estimate) -> Spread:
        """Jacobians of the pairs by frame states and clock offsets."""
        arrays = self.arrays
        shape = (arrays.camera_count, arrays.moment_count)
        state = leaf(arrays.at_moments(estimate.frame_state).expand(*shape, -1))
        clock = leaf(estimate.clock_s[:, None].expand(*shape, -1))
        poses = model.cam_from_map(arrays, estimate.cam_from_vehicle, state, clock)
        if not poses.requires_grad:
            return Spread(arrays, poses.new_zeros(*shape, 6, 0), poses.new_zeros(*shape, 6, 0))
        return Spread(arrays, *jacobians(model.left_tangent(poses, poses.detach()), [state, clock]))

    def prior_blocks(self, estimate: Estimate) -> PriorBlocks:
        """Gauss-Newton Hessian of the priors by the reduced unknowns."""
        arrays, each = self.arrays, self.arrays.camera_unknowns
        camera = leaf(estimate.clock_s.new_zeros(arrays.camera_count, each))
        moved = model.rigid(camera[:, :6]) @ estimate.cam_from_vehicle
        clock = estimate.clock_s + camera[:, 6:]
        residual = torch.hstack([model.centre_residual(arrays, moved), model.clock_residual(arrays, clock)])
        (by_camera,) = jacobians(residual, [camera])
        cameras = torch.block_diag(*(by_camera.mT @ by_camera))  # type: ignore[no-untyped-call]
        own = leaf(estimate.frame_state)
        before = leaf(estimate.frame_state)
        frame = own.new_zeros(arrays.frame_count, *2 * (len(arrays.states),))
        if not arrays.states:
            return PriorBlocks(cameras, frame, frame)
        by_own, by_before = jacobians(model.state_residual(arrays, own, before), [own, before])
        frame += by_own.mT @ by_own
        frame[:-1] += (by_before.mT @ by_before)[1:]
        return PriorBlocks(cameras, frame, by_own.mT @ by_before)

    def linearise(self, run: Run, poses: Tensor, corners_map: Tensor, robust: Loss) -> tuple[Tensor, Tensor]:
        """Jacobians (k, 2, 6) and (k, 2, 2) of a run's residuals by pair and corner, times root weights."""
        tangent = leaf(poses.new_zeros(len(run.pair), 6))
        corner = leaf(corners_map[run.corner])
        points = model.points_in_camera(model.rigid(tangent) @ poses[run.pair], corner)
        residual = model.corner_residual(points, run.measured, run.root_information)
        by_pair, by_corner = jacobians(residual, [tangent, corner])
        _, weight = model.robustified(robust, residual.detach().square().sum(1))
        root = weight.clamp(min=WEIGHT_FLOOR).sqrt()[:, None, None]
        return by_pair * root, by_corner * root

    def eliminate(self, system: ReducedSystem, estimate: Estimate, robust: Loss) -> TorchLinearised:
        """Linearise, and subtract the eliminated corners from the reduced system."""
        arrays = self.arrays
        poses = self.poses(estimate).flatten(0, 1)
        own = poses.new_zeros(arrays.pair_count, 6, 6)
        corner = leaf(estimate.corners_map)
        coupling = poses.new_empty(len(arrays.pair), 2, 6)
        (surveyed,) = jacobians(model.control_residual(arrays, corner), [corner])
        blocks = surveyed.mT @ surveyed
        for run in arrays.runs():
            by_pair, by_corner = self.linearise(run, poses, estimate.corners_map[run.corners], robust)
            own.index_add_(0, run.pair, by_pair.mT @ by_pair)
            blocks[run.corners] += run.sum_by_corner(by_corner.mT @ by_corner)
            coupling[run.observations] = by_corner.mT @ by_pair
        factor = factorise_corners(arrays, blocks, self._by_length(estimate))
        own = own.view(arrays.camera_count, -1, 6, 6)
        tip = own.new_zeros(system.tip, system.tip)
        for n, run in enumerate(arrays.runs(_BLOCK if arrays.states else None)):
            of_run = factor.part(run.corners)
            part = coupling[run.observations]
            by_camera = of_run.solve(system.spread.by_camera(run, part)).flatten(0, 1)
            tip.addmm_(by_camera.mT, by_camera)
            if arrays.states:
                by_frame = _by_frame(system, run, self._tiles[n], system.spread.by_state(run, part))
                _subtract_block(system, self._tiles[n], of_run.solve(by_frame).flatten(0, 1), by_camera)
        system.add(own if system.by_pair else own.sum(1, keepdim=True), tip)
        _, terms, gradient = self.cost_and_gradient(
            estimate, estimate.clock_s.new_zeros(arrays.camera_count, 6), robust
        )
        whitened, coupled = _carry(arrays, system.spread, factor, coupling, gradient.corners_map)
        rest = self, estimate, robust, system.spread, coupling
        return TorchLinearised(terms, gradient, factor, whitened, coupled, *rest)

    def _by_length(self, estimate: Estimate) -> tuple[Tensor, Tensor]:
        """Derivatives (M, 2) of the lengths' residuals by first and second corner."""
        known = self.arrays.lengths
        corners = estimate.corners_map
        first = leaf(corners[known.first])
        second = leaf(corners[known.second])
        residual = model.length_residual(self.arrays, first, second)
        by_first, by_second = jacobians(residual[:, None], [first, second])
        return by_first[:, 0], by_second[:, 0]


@dataclass(frozen=True)
class TorchLinearised(Linearised):
    """A problem linearised by autograd, its corners eliminated; ``couplings`` (K, 2, 6) are W'."""

    engine: TorchEngine
    estimate: Estimate
    robust: Loss
    spread: Spread
    couplings: Tensor

    def evaluate(self, step: Gradient, tangents: Tensor, own: Tensor) -> Evaluated:
        """Evaluate after a step of the reduced unknowns: x_c = L^-T (y_c - B x_r)."""
        motion = tangents.flatten(0, 1)[..., None]
        base = self.estimate
        factor = self.corner_factor
        moved = [
            run.sum_by_corner((self.couplings[run.observations] @ motion[run.pair])[..., 0])
            for run in self.engine.arrays.runs()
        ]
        corners = base.corners_map + factor.solve_transposed(own - factor.solve(torch.cat(moved)))
        state = base.frame_state + step.frame_state
        clock = base.clock_s + step.clock_s
        at = Estimate(base.cam_from_vehicle, state, corners, clock)
        estimate, terms, gradient = self.engine.cost_and_gradient(at, step.extrinsic, self.robust)
        return Evaluated(estimate, terms, gradient, *self.carry(gradient.corners_map))

    def carry(self, by_corner: Tensor) -> tuple[Tensor, Coupled]:
        """L^-1 g (N, 2) and W V^-1 g of a gradient g (N, 2) by the corners."""
        return _carry(self.engine.arrays, self.spread, self.corner_factor, self.couplings, by_corner)

    def coupling(self, run: Run, corners_map: Tensor) -> Tensor:
        """W' (k, 2, 6) of a run's observations."""
        poses = self.engine.poses(self.estimate).flatten(0, 1)
        by_pair, by_corner = self.engine.linearise(run, poses, corners_map, self.robust)
        return by_corner.mT @ by_pair


def _carry(
    arrays: Arrays, spread: Spread, factor: CornerFactor, couplings: Tensor, by_corner: Tensor
) -> tuple[Tensor, Coupled]:
    whitened = factor.solve(by_corner)
    step = factor.solve_transposed(whitened)
    by_pair = step.new_zeros(arrays.pair_count, 6)
    for run in arrays.runs():
        along = step[run.corners][run.corner]
        by_pair.index_add_(0, run.pair, (couplings[run.observations].mT @ along[..., None])[..., 0])
    return whitened, spread.gather(by_pair.view(arrays.camera_count, -1, 6))


def _residual(run: Run, poses: Tensor, corners_map: Tensor) -> Tensor:
    """Whitened residuals (k, 2) of a run, for pairs (P, 4, 4) and all corners (N, 2)."""
    points = model.points_in_camera(poses[run.pair], corners_map[run.corners][run.corner])
    return model.corner_residual(points, run.measured, run.root_information)


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
