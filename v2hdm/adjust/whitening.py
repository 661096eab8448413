"""Whitening: variables in which the Gauss-Newton Hessian is the identity.

With V the Hessian's block of the corners (2 x 2 each, or more where known lengths join some), W the coupling
of the reduced unknowns r (frame states, then extrinsics) to them and U their own block,

    L L' = V,   B = L^-1 W',   S = U - B' B = L_S L_S',

the change of variables x_r = L_S^-T y_r, x_c = L^-T (y_c - B x_r) turns the Hessian into the identity: a
block Cholesky factorisation with the corners eliminated first. The gradient is g_yc = L^-1 g_c,
g_yr = L_S^-1 (g_r - B' g_yc): a gradient step of length 1 in y is the Gauss-Newton step in x, and |g_y|^2 / 2
its predicted decrease.

Engines know W by *pair* of a camera and a frame (:class:`v2hdm.adjust.engine.Linearised`), which small tables
carry to extrinsics and frames. Corners that several drives observed may be *kept*: they are then unknowns of
r, and their places among the corners hold variables that are always zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from v2hdm.adjust.engine import Linearised, Reached, TorchEngine
from v2hdm.adjust.model import Estimate, Gradient, Loss
from v2hdm.adjust.reduced import Coupled, Plan, ReducedSystem, Spread, from_tiles, to_tiles
from v2hdm.adjust.tiles import TiledCholesky
from v2hdm.errors import AdjustError

SINGULAR_PIVOT = 1e-13  # a smaller pivot is the rounding of zero
# Added to a diagonal, relative to it, until it can be factorised; only a singular problem needs any. The
# pivots left by elimination are rounding there, and do not show the size needed.
JITTER_STEPS = (0.0, 1e-12, 1e-9, 1e-6, 1e-3)


class Step(NamedTuple):
    """A step of the unknowns, from whitened variables."""

    unknowns: Gradient  # the step x, except of corners
    tangents: Tensor  # (C, M, 6) left tangents of the pairs under it
    corners: Tensor  # (N, 2) whitened variables of the corners, of kept corners the step itself


@dataclass(frozen=True)
class Whitening:
    """The factorised Hessian at one estimate."""

    engine: TorchEngine  # of the problem
    plan: Plan  # tiles of the reduced system
    estimate: Estimate  # the point of linearisation, under ``robust``
    robust: Loss
    linearised: Linearised  # the problem there, corners eliminated
    gradient: Tensor  # of the cost there by y
    spread: Spread  # Jacobians of the pairs by frames and cameras
    reduced_factor: TiledCholesky  # L_S
    smallest_pivot: float  # least fraction of an unknown's information that the others leave
    jitter: float  # relative addition to U's diagonal that made L_S exist

    @property
    def terms(self) -> dict[str, float]:
        """The cost at the estimate, by name."""
        return self.linearised.terms

    @property
    def is_singular(self) -> bool:
        """Whether the observations and priors leave a direction of the reduced unknowns undetermined."""
        return self.jitter > 0 or self.smallest_pivot < SINGULAR_PIVOT

    @property
    def size(self) -> int:
        """Number of whitened variables: the reduced ones, then 2 N."""
        return self.reduced_factor.size + 2 * self.engine.arrays.corner_count

    def pull(self, by_residual: Tensor) -> Gradient:
        """Gradient by x of a scalar, from that by the whitened residuals (2, K)."""
        return self.engine.pull(self.estimate, self.spread, by_residual)

    def whiten(self, gradients: Sequence[Gradient]) -> Tensor:
        """Gradients by x, as (n, size) by y under this Hessian's factors."""
        carried = [self.linearised.carry(gradient.corners_map) for gradient in gradients]
        reduced_gradients = [
            _less_corners(self.plan, gradient, coupled, corners)
            for gradient, (corners, coupled) in zip(gradients, carried, strict=True)
        ]
        reduced = self.reduced_factor.solve(torch.stack(reduced_gradients, dim=1))
        corner_gradients = torch.stack([_less_kept(self.plan, corners) for corners, _ in carried])
        return torch.cat([reduced.mT, corner_gradients.flatten(1)], dim=1)

    def camera_step(self, whitened: Tensor) -> Tensor:
        """The cameras' part (C, 6 + Q) of a step: they come last, and need no other variables."""
        at_once = self.linearised.camera_step(whitened)
        if at_once is not None:
            return at_once
        tip = self.reduced_factor.tip
        end = self.reduced_factor.size
        solved: Tensor = torch.linalg.solve_triangular(
            tip.mT, whitened[end - len(tip) : end, None], upper=True
        )
        return solved.view(self.engine.arrays.camera_count, -1)

    def step(self, whitened: Tensor) -> Step:
        """The step of whitened variables."""
        arrays = self.engine.arrays
        tip = len(self.reduced_factor.tip)
        solved = self.reduced_factor.solve_transposed(whitened[: self.reduced_factor.size, None])[:, 0]
        states, kept_steps = from_tiles(self.plan, solved[:-tip], arrays.frame_count, len(arrays.states))
        by_camera = solved[-tip:].reshape(arrays.camera_count, -1)
        extrinsics = by_camera[:, :6]
        clock = by_camera[:, 6:]
        motion = extrinsics[:, None].expand(-1, arrays.moment_count, -1)
        if arrays.states:
            motion = motion + (self.spread.state @ arrays.at_moments(states)[None, ..., None])[..., 0]
        if clock.shape[-1]:
            motion = motion + (self.spread.clock @ clock[:, None, :, None])[..., 0]
        whitened_corners = whitened[self.reduced_factor.size :].reshape(-1, 2)
        if len(kept_steps):
            whitened_corners = whitened_corners.index_copy(0, self.plan.kept_corners, kept_steps)
        return Step(Gradient(extrinsics, states, motion.new_empty(0, 2), clock), motion, whitened_corners)

    def reach(self, whitened: Tensor) -> Reached:
        """The estimate that whitened variables stand for, its cost, and the gradient by them."""
        at_once = self.linearised.reach(whitened)
        if at_once is not None:
            return at_once
        done = self.linearised.evaluate(*self.step(whitened))
        gradient = whitened_gradient(
            self.plan, self.reduced_factor, done.gradient, done.coupled, done.whitened
        )
        return Reached(done.estimate, done.terms, gradient)


