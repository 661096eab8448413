"""The accuracy of markings and symbols: radii, and a grade by that of the worst corner and the user's goal.

Two figures are stated everywhere. The **95 % radius** of a corner holds the true corner with a probability of
95 %, that of a marking beside its neighbours its true centre. A radius **of all** holds 95 % of them.

A grade says how well a corner's place in the map frame is known, with all that the map's markings share; it
says nothing of whether the marking is there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2hdm.records import ACCURACIES, SIGMAS_95, FloatArray, Marking

_SHARE = 0.95  # share of all corners, and probability for each, of every stated radius

_B_OF_GOAL = 2.0  # largest radius of grade B over the goal; chosen

_LEFT_OUT = "accuracy {}, and mapping.acceptance.accuracy asks for {}"

LEFT_OUT_BY_GRADE = frozenset(
    _LEFT_OUT.format(worse, ACCURACIES[number])
    for number in range(len(ACCURACIES))
    for worse in ACCURACIES[number + 1 :]
)
"""All reasons of :func:`objection_to`."""


def accuracy_of(covariance_m2: FloatArray | None, goal_m: float) -> str | None:
    """The grade of a marking or symbol, of :data:`ACCURACIES`, None without a covariance.

    ``covariance_m2`` (2N, 2N) is of its stacked corners, ``goal_m`` the 95 % radius that is asked of a map.
    """
    if covariance_m2 is None:
        return None
    best, middle, worst = ACCURACIES
    radius_m = float(corner_radii_m(covariance_m2).max())
    if radius_m <= goal_m:
        return best
    return middle if radius_m <= _B_OF_GOAL * goal_m else worst


def well_known(markings: Sequence[Marking]) -> Sequence[Marking]:
    """The markings but those of accuracy C as long as these are fewer, else all of them."""
    better_known = [marking for marking in markings if marking.accuracy != ACCURACIES[-1]]
    return better_known if 2 * len(better_known) > len(markings) else markings


def objection_to(accuracy: str | None, least_accuracy: str) -> str | None:
    """Reason against a marking of that accuracy where ``asked`` is the worst allowed; None if unknown."""
    if accuracy is None or ACCURACIES.index(accuracy) <= ACCURACIES.index(least_accuracy):
        return None
    return _LEFT_OUT.format(accuracy, least_accuracy)


def corner_radii_m(covariance_m2: FloatArray) -> FloatArray:
    """The 95 % radii (N,), m, of corners with the covariance (2N, 2N) of their stacked coordinates."""
    corner = np.arange(len(covariance_m2) // 2)
    blocks = covariance_m2.reshape(len(corner), 2, len(corner), 2)[corner, :, corner, :]
    return radius_95_m(blocks)


def radius_95_m(covariance_m2: FloatArray) -> FloatArray:
    """The radii (...), m, that hold 95 % of errors of covariances (..., 2, 2), by Leenhouts (1985)."""
    sigma_m = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance_m2), 1e-18))
    minor = sigma_m[..., 0]
    major = sigma_m[..., 1]
    return np.asarray(major * np.polyval((0.371625, 0.114276, 0.004071, 1.960790), minor / major))


def absolute_radii_m(markings: Sequence[Marking]) -> FloatArray:
    """The 95 % radii (M, 4), m, of the markings' corners; infinite where no covariance is stated."""
    radii_m = np.full((len(markings), 4), np.inf)
    blocks = [marking.corner_covariances_m2 for marking in markings]
    rows = [row for row, block in enumerate(blocks) if block is not None]
    if rows:
        radii_m[rows] = radius_95_m(np.stack([block for block in blocks if block is not None]))
    return radii_m


def relative_radii_m(markings: Sequence[Marking]) -> FloatArray:
    """The 95 % radii, m, of the centres of those markings whose place beside their neighbours is stated."""
    return SIGMAS_95 * np.array([m.relative_sigma_m for m in markings if m.relative_sigma_m is not None])


def radius_of_all_m(radius_m: FloatArray) -> float:
    """The radius that holds 95 % of all points, given the radius (N,) that holds each with 95 %.

    Errors are circular normal: with 1 - 0.05^((r / own)^2) a point lies within r. Infinite for no points.
    """
    from scipy.optimize import brentq  # slow to load, and `view` shows each radius by itself

    if not len(radius_m) or np.mean(np.isfinite(radius_m)) < _SHARE:
        return float("inf")

    def missing(radius: float) -> float:
        return float(np.mean((1 - _SHARE) ** ((radius / radius_m) ** 2))) - (1 - _SHARE)

    return float(brentq(missing, 0.0, 5.0 * float(radius_m[np.isfinite(radius_m)].max())))
