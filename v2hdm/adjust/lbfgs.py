"""torch's LBFGS over whitened variables, set up so that its first step is the Gauss-Newton step."""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

Objective = Callable[[Tensor], tuple[float, Tensor]]
"""Cost and gradient at whitened variables y."""

_HISTORY = 20
_LINE_SEARCH_EVALUATIONS = 25
# Steps that a whitening near the optimum takes to the end.
_STEPS_FROM_NEARBY = 2
# A relative decrease below this is rounding.
_NO_PROGRESS = 1e-15


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
    objective: Objective,
    cost: float,
    gradient: Tensor,
    tolerance: float,
    max_iterations: int,
    renewal: float = math.inf,
) -> Minimum:
    """Minimise from y = 0, whose cost and gradient are given.

    torch's first step is ``-min(1, 1 / |g|_1) g``. On u = y / a with the objective scaled by 1 / a^2 and
    a = |g_y(0)|_1 the gradient's 1-norm is 1 and that step is y = -g_y: the unit step that the
    whitening was made for, with no internals touched.

    Args:
        objective: cost and gradient; the Hessian at 0 is about the identity.
        cost: at 0.
        gradient: at 0, (n,).
        tolerance: stop when :func:`predicted_gap` is below this.
        max_iterations: after these the whitening is better renewed.
        renewal: evaluations that a new whitening costs. Where the steps that are left, at the rate of the
            last, cost more than that and the few steps from nearby, this one was made too far away.
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
    # One iteration a step: stopping is this loop's affair.
    optimizer = torch.optim.LBFGS(
        [u],
        max_iter=1,
        max_eval=_LINE_SEARCH_EVALUATIONS,
        tolerance_grad=0.0,
        tolerance_change=0.0,
        history_size=_HISTORY,
        line_search_fn="strong_wolfe",
    )
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

    def __init__(self, objective: Objective, start: Tensor, cost: float, gradient: Tensor) -> None:
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