def whitened_gradient(
    plan: Plan, factor: TiledCholesky, gradient: Gradient, coupled: Coupled, corners: Tensor
) -> Tensor:
    """Gradient by y from that by x, the corners' part (N, 2) and ``coupled``, W V^-1 g_c."""
    reduced_gradient = _less_corners(plan, gradient, coupled, corners)
    return torch.cat([factor.solve(reduced_gradient[:, None])[:, 0], _less_kept(plan, corners).flatten()])


def _less_corners(plan: Plan, gradient: Gradient, coupled: Coupled, corners: Tensor) -> Tensor:
    """Gradient by the reduced unknowns, g_r - W V^-1 g_c."""
    reduced_gradient = (torch.cat([gradient.extrinsic, gradient.clock_s], dim=1) - coupled.camera).flatten()
    if plan.tile_count:
        by_state = gradient.frame_state - coupled.frame_state
        reduced_gradient = torch.cat([to_tiles(plan, by_state, corners[plan.kept_corners]), reduced_gradient])
    return reduced_gradient


def _less_kept(plan: Plan, corners: Tensor) -> Tensor:
    return corners.index_fill(0, plan.kept_corners, 0.0) if len(plan.kept_corners) else corners


def factorise(
    engine: TorchEngine, plan: Plan, estimate: Estimate, robust: Loss, hold_cameras: bool = False
) -> Whitening:
    """Whitening at ``estimate`` under the loss's weights there; held cameras' unknowns stay fixed.

    Raises AdjustError if the normal equations cannot be factorised.
    """
    at_once = engine.factorised(estimate, robust, hold_cameras)
    if at_once is not None:
        return Whitening(
            engine=engine,
            plan=plan,
            estimate=estimate,
            robust=robust,
            linearised=at_once.linearised,
            gradient=at_once.gradient,
            spread=at_once.linearised.spread,
            reduced_factor=at_once.reduced_factor,
            smallest_pivot=at_once.smallest_pivot,
            jitter=0.0,
        )
    spread = engine.spread(estimate)
    priors = engine.prior_blocks(estimate)
    for jitter in JITTER_STEPS:
        system = ReducedSystem(engine.arrays, plan, spread)
        linearised = engine.eliminate(system, estimate, robust)
        factorised = system.factorise(priors, jitter, hold_cameras)
        if factorised is None:
            continue
        factor, smallest_pivot = factorised
        return Whitening(
            engine=engine,
            plan=plan,
            estimate=estimate,
            robust=robust,
            linearised=linearised,
            gradient=whitened_gradient(
                plan, factor, linearised.gradient, linearised.coupled, linearised.whitened
            ),
            spread=spread,
            reduced_factor=factor,
            smallest_pivot=smallest_pivot,
            jitter=jitter,
        )
    raise AdjustError(
        "the normal equations cannot be factorised even when damped: look for observations or priors "
        "whose sigmas differ by many orders of magnitude"
    )
