"""From a start to an optimum: whiten, minimise, renew the whitening, until a certificate holds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.engines.numba.pool import one_thread_in_torch
from v2hdm.adjust.lbfgs import minimise, predicted_gap
from v2hdm.adjust.reduced import Plan, make_plan
from v2hdm.adjust.residuals import (
    Estimate,
    Gradient,
    Loss,
    Tally,
    by_corner_priors,
    moved_columns,
    observe,
    pair_table,
    squared_residuals,
    with_priors,
)
from v2hdm.adjust.robust import annealed_scale
from v2hdm.adjust.whitening import Evaluated, Whitener, Whitening, factorise, whitened_gradient
from v2hdm.geometry.tensors import exp, left_jacobian

# While a robust loss is still being narrowed, there is no point in more digits than this.
_ANNEALING_TOLERANCE = 1e-3
_ANNEALING_STEP = 3.0
_ITERATIONS_PER_WHITENING = 12
# Evaluations that a whitening takes as long as.
RENEWAL = 2.0
RENEWAL_WITH_STATES = 10.0
_MAX_LM_DAMPING = 1e8
_MIN_LM_DAMPING = 1e-5


@dataclass(frozen=True)
class Descent:
    """Where a descent ended.

    Attributes:
        arrays, plan: the problem.
        estimate, robust, terms: where it ended, under which loss, and the cost there by name.
        gap: the predicted remaining decrease as a fraction of the cost.
        evaluations: of cost and gradient.
        progressing: it was still going down when it was stopped.
        is_singular: observations and priors leave a direction of the reduced unknowns free.
        made: the whitening at the estimate, where the descent had to make it.
    """

    arrays: Arrays
    plan: Plan
    estimate: Estimate
    robust: Loss
    terms: dict[str, Tensor]
    gap: float
    evaluations: int
    progressing: bool
    is_singular: bool
    made: Whitening | None

    @cached_property
    def whitening(self) -> Whitening:
        """That at the estimate, made when it is asked for."""
        if self.made is not None:
            return self.made
        with one_thread_in_torch(len(self.arrays.pair), self.arrays.passes is not None):
            return factorise(self.arrays, self.plan, self.estimate, self.robust)


class Point(NamedTuple):
    """Whitened variables, what they stand for, and the cost there by name."""

    whitened: Tensor
    estimate: Estimate
    terms: dict[str, Tensor]


class Objective:
    """Cost and gradient by whitened variables around where the whitening was made; counts its evaluations."""

    def __init__(self, whitening: Whitening) -> None:
        self.whitening = whitening
        self.evaluations = 0
        self._last: Point | None = None

    def at_base(self) -> tuple[Tensor, Tensor]:
        """Cost and gradient at 0, which the whitening knows."""
        self.evaluations += 1
        return total(self.whitening.terms), self.whitening.gradient

    def point(self, whitened: Tensor) -> Point:
        """What whitened variables stand for; known where they were evaluated last."""
        if not bool(whitened.any()):
            return Point(whitened, self.whitening.estimate, self.whitening.terms)
        if self._last is None or not torch.equal(self._last.whitened, whitened):
            self(whitened)
        assert self._last is not None
        return self._last

    def __call__(self, whitened: Tensor) -> tuple[Tensor, Tensor]:
        """Cost and gradient at whitened variables."""
        self.evaluations += 1
        whitening, arrays = self.whitening, self.whitening.arrays
        step, tangents = whitening.reduced_step(whitened)
        estimate, jacobian = moved(arrays, whitening.estimate, step)
        done = evaluate(whitening, estimate, step, tangents, whitening.corner_part(whitened))
        estimate = replace(estimate, corners_map=done.corners_map)
        terms, gradient = with_priors(arrays, estimate, done.sums)
        by_tangent = (jacobian.mT @ gradient.extrinsic[..., None])[..., 0]
        by_whitened = whitened_gradient(
            whitening.plan,
            whitening.reduced_factor,
            replace(gradient, extrinsic=by_tangent),
            done.coupled,
            done.whitened,
        )
        self._last = Point(whitened.clone(), estimate, terms)
        return total(terms), by_whitened


def evaluate(
    whitening: Whitening, estimate: Estimate, step: Gradient, tangents: Tensor, own: Tensor
) -> Evaluated:
    """Evaluate where the reduced unknowns are those of ``estimate``, and its corners move with them.

    Args:
        whitening: the problem, whitened.
        estimate: moved by ``step`` but for its corners, see :func:`moved`.
        step: of the reduced unknowns.
        tangents: (C, J, 6) how the pairs move with them.
        own: (N, 2) whitened variables of the corners.
    """
    passes = whitening.arrays.passes
    if passes is not None and whitening.base is not None:
        return passes.evaluate(whitening, estimate, step, tangents, own)
    return _evaluate(whitening, estimate, tangents, own)


def _evaluate(whitening: Whitening, estimate: Estimate, tangents: Tensor, own: Tensor) -> Evaluated:
    """As :func:`evaluate`, by torch.

    Run by run: a run's corners are moved, x_c = L^-T (y_c - B x_r), and seen, and their gradient is carried
    back, while all of it is in the processor's cache.
    """
    arrays, robust = whitening.arrays, whitening.robust
    table, tally, back = pair_table(arrays, estimate), Tally(arrays), Whitener(arrays, whitening.table)
    motion = moved_columns(whitening.table, tangents.reshape(-1, 6).T)
    estimate = replace(estimate, corners_map=estimate.corners_map.clone())
    for run in arrays.runs():
        linear, factor = whitening.linear(run), whitening.corner_factor.part(run.corners)
        coupled = factor.solve(linear.corners_from_pairs(motion))
        estimate.corners_map[run.corners] += factor.solve_transposed(own[run.corners] - coupled)
        tally.add(run, observe(run, table, estimate.corners_map), robust)
        by_corner = tally.by_corner[run.corners] + by_corner_priors(arrays, estimate, run.corners)
        back.add(linear, factor, by_corner)
    sums = tally.sums(arrays, estimate, table)
    return Evaluated(sums, back.coupled(whitening.spread), back.corners, estimate.corners_map)


def moved(arrays: Arrays, base: Estimate, step: Gradient) -> tuple[Estimate, Tensor]:
    """``base`` moved by a step x but for its corners, and the left Jacobians (C, 6, 6) of the extrinsics'."""
    if arrays.passes is not None:
        cam_from_vehicle, jacobian = arrays.passes.move(step.extrinsic, base.cam_from_vehicle)
    else:
        cam_from_vehicle = exp(step.extrinsic) @ base.cam_from_vehicle
        jacobian = left_jacobian(step.extrinsic)
    state, clock = base.frame_state + step.frame_state, base.clock_s + step.clock_s
    return Estimate(cam_from_vehicle, state, base.corners_map, clock), jacobian


