"""Variables in which the problem looks round: the Gauss-Newton Hessian becomes the identity.

With V the Hessian's block of the corners (2 x 2 each, or more where known lengths join some), W the coupling
of the reduced unknowns r (frame states, then extrinsics) to them and U their own block,

    L L' = V,   B = L^-1 W',   S = U - B' B = L_S L_S',

the change of variables x_r = L_S^-T y_r, x_c = L^-T (y_c - B x_r) turns the Hessian into the identity: a
block Cholesky factorisation of the whole, corners eliminated first. A gradient follows as
g_yc = L^-1 g_c, g_yr = L_S^-1 (g_r - B' g_yc). One gradient step of length 1 in y is then
the Gauss-Newton step in x, and |g_y|^2 / 2 the decrease that it predicts.

W is never stored: a run's part of it is computed anew whenever it is needed (:mod:`v2hdm.adjust.linear`),
by *pair*, and spread to extrinsics and frames on the small table of pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, Run
from v2hdm.adjust.corner_factor import CornerFactor, factorise_corners
from v2hdm.adjust.linear import Linear, corner_blocks, coupling, jacobians, pair_blocks
from v2hdm.adjust.reduced import Coupled, Plan, ReducedSystem, Spread, from_tiles, to_tiles
from v2hdm.adjust.residuals import (
    Estimate,
    Gradient,
    Loss,
    Sums,
    Tally,
    View,
    by_camera_and_frame,
    by_corner_priors,
    length_residual,
    observe,
    pair_from_clock,
    pair_from_state,
    pair_table,
    with_priors,
    wrenches,
)
from v2hdm.adjust.robust import loss
from v2hdm.adjust.tiles import TiledCholesky
from v2hdm.errors import AdjustError

if TYPE_CHECKING:
    from v2hdm.adjust.engines.numba.evaluate import Base

WEIGHT_FLOOR = 1e-6
"""Keeps a corner factorable whose sightings a robust loss has all but switched off."""

# Below this a pivot is what rounding left of zero.
SINGULAR_PIVOT = 1e-13
# What is added to a diagonal, relative to it, until it can be factorised; only a singular problem needs any.
# A pivot is what elimination has left of it, and where that is rounding it says nothing of the size needed.
JITTER_STEPS = (0.0, 1e-12, 1e-9, 1e-6, 1e-3)


@dataclass(frozen=True)
class Elimination:
    """What linearising adds up, and what eliminating the corners leaves of it.

    ``whitened`` (N, 2) is L^-1 g_c, ``coupled`` W V^-1 g_c; ``corner_factor`` and ``base`` are those of
    :class:`Whitening`.
    """

    sums: Sums
    coupled: Coupled
    whitened: Tensor
    corner_factor: CornerFactor
    base: Base | None


@dataclass(frozen=True)
class Evaluated:
    """What an evaluation adds up: the moved corners (N, 2), and what is named as in :class:`Elimination`."""

    sums: Sums
    coupled: Coupled
    whitened: Tensor
    corners_map: Tensor


@dataclass(frozen=True)
class Whitening:
    """The factorised Hessian at one estimate.

    Attributes:
        arrays: the problem it belongs to.
        plan: the tiles of its reduced system.
        estimate, robust: where, and under which loss, it was linearised.
        terms, gradient: the cost there, by name, and its gradient by y.
        corner_factor: L.
        spread: how the pairs move with frames and cameras.
        reduced_factor: L_S.
        smallest_pivot: least share of an unknown's own information that the others leave it.
        jitter: what had to be added to U's diagonal, relative to it, for there to be an L_S.
        base: the corners' part as the kernels hold it, None where torch made it.
    """

    arrays: Arrays
    plan: Plan
    estimate: Estimate
    robust: Loss
    terms: dict[str, Tensor]
    gradient: Tensor
    corner_factor: CornerFactor
    spread: Spread
    reduced_factor: TiledCholesky
    smallest_pivot: float
    jitter: float
    base: Base | None

    @cached_property
    def table(self) -> Tensor:
        """The pairs where it was linearised, :func:`~v2hdm.adjust.residuals.pair_table`."""
        return pair_table(self.arrays, self.estimate)

    @property
    def is_singular(self) -> bool:
        """Whether the observations and priors leave a direction of the reduced unknowns free."""
        return self.jitter > 0 or self.smallest_pivot < SINGULAR_PIVOT

    @property
    def size(self) -> int:
        """Number of whitened variables: the reduced ones, then 2 N."""
        return self.reduced_factor.size + 2 * self.arrays.corner_count

    def linear(self, run: Run) -> Linear:
        """The coupling of a run's corners to its pairs."""
        view = observe(run, self.table, self.estimate.corners_map)
        return Linear.at(run, view, self.weight(view))

    def weight(self, view: View) -> Tensor:
        """What the Hessian counts the observations of a run for (k,)."""
        return loss(self.robust.name, view.squared, self.robust.scale)[1].clamp(min=WEIGHT_FLOOR)

    def whiten(self, gradient: Gradient) -> Tensor:
        """A gradient by x as one by y, under the factors of this Hessian."""
        whitener = Whitener(self.arrays, self.table)
        for run in self.arrays.runs():
            whitener.add(
                self.linear(run), self.corner_factor.part(run.corners), gradient.corners_map[run.corners]
            )
        return whitened_gradient(
            self.plan, self.reduced_factor, gradient, whitener.coupled(self.spread), whitener.corners
        )

    def corner_part(self, whitened: Tensor) -> Tensor:
        """Of whitened variables those of the corners, (N, 2)."""
        return whitened[self.reduced_factor.size :].reshape(-1, 2)

    def reduced_step(self, whitened: Tensor) -> tuple[Gradient, Tensor]:
        """The step x, that of the corners not yet known (0, 2), and the pairs' left tangents (C, J, 6)."""
        arrays, tip = self.arrays, self.arrays.camera_unknowns * self.arrays.camera_count
        reduced = whitened[: self.reduced_factor.size, None]
        solved = self.reduced_factor.solve_transposed(reduced)[:, 0]
        states = from_tiles(self.plan, solved[:-tip], arrays.frame_count, len(arrays.states))
        by_camera = solved[-tip:].reshape(arrays.camera_count, -1)
        extrinsics, clock = by_camera[:, :6], by_camera[:, 6:]
        motion = extrinsics[:, None].expand(-1, arrays.frame_count, -1)
        if arrays.states:
            motion = motion + (self.spread.state @ states[None, ..., None])[..., 0]
        if clock.shape[-1]:
            motion = motion + (self.spread.clock @ clock[:, None, :, None])[..., 0]
        return Gradient(extrinsics, states, motion.new_empty(0, 2), clock), motion


