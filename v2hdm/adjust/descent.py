"""From a start to an optimum: whiten, minimise, renew the whitening, until a certificate holds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from v2hdm.adjust.engine import Engine
from v2hdm.adjust.engines.numba.pool import one_thread_in_torch
from v2hdm.adjust.lbfgs import minimise, predicted_gap
from v2hdm.adjust.model import Estimate, Loss
from v2hdm.adjust.reduced import Plan
from v2hdm.adjust.whitening import Whitening, factorise, whitened_gradient

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
