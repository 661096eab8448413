"""Regularity of dashes along a line: their spacing gives each one's length, and its neighbours its centre.

In a bend, paint and gaps are longer on the outer side alike, and a dash lies midway between two others. The
frequency and precision of both regularities are learned from the drive.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtri

from v2hdm.densities import normal_density
from v2hdm.geometry.planar import cross
from v2hdm.records import BoolArray, FloatArray
from v2hdm.site.candidates import Candidates
from v2hdm.site.shapes import MEMBER_M, Laid

_TURN_RAD = 1.0  # largest rotation, rad, of a line from dash to dash: a bend of 6 m radius at 6 m spacing
_BESIDE_M = 0.5  # largest distance, m, of dashes from an arc between them: less than that of parallel lines

_UNEVEN = 1 / 6
"""Largest difference of a dash's two spacings, relative to their sum: none, or a third with one missing."""

_STRETCH = 1.5  # largest stretch or compression of a line in a bend: 4 m beside a centre line of 12 m radius
_ASIDE_M = 2.0  # sigma of a line's offset from the bend's centre line, along which dashes were laid out
_NEAR = 32  # nearest dashes searched for those of the line
_LEAST = 3  # dashes of the class's length with successors: enough for a median
_PASSES = 2  # rounds of expectation maximisation


@dataclass(frozen=True)
class Series:
    """Length and position of N dashes from their neighbours in the line."""

    longer_m: FloatArray  # (N,) excess over the class's length, 0 without a neighbour
    longer_sigma_m: FloatArray  # (N,)
    longer_often: float  # fraction of dashes whose length follows the spacing
    apart_m: FloatArray  # (N,) spacing to the next one
    middle: FloatArray  # (N, 8) maps corners to their mean's position along the dash
    middle_m: FloatArray  # (N,) its expected value, nan without two neighbours
    middle_sigma_m: FloatArray  # (N,)
    middle_often: float  # fraction of dashes that are centred so

    def evidence(self, corners: Candidates) -> FloatArray:
        """Log-likelihood ratio (N,) of a marking's ``corners`` against any position along its line."""
        off_m = _times(self.middle, corners) - self.middle_m
        sigma_m = np.sqrt(self.middle_sigma_m**2 + corners.along(self.middle, self.middle))
        apart_m = np.where(np.isnan(off_m), 1.0, self.apart_m)
        ratio = normal_density(np.nan_to_num(off_m), 0.0, sigma_m) * apart_m
        log_ratio = np.log(self.middle_often * ratio + 1 - self.middle_often)
        return np.asarray(np.where(np.isnan(off_m), 0.0, log_ratio))


def in_series(
    candidates: Candidates,
    believed: Candidates,
    laid: Laid,
    shorter: FloatArray,
    sigma_m: float,
    weight: FloatArray,
) -> Series | None:
    """Learn the lines of N solved dashes, ``believed`` in the previous pass; None if too few have neighbours.

    ``laid`` is a shape of sigma ``sigma_m`` laid on each, ``shorter`` (N, 8) shortens it by 1 m, ``weight``
    (N,) is the probability of a marking.
    """
    length_m, axis = _long_sides(laid)
    marking = weight > 0.5
    middle = np.tile(axis, 4) / 4
    own_m2 = believed.along(middle, middle)
    spacing = _spacing(believed, axis, own_m2, length_m, marking)
    apart_m = spacing.apart_m
    own_m = np.sum((laid.corners_map - candidates.corners_map).reshape(-1, 8) * shorter, axis=1)
    variance = candidates.along(shorter, shorter) + sigma_m**2
    usual = np.isfinite(apart_m) & marking & (own_m**2 < 9 * variance)
    if usual.sum() < _LEAST:
        return None
    step_m = np.median(apart_m[usual])
    stretch = apart_m / step_m
    in_line = np.abs(np.log(stretch)) < np.log(_STRETCH)
    regular = in_line & marking
    if regular.sum() < _LEAST:
        return None
    # The largest stretch in bends acts as a prior: uncertain spacings are shrunk to the class's length.
    unknown_m2 = (length_m / step_m) ** 2 * spacing.apart_m2
    most_m2 = (length_m * np.log(_STRETCH) / 2) ** 2
    trust = np.where(in_line, most_m2 / (most_m2 + unknown_m2), 0.0)
    longer_m = length_m * trust * np.where(in_line, stretch - 1, 0.0)
    longer_m2 = np.where(in_line, trust * unknown_m2, 0.0)
    fixed = normal_density(own_m[regular], 0.0, np.sqrt(variance[regular]))
    spread_m, often = _regularity((own_m - longer_m)[regular], (variance + longer_m2)[regular], fixed)
    longer_sigma_m = np.where(in_line, np.sqrt(longer_m2 + spread_m**2), 0.0)
    enclosed = regular & np.isfinite(spacing.off_m)
    scatter_m, midway = _midway(spacing, own_m2, enclosed)
    return Series(
        longer_m=longer_m,
        longer_sigma_m=longer_sigma_m,
        longer_often=often,
        apart_m=apart_m,
        middle=middle,
        middle_m=_times(middle, believed) + spacing.off_m,
        middle_sigma_m=np.sqrt(spacing.off_m2 + scatter_m**2),
        middle_often=midway,
    )


