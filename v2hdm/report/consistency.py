"""Whether the errors of mapped corners are as large as a map states, for benchmarks with ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from v2hdm.records import FloatArray, Marking
from v2hdm.report.metrics import corner_errors, first_corners
from v2hdm.site.relative import neighbours

INSIDE_95 = float(chdtri(2, 0.05))
"""Squared error, in sigmas, of a corner on the border of its 95 % ellipse."""


@dataclass(frozen=True)
class Consistency:
    """The errors of the corners that have a covariance against it; nan where none has.

    A NEES is a normalised estimation error squared, the mean by degree of freedom: 1 where sigmas are right,
    less where they are too large. Drift and mounting move neighbours alike, so that ``place`` is the draw of
    a few unknowns however many markings there are; ``beside`` and ``shape`` are those of many.
    """

    corners: int
    nees: float  # of the corners, each for itself
    inside_95: float  # share of the corners inside their 95 % ellipses: .95 where sigmas are right
    place: float  # NEES of the markings' centres
    beside: float  # that of a centre less the mean of its neighbours, by relative_sigma_m; 1 or more is right
    shape: float  # NEES of the corners about their marking's centre


def consistency_of(mapped: Sequence[Marking], true: Sequence[Marking]) -> Consistency:
    """Compare the errors of paired markings with their covariances."""
    squared = squared_in_sigmas(mapped, true)
    parts = _parts(mapped, true)
    if not len(squared):
        return Consistency(0, float("nan"), float("nan"), *parts)
    return Consistency(len(squared), float(squared.mean()) / 2, float((squared <= INSIDE_95).mean()), *parts)


class _Parts(NamedTuple):
    """NEES of centres, of centres beside their neighbours', and of shapes."""

    place: float
    beside: float
    shape: float


def _parts(mapped: Sequence[Marking], true: Sequence[Marking]) -> _Parts:
    places = []
    shapes = []
    beside = []
    errors_m = corner_errors(mapped, true).reshape(-1, 4, 2)
    centres_m = errors_m.mean(axis=1)
    shifts = first_corners(mapped, true)
    others = neighbours(np.array([marking.corners_map.mean(axis=0) for marking in mapped]).reshape(-1, 2))
    stated_m = [
        np.nan if marking.relative_sigma_m is None else marking.relative_sigma_m for marking in mapped
    ]
    relative_m2 = np.square(stated_m)
    for k, marking in enumerate(mapped):
        if marking.covariance_m2 is None:
            continue
        covariance_m2 = np.roll(marking.covariance_m2.reshape(4, 2, 4, 2), shifts[k], axis=(0, 2))
        places.append(_squared(centres_m[k], covariance_m2.mean(axis=(0, 2))) / 2)
        about_m2 = _ABOUT_CENTRE @ covariance_m2.reshape(8, 8) @ _ABOUT_CENTRE.T
        shapes.append(_squared(_ABOUT_CENTRE @ errors_m[k].ravel(), about_m2) / len(_ABOUT_CENTRE))
        nearest = others[k][:_NEIGHBOURS]
        nearest = nearest[np.isfinite(relative_m2[nearest])]
        if np.isfinite(relative_m2[k]) and len(nearest):
            off_m = centres_m[k] - centres_m[nearest].mean(axis=0)
            # The neighbours' own errors add to the difference.
            expected_m2 = relative_m2[k] + relative_m2[nearest].mean() / len(nearest)
            beside.append(float(off_m @ off_m / (2 * expected_m2)))
    means = [float(np.mean(values)) if values else float("nan") for values in (places, beside, shapes)]
    return _Parts(*means)


_NEIGHBOURS = 4  # largest number of neighbours that a marking is compared with, as in its stated sigma

# Three of the four corners (6, 8) less their centre: what is left of a marking without its place.
_ABOUT_CENTRE = np.kron(np.eye(4)[:3] - 0.25, np.eye(2))


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
    """The squared Mahalanobis length of an error (n,) under its covariance (n, n)."""
    if np.linalg.slogdet(covariance_m2).sign <= 0:
        return float("inf")
    return float(error_m @ np.linalg.solve(covariance_m2, error_m))
