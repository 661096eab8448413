"""From a start to an optimum: whiten, minimise, renew the whitening, until a certificate holds."""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.engine import Engine
from v2hdm.adjust.engines.numba.layout import one_thread_in_torch
from v2hdm.adjust.model import Estimate, Loss
from v2hdm.adjust.reduced import Plan
from v2hdm.adjust.whitening import Whitening, factorise, whitened_gradient

Evaluate = Callable[[Tensor], tuple[float, Tensor]]  # cost and gradient at whitened variables y

_LINE_SEARCH: dict[str, Any] = {"history_size": 20, "max_eval": 25}
# One iteration a step: stopping is the affair of the loop around it.
_STEPWISE: dict[str, Any] = {"max_iter": 1, "tolerance_grad": 0.0, "tolerance_change": 0.0}
_STEPS_FROM_NEARBY = 2  # steps that a whitening near the optimum takes to the end
_NO_PROGRESS = 1e-15  # a relative decrease below this is rounding


def predicted_gap(cost: float, gradient: Tensor) -> float:
    """|g|^2, twice what a unit Newton step gains, as a share of the cost where that is above 1."""
    return float(gradient @ gradient) / max(cost, 1.0)


class Minimum(NamedTuple):
    """Where a minimisation ended: y, its cost and its gradient, and whether its whitening was too slow."""

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
    """Minimise from y = 0, whose cost and gradient (n,) are given; the Hessian there is about identity.

    torch's first step is ``-min(1, 1 / |g|_1) g``. On u = y / a with the objective scaled by 1 / a^2 and a =
    |g_y(0)|_1 the gradient's 1-norm is 1 and that step is y = -g_y: the unit step that the whitening was made
    for, with no internals touched.

    It stops when :func:`predicted_gap` is below ``tolerance``. A new whitening, which costs ``renewal``
    evaluations, is better after ``max_iterations``, or where the steps that are left, at the rate of the
    last, cost more than that and the few steps from nearby.
    """
    scale = float(gradient.abs().sum())
    u = torch.zeros_like(gradient)
    seen = _Evaluations(lambda point: objective(point * scale), torch.zeros_like(gradient), cost, gradient)

    def closure() -> float:
        new_cost, new_gradient = seen.at(u)
        # An infinite cost is but a step too far, whatever its gradient.
        if math.isnan(new_cost) or not (math.isinf(new_cost) or bool(new_gradient.isfinite().all())):
            raise _NoNumberError
        u.grad = new_gradient / scale
        # Relative to the start, small improvements of a large cost keep their digits.
        return (new_cost - cost) / scale**2

    _leave_compiler_out()
    optimizer = torch.optim.LBFGS([u], line_search_fn="strong_wolfe", **_STEPWISE, **_LINE_SEARCH)
    # Without the hooks of profilers around it, which take as long.
    step = inspect.unwrap(torch.optim.LBFGS.step)
    best, best_gradient = cost, gradient
    gap, slow = predicted_gap(best, best_gradient), False
    for iteration in range(max_iterations):
        if gap <= tolerance or slow:
            break
        try:
            step(optimizer, closure)
            reached, reached_gradient = seen.at(u)
        except _NoNumberError:
            reached = math.inf
        if not math.isfinite(reached):
            # A line search over a singular direction has run off; the point before it still stands.
            u.copy_(seen.start)
            break
        seen.begin_step(u, reached, reached_gradient)
        progress = best - reached
        best, best_gradient = reached, reached_gradient
        if progress <= _NO_PROGRESS * best:
            break
        before, gap = gap, predicted_gap(best, best_gradient)
        slow = iteration > 0 and _steps_left(before, gap, tolerance) > renewal + _STEPS_FROM_NEARBY
    return Minimum(u * scale, best, best_gradient, slow)


def _steps_left(before: float, gap: float, tolerance: float) -> float:
    """Steps to the tolerance, if each takes as much of the gap as the last."""
    if gap <= tolerance:
        return 0.0
    return math.log(tolerance / gap) / math.log(gap / before) if gap < before else math.inf


class _NoNumberError(Exception):
    """The objective is no number where a line search looked, whose comparisons then mean nothing."""


class _Evaluations:
    """An objective that knows the points of one step: each asks first where the last one ended."""

    def __init__(self, objective: Evaluate, start: Tensor, cost: float, gradient: Tensor) -> None:
        self._objective = objective
        self.begin_step(start, cost, gradient)

    def begin_step(self, start: Tensor, cost: float, gradient: Tensor) -> None:
        """Forget all points but the one that a step starts from, with its cost and gradient."""
        self._known = [(start.clone(), cost, gradient)]

    @property
    def start(self) -> Tensor:
        """The point that the current step started from."""
        return self._known[0][0]

    def at(self, point: Tensor) -> tuple[float, Tensor]:
        """Cost and gradient at a point, computed if it is none of the known ones."""
        for known, cost, gradient in self._known:
            if torch.equal(known, point):
                return cost, gradient
        with np.errstate(over="ignore", invalid="ignore"):  # a step too far may overflow
            cost, gradient = self._objective(point)
        self._known.append((point.clone(), cost, gradient))
        return cost, gradient


@cache
def _leave_compiler_out() -> None:
    """Keep torch from importing its compiler, which takes 1 to 2.5 s, for the first optimiser's methods."""
    if "torch._dynamo" in sys.modules:
        return
    for name in dir(torch.optim.Optimizer):
        method = getattr(getattr(torch.optim.Optimizer, name), "__wrapped__", None)
        if method is not None:
            with suppress(AttributeError, TypeError):
                method.__dynamo_disable = method


