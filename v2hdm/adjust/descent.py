"""From a start to an optimum: whiten, minimise, renew the whitening, until a certificate holds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.lbfgs import minimise, predicted_gap
from v2hdm.adjust.reduced import make_plan
from v2hdm.adjust.residuals import Estimate, Loss, cost_and_gradient, squared_residuals
from v2hdm.adjust.robust import annealed_scale, loss
from v2hdm.adjust.whitening import Whitening, factorise
from v2hdm.geometry.transform import exp, left_jacobian

# While a robust loss is still being narrowed, there is no point in more digits than this.
_ANNEALING_TOLERANCE = 1e-3
_ANNEALING_STEP = 3.0
_ITERATIONS_PER_WHITENING = 12
_MAX_LM_DAMPING = 1e8
_MIN_LM_DAMPING = 1e-5


@dataclass(frozen=True)
class Descent:
    """Where a descent ended.

    ``whitening`` is that at the estimate; ``gap`` is the predicted remaining decrease as a fraction of
    the cost. ``progressing``: it was still going down when it was stopped.
    """

    estimate: Estimate
    whitening: Whitening
    gap: float
    evaluations: int
    progressing: bool


class Objective:
    """Cost and gradient around one estimate, by whitened variables; counts its evaluations."""

    def __init__(self, whitening: Whitening, base: Estimate, robust: Loss) -> None:
        self.whitening = whitening
        self.base = base
        self.robust = robust
        self.evaluations = 0

    def moved(self, whitened: Tensor) -> tuple[Estimate, Tensor]:
        """The estimate at whitened variables, and the extrinsics' tangents that led there."""
        step = self.whitening.step(whitened)
        estimate = Estimate(
            exp(step.extrinsic) @ self.base.cam_from_vehicle,
            self.base.frame_state + step.frame_state,
            self.base.corners_map + step.corners_map,
            self.base.clock_s + step.clock_s,
        )
        return estimate, step.extrinsic

    def __call__(self, whitened: Tensor) -> tuple[Tensor, Tensor]:
        """Cost and gradient at whitened variables."""
        self.evaluations += 1
        estimate, tangent = self.moved(whitened)
        terms, gradient = cost_and_gradient(self.whitening.arrays, estimate, self.robust)
        by_tangent = (left_jacobian(tangent).mT @ gradient.extrinsic[..., None])[..., 0]
        return total(terms), self.whitening.whiten(replace(gradient, extrinsic=by_tangent))


def total(terms: dict[str, Tensor]) -> Tensor:
    """The cost: the sum of its terms."""
    return torch.stack(list(terms.values())).sum()


def descend(
    arrays: Arrays,
    estimate: Estimate,
    robust: Loss,
    solver: str,
    tolerance: float,
    max_refreshes: int,
    max_evaluations: int,
) -> Descent:
    """Minimise the cost from ``estimate``, narrowing the robust loss on the way."""
    evaluations, refreshes, damping, scale, progressing = 0, 0, 0.0, float("inf"), True
    plan = make_plan(arrays)
    while True:
        squared = squared_residuals(arrays, estimate)
        narrowed = annealed_scale(squared, robust.scale) if robust.name != "none" else robust.scale
        scale = max(robust.scale, min(narrowed, scale / _ANNEALING_STEP))
        current = Loss(robust.name, scale)
        final = scale <= robust.scale
        whitening = factorise(arrays, plan, estimate, loss(current.name, squared, scale)[1], damping)
        objective = Objective(whitening, estimate, current)
        cost, gradient = objective(squared.new_zeros(whitening.size))
        gap = predicted_gap(cost, gradient)
        refreshes += 1
        done = (
            (final and gap <= tolerance and damping == 0)
            or refreshes > max_refreshes
            or evaluations >= max_evaluations
        )
        if done or not progressing:
            return Descent(estimate, whitening, gap, evaluations + 1, progressing)
        if solver == "lm":
            whitened, reached, damping = _newton_step(objective, cost, gradient, damping)
        else:
            inner = tolerance if final else _ANNEALING_TOLERANCE
            whitened, reached, gradient = minimise(
                objective, cost, gradient, inner, _ITERATIONS_PER_WHITENING
            )
        evaluations += objective.evaluations
        estimate, _ = objective.moved(whitened)
        progressing = float(reached) < float(cost) or not final or 0 < damping < _MAX_LM_DAMPING


def _newton_step(
    objective: Objective, cost: Tensor, gradient: Tensor, damping: float
) -> tuple[Tensor, Tensor, float]:
    """One damped Gauss-Newton step of Levenberg-Marquardt; a rejected one raises the damping."""
    reached, _ = objective(-gradient)
    if float(reached) <= float(cost):
        return -gradient, reached, damping / 10 if damping > _MIN_LM_DAMPING else 0.0
    return torch.zeros_like(gradient), cost, min(max(10 * damping, _MIN_LM_DAMPING), _MAX_LM_DAMPING)