def total(terms: dict[str, Tensor]) -> Tensor:
    """The cost: the sum of its terms."""
    return torch.stack(list(terms.values())).sum()


class Linearised(Protocol):
    """A problem whitened at one estimate, under one loss."""

    @property
    def robust(self) -> Loss:
        """The loss."""

    @property
    def is_singular(self) -> bool:
        """Whether a direction of the reduced unknowns is free."""


class Measured(Protocol):
    """Cost and gradient by whitened variables, as :class:`Objective`."""

    evaluations: int

    def at_base(self) -> tuple[Tensor, Tensor]:
        """Cost and gradient at 0."""

    def __call__(self, whitened: Tensor) -> tuple[Tensor, Tensor]:
        """Cost and gradient at whitened variables."""

    def point(self, whitened: Tensor) -> Any:
        """What whitened variables stand for, as :class:`Point`."""


class System(Protocol):
    """What a descent goes down: a problem in this process, or in parts in several."""

    @property
    def renewal(self) -> float:
        """Evaluations that a whitening takes as long as."""

    def factorise(self, estimate: Any, robust: Loss, damping: float) -> Any:
        """The problem whitened at an estimate, :class:`Linearised`."""

    def annealed(self, estimate: Any, scale: float) -> float:
        """:func:`~v2hdm.adjust.robust.annealed_scale` of the residuals at an estimate."""

    def objective(self, linearised: Any) -> Measured:
        """Cost and gradient around where it was whitened."""


@dataclass(frozen=True)
class _InOneProcess:
    """The whole problem here."""

    arrays: Arrays
    plan: Plan

    @property
    def renewal(self) -> float:
        return RENEWAL_WITH_STATES if self.arrays.states else RENEWAL

    def factorise(self, estimate: Estimate, robust: Loss, damping: float) -> Whitening:
        return factorise(self.arrays, self.plan, estimate, robust, damping)

    def annealed(self, estimate: Estimate, scale: float) -> float:
        return annealed_scale(squared_residuals(self.arrays, estimate), scale)

    def objective(self, linearised: Whitening) -> Objective:
        return Objective(linearised)