class Whitener:
    """A gradient by x on its way to y, run by run: the corners' part, and what it hands on to the pairs.

    Attributes:
        corners: (N, 2) L^-1 g_c.
    """

    def __init__(self, arrays: Arrays, table: Tensor) -> None:
        self._arrays, self._table = arrays, table
        self.corners = table.new_empty(arrays.corner_count, 2)
        self._by_table = table.new_zeros(9, arrays.pair_count)

    def add(self, linear: Linear, factor: CornerFactor, by_corner: Tensor) -> None:
        """Add a run, given the factor of its corners and the gradient (n, 2) by them."""
        whitened = factor.solve(by_corner)
        self.corners[linear.run.corners] = whitened
        coupled = linear.pairs_from_corners(factor.solve_transposed(whitened))
        self._by_table.index_add_(1, linear.run.pair, coupled)

    def coupled(self, spread: Spread) -> Coupled:
        """W V^-1 g_c, once all runs are in."""
        return spread.gather(by_camera_and_frame(self._arrays, wrenches(self._table, self._by_table)))


def whitened_gradient(
    plan: Plan, factor: TiledCholesky, gradient: Gradient, coupled: Coupled, corners: Tensor
) -> Tensor:
    """The gradient by y, of the part of the corners (N, 2) and ``coupled``, W V^-1 g_c."""
    by_state = gradient.frame_state - coupled.frame_state
    by_camera = torch.cat([gradient.extrinsic, gradient.clock_s], dim=1) - coupled.camera
    rest = torch.cat([to_tiles(plan, by_state), by_camera.flatten()])
    return torch.cat([factor.solve(rest[:, None])[:, 0], corners.flatten()])


