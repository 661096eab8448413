"""From a start to an optimum: whiten, minimise and whiten again, until the predicted decrease vanishes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.engine import TorchEngine
from v2hdm.adjust.model import Estimate, Loss
from v2hdm.adjust.reduced import Plan
from v2hdm.adjust.threads import one_thread_in_torch
from v2hdm.adjust.torch_quirks import bare_step, leave_compiler_out
from v2hdm.adjust.whitening import Whitening, factorise

Evaluate = Callable[[Tensor], tuple[float, Tensor]]  # cost and gradient at whitened variables y

# Pairs of steps and gradients that LBFGS remembers, and most evaluations of a step: chosen.
_LINE_SEARCH: dict[str, Any] = {"history_size": 20, "max_eval": 25}
# One iteration per step: the surrounding loop decides when to stop.
_STEPWISE: dict[str, Any] = {"max_iter": 1, "tolerance_grad": 0.0, "tolerance_change": 0.0}
_STEPS_FROM_NEARBY = 2  # steps to convergence under a whitening made near the optimum
_NO_PROGRESS = 1e-15  # relative decrease below which it is rounding


def predicted_gap(cost: float, gradient: Tensor) -> float:
    """|g|^2, twice the predicted decrease of a unit Newton step, relative to a cost above 1."""
    return float(gradient @ gradient) / max(cost, 1.0)


class Minimum(NamedTuple):
    """The end of a minimisation: y, cost, gradient, and whether its whitening converged too slowly."""

    whitened: Tensor
    cost: float
    gradient: Tensor
    slow: bool


def minimise(
    objective: Evaluate,
    cost: float,
    gradient: Tensor,
    tolerance: float,
    max_iterations: int,
    renewal: float = math.inf,
) -> Minimum:
    """Minimise from y = 0 of known cost and gradient (n,); the Hessian there is approximately the identity.

    torch's first step is ``-min(1, 1 / |g|_1) g``. On u = y / a with the objective scaled by 1 / a^2 and a =
    |g_y(0)|_1 the gradient's 1-norm is 1 and that step is y = -g_y: the unit step that the whitening is made
    for, without touching internals. It stops once :func:`predicted_gap` is below ``tolerance``, and is too
    slow after ``max_iterations``, or if the remaining steps, at the rate of the last, cost more than a new
    whitening of ``renewal`` evaluations and the few steps from nearby.
    """
    scale = float(gradient.abs().sum())
    u = torch.zeros_like(gradient)
    evaluations = _Evaluations(
        lambda point: objective(point * scale), torch.zeros_like(gradient), cost, gradient
    )

    def closure() -> float:
        new_cost, new_gradient = evaluations.at(u)
        # An infinite cost means an overshooting step; a sum is finite only if all of its terms are.
        if math.isnan(new_cost) or not (math.isinf(new_cost) or math.isfinite(float(new_gradient.sum()))):
            raise _NoNumberError
        u.grad = new_gradient / scale
        # Differences to the start keep the digits of small improvements of a large cost.
        return (new_cost - cost) / scale**2

    leave_compiler_out()
    optimizer = torch.optim.LBFGS([u], line_search_fn="strong_wolfe", **_STEPWISE, **_LINE_SEARCH)
    step = bare_step()
    best = cost
    best_gradient = gradient
    gap = predicted_gap(best, best_gradient)
    slow = False
    for iteration in range(max_iterations):
        if gap <= tolerance or slow:
            break
        try:
            step(optimizer, closure)
            reached, reached_gradient = evaluations.at(u)
        except _NoNumberError:
            reached = math.inf
        if not math.isfinite(reached):
            # A line search along a singular direction diverged; the point before it stands.
            u.copy_(evaluations.start)
            break
        evaluations.begin_step(u, reached, reached_gradient)
        progress = best - reached
        best = reached
        best_gradient = reached_gradient
        if progress <= _NO_PROGRESS * best:
            break
        before = gap
        gap = predicted_gap(best, best_gradient)
        slow = iteration > 0 and _steps_left(before, gap, tolerance) > renewal + _STEPS_FROM_NEARBY
    return Minimum(u * scale, best, best_gradient, slow)


def _steps_left(before: float, gap: float, tolerance: float) -> float:
    """Steps to the tolerance if each reduces the gap by the last one's factor."""
    if gap <= tolerance:
        return 0.0
    return math.log(tolerance / gap) / math.log(gap / before) if gap < before else math.inf


