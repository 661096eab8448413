"""The engine ``torch``: the model differentiated by autograd, on any device; kernels are tested against it.

Observations are taken run by run. Each has leaves of its own, a left tangent of its pair and its corner, so
that one backward pass a pixel coordinate gives the blocks of all. The blocks W' that couple corners to pairs
are kept with the linearisation: 12 numbers an observation.
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
from v2hdm.adjust.corner_factor import CornerFactor, cholesky_2x2, factorise_corners
from v2hdm.adjust.engine import WEIGHT_FLOOR, Evaluated
from v2hdm.adjust.model import Estimate, Gradient, Loss
from v2hdm.adjust.reduced import Coupled, Plan, PriorBlocks, ReducedSystem, Spread, frames_per_tile
from v2hdm.adjust.tiles import TIP, find_pattern
from v2hdm.geometry.tensors import NEAR_M
from v2hdm.records import BoolArray, FloatArray

# Corners whose part of the Schur complement is one dense product: neighbours share their frames.
_BLOCK_CORNERS = 32


def jacobians(residual: Tensor, leaves: Sequence[Tensor]) -> list[Tensor]:
    """Derivatives (..., m, w) of residuals (..., m), each by its own row of the leaves (..., w).

    One backward pass each of the m columns.
    """
    rows = [
        torch.autograd.grad(column.sum(), leaves, retain_graph=True, materialize_grads=True)
        for column in residual.unbind(-1)
    ]
    return [torch.stack(one, dim=-2) for one in zip(*rows, strict=True)]


def leaf(values: Tensor) -> Tensor:
    """A copy of values to differentiate by."""
    return values.detach().clone().requires_grad_()


@dataclass(frozen=True)
class Block:
    """Some corners of a run and their observations, counted within it, and the tiles that they touch."""

    observations: slice
    corners: slice
    tiles: tuple[int, ...]


class TorchEngine:
    """The engine ``torch`` over one problem's arrays."""

    def __init__(self, arrays: Arrays) -> None:
        self._arrays = arrays

    @property
    def arrays(self) -> Arrays:
        """The problem."""
        return self._arrays

    def over(self, arrays: Arrays) -> TorchEngine:
        """The engine over another problem."""
        return TorchEngine(arrays)

    @cached_property
    def blocks(self) -> list[list[Block]]:
        """Each run in blocks of corners; none where frames have no states."""
        arrays, per_tile = self._arrays, frames_per_tile(self._arrays)
        return [_blocks(arrays, run, per_tile) if arrays.states else [] for run in arrays.runs()]

    def plan(self) -> Plan:
        """How the reduced system is cut into tiles: all corners are eliminated before the frames."""
        arrays, per_tile = self._arrays, frames_per_tile(self._arrays)
        count = -(-arrays.frame_count // per_tile) if arrays.states else 0
        cliques: list[Sequence[int]] = [block.tiles for run in self.blocks for block in run]
        if bool(arrays.state_transition.any()):
            cliques += pairwise(range(count))
        none = arrays.corner_order[:0]
        return Plan(per_tile, per_tile * len(arrays.states), count, find_pattern(count, cliques), none)

    def poses(self, estimate: Estimate) -> Tensor:
        """``cam_from_map`` of every pair, (C, J, 4, 4)."""
        with torch.no_grad():
            return model.cam_from_map(
                self._arrays, estimate.cam_from_vehicle, estimate.frame_state, estimate.clock_s
            )

    def residuals(self, cam_from_map: Tensor, corners_map: Tensor) -> Tensor:
        """Whitened residuals (2, K) of the observations."""
        with torch.no_grad():
            return torch.cat(
                [_residual(run, cam_from_map.flatten(0, 1), corners_map) for run in self._arrays.runs()]
            ).T

    def report(self, estimate: Estimate, focal_px: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """In the problem's order: residuals (K, 2) px, their squares in sigmas, who lies behind."""
        arrays, poses = self._arrays, self.poses(estimate).flatten(0, 1)
        corners_map, order = estimate.corners_map[arrays.corner.long()], arrays.order.cpu().numpy()
        points = model.points_in_camera(poses[arrays.pair.long()], corners_map)
        none = torch.tensor([[1.0], [0.0], [1.0]], dtype=points.dtype, device=points.device)
        off = model.corner_residual(points, arrays.measured, none).cpu().numpy()
        squared = self.residuals(poses[None], estimate.corners_map).square().sum(0).cpu().numpy()
        camera = arrays.pair.cpu().numpy() // arrays.frame_count
        out = np.empty((len(order), 2)), np.empty(len(order)), np.empty(len(order), dtype=np.bool_)
        out[0][order], out[1][order] = off * focal_px[camera], squared
        out[2][order] = (points[:, 2] <= NEAR_M).cpu().numpy()
        return out

    def back_project(self, cam_from_vehicle: Tensor) -> tuple[Tensor, Tensor]:
        """Corners (N, 2) by weighted back-projection from recorded poses, and which a ray fixes."""
        arrays = self._arrays
        state = torch.zeros_like(arrays.state_information_root)
        at = Estimate(cam_from_vehicle, state, arrays.control, arrays.no_clock())
        poses = self.poses(at).flatten(0, 1)
        corners, fixed = torch.empty_like(arrays.control), torch.empty_like(arrays.joined)
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

    def terms(self, estimate: Estimate, robust: Loss) -> dict[str, Tensor]:
        """The cost, by name."""
        squared = self.residuals(self.poses(estimate), estimate.corners_map).square().sum(0)
        with torch.no_grad():
            observations = model.robustified(robust, squared)[0].sum() / 2
            return {"observations": observations, **model.prior_terms(self._arrays, estimate)}

    def cost_and_gradient(
        self, base: Estimate, step: Tensor, robust: Loss
    ) -> tuple[Estimate, dict[str, Tensor], Gradient]:
        """The cost where the cameras of ``base`` are moved by tangents (C, 6), and its gradient.

        Returns the estimate with the cameras moved, the cost by name, and the gradient by ``step``.
        """
        arrays = self._arrays
        leaves = [leaf(one) for one in (step, base.frame_state, base.corners_map, base.clock_s)]
        tangent, state, corners_map, clock_s = leaves
        estimate = Estimate(model.rigid(tangent) @ base.cam_from_vehicle, state, corners_map, clock_s)
        poses = model.cam_from_map(arrays, estimate.cam_from_vehicle, state, clock_s).flatten(0, 1)
        # By runs: the gradient by poses and corners is summed up, and carried back to their unknowns once.
        pose, corner = leaf(poses), leaf(corners_map)
        observations = poses.new_zeros(())
        for run in arrays.runs():
            squared = _residual(run, pose, corner).square().sum(1)
            cost = model.robustified(robust, squared)[0].sum() / 2
            torch.autograd.backward([cost], inputs=[pose, corner])
            observations += cost.detach()
        priors = model.prior_terms(arrays, estimate)
        ends = [torch.stack(list(priors.values())).sum(), poses, corners_map]
        gradient = torch.autograd.grad(ends, leaves, [None, pose.grad, corner.grad], materialize_grads=True)
        terms = {"observations": observations, **{name: term.detach() for name, term in priors.items()}}
        moved = Estimate(estimate.cam_from_vehicle.detach(), base.frame_state, base.corners_map, base.clock_s)
        return moved, terms, Gradient(*gradient)

    def pull(self, estimate: Estimate, by_residual: Tensor) -> Gradient:
        """The gradient of a scalar whose gradient by the whitened residuals is ``by_residual`` (2, K)."""
        arrays = self._arrays
        tangent = estimate.cam_from_vehicle.new_zeros(arrays.camera_count, 6)
        leaves = [
            leaf(one) for one in (tangent, estimate.frame_state, estimate.corners_map, estimate.clock_s)
        ]
        cameras = model.rigid(leaves[0]) @ estimate.cam_from_vehicle
        poses = model.cam_from_map(arrays, cameras, leaves[1], leaves[3]).flatten(0, 1)
        residuals = [_residual(run, poses, leaves[2]) for run in arrays.runs()]
        return Gradient(
            *torch.autograd.grad(torch.cat(residuals), leaves, by_residual.T, materialize_grads=True)
        )

    def spread(self, estimate: Estimate) -> Spread:
        """How pairs move with frame states and clock offsets."""
        arrays = self._arrays
        shape = (arrays.camera_count, arrays.frame_count)
        state = leaf(estimate.frame_state.expand(*shape, -1))
        clock = leaf(estimate.clock_s[:, None].expand(*shape, -1))
        poses = model.cam_from_map(arrays, estimate.cam_from_vehicle, state, clock)
        if not poses.requires_grad:
            return Spread(poses.new_zeros(*shape, 6, 0), poses.new_zeros(*shape, 6, 0))
        return Spread(*jacobians(model.left_tangent(poses, poses.detach()), [state, clock]))

    def prior_blocks(self, estimate: Estimate) -> PriorBlocks:
        """The priors' part of the Gauss-Newton Hessian of the reduced unknowns."""
        arrays, each = self._arrays, self._arrays.camera_unknowns
        camera = leaf(estimate.clock_s.new_zeros(arrays.camera_count, each))
        moved = model.rigid(camera[:, :6]) @ estimate.cam_from_vehicle
        clock = estimate.clock_s + camera[:, 6:]
        residual = torch.cat(
            [model.centre_residual(arrays, moved), model.clock_residual(arrays, clock)], dim=1
        )
        (by_camera,) = jacobians(residual, [camera])
        cameras = torch.block_diag(*(by_camera.mT @ by_camera))  # type: ignore[no-untyped-call]
        if arrays.camera_prior is not None:
            off = model.camera_offset(arrays.camera_prior, moved, clock)
            (chart,) = jacobians(off, [camera])
            turned = torch.block_diag(*chart)  # type: ignore[no-untyped-call]
            cameras = cameras + turned.mT @ arrays.camera_prior.information @ turned
        own, before = leaf(estimate.frame_state), leaf(estimate.frame_state)
        frame = own.new_zeros(arrays.frame_count, *2 * (len(arrays.states),))
        if not arrays.states:
            return PriorBlocks(cameras, frame, frame)
        by_own, by_before = jacobians(model.state_residual(arrays, own, before), [own, before])
        frame += by_own.mT @ by_own
        frame[:-1] += (by_before.mT @ by_before)[1:]
        return PriorBlocks(cameras, frame, by_own.mT @ by_before)

    def linearise(self, run: Run, poses: Tensor, corners_map: Tensor, robust: Loss) -> tuple[Tensor, Tensor]:
        """Derivatives (k, 2, 6) and (k, 2, 2) of a run's residuals by pair and corner, times root weights."""
        tangent, corner = leaf(poses.new_zeros(len(run.pair), 6)), leaf(corners_map[run.corner])
        points = model.points_in_camera(model.rigid(tangent) @ poses[run.pair], corner)
        residual = model.corner_residual(points, run.measured, run.root_information)
        by_pair, by_corner = jacobians(residual, [tangent, corner])
        _, weight = model.robustified(robust, residual.detach().square().sum(1))
        root = weight.clamp(min=WEIGHT_FLOOR).sqrt()[:, None, None]
        return by_pair * root, by_corner * root

    def eliminate(
        self, system: ReducedSystem, estimate: Estimate, robust: Loss, damping: float
    ) -> TorchLinearised:
        """Linearise, and subtract the eliminated corners from the reduced system."""
        arrays, poses = self._arrays, self.poses(estimate).flatten(0, 1)
        own = poses.new_zeros(arrays.pair_count, 6, 6)
        blocks, couplings = self._corner_priors(estimate), []
        for run in arrays.runs():
            by_pair, by_corner = self.linearise(run, poses, estimate.corners_map[run.corners], robust)
            own.index_add_(0, run.pair, by_pair.mT @ by_pair)
            blocks[run.corners] += run.sum_by_corner(by_corner.mT @ by_corner)
            couplings.append(by_corner.mT @ by_pair)
        factor = factorise_corners(arrays, blocks, self._by_length(estimate), damping)
        own = own.view(arrays.camera_count, arrays.frame_count, 6, 6)
        tip = own.new_zeros(system.tip, system.tip)
        for run, coupling, parts in zip(arrays.runs(), couplings, self.blocks, strict=True):
            by_camera = factor.part(run.corners).solve(system.spread.by_camera(run, coupling))
            tip.addmm_(by_camera.flatten(0, 1).mT, by_camera.flatten(0, 1))
            by_state = system.spread.by_state(run, coupling)
            for block in parts:
                corners = slice(
                    run.corners.start + block.corners.start, run.corners.start + block.corners.stop
                )
                columns = factor.part(corners).solve(_by_frame(system, block, run, by_state)).flatten(0, 1)
                _subtract_block(system, block, columns, by_camera[block.corners].flatten(0, 1))
        system.add(own if system.by_pair else own.sum(1, keepdim=True), tip)
        _, terms, gradient = self.cost_and_gradient(
            estimate, estimate.clock_s.new_zeros(arrays.camera_count, 6), robust
        )
        return TorchLinearised(self, estimate, robust, system.spread, terms, gradient, factor, couplings)

    def _corner_priors(self, estimate: Estimate) -> Tensor:
        """J'J (N, 2, 2) of the survey by corner."""
        corner = leaf(estimate.corners_map)
        (by_corner,) = jacobians(model.control_residual(self._arrays, corner), [corner])
        return by_corner.mT @ by_corner

    def _by_length(self, estimate: Estimate) -> tuple[Tensor, Tensor]:
        """Derivatives (M, 2) of the lengths' residuals by their first and second corners."""
        known, corners = self._arrays.lengths, estimate.corners_map
        first, second = leaf(corners[known.first]), leaf(corners[known.second])
        residual = model.length_residual(self._arrays, first, second)
        by_first, by_second = jacobians(residual[:, None], [first, second])
        return by_first[:, 0], by_second[:, 0]


class TorchLinearised:
    """A problem linearised by autograd, its corners eliminated: :class:`v2hdm.adjust.engine.Linearised`."""

    def __init__(
        self,
        engine: TorchEngine,
        estimate: Estimate,
        robust: Loss,
        spread: Spread,
        terms: dict[str, Tensor],
        gradient: Gradient,
        corner_factor: CornerFactor,
        couplings: list[Tensor],
    ) -> None:
        self._engine, self._estimate, self._robust, self._spread = engine, estimate, robust, spread
        self.terms, self.gradient, self.corner_factor = terms, gradient, corner_factor
        self._couplings = couplings
        self.whitened, self.coupled = self.carry(gradient.corners_map)

    def evaluate(self, step: Gradient, tangents: Tensor, own: Tensor) -> Evaluated:
        """Evaluate after a step of the reduced unknowns: x_c = L^-T (y_c - B x_r)."""
        motion, base = tangents.flatten(0, 1)[..., None], self._estimate
        moved = [run.sum_by_corner((w @ motion[run.pair])[..., 0]) for run, w in self._runs()]
        factor = self.corner_factor
        corners = base.corners_map + factor.solve_transposed(own - factor.solve(torch.cat(moved)))
        state, clock = base.frame_state + step.frame_state, base.clock_s + step.clock_s
        at = Estimate(base.cam_from_vehicle, state, corners, clock)
        estimate, terms, gradient = self._engine.cost_and_gradient(at, step.extrinsic, self._robust)
        return Evaluated(estimate, terms, gradient, *self.carry(gradient.corners_map))

    def carry(self, by_corner: Tensor) -> tuple[Tensor, Coupled]:
        """L^-1 g (N, 2) and W V^-1 g of a gradient g (N, 2) by the corners."""
        whitened = self.corner_factor.solve(by_corner)
        step = self.corner_factor.solve_transposed(whitened)
        shape = self._spread.clock.shape[:2]
        by_pair = step.new_zeros(shape.numel(), 6)
        for run, w in self._runs():
            along = step[run.corners][run.corner]
            by_pair.index_add_(0, run.pair, (w.mT @ along[..., None])[..., 0])
        return whitened, self._spread.gather(by_pair.view(*shape, 6))

    def coupling(self, run: Run, corners_map: Tensor) -> Tensor:
        """W' (k, 2, 6) of a run's observations."""
        poses = self._engine.poses(self._estimate).flatten(0, 1)
        by_pair, by_corner = self._engine.linearise(run, poses, corners_map, self._robust)
        return by_corner.mT @ by_pair

    def _runs(self) -> zip[tuple[Run, Tensor]]:
        return zip(self._engine.arrays.runs(), self._couplings, strict=True)


def _residual(run: Run, poses: Tensor, corners_map: Tensor) -> Tensor:
    """Whitened residuals (k, 2) of a run, for pairs (P, 4, 4) and all corners (N, 2)."""
    points = model.points_in_camera(poses[run.pair], corners_map[run.corners][run.corner])
    return model.corner_residual(points, run.measured, run.root_information)


def _blocks(arrays: Arrays, run: Run, per_tile: int) -> list[Block]:
    """Cut a run; corners that are joined are not parted."""
    units, begins = arrays.unit_bounds
    wanted = torch.arange(run.corners.start, run.corners.stop + _BLOCK_CORNERS, _BLOCK_CORNERS)
    wanted = wanted.clamp(max=run.corners.stop).to(units.device)
    cuts = torch.unique(torch.searchsorted(units, wanted))
    bounds = zip(
        (begins[cuts] - run.observations.start).tolist(),
        (units[cuts] - run.corners.start).tolist(),
        strict=True,
    )
    tile = run.pair % arrays.frame_count // per_tile
    return [
        Block(slice(begin, end), slice(first, last), tuple(torch.unique(tile[begin:end]).tolist()))
        for (begin, first), (end, last) in pairwise(bounds)
    ]


def _by_frame(system: ReducedSystem, block: Block, run: Run, by_state: Tensor) -> Tensor:
    """W' of a block by the states of the frames of its tiles, (n, 2, tiles * F * S)."""
    per_tile, part = system.plan.frames_per_tile, block.observations
    corners = block.corners.stop - block.corners.start
    tiles = torch.tensor(block.tiles, device=run.pair.device)
    frame, slots = run.pair[part] % system.arrays.frame_count, per_tile * len(block.tiles)
    slot = torch.searchsorted(tiles, frame // per_tile) * per_tile + frame % per_tile
    rows = by_state.new_zeros(corners * slots, *by_state.shape[1:])
    rows.index_add_(0, (run.corner[part] - block.corners.start) * slots + slot, by_state[part])
    return rows.view(corners, slots, 2, -1).transpose(1, 2).flatten(2)


def _subtract_block(system: ReducedSystem, block: Block, columns: Tensor, tip: Tensor) -> None:
    """Subtract the products of a block's frames (2 n, tiles * F * S) with each other and the cameras."""
    parts, tiles = columns.chunk(len(block.tiles), dim=1), system.matrix.tiles
    placed = sorted((system.plan.pattern.position[tile], part) for part, tile in enumerate(block.tiles))
    for n, (column, first) in enumerate(placed):
        tiles[TIP, column].addmm_(tip.mT, parts[first], alpha=-1)
        for row, second in placed[n:]:
            tiles[row, column].addmm_(parts[second].mT, parts[first], alpha=-1)
