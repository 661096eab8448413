"""From a start to an optimum: whiten, minimise and whiten again, until the predicted decrease vanishes."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
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

# Pairs of steps and gradients that LBFGS remembers, and most evaluations under one whitening: chosen. When to
# stop is decided by the closure.
_LBFGS: dict[str, Any] = {
    "line_search_fn": "strong_wolfe",
    "history_size": 20,
    "max_eval": 100,
    "tolerance_grad": 0.0,
    "tolerance_change": 0.0,
}
_STEPS_FROM_NEARBY = 2  # steps to convergence under a whitening made near the optimum
_NO_PROGRESS = 1e-15  # relative decrease below which it is rounding


def predicted_gap(cost: float, gradient: Tensor) -> float:
    """|g|^2, twice the predicted decrease of a unit Newton step, relative to a cost above 1."""
    return float(gradient @ gradient) / max(cost, 1.0)


class Minimum(NamedTuple):
    """The end of a minimisation, and whether its whitening converged too slowly."""

    whitened: Tensor  # y
    cost: float
    gradient: Tensor
    gap: float
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
    start = _Evaluation(torch.zeros_like(gradient), cost, gradient, predicted_gap(cost, gradient))
    scale = float(gradient.abs().sum())
    # No step leads from a gradient of zero, and none is needed where the gap is small.
    if not start.gap > tolerance or scale == 0.0:
        return Minimum(start.whitened, cost, gradient, start.gap, slow=False)
    leave_compiler_out()
    u = torch.zeros_like(gradient)
    optimizer = torch.optim.LBFGS([u], max_iter=max_iterations, **_LBFGS)
    search = _Search(objective, optimizer, u, scale, start, tolerance, renewal)
    with suppress(_EnoughError):
        bare_step()(optimizer, search)
        search.accept()
    end = search.accepted
    return Minimum(end.whitened, end.cost, end.gradient, end.gap, search.slow)


def _steps_left(before: float, gap: float, tolerance: float) -> float:
    """Steps to the tolerance if each reduces the gap by the last one's factor."""
    if gap <= tolerance:
        return 0.0
    return math.log(tolerance / gap) / math.log(gap / before) if gap < before else math.inf


class _EnoughError(Exception):
    """Raised by a closure to end the optimiser's step."""


class _Evaluation(NamedTuple):
    """An objective at whitened variables, and the gap there."""

    whitened: Tensor
    cost: float
    gradient: Tensor
    gap: float


class _Search:
    """The closure of LBFGS in u = y / ``scale``: evaluates, and ends the step where a point is good enough.

    ``accepted`` is the start of LBFGS' present iteration, and in the end the result.
    """

    def __init__(
        self,
        objective: Evaluate,
        optimizer: torch.optim.LBFGS,
        u: Tensor,
        scale: float,
        start: _Evaluation,
        tolerance: float,
        renewal: float,
    ) -> None:
        self._objective = objective
        self._u = u
        self._scale = scale
        self._start_cost = start.cost
        self._tolerance = tolerance
        self._renewal = renewal
        self._state = optimizer.state[u]
        self._iteration = 0
        self._lowest = start
        self.accepted = start
        self.slow = False

    def __call__(self) -> float:
        """Cost at u less that at the start, where LBFGS asks first; sets the gradient."""
        if self._state["n_iter"] == 0:
            return self._told(self.accepted.cost, self.accepted.gradient)
        if self._state["n_iter"] > self._iteration:
            self._begin_iteration()
        whitened = self._u * self._scale
        with np.errstate(over="ignore", invalid="ignore"):  # an overshooting step may overflow
            cost, gradient = self._objective(whitened)
        gap = predicted_gap(cost, gradient)
        # An infinite cost means an overshooting step. After NaN a line search, which compares, means nothing.
        if math.isnan(cost) or not (math.isinf(cost) or math.isfinite(gap)):
            raise _EnoughError
        if cost <= self._lowest.cost:
            self._lowest = _Evaluation(whitened, cost, gradient, gap)
            self._end_where_good_enough()
        return self._told(cost, gradient)

    def accept(self) -> None:
        """Take the lowest point so far for the start of an iteration."""
        self.accepted = self._lowest

    def _begin_iteration(self) -> None:
        before = self.accepted
        self.accept()
        if self._iteration > 0 and before.cost - self.accepted.cost <= _NO_PROGRESS * self.accepted.cost:
            raise _EnoughError
        self._iteration = self._state["n_iter"]

    def _end_where_good_enough(self) -> None:
        """End at the lowest point if it is at the minimum, or if the way there is longer than a new one."""
        gap = self._lowest.gap
        left = _steps_left(self.accepted.gap, gap, self._tolerance)
        self.slow = self._iteration > 1 and left > self._renewal + _STEPS_FROM_NEARBY
        if gap <= self._tolerance or self.slow:
            self.accept()
            raise _EnoughError

    def _told(self, cost: float, gradient: Tensor) -> float:
        """Cost and gradient as LBFGS reads them."""
        self._u.grad = gradient / self._scale
        # Differences to the start keep the digits of small improvements of a large cost.
        return (cost - self._start_cost) / self._scale**2


_ANNEALING_TOLERANCE = 1e-3  # while a robust loss is being narrowed, more digits are wasted
_ANNEALING_STEP = 3.0  # least factor that narrows a robust loss from whitening to whitening
_ITERATIONS_PER_WHITENING = 30  # most steps of LBFGS under one whitening
RENEWAL = 2.0  # cost of a whitening, in evaluations, if frames have no states
RENEWAL_WITH_STATES = 25.0  # cost of a whitening, in evaluations, if frames have states


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
        minimum = minimise(
            objective, cost, gradient, inner, _ITERATIONS_PER_WHITENING, math.inf if slow else renewal
        )
        slow = minimum.slow
        gap = minimum.gap
        point = objective.point(minimum.whitened)
        evaluations += objective.evaluations
        # A whitening under which the gap shrank this fast determines it well.
        if final and not slow and gap <= tolerance:
            return _descent_to(point, whitening, gap, evaluations, progressing, is_base=False)
        progressing = minimum.cost < cost or not final
        estimate = point.estimate
        last = whitening.robust
        # Frees the memory of the old factor, and of what refers to it, before the new one is made.
        del whitening, objective, minimum, gradient, point
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