def _long_sides(laid: Laid) -> tuple[FloatArray, FloatArray]:
    """Length (N,), m, and direction (N, 2) of the longest side of each laid shape."""
    sides = np.roll(laid.corners_map, -1, axis=1) - laid.corners_map
    lengths = np.linalg.norm(sides, axis=2)
    rows = np.arange(len(sides))
    longest = lengths.argmax(axis=1)
    length_m = lengths[rows, longest]
    return length_m, sides[rows, longest] / length_m[:, None]


class _Spacing(NamedTuple):
    """Places of N dashes among their neighbours, along the line."""

    apart_m: FloatArray  # (N,) spacing to its neighbours, inf without one
    apart_m2: FloatArray  # (N,) variance, m^2
    off_m: FloatArray  # (N,) offset ahead of the neighbours' midpoint, nan without one on either side
    off_m2: FloatArray  # (N,) variance, m^2


def _spacing(
    believed: Candidates, axis: FloatArray, own_m2: FloatArray, length_m: FloatArray, marking: BoolArray
) -> _Spacing:
    """Spacing of each dash to its neighbours, and where their midpoint lies.

    ``own_m2`` (N,) is the variance of its position along ``axis`` (N, 2).
    """
    centre = believed.corners_map.mean(axis=1)
    neighbours = cKDTree(centre).query(centre, min(_NEAR, len(centre)))[1].reshape(len(centre), -1)
    offset = centre[neighbours] - centre[:, None]
    others = axis[neighbours]
    along = np.einsum("nki,ni->nk", offset, axis)
    alike = np.einsum("nki,ni->nk", others, axis)
    others *= np.where(alike < 0, -1.0, 1.0)[..., None]
    across = cross(axis[:, None], offset)
    across_other = cross(offset, others)
    turn = np.arctan2(cross(axis[:, None], others), np.abs(alike))
    # The chord between two points of a circle makes equal angles with the tangents there.
    beside_m = np.abs(across - across_other) / 2
    follows = marking[neighbours] & (np.abs(along) > length_m[:, None])
    follows &= (np.abs(turn) < _TURN_RAD) & (beside_m < _BESIDE_M)
    arc_m = np.linalg.norm(offset, axis=2) / np.sinc(turn / 2 / np.pi)
    rows = np.arange(len(neighbours))
    arc_ahead_m = np.where(follows & (along > 0), arc_m, np.inf)
    arc_behind_m = np.where(follows & (along < 0), arc_m, np.inf)
    ahead = arc_ahead_m.min(axis=1)
    behind = arc_behind_m.min(axis=1)
    nearest_ahead = rows, arc_ahead_m.argmin(axis=1)
    nearest_behind = rows, arc_behind_m.argmin(axis=1)
    with np.errstate(invalid="ignore"):
        enclosed = np.abs(ahead - behind) < _UNEVEN * (ahead + behind)
        apart_m = np.where(enclosed, (ahead + behind) / 2, np.minimum(ahead, behind))
        off_m = np.where(enclosed, (ahead - behind) / 2, np.nan)
    # At the start of a bend, the two spacings differ by the line's distance from the bend's centre line times
    # the difference of their rotations.
    ahead_m2 = own_m2[neighbours][nearest_ahead]
    behind_m2 = own_m2[neighbours][nearest_behind]
    off_m2 = (ahead_m2 + behind_m2 + (_ASIDE_M * (turn[nearest_ahead] + turn[nearest_behind])) ** 2) / 4
    apart_m2 = np.where(enclosed, off_m2, own_m2 + np.where(ahead < behind, ahead_m2, behind_m2))
    return _Spacing(apart_m, apart_m2, off_m, off_m2)


def _midway(spacing: _Spacing, own_m2: FloatArray, enclosed: BoolArray) -> tuple[float, float]:
    """How far ``enclosed`` dashes (N,) scatter about their neighbours' midpoint, m, and how many lie there.

    ``own_m2`` (N,) is the variance of their positions along the line.
    """
    if enclosed.sum() < _LEAST:
        return MEMBER_M, 0.0
    variance_m2 = own_m2 + spacing.off_m2
    anywhere = 1 / spacing.apart_m
    return _regularity(spacing.off_m[enclosed], variance_m2[enclosed], anywhere[enclosed])


def _regularity(off_m: FloatArray, variance: FloatArray, otherwise: FloatArray) -> tuple[float, float]:
    """Standard deviation, m, of dashes about their line's prediction, and the fraction that follows it.

    ``off_m`` (N,) are deviations, ``otherwise`` (N,) their density for dashes that do not follow.
    """
    # Dashes that scatter more than markings of a class form no series.
    spread_m = min(float(np.median(np.abs(off_m)) / ndtri(0.75)), MEMBER_M)
    often = 0.5
    series = normal_density(off_m, 0.0, np.sqrt(variance + spread_m**2))
    for _ in range(_PASSES):
        mixture = often * series + (1 - often) * otherwise
        often = float((1 + np.sum(often * series / np.maximum(mixture, 1e-300))) / (2 + len(off_m)))
    return spread_m, often


def _times(middle: FloatArray, corners: Candidates) -> FloatArray:
    """Position (N,), m, of the mean of ``corners`` along the dash, by ``middle`` (N, 8)."""
    return np.asarray(np.sum(middle * corners.corners_map.reshape(-1, 8), axis=1))
