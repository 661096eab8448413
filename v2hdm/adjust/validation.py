"""Validation of observations by their residuals, and of the stated variances by all of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from v2hdm.adjust.problem import Observations
from v2hdm.records import BoolArray, FloatArray

VerdictArray = NDArray[np.int8]

# The median of a chi-square distribution with two degrees of freedom is 2 ln 2.
_MEDIAN_SQUARED = 2 * float(np.log(2))
_ROWS = 1 << 18  # observations that are judged at once


class Verdict(IntEnum):
    """The verdict on an observation; unconfirmed: all others of its corner contradict it and one another."""

    ACCEPTED = 0
    CONTRADICTS = 1
    UNCONFIRMED = 2
    BEHIND_CAMERA = 3


def noise_scale(mahalanobis2: FloatArray) -> float:
    """How many times as large as stated the noise's variance is, by the median; at least 1."""
    median = float(np.median(mahalanobis2.astype(np.float32), overwrite_input=True))
    return max(1.0, median / _MEDIAN_SQUARED)


def as_of_point(squared_of_line: FloatArray) -> FloatArray:
    """Squared residuals of lines, chi-square of one degree of freedom, as equally likely ones of points."""
    return np.asarray(-2 * chi2.logsf(squared_of_line, 1))


def line_variance_factor(squared: FloatArray, taken: float) -> float:
    """How many times as large as stated the variance of lines is, by the median of ``squared`` (K,).

    ``taken`` is the share of their degrees of freedom that unknowns take.
    """
    if not len(squared):
        return 1.0
    of_line = float(chi2.isf(np.exp(-np.median(squared) / 2), 1))
    return of_line / float(chi2.median(1)) / max(1 - taken, 0.1)


def classify(
    observations: Observations, mahalanobis2: FloatArray, behind: BoolArray, probability: float, scale: float
) -> VerdictArray:
    """A :class:`Verdict` (K,) for every observation, by its squared residual in sigmas ``mahalanobis2`` (K,).

    The gate is the squared distance that a sound observation exceeds with ``probability`` (chi-square, two
    degrees of freedom: -2 ln p), widened by the noise's ``scale`` so that covariances that are too small do
    not empty the map. An observation is unconfirmed when the gate leaves it alone with a corner that had
    others.
    """
    gate = -2 * np.log(probability) * scale
    verdict = np.full(len(mahalanobis2), Verdict.ACCEPTED, dtype=np.int8)
    verdict[mahalanobis2 > gate] = Verdict.CONTRADICTS
    verdict[behind] = Verdict.BEHIND_CAMERA
    count = int(observations.corner.max()) + 1
    seen = np.bincount(observations.corner, minlength=count)
    left = np.bincount(observations.corner[verdict == Verdict.ACCEPTED], minlength=count)
    alone = (left == 1) & (seen > 1)
    for begin in range(0, len(verdict) if alone.any() else 0, _ROWS):
        part = slice(begin, begin + _ROWS)
        verdict[part][alone[observations.corner[part]] & (verdict[part] == Verdict.ACCEPTED)] = (
            Verdict.UNCONFIRMED
        )
    return verdict


# Squared residual that one good observation in a thousand exceeds: chi-square, 2 degrees of freedom.
_OUTLIER_SQUARED = 13.8
# Mean of half such a variable below that limit: leaving the tail out takes a little off the chi-square.
_TRIMMED_MEAN = 1 - _OUTLIER_SQUARED / 2 / math.expm1(_OUTLIER_SQUARED / 2)


@dataclass(frozen=True)
class VarianceFactors:
    """Variances as multiples of the stated ones: of everything, and of the observations alone."""

    all: float
    observations: float


def variance_factors(
    squared: FloatArray, of_priors: float, free: int, scale: float | None = None
) -> VarianceFactors:
    """Chi-square per degree of freedom, of good observations and priors together and of the former.

    What the priors have left of their own degrees of freedom is what the observations have taken of them: the
    expected chi-square of a prior is the one less the other (Foerstner and Wrobel, Photogrammetric Computer
    Vision, section 4.2.4, on variance components). ``free`` are the unknowns less those that priors other
    than the poses' hold.
    """
    good = squared <= _OUTLIER_SQUARED * (noise_scale(squared) if scale is None else scale)
    of_observations = float(squared.sum(where=good)) / _TRIMMED_MEAN
    redundancy = 2 * int(good.sum()) - free
    return VarianceFactors(
        all=(of_observations + of_priors) / max(redundancy, 1),
        observations=of_observations / max(redundancy - of_priors, 1),
    )
