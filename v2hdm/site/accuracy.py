"""The accuracy of markings and symbols: a grade by the 95 % radius of the worst corner and the user's goal.

A grade says how well a corner's place in the map frame is known, with all that the map's markings share; it
says nothing of whether the marking is there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2hdm.records import ACCURACIES, FloatArray, Marking

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
    known = [marking for marking in markings if marking.accuracy != ACCURACIES[-1]]
    return known if 2 * len(known) > len(markings) else markings


def objection_to(accuracy: str | None, asked: str) -> str | None:
    """Reason against a marking of that accuracy where ``asked`` is the worst allowed; None if unknown."""
    if accuracy is None or ACCURACIES.index(accuracy) <= ACCURACIES.index(asked):
        return None
    return _LEFT_OUT.format(accuracy, asked)


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
