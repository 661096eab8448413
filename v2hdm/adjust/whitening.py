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

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, Run
from v2hdm.adjust.corner_factor import CornerFactor, factorise_corners
from v2hdm.adjust.linear import Linear, corner_blocks, coupling, jacobians, pair_blocks
from v2hdm.adjust.reduced import Plan, ReducedSystem, Spread, from_tiles, to_tiles
from v2hdm.adjust.residuals import (
    Estimate,
    Gradient,
    Loss,
    Tally,
    View,
    by_corner_priors,
    length_residual,
    moved_columns,
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

# Keeps a corner factorable whose sightings a robust loss has all but switched off.
_WEIGHT_FLOOR = 1e-6
# Below this a pivot is what rounding left of zero.
_SINGULAR_PIVOT = 1e-13
# What is added to a diagonal, relative to it, until it can be factorised; only a singular problem needs any.
# A pivot is what elimination has left of it, and where that is rounding it says nothing of the size needed.
_JITTER_STEPS = (0.0, 1e-12, 1e-9, 1e-6, 1e-3)


@dataclass(frozen=True)
class Whitening:
    """The factorised Hessian at one estimate.

    Attributes:
        arrays: the problem it belongs to.
        plan: the tiles of its reduced system.
        estimate, robust: where, and under which loss, it was linearised.
        table: the pairs there, :func:`~v2hdm.adjust.residuals.pair_table`.
        terms, gradient: the cost there, by name, and its gradient by y.
        corner_factor: L.
        spread: how the pairs move with frames and cameras.
        reduced_factor: L_S.
        smallest_pivot: least share of an unknown's own information that the others leave it.
        jitter: what had to be added to U's diagonal, relative to it, for there to be an L_S.
    """

    arrays: Arrays
    plan: Plan
    estimate: Estimate
    robust: Loss
    table: Tensor
    terms: dict[str, Tensor]
    gradient: Tensor
    corner_factor: CornerFactor
    spread: Spread
    reduced_factor: TiledCholesky
    smallest_pivot: float
    jitter: float

    @property
    def is_singular(self) -> bool:
        """Whether the observations and priors leave a direction of the reduced unknowns free."""
        return self.jitter > 0 or self.smallest_pivot < _SINGULAR_PIVOT

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
        return loss(self.robust.name, view.squared, self.robust.scale)[1].clamp(min=_WEIGHT_FLOOR)

    def whiten(self, gradient: Gradient) -> Tensor:
        """A gradient by x as one by y, under the factors of this Hessian."""
        whitener = Whitener(self.arrays, self.table)
        for run in self.arrays.runs():
            whitener.add(
                self.linear(run), self.corner_factor.part(run.corners), gradient.corners_map[run.corners]
            )
        return whitener.whitened(self.plan, self.spread, self.reduced_factor, gradient)

    def corner_part(self, whitened: Tensor) -> Tensor:
        """Of whitened variables those of the corners, (N, 2)."""
        return whitened[self.reduced_factor.size :].reshape(-1, 2)

    def reduced_step(self, whitened: Tensor) -> tuple[Gradient, Tensor]:
        """The step x, that of the corners still 0; and how it moves the columns (9, P) of the pairs."""
        arrays, tip = self.arrays, self.arrays.camera_unknowns * self.arrays.camera_count
        reduced = whitened[: self.reduced_factor.size, None]
        solved = self.reduced_factor.solve_transposed(reduced)[:, 0]
        states = from_tiles(self.plan, solved[:-tip], arrays.frame_count, len(arrays.states))
        by_camera = solved[-tip:].reshape(arrays.camera_count, -1)
        extrinsics, clock = by_camera[:, :6], by_camera[:, 6:]
        motion = extrinsics[:, None] + (self.spread.state @ states[None, ..., None])[..., 0]
        motion = motion + (self.spread.clock @ clock[:, None, :, None])[..., 0]
        corners = torch.zeros_like(self.estimate.corners_map)
        tangents = motion.reshape(-1, 6).T
        return Gradient(extrinsics, states, corners, clock), moved_columns(self.table, tangents)


class Whitener:
    """A gradient by x on its way to y, run by run: the corners' part, and what it hands on to the pairs."""

    def __init__(self, arrays: Arrays, table: Tensor) -> None:
        self._arrays, self._table = arrays, table
        self._corners = table.new_empty(arrays.corner_count, 2)
        # W V^-1 g_c, by the pairs' columns.
        self._coupled = table.new_zeros(9, arrays.pair_count)

    def add(self, linear: Linear, factor: CornerFactor, by_corner: Tensor) -> None:
        """Add a run, given the factor of its corners and the gradient (n, 2) by them."""
        whitened = factor.solve(by_corner)
        self._corners[linear.run.corners] = whitened
        coupled = linear.pairs_from_corners(factor.solve_transposed(whitened))
        self._coupled.index_add_(1, linear.run.pair, coupled)

    def whitened(self, plan: Plan, spread: Spread, factor: TiledCholesky, gradient: Gradient) -> Tensor:
        """The gradient by y, once all runs are in; of ``gradient`` the corners' part is known already."""
        arrays = self._arrays
        by_pair = wrenches(self._table, self._coupled).T.reshape(arrays.camera_count, arrays.frame_count, 6)
        by_state = gradient.frame_state - (spread.state.mT @ by_pair[..., None])[..., 0].sum(0)
        by_clock = gradient.clock_s - (spread.clock.mT @ by_pair[..., None])[..., 0].sum(1)
        by_camera = torch.cat([gradient.extrinsic - by_pair.sum(1), by_clock], dim=1)
        rest = torch.cat([to_tiles(plan, by_state), by_camera.flatten()])
        return torch.cat([factor.solve(rest[:, None])[:, 0], self._corners.flatten()])


def factorise(
    arrays: Arrays, plan: Plan, estimate: Estimate, robust: Loss, damping: float = 0.0
) -> Whitening:
    """Whitening at ``estimate``, under the weights that the loss gives there.

    ``damping`` is added to the diagonal of the Hessian, relative to it (Levenberg-Marquardt).
    """
    for jitter in _JITTER_STEPS:
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
    table, tally = pair_table(arrays, estimate), Tally(arrays)
    spread = Spread(pair_from_state(arrays, estimate), pair_from_clock(arrays, estimate))
    system, whitener, factors = ReducedSystem(arrays, plan, spread), Whitener(arrays, table), []
    _, by_length = length_residual(arrays, estimate.corners_map)
    for number, run in enumerate(arrays.runs()):
        view = observe(run, table, estimate.corners_map)
        weight = tally.add(run, view, robust).clamp(min=_WEIGHT_FLOOR)
        by_pair, by_corner = (rows * weight.sqrt() for rows in jacobians(run, view))
        blocks = run.sum_by_corner(corner_blocks(by_corner)).T
        factors.append(factorise_corners(arrays, run.corners, blocks, by_length, damping))
        system.add(run, pair_blocks(by_pair))
        system.subtract(number, run, coupling(by_pair, by_corner), factors[-1])
        gradient = tally.by_corner[run.corners] + by_corner_priors(arrays, estimate, run.corners)
        whitener.add(Linear.at(run, view, weight), factors[-1], gradient)
    factorised = system.factorise(estimate, damping + jitter)
    if factorised is None:
        return None
    reduced_factor, smallest_pivot = factorised
    terms, by_estimate = with_priors(arrays, estimate, table, tally)
    return Whitening(
        arrays=arrays,
        plan=plan,
        estimate=estimate,
        robust=robust,
        table=table,
        terms=terms,
        gradient=whitener.whitened(plan, spread, reduced_factor, by_estimate),
        corner_factor=CornerFactor.side_by_side(factors),
        spread=spread,
        reduced_factor=reduced_factor,
        smallest_pivot=smallest_pivot,
        jitter=jitter,
    )
