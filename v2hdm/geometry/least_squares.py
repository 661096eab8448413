"""Gauss-Newton with Levenberg-Marquardt damping for problems of a few dozen to a few hundred unknowns.

A problem is a function that returns its :class:`Normal` equations at an estimate of any type. Steps live in
the tangent space of the estimate and ``retract`` applies them. Robust problems weight their equations and so
are iteratively reweighted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import add
from typing import Generic, TypeVar

import cv2
import numpy as np

from v2hdm.records import FloatArray

X = TypeVar("X")
N = TypeVar("N", bound="Normal")

_RANK = 1e-12  # relative eigenvalue of the scaled information matrix below which it is rounding
_GIVE_UP = 1e8  # damping from which a cost that still rises is at its minimum up to rounding


@dataclass(frozen=True)
class Normal:
    """Normal equations at an estimate: residual r, Jacobian J, inverse covariance W."""

    information: FloatArray  # (U, U) J'WJ
    gradient: FloatArray  # (U,) J'Wr
    cost: float  # r'Wr / 2, or that of a robust loss


def normal_equations(residual: FloatArray, jacobian: FloatArray, weight: FloatArray | None = None) -> Normal:
    """Normal equations of residuals (N, D), Jacobians (N, D, U) and weights (N, D, D), default 1."""
    weighted = jacobian if weight is None else weight @ jacobian
    moved = residual if weight is None else (weight @ residual[..., None])[..., 0]
    return Normal(
        np.einsum("nij,nik->jk", jacobian, weighted),
        np.einsum("nij,ni->j", weighted, residual),
        0.5 * float(np.sum(residual * moved)),
    )


@dataclass(frozen=True)
class Fit(Generic[X, N]):
    """The end of an iteration."""

    x: X
    last: N
    step: FloatArray  # (U,) the last, after ``limit``, from the equations ``last``
    converged: bool  # the step was short enough; False: out of steps, or not finite
    steps: int

    @property
    def predicted_cost(self) -> float:
        """The cost at :attr:`x` that the linearisation predicts; infinite where the problem is not finite."""
        last = self.last
        step = self.step
        cost = last.cost + float(last.gradient @ step) + 0.5 * float(step @ last.information @ step)
        return cost if np.isfinite(cost) else np.inf

    @property
    def covariance(self) -> FloatArray:
        """Covariance (U, U) of the tangent; infinite variances where the problem is rank deficient."""
        return covariance_of(self.last.information)


def gauss_newton(
    linearise: Callable[[X], N],
    x0: X,
    *,
    retract: Callable[[X, FloatArray], X] | None = None,
    steps: int = 20,
    tolerance: float = 1e-8,
    damping: float = 0.0,
    limit: Callable[[FloatArray], FloatArray] | None = None,
    settled: Callable[[FloatArray], bool] | None = None,
) -> Fit[X, N]:
    """Minimise a sum of squares from ``x0`` in at most ``steps`` steps.

    ``retract`` applies a step (U,) to an estimate, by default their sum; ``limit`` shortens steps to the
    range of the linearisation. It ends on a step below ``tolerance`` conditional standard deviations of every
    unknown, or once ``settled``. ``damping`` is a fraction of the information's diagonal: a step that raises
    the cost is rejected and the damping raised tenfold, at least to where it began; at 0 every step is
    accepted whole.
    """
    move: Callable[[X, FloatArray], X] = retract or add
    x = x0
    last = linearise(x0)
    damped = damping
    step = np.zeros(len(last.gradient))
    step_count = 0
    while step_count < steps:
        if not (np.isfinite(last.gradient).all() and np.isfinite(last.information).all()):
            return Fit(x, last, np.full(len(last.gradient), np.nan), False, step_count)
        step = solve_normal(last, damped)
        step = step if limit is None else limit(step)
        moved = move(x, step)
        step_count = step_count + 1
        in_sigmas = np.abs(step) * np.sqrt(np.diag(last.information))
        if settled(step) if settled else np.max(in_sigmas, initial=0.0) < tolerance:
            return Fit(moved, last, step, True, step_count)
        if damping == 0 and step_count == steps:
            return Fit(moved, last, step, False, step_count)
        after = linearise(moved)
        if damping > 0 and not after.cost <= last.cost:
            if damped > _GIVE_UP:
                return Fit(x, last, np.zeros(len(step)), True, step_count)
            # Far below where it began, ten times the damping leads to the same step again.
            damped = max(10.0 * damped, damping)
        else:
            x = moved
            last = after
            damped = damped / 10.0
    return Fit(x, last, step, False, step_count)


def solve_normal(equations: Normal, damping: float = 0.0) -> FloatArray:
    """The step (U,) to the minimum; in a rank-deficient problem the shortest, in scaled unknowns."""
    scale, scaled = _scaled(equations.information)
    scaled = scaled + damping * np.eye(len(scale))
    pull = -equations.gradient / scale
    if not len(pull):
        return pull
    # Of 554 unknowns a fifth of the time of numpy's, which cannot reuse its Cholesky factor.
    is_definite, solved = cv2.solve(scaled, pull[:, None], flags=cv2.DECOMP_CHOLESKY)
    if is_definite:
        return np.asarray(solved[:, 0] / scale)
    return np.asarray(np.linalg.pinv(scaled, rcond=_RANK, hermitian=True) @ pull / scale)


def covariance_of(information: FloatArray) -> FloatArray:
    """Inverse (U, U) of an information matrix; all variances infinite if it is singular."""
    scale, scaled = _scaled(information)
    values, axes = np.linalg.eigh(scaled)
    if not (np.diag(information) > 0).all() or values[0] < _RANK * values[-1]:
        return np.diag(np.full(len(scale), np.inf))
    return np.asarray((axes / values) @ axes.T / np.outer(scale, scale))


def first_of_inverse(information: FloatArray, count: int) -> FloatArray:
    """The first rows and columns (count, count) of the inverse of an information matrix (U, U)."""
    scale, scaled = _scaled(information)
    is_definite, solved = cv2.solve(scaled, np.eye(len(scale), count), flags=cv2.DECOMP_CHOLESKY)
    if not is_definite:
        solved = np.linalg.inv(scaled)
    return np.asarray(solved[:count, :count] / np.outer(scale[:count], scale[:count]))


def _scaled(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Scales (U,), and the information matrix scaled to a diagonal of 1, or 0."""
    diagonal = np.diag(information)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    return scale, information / np.outer(scale, scale)
