"""Whether the errors of mapped corners are as large as a map states, for benchmarks with ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from v2hdm.records import FloatArray, Marking
from v2hdm.report.metrics import corner_errors, first_corners

INSIDE_95 = float(chi2.ppf(0.95, 2))
"""Squared error, in sigmas, of a corner on the border of its 95 % ellipse."""


@dataclass(frozen=True)
class Consistency:
    """The errors of the corners that have a covariance against it; nan where none has."""

    corners: int
    nees: float  # normalised estimation error squared, mean by degree of freedom: 1 where sigmas are right
    inside_95: float  # share inside their 95 % ellipses: .95 where sigmas are right


def consistency_of(mapped: Sequence[Marking], true: Sequence[Marking]) -> Consistency:
    """Compare the errors of paired markings with their covariances."""
    squared = squared_in_sigmas(mapped, true)
    if not len(squared):
        return Consistency(0, float("nan"), float("nan"))
    return Consistency(len(squared), float(squared.mean()) / 2, float((squared <= INSIDE_95).mean()))


def squared_in_sigmas(mapped: Sequence[Marking], true: Sequence[Marking]) -> FloatArray:
    """Squared errors (4 M,), in sigmas, of the corners of the paired markings that have a covariance.

    They are chi-square of two degrees of freedom where the covariances are right, and infinite where one is
    singular.
    """
    squared = []
    for marking, counterpart in zip(mapped, true, strict=True):
        covariances_m2 = marking.corner_covariances_m2
        if covariances_m2 is None:
            continue
        (shift,) = first_corners([marking], [counterpart])
        errors_m = corner_errors([marking], [counterpart])
        rolled_m2 = np.roll(covariances_m2, shift, axis=0)
        pairs = zip(errors_m, rolled_m2, strict=True)
        squared.append([_squared(error_m, block_m2) for error_m, block_m2 in pairs])
    return np.array(squared, dtype=np.float64).ravel()


def _squared(error_m: FloatArray, covariance_m2: FloatArray) -> float:
    """The squared Mahalanobis length of an error (2,) under its covariance (2, 2)."""
    if np.linalg.det(covariance_m2) <= 0:
        return float("inf")
    return float(error_m @ np.linalg.solve(covariance_m2, error_m))
