"""Where the contrast of paint to the ground around it is sampled, in images and in a mosaic alike.

Bare ground has nearly no contrast between the inside of an outline and the ground beside it, paint has. A
map's own markings give the contrast of paint, places beside them that of bare ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import Quad, turned_left
from v2hdm.records import SIGMA_OF_MAD, FloatArray

_INSIDE = np.linspace(0.2, 0.8, 7)
"""Fractions along either side at which the inside is sampled: off the edges, which pose errors blur."""

_ASIDE_M = 1.3  # distance of bare ground from a marking, m
_LEAST_SIGMA = 0.02  # floor of the sigma of bare ground's contrast: the grain of an image
_LEAST_SIDE_M = 1e-9  # least length of a side, m, for its direction to be computed


class Samples(NamedTuple):
    """Points on the ground within an outline (I, 2) and beside its four sides (B, 2), m."""

    inside: FloatArray
    beside: FloatArray


class Contrast(NamedTuple):
    """The usual contrast of some places, a log ratio of grey values: median, and sigma by the median."""

    middle: float
    sigma: float


def samples_of(corners: FloatArray, beside_m: Sequence[float]) -> Samples:
    """The points of an outline (4, 2), counter-clockwise; beside it at the distances ``beside_m``."""
    along, across = np.meshgrid(_INSIDE, _INSIDE)
    sides = np.roll(corners, -1, axis=0) - corners
    length_m = np.maximum(np.linalg.norm(sides, axis=1), _LEAST_SIDE_M)
    outwards = -turned_left(sides) / length_m[:, None]
    on_sides = corners[:, None] + _INSIDE[:, None] * sides[:, None]
    beside = [(on_sides + away_m * outwards[:, None]).reshape(-1, 2) for away_m in beside_m]
    return Samples(Quad(corners).at(along.ravel(), across.ravel()), np.concatenate(beside))


def places_aside(corners: FloatArray) -> FloatArray:
    """Places (2 N, 4, 2) beside markings (N, 4, 2), across the longest side or diagonal of each."""
    sides = corners[:, [1, 2, 2, 3]] - corners[:, [0, 1, 0, 1]]
    extent_m = np.linalg.norm(sides, axis=2)
    rows = np.arange(len(sides))
    longest = np.argmax(extent_m, axis=1)
    along = sides[rows, longest] / extent_m[rows, longest, None]
    across = _ASIDE_M * turned_left(along)[:, None]
    return np.concatenate([corners - across, corners + across])


def usual_contrast(values: FloatArray) -> Contrast:
    """The usual contrast of a sample (M,) without nan."""
    middle = float(np.median(values))
    sigma = SIGMA_OF_MAD * float(np.median(np.abs(values - middle)))
    return Contrast(middle, max(sigma, _LEAST_SIGMA))
