"""From a start to an optimum: whiten, minimise, renew the whitening, until a certificate holds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, Run
from v2hdm.adjust.corner_factor import CornerFactor
from v2hdm.adjust.lbfgs import minimise, predicted_gap
from v2hdm.adjust.linear import Linear
from v2hdm.adjust.reduced import make_plan
from v2hdm.adjust.residuals import (
    Estimate,
    Gradient,
    Loss,
    Tally,
    by_corner_priors,
    observe,
    pair_table,
    squared_residuals,
    with_priors,
)
from v2hdm.adjust.robust import annealed_scale
from v2hdm.adjust.whitening import Whitener, Whitening, factorise
from v2hdm.geometry.tensors import exp, left_jacobian

# While a robust loss is still being narrowed, there is no point in more digits than this.
_ANNEALING_TOLERANCE = 1e-3
_ANNEALING_STEP = 3.0
_ITERATIONS_PER_WHITENING = 12
_MAX_LM_DAMPING = 1e8
_MIN_LM_DAMPING = 1e-5


@dataclass(frozen=True)
class Descent:
    """Where a descent ended.

    ``whitening`` is that at the estimate, and knows it; ``gap`` is the predicted remaining decrease as a
    fraction of the cost. ``progressing``: it was still going down when it was stopped.
    """

    whitening: Whitening
    gap: float
    evaluations: int
    progressing: bool


class Objective:
    """Cost and gradient by whitened variables around where the whitening was made; counts its evaluations."""

    def __init__(self, whitening: Whitening) -> None:
        self.whitening = whitening
        self.evaluations = 0

    def at_base(self) -> tuple[Tensor, Tensor]:
        """Cost and gradient at 0, which the whitening knows."""
        self.evaluations += 1
        return total(self.whitening.terms), self.whitening.gradient

    def moved(self, whitened: Tensor) -> Estimate:
        """The estimate at whitened variables."""
        step, motion = self.whitening.reduced_step(whitened)
        estimate = _moved(self.whitening.estimate, step)
        for run in self.whitening.arrays.runs():
            self._move_corners(run, whitened, motion, estimate)
        return estimate

    def __call__(self, whitened: Tensor) -> tuple[Tensor, Tensor]:
        """Cost and gradient at whitened variables.

        One pass: a run's corners are moved and seen, and their gradient is carried back, while all of it
        is in the processor's cache.
        """
        self.evaluations += 1
        whitening, arrays = self.whitening, self.whitening.arrays
        step, motion = whitening.reduced_step(whitened)
        estimate = _moved(whitening.estimate, step)
        table, tally, back = pair_table(arrays, estimate), Tally(arrays), Whitener(arrays, whitening.table)
        for run in arrays.runs():
            linear, factor = self._move_corners(run, whitened, motion, estimate)
            tally.add(run, observe(run, table, estimate.corners_map), whitening.robust)
            by_corner = tally.by_corner[run.corners] + by_corner_priors(arrays, estimate, run.corners)
            back.add(linear, factor, by_corner)
        terms, gradient = with_priors(arrays, estimate, table, tally)
        by_tangent = (left_jacobian(step.extrinsic).mT @ gradient.extrinsic[..., None])[..., 0]
        gradient = replace(gradient, extrinsic=by_tangent)
        by_whitened = back.whitened(whitening.plan, whitening.spread, whitening.reduced_factor, gradient)
        return total(terms), by_whitened

    def _move_corners(
        self, run: Run, whitened: Tensor, motion: Tensor, estimate: Estimate
    ) -> tuple[Linear, CornerFactor]:
        """Move a run's corners in ``estimate``, x_c = L^-T (y_c - B x_r); returns their coupling and L."""
        linear, factor = self.whitening.linear(run), self.whitening.corner_factor.part(run.corners)
        coupled = factor.solve(linear.corners_from_pairs(motion))
        own = self.whitening.corner_part(whitened)[run.corners]
        estimate.corners_map[run.corners] += factor.solve_transposed(own - coupled)
        return linear, factor


def _moved(base: Estimate, step: Gradient) -> Estimate:
    """``base`` moved by a step x, in tensors of its own."""
    return Estimate(
        exp(step.extrinsic) @ base.cam_from_vehicle,
        base.frame_state + step.frame_state,
        base.corners_map + step.corners_map,
        base.clock_s + step.clock_s,
    )


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
    evaluations, refreshes, damping, progressing, slow = 0, 0, 0.0, True, False
    scale = robust.scale if robust.name == "none" else float("inf")
    plan = make_plan(arrays)
    while True:
        if scale > robust.scale:
            narrowed = annealed_scale(squared_residuals(arrays, estimate), robust.scale)
            scale = max(robust.scale, min(narrowed, scale / _ANNEALING_STEP))
        final = scale <= robust.scale
        whitening = factorise(arrays, plan, estimate, Loss(robust.name, scale), damping)
        objective = Objective(whitening)
        cost, gradient = objective.at_base()
        gap = predicted_gap(cost, gradient)
        refreshes += 1
        done = (
            (final and gap <= tolerance and damping == 0)
            # Each step of Levenberg-Marquardt has a whitening of its own.
            or (refreshes > max_refreshes and solver != "lm")
            or evaluations >= max_evaluations
        )
        if done or not progressing:
            return Descent(whitening, gap, evaluations + 1, progressing)
        if solver == "lm":
            whitened, reached, damping = _newton_step(objective, cost, gradient, damping)
        else:
            inner = tolerance if final else _ANNEALING_TOLERANCE
            # One that follows a slow one was made near enough: what slows it is the loss, not the distance.
            whitened, reached, gradient, slow = minimise(
                objective, cost, gradient, inner, _ITERATIONS_PER_WHITENING, patient=slow
            )
        evaluations += objective.evaluations
        estimate = objective.moved(whitened)
        progressing = float(reached) < float(cost) or not final or 0 < damping < _MAX_LM_DAMPING
        # The old factor and what led away from it go before the new one comes.
        del whitening, objective, whitened, gradient


def _newton_step(
    objective: Objective, cost: Tensor, gradient: Tensor, damping: float
) -> tuple[Tensor, Tensor, float]:
    """One damped Gauss-Newton step of Levenberg-Marquardt; a rejected one raises the damping."""
    reached, _ = objective(-gradient)
    if float(reached) <= float(cost):
        return -gradient, reached, damping / 10 if damping > _MIN_LM_DAMPING else 0.0
    return torch.zeros_like(gradient), cost, min(max(10 * damping, _MIN_LM_DAMPING), _MAX_LM_DAMPING)