class _NoNumberError(Exception):
    """The objective is NaN within a line search, whose comparisons are then meaningless."""


class _Evaluations:
    """An objective that caches the points of a step: each step first asks for the end of the last."""

    def __init__(self, objective: Evaluate, start: Tensor, cost: float, gradient: Tensor) -> None:
        self._objective = objective
        self.begin_step(start, cost, gradient)

    def begin_step(self, start: Tensor, cost: float, gradient: Tensor) -> None:
        """Forget all points except the start of a step, with its cost and gradient."""
        self._known = [(start.clone(), cost, gradient)]

    @property
    def start(self) -> Tensor:
        """Start of the current step."""
        return self._known[0][0]

    def at(self, point: Tensor) -> tuple[float, Tensor]:
        """Cost and gradient at a point, from the cache if possible."""
        for evaluated_point, cost, gradient in self._known:
            if torch.equal(evaluated_point, point):
                return cost, gradient
        with np.errstate(over="ignore", invalid="ignore"):  # an overshooting step may overflow
            cost, gradient = self._objective(point)
        self._known.append((point.clone(), cost, gradient))
        return cost, gradient


_ANNEALING_TOLERANCE = 1e-3  # while a robust loss is being narrowed, more digits are wasted
_ANNEALING_STEP = 3.0  # factor by which a robust loss is narrowed at least, from whitening to whitening
_ITERATIONS_PER_WHITENING = 12  # most steps of LBFGS under one whitening
RENEWAL = 2.0  # cost of a whitening, in evaluations, if frames have no states
RENEWAL_WITH_STATES = 10.0  # cost of a whitening, in evaluations, if frames have states


@dataclass(frozen=True)
class Descent:
    """The end of a descent."""

    engine: TorchEngine
    plan: Plan
    estimate: Estimate  # the optimum, under ``robust``, with the cost by name
    robust: Loss
    terms: dict[str, float]
    gap: float  # the predicted remaining decrease as a fraction of the cost
    evaluations: int  # of cost and gradient
    progressing: bool  # the cost was still falling at the end
    is_singular: bool  # some direction of the reduced unknowns is undetermined
    last_whitening: Whitening | None  # the whitening at the estimate, if the descent made it

    @cached_property
    def whitening(self) -> Whitening:
        """The whitening at the estimate, computed on first use."""
        if self.last_whitening is not None:
            return self.last_whitening
        arrays = self.engine.arrays
        with one_thread_in_torch(len(arrays.pair), arrays.centre.device.type == "cpu"):
            return factorise(self.engine, self.plan, self.estimate, self.robust)


class Point(NamedTuple):
    """Whitened variables, the estimate they represent, and its cost by name."""

    whitened: Tensor
    estimate: Estimate
    terms: dict[str, float]


class Objective:
    """Cost and gradient by whitened variables about the whitening's estimate; counts evaluations."""

    def __init__(self, whitening: Whitening) -> None:
        self.whitening = whitening
        self.evaluations = 0
        self._last: Point | None = None

    def at_base(self) -> tuple[float, Tensor]:
        """Cost and gradient at 0, from the whitening."""
        self.evaluations += 1
        return sum(self.whitening.terms.values()), self.whitening.gradient

    def point(self, whitened: Tensor) -> Point:
        """The point of some whitened variables, cached if they were evaluated last."""
        if not bool(whitened.any()):
            return Point(whitened, self.whitening.estimate, self.whitening.terms)
        if self._last is None or not torch.equal(self._last.whitened, whitened):
            self(whitened)
        assert self._last is not None
        return self._last

    def __call__(self, whitened: Tensor) -> tuple[float, Tensor]:
        """Cost and gradient at whitened variables."""
        self.evaluations += 1
        reached = self.whitening.reach(whitened)
        self._last = Point(whitened.clone(), reached.estimate, reached.terms)
        return sum(reached.terms.values()), reached.gradient