class Ended(NamedTuple):
    """Where :func:`go_down` ended, named as in :class:`Descent`; ``made`` is the problem whitened there."""

    point: Any
    robust: Loss
    gap: float
    evaluations: int
    progressing: bool
    is_singular: bool
    made: Any


def descend(
    arrays: Arrays,
    estimate: Estimate,
    robust: Loss,
    solver: str,
    tolerance: float,
    max_refreshes: int,
    max_evaluations: int,
    opening: Whitening | None = None,
) -> Descent:
    """Minimise the cost from ``estimate``, narrowing the robust loss on the way.

    ``opening`` is what :func:`open_descent` makes of ``estimate``, if that was needed before.
    """
    opening = opening or open_descent(arrays, estimate, robust)
    system = _InOneProcess(arrays, opening.plan)
    end = go_down(system, [opening], robust, solver, tolerance, max_refreshes, max_evaluations)
    return Descent(
        arrays,
        system.plan,
        end.point.estimate,
        end.robust,
        end.point.terms,
        end.gap,
        end.evaluations,
        end.progressing,
        end.is_singular,
        end.made,
    )


def go_down(
    system: System,
    opening: list[Any],
    robust: Loss,
    solver: str,
    tolerance: float,
    max_refreshes: int,
    max_evaluations: int,
) -> Ended:
    """Minimise the cost of a system, narrowing the robust loss on the way.

    ``opening`` holds it whitened at the start, and is emptied, so that it goes when the next one comes.
    """
    evaluations, refreshes, damping, progressing, slow = 0, 0, 0.0, True, False
    whitening = opening.pop()
    renewal = system.renewal
    while True:
        scale = whitening.robust.scale
        final = scale <= robust.scale
        objective = system.objective(whitening)
        cost, gradient = objective.at_base()
        gap = predicted_gap(cost, gradient)
        refreshes += 1
        ended = (
            (final and gap <= tolerance and damping == 0)
            # Each step of Levenberg-Marquardt has a whitening of its own.
            or (refreshes > max_refreshes and solver != "lm")
            or evaluations >= max_evaluations
            or not progressing
        )
        whitened, reached, made = torch.zeros_like(gradient), cost, None
        if ended:
            made = whitening if damping == 0 else None
        elif solver == "lm":
            whitened, reached, damping = _newton_step(objective, cost, gradient, damping)
        else:
            inner = tolerance if final else _ANNEALING_TOLERANCE
            # One that follows a slow one was made near enough: what slows it is the loss, not the distance.
            whitened, reached, gradient, slow = minimise(
                objective, cost, gradient, inner, _ITERATIONS_PER_WHITENING, math.inf if slow else renewal
            )
            gap = predicted_gap(reached, gradient)
            # A whitening under which the gap shrank this fast tells it well enough.
            ended = final and not slow and gap <= tolerance
        point, used = objective.point(whitened), whitening.robust
        evaluations += objective.evaluations
        singular = whitening.is_singular
        if ended:
            return Ended(point, used, gap, evaluations, progressing, singular, made)
        estimate = point.estimate
        progressing = float(reached) < float(cost) or not final or 0 < damping < _MAX_LM_DAMPING
        # The old factor and what led away from it go before the new one comes.
        del whitening, objective, whitened, gradient, point
        if not final:
            narrowed = system.annealed(estimate, robust.scale)
            scale = max(robust.scale, min(narrowed, scale / _ANNEALING_STEP))
        whitening = system.factorise(estimate, Loss(robust.name, scale), damping)


def open_descent(arrays: Arrays, estimate: Estimate, robust: Loss) -> Whitening:
    """The first whitening of a descent, under a loss as wide as the residuals ask for."""
    scale = robust.scale
    if robust.name != "none":
        scale = annealed_scale(squared_residuals(arrays, estimate), scale)
    return factorise(arrays, make_plan(arrays), estimate, Loss(robust.name, scale))


def _newton_step(
    objective: Measured, cost: Tensor, gradient: Tensor, damping: float
) -> tuple[Tensor, Tensor, float]:
    """One damped Gauss-Newton step of Levenberg-Marquardt; a rejected one raises the damping."""
    reached, _ = objective(-gradient)
    if float(reached) <= float(cost):
        return -gradient, reached, damping / 10 if damping > _MIN_LM_DAMPING else 0.0
    return torch.zeros_like(gradient), cost, min(max(10 * damping, _MIN_LM_DAMPING), _MAX_LM_DAMPING)