# While a robust loss is still being narrowed, there is no point in more digits than this.
_ANNEALING_TOLERANCE = 1e-3
_ANNEALING_STEP = 3.0
_ITERATIONS_PER_WHITENING = 12
# Evaluations that a whitening takes as long as.
RENEWAL = 2.0
RENEWAL_WITH_STATES = 10.0


@dataclass(frozen=True)
class Descent:
    """Where a descent ended."""

    # of the problem
    engine: Engine
    plan: Plan
    # where it ended, under which loss, and the cost there by name
    estimate: Estimate
    robust: Loss
    terms: dict[str, float]
    gap: float  # the predicted remaining decrease as a fraction of the cost
    evaluations: int  # of cost and gradient
    progressing: bool  # it was still going down when it was stopped
    is_singular: bool  # observations and priors leave a direction of the reduced unknowns free
    made: Whitening | None  # the whitening at the estimate, where the descent had to make it

    @cached_property
    def whitening(self) -> Whitening:
        """The whitening at the estimate, made when it is asked for."""
        if self.made is not None:
            return self.made
        arrays = self.engine.arrays
        with one_thread_in_torch(len(arrays.pair), arrays.centre.device.type == "cpu"):
            return factorise(self.engine, self.plan, self.estimate, self.robust)


class Point(NamedTuple):
    """Whitened variables, what they stand for, and the cost there by name."""

    whitened: Tensor
    estimate: Estimate
    terms: dict[str, float]


class Objective:
    """Cost and gradient by whitened variables around where the whitening was made; counts its evaluations."""

    def __init__(self, whitening: Whitening) -> None:
        self.whitening = whitening
        self.evaluations = 0
        self._last: Point | None = None

    def at_base(self) -> tuple[float, Tensor]:
        """Cost and gradient at 0, which the whitening knows."""
        self.evaluations += 1
        return sum(self.whitening.terms.values()), self.whitening.gradient

    def point(self, whitened: Tensor) -> Point:
        """The point that whitened variables stand for; known where they were evaluated last."""
        if not bool(whitened.any()):
            return Point(whitened, self.whitening.estimate, self.whitening.terms)
        if self._last is None or not torch.equal(self._last.whitened, whitened):
            self(whitened)
        assert self._last is not None
        return self._last

    def __call__(self, whitened: Tensor) -> tuple[float, Tensor]:
        """Cost and gradient at whitened variables."""
        self.evaluations += 1
        whitening = self.whitening
        done = whitening.linearised.evaluate(*whitening.step(whitened))
        self._last = Point(whitened.clone(), done.estimate, done.terms)
        by_whitened = whitened_gradient(
            whitening.plan, whitening.reduced_factor, done.gradient, done.coupled, done.whitened
        )
        return sum(done.terms.values()), by_whitened


def narrowed(engine: Engine, estimate: Estimate, robust: Loss, last: Loss | None = None) -> Loss:
    """The loss with most residuals in its convex part, and a third as wide as the ``last`` at most."""
    if robust.name == "none":
        return robust
    squared = engine.residuals(engine.poses(estimate), estimate.corners_map).square().sum(0)
    scale = 2.0 * float(squared.median().sqrt())
    if last is not None:
        scale = min(scale, last.scale / _ANNEALING_STEP)
    return Loss(robust.name, max(robust.scale, scale))


def descend(
    engine: Engine,
    estimate: Estimate,
    robust: Loss,
    tolerance: float,
    max_refreshes: int,
    max_evaluations: int,
    opening: Whitening | None = None,
) -> Descent:
    """Minimise the cost, narrowing the loss; ``opening`` is what :func:`open_descent` made of the start."""
    whitening = opening or open_descent(engine, estimate, robust)
    del opening
    plan, renewal = whitening.plan, RENEWAL_WITH_STATES if engine.arrays.states else RENEWAL
    evaluations, refreshes, progressing, slow = 0, 0, True, False
    while True:
        final = whitening.robust.scale <= robust.scale
        objective = Objective(whitening)
        cost, gradient = objective.at_base()
        gap = predicted_gap(cost, gradient)
        refreshes += 1
        ended = (
            (final and gap <= tolerance)
            or refreshes > max_refreshes
            or evaluations >= max_evaluations
            or not progressing
        )
        whitened, reached, made = torch.zeros_like(gradient), cost, None
        if ended:
            made = whitening
        else:
            inner = tolerance if final else _ANNEALING_TOLERANCE
            # One that follows a slow one was made near enough: what slows it is the loss, not the distance.
            whitened, reached, gradient, slow = minimise(
                objective, cost, gradient, inner, _ITERATIONS_PER_WHITENING, math.inf if slow else renewal
            )
            gap = predicted_gap(reached, gradient)
            # A whitening under which the gap shrank this fast determines it well enough.
            ended = final and not slow and gap <= tolerance
        point, used = objective.point(whitened), whitening.robust
        evaluations += objective.evaluations
        singular = whitening.is_singular
        if ended:
            at = engine, plan, point.estimate, used, point.terms
            return Descent(*at, gap, evaluations, progressing, singular, made)
        estimate = point.estimate
        progressing = reached < cost or not final
        # The old factor and what led away from it go before the new one comes.
        del whitening, objective, whitened, gradient, point
        whitening = factorise(
            engine, plan, estimate, used if final else narrowed(engine, estimate, robust, used)
        )


def open_descent(engine: Engine, estimate: Estimate, robust: Loss) -> Whitening:
    """The first whitening of a descent, under a loss as wide as the residuals ask for."""
    return factorise(engine, engine.plan(), estimate, narrowed(engine, estimate, robust))