def narrowed(engine: TorchEngine, estimate: Estimate, robust: Loss, last: Loss | None = None) -> Loss:
    """The loss, with most residuals in its convex part, at most a third as wide as ``last``."""
    if robust.name == "none":
        return robust
    squared = engine.residuals(engine.poses(estimate), estimate.corners_map).square().sum(0)
    scale = 2.0 * float(squared.median().sqrt())
    if last is not None:
        scale = min(scale, last.scale / _ANNEALING_STEP)
    return Loss(robust.name, max(robust.scale, scale))


def descend(
    engine: TorchEngine,
    estimate: Estimate,
    robust: Loss,
    tolerance: float,
    max_refreshes: int,
    max_evaluations: int,
    opening: Whitening | None = None,
) -> Descent:
    """Minimise the cost while narrowing the loss; ``opening`` is :func:`open_descent` of the start."""
    whitening = opening or open_descent(engine, estimate, robust)
    del opening
    plan = whitening.plan
    renewal = RENEWAL_WITH_STATES if engine.arrays.states else RENEWAL
    evaluations = 0
    refreshes = 0
    progressing = True
    slow = False
    while True:
        final = whitening.robust.scale <= robust.scale
        objective = Objective(whitening)
        cost, gradient = objective.at_base()
        gap = predicted_gap(cost, gradient)
        refreshes += 1
        is_spent = refreshes > max_refreshes or evaluations >= max_evaluations
        if (final and gap <= tolerance) or is_spent or not progressing:
            base = objective.point(torch.zeros_like(gradient))
            evaluations += objective.evaluations
            return _descent_to(base, whitening, gap, evaluations, progressing, is_base=True)
        inner = tolerance if final else _ANNEALING_TOLERANCE
        # After a slow whitening the next is near enough: the loss slows it, not the distance.
        whitened, reached, gradient, slow = minimise(
            objective, cost, gradient, inner, _ITERATIONS_PER_WHITENING, math.inf if slow else renewal
        )
        gap = predicted_gap(reached, gradient)
        point = objective.point(whitened)
        evaluations += objective.evaluations
        # A whitening under which the gap shrank this fast determines it well.
        if final and not slow and gap <= tolerance:
            return _descent_to(point, whitening, gap, evaluations, progressing, is_base=False)
        progressing = reached < cost or not final
        estimate = point.estimate
        last = whitening.robust
        # Frees the memory of the old factor, and of what refers to it, before the new one is made.
        del whitening, objective, whitened, gradient, point
        loss = last if final else narrowed(engine, estimate, robust, last)
        whitening = factorise(engine, plan, estimate, loss)


def _descent_to(
    point: Point, whitening: Whitening, gap: float, evaluations: int, progressing: bool, *, is_base: bool
) -> Descent:
    """The descent that ends at a point of a whitening, or at its base."""
    return Descent(
        engine=whitening.engine,
        plan=whitening.plan,
        estimate=point.estimate,
        robust=whitening.robust,
        terms=point.terms,
        gap=gap,
        evaluations=evaluations,
        progressing=progressing,
        is_singular=whitening.is_singular,
        last_whitening=whitening if is_base else None,
    )


def open_descent(engine: TorchEngine, estimate: Estimate, robust: Loss) -> Whitening:
    """First whitening of a descent, under a loss wide enough for the residuals."""
    return factorise(engine, engine.plan(), estimate, narrowed(engine, estimate, robust))
