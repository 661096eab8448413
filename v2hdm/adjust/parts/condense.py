"""What one part hands on of the shared unknowns, once its own are eliminated.

In the order of elimination a part's unknowns are its own corners, its frames' states, its clock offsets; what
is left are the shared ones s: six of each extrinsic, then two of each shared corner that it saw. With L the
factor of its own block H = L L' and R = L^-1 W, W the coupling of its own unknowns to s, it hands on

    S = U - R' R,   g = g_s - R' L^-1 g_own,

and where s and the whitened own variables y are given, its own unknowns are x = L^-T (y - R s).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.corner_factor import CORNER_FLOOR, CornerFactor
from v2hdm.adjust.descent import evaluate, moved
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.linear import corner_blocks, coupling, jacobians, pair_blocks
from v2hdm.adjust.parts.split import Part
from v2hdm.adjust.reduced import (
    Coupled,
    Plan,
    ReducedSystem,
    Spread,
    from_tiles,
    make_plan,
    reduced_coupling,
    to_tiles,
)
from v2hdm.adjust.residuals import (
    Estimate,
    Gradient,
    Loss,
    Sums,
    Tally,
    observe,
    pair_from_clock,
    pair_from_state,
    pair_table,
    squared_residuals,
    with_priors,
)
from v2hdm.adjust.robust import loss
from v2hdm.adjust.whitening import WEIGHT_FLOOR, Elimination, Whitening, eliminate
from v2hdm.errors import AdjustError


@dataclass(frozen=True)
class Base:
    """Where a part is: an estimate whose corners are its own, and its shared corners (m, 2).

    Bases of one number are the same.
    """

    number: int
    estimate: Estimate
    shared_map: Tensor


@dataclass(frozen=True)
class Laid:
    """A part's arrays.

    Attributes:
        own, common: its observations of its own corners, and of shared ones; None without any.
        own_corners, common_corners: which of the part's corners they are of.
    """

    own: Arrays | None
    common: Arrays | None
    own_corners: Tensor
    common_corners: Tensor

    @classmethod
    def of(cls, part: Part) -> Laid:
        """Lay a part out."""
        arrays = make_arrays(part.problem, part.pose_states, "cpu", part.clock_offset)
        if arrays.clock_twist.shape[-1]:
            arrays = replace(arrays, clock_twist=arrays.clock_twist[..., part.visit : part.visit + 1])
        is_shared = torch.as_tensor(part.shared >= 0)[arrays.corner_order]
        sides = []
        for keep in (~is_shared, is_shared):
            mask = keep[arrays.corner.long()]
            side = arrays.take(mask)[0] if bool(mask.any()) else None
            sides.append((side, arrays.corner_order[:0] if side is None else side.corner_order))
        return cls(sides[0][0], sides[1][0], sides[0][1], sides[1][1])

    @property
    def host(self) -> Arrays:
        """Arrays that know frames, cameras and their priors."""
        arrays = self.own or self.common
        assert arrays is not None
        return arrays

    @cached_property
    def plan(self) -> Plan:
        """The tiles of its frames."""
        return make_plan(self.host)

    def squared(self, base: Base) -> Tensor:
        """Squared Mahalanobis distances of all its observations."""
        parts = []
        if self.own is not None:
            parts.append(squared_residuals(self.own, base.estimate))
        if self.common is not None:
            of_shared = replace(base.estimate, corners_map=base.shared_map)
            parts.append(squared_residuals(self.common, of_shared))
        return torch.cat(parts)


@dataclass(frozen=True)
class HandedOn:
    """What a part says of the shared unknowns: all that travels of it, and its own gradient's whitened part.

    Attributes:
        information: S (s, s).
        known: diagonal (s,) of what its observations say of them before anything is eliminated.
        cost: by name.
        gradient: g (s,).
        own: (o,) the gradient by its own whitened variables.
    """

    information: Tensor
    known: Tensor
    cost: dict[str, Tensor]
    gradient: Tensor
    own: Tensor


class Condensed:
    """A part linearised at a base under a loss, its own unknowns eliminated."""

    def __init__(self, laid: Laid, base: Base, robust: Loss) -> None:
        """Linearise and eliminate.

        Raises:
            AdjustError: its own unknowns cannot be eliminated.
        """
        self._laid, self._base, self._robust = laid, base, robust
        host, estimate = laid.host, base.estimate
        self._spread = Spread(pair_from_state(host, estimate), pair_from_clock(host, estimate))
        system = ReducedSystem(host, laid.plan, self._spread)
        done = _nothing(host) if laid.own is None else eliminate(system, estimate, robust, 0.0)
        border, blocks = self._add_common(system)
        eliminated = system.eliminate_frames(estimate)
        if eliminated is None:
            raise AdjustError("the frames of a visit cannot be eliminated: look at its pose_sigma")
        self._frames, known = eliminated
        tip = len(self._frames.tip)
        solved = self._frames.solve_above_tip(border)
        self._of_shared = solved[: len(solved) - tip]
        self._own = Whitening(
            arrays=host,
            plan=laid.plan,
            estimate=estimate,
            robust=robust,
            terms={},
            gradient=estimate.corners_map.new_empty(0),
            corner_factor=done.corner_factor,
            spread=self._spread,
            reduced_factor=self._frames,
            smallest_pivot=1.0,
            jitter=0.0,
            base=done.base,
        )
        below = blocks - self._of_shared.mT @ self._of_shared
        matrix = torch.cat(
            [
                torch.cat([self._frames.tip, solved[len(solved) - tip :]], dim=1),
                torch.cat([solved[len(solved) - tip :].mT, below], dim=1),
            ]
        )
        information = self._eliminate_clocks(matrix)
        terms, gradient, by_shared = self._with_priors(estimate, base.shared_map, done.sums)
        own, by_shared = self._reduce(gradient, by_shared, done.coupled, done.whitened)
        diagonal = torch.cat([known, blocks.diagonal()])[self._shared_rows]
        self.handed_on = HandedOn(information, diagonal, terms, by_shared, own)

    def evaluate(self, number: int, shared: Tensor, own: Tensor) -> tuple[Base, HandedOn]:
        """Where shared unknowns (s,) and own whitened ones (o,) lead, and cost and gradient there.

        ``number`` is that of the base reached. S is not computed anew.
        """
        host, base = self._laid.host, self._base
        cameras, frames = host.camera_count, self._of_shared.shape[0]
        step, tangents = self._step(shared, own[:frames], own[frames : frames + len(self._clocks)])
        estimate, jacobian = moved(host, base.estimate, step)
        corners = own[frames + len(self._clocks) :].view(-1, 2)
        shared_map = base.shared_map + shared[6 * cameras :].view(-1, 2)
        if self._laid.own is None:
            done = _nothing(host)
            sums, coupled, whitened = done.sums, done.coupled, done.whitened
        else:
            at = evaluate(self._own, estimate, step, tangents, corners)
            estimate = replace(estimate, corners_map=at.corners_map)
            sums, coupled, whitened = at.sums, at.coupled, at.whitened
        terms, gradient, by_shared = self._with_priors(estimate, shared_map, sums)
        by_tangent = (jacobian.mT @ gradient.extrinsic[..., None])[..., 0]
        by_own, by_shared = self._reduce(
            replace(gradient, extrinsic=by_tangent), by_shared, coupled, whitened
        )
        nothing = by_shared.new_empty(0)
        return Base(number, estimate, shared_map), HandedOn(nothing, nothing, terms, by_shared, by_own)

    def _add_common(self, system: ReducedSystem) -> tuple[Tensor, Tensor]:
        """Add what shared corners say of frames and cameras; their coupling to them, and their own block."""
        host, common = self._laid.host, self._laid.common
        columns, diagonal = [], []
        table = pair_table(host, self._base.estimate)
        for run in [] if common is None else common.runs():
            view = observe(run, table, self._base.shared_map)
            weight = loss(self._robust.name, view.squared, self._robust.scale)[1].clamp(min=WEIGHT_FLOOR)
            by_pair, by_corner = (rows * weight.sqrt() for rows in jacobians(run, view))
            system.add(run, pair_blocks(by_pair))
            along = coupling(by_pair, by_corner)
            columns.append(reduced_coupling(host, self._laid.plan, self._spread, run, along))
            xx, yx, yy = run.sum_by_corner(corner_blocks(by_corner)).T
            diagonal.append(torch.stack([xx, yx, yx, yy], dim=1).view(-1, 2, 2))
        if not columns:
            rows = self._laid.plan.tile_count * self._laid.plan.frames_per_tile * len(host.states)
            return table.new_zeros(rows + host.camera_count * host.camera_unknowns, 0), table.new_zeros(0, 0)
        each = torch.cat(diagonal)
        index = torch.arange(len(each))
        blocks = each.new_zeros(len(each), 2, len(each), 2)
        blocks[index, :, index, :] = each
        blocks = blocks.view(2 * len(each), -1)
        blocks.diagonal().add_(CORNER_FLOOR)
        return torch.cat(columns, dim=1), blocks

    def _eliminate_clocks(self, matrix: Tensor) -> Tensor:
        """Of the information (t, t) of cameras and shared corners, what clock offsets leave."""
        host = self._laid.host
        index = torch.arange(len(matrix))
        cameras = index[: host.camera_count * host.camera_unknowns].view(host.camera_count, -1)
        self._clocks = cameras[:, 6:].flatten()
        self._shared_rows = torch.cat([cameras[:, :6].flatten(), index[cameras.numel() :]])
        own = matrix[self._clocks][:, self._clocks]
        self._clock_factor = torch.linalg.cholesky(own) if len(own) else own
        across = matrix[self._clocks][:, self._shared_rows]
        self._of_clock = torch.linalg.solve_triangular(self._clock_factor, across, upper=False)
        rest = matrix[self._shared_rows][:, self._shared_rows]
        left: Tensor = rest - self._of_clock.mT @ self._of_clock
        return left

    def _with_priors(
        self, estimate: Estimate, shared_map: Tensor, sums: Sums
    ) -> tuple[dict[str, Tensor], Gradient, Tensor]:
        """Cost by name, gradient by cameras, frames and clocks, and that (m, 2) by the shared corners."""
        host, common = self._laid.host, self._laid.common
        by_shared = shared_map.new_zeros(0, 2)
        if common is not None:
            table, tally = pair_table(host, estimate), Tally(common)
            for run in common.runs():
                tally.add(run, observe(run, table, shared_map), self._robust)
            more = tally.sums(common, replace(estimate, corners_map=shared_map), table)
            by_shared = more.by_corner
            sums = replace(
                sums, observations=sums.observations + more.observations, wrench=sums.wrench + more.wrench
            )
        terms, gradient = with_priors(host, estimate, sums)
        return terms, gradient, by_shared

    def _reduce(
        self, gradient: Gradient, by_shared: Tensor, coupled: Coupled, whitened: Tensor
    ) -> tuple[Tensor, Tensor]:
        """A gradient by all its unknowns as those by its own whitened ones (o,) and by the shared (s,)."""
        by_camera = torch.cat([gradient.extrinsic, gradient.clock_s], dim=1) - coupled.camera
        by_frame = to_tiles(self._laid.plan, gradient.frame_state - coupled.frame_state)
        rest = self._frames.solve_above_tip(torch.cat([by_frame, by_camera.flatten()])[:, None])[:, 0]
        frames = rest[: len(by_frame)]
        left = torch.cat([rest[len(by_frame) :], by_shared.flatten() - self._of_shared.mT @ frames])
        clock = left[self._clocks][:, None]
        clock = torch.linalg.solve_triangular(self._clock_factor, clock, upper=False)[:, 0]
        own = torch.cat([frames, clock, whitened.flatten()])
        return own, left[self._shared_rows] - self._of_clock.mT @ clock

    def _step(self, shared: Tensor, frames: Tensor, clock: Tensor) -> tuple[Gradient, Tensor]:
        """The step of all reduced unknowns, corners aside, and the pairs' left tangents (C, J, 6)."""
        host, plan, spread = self._laid.host, self._laid.plan, self._spread
        cameras = host.camera_count
        extrinsic = shared[: 6 * cameras].view(cameras, 6)
        by_clock = (clock - self._of_clock @ shared)[:, None]
        offset = torch.linalg.solve_triangular(self._clock_factor.mT, by_clock, upper=True).view(cameras, -1)
        above = frames - self._of_shared @ shared[6 * cameras :]
        right = torch.cat([above, torch.cat([extrinsic, offset], dim=1).flatten()])[:, None]
        solved = self._frames.solve_transposed_above_tip(right)[: len(frames), 0]
        states = from_tiles(plan, solved, host.frame_count, len(host.states))
        motion = extrinsic[:, None].expand(-1, host.frame_count, -1)
        if host.states:
            motion = motion + (spread.state @ states[None, ..., None])[..., 0]
        if offset.shape[-1]:
            motion = motion + (spread.clock @ offset[:, None, :, None])[..., 0]
        return Gradient(extrinsic, states, motion.new_empty(0, 2), offset), motion


def _nothing(arrays: Arrays) -> Elimination:
    """Of a part without corners of its own."""
    zero, wrench = (
        arrays.centre.new_zeros(()),
        arrays.centre.new_zeros(arrays.camera_count, arrays.frame_count, 6),
    )
    none = arrays.centre.new_zeros(0, 2)
    by_state = wrench.new_zeros(arrays.frame_count, len(arrays.states))
    by_camera = wrench.new_zeros(arrays.camera_count, arrays.camera_unknowns)
    factor = CornerFactor(none.new_zeros(3, 0), ())
    return Elimination(Sums(zero, zero, zero, wrench, none), Coupled(by_state, by_camera), none, factor, None)