def factorise(
    arrays: Arrays, plan: Plan, estimate: Estimate, robust: Loss, damping: float = 0.0
) -> Whitening:
    """Whitening at ``estimate``, under the weights that the loss gives there.

    ``damping`` is added to the diagonal of the Hessian, relative to it (Levenberg-Marquardt).
    """
    for jitter in JITTER_STEPS:
        whitening = _try_factorise(arrays, plan, estimate, robust, damping, jitter)
        if whitening is not None:
            return whitening
    raise AdjustError(
        "the normal equations cannot be factorised even when damped: look for observations or priors "
        "whose sigmas differ by many orders of magnitude"
    )


def _try_factorise(
    arrays: Arrays, plan: Plan, estimate: Estimate, robust: Loss, damping: float, jitter: float
) -> Whitening | None:
    """The whitening, if the diagonal of the reduced part with ``jitter`` added to it can be factorised."""
    spread = Spread(pair_from_state(arrays, estimate), pair_from_clock(arrays, estimate))
    system = ReducedSystem(arrays, plan, spread)
    done = eliminate(system, estimate, robust, damping)
    factorised = system.factorise(estimate, damping + jitter)
    if factorised is None:
        return None
    reduced_factor, smallest_pivot = factorised
    terms, gradient = with_priors(arrays, estimate, done.sums)
    return Whitening(
        arrays=arrays,
        plan=plan,
        estimate=estimate,
        robust=robust,
        terms=terms,
        gradient=whitened_gradient(plan, reduced_factor, gradient, done.coupled, done.whitened),
        corner_factor=done.corner_factor,
        spread=spread,
        reduced_factor=reduced_factor,
        smallest_pivot=smallest_pivot,
        jitter=jitter,
        base=done.base,
    )


def eliminate(system: ReducedSystem, estimate: Estimate, robust: Loss, damping: float) -> Elimination:
    """Linearise, and take the eliminated corners off the reduced system."""
    if system.arrays.passes is not None:
        return system.arrays.passes.eliminate(system, estimate, robust, damping)
    return _eliminate(system, estimate, robust, damping)


def _eliminate(system: ReducedSystem, estimate: Estimate, robust: Loss, damping: float) -> Elimination:
    """Linearise run by run, and take the eliminated corners off the reduced system."""
    arrays, table = system.arrays, pair_table(system.arrays, estimate)
    tally, whitener, factors = Tally(arrays), Whitener(arrays, table), []
    _, by_length = length_residual(arrays, estimate.corners_map)
    for number, run in enumerate(arrays.runs()):
        view = observe(run, table, estimate.corners_map)
        weight = tally.add(run, view, robust).clamp(min=WEIGHT_FLOOR)
        by_pair, by_corner = (rows * weight.sqrt() for rows in jacobians(run, view))
        blocks = run.sum_by_corner(corner_blocks(by_corner)).T
        factors.append(factorise_corners(arrays, run.corners, blocks, by_length, damping))
        system.add(run, pair_blocks(by_pair))
        system.subtract(number, run, coupling(by_pair, by_corner), factors[-1])
        gradient = tally.by_corner[run.corners] + by_corner_priors(arrays, estimate, run.corners)
        whitener.add(Linear.at(run, view, weight), factors[-1], gradient)
    return Elimination(
        sums=tally.sums(arrays, estimate, table),
        coupled=whitener.coupled(system.spread),
        whitened=whitener.corners,
        corner_factor=CornerFactor.side_by_side(factors),
        base=None,
    )
