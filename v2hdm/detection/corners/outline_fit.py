"""Corners from the network's outline alone: for markings that no edge of the image shows as a whole.

Where the border of a shadow crosses a marking, or where much of its paint is gone, its sides are no single
step of grey, and the fits to the image fail. The network has seen such markings and draws their shape all the
same. Straight lines through its outline give corners that are a few times less certain, and say so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.detection.corners.covariance import corner_covariance
from v2hdm.geometry.quadrilateral import following, intersect_sides, preceding, side_frames
from v2hdm.geometry.quadrilateral import is_convex_px as is_convex
from v2hdm.records import BoolArray, FloatArray

_CENTRAL_SHARE = 0.8
"""Part of a side about its middle whose outline is used: near the corners it is rounded."""

_MAX_OFFSET_SHARE = 0.2
_MIN_OFFSET_PX = 3.0
"""Outline points belong to a side if they are within this share of the shortest side, or of so many px."""

_MIN_POINTS = 5
_MAX_ROUGHNESS_PX = 1.0
_MAX_ROUGHNESS_SHARE = 0.03
"""The outline of a quadrilateral is straight to within this, or within this share of the side."""

_BINS = 8
_LEAST_BINS = 6
"""A side is known if its outline is seen in so many of its parts and straight there."""

_GATE = 2.5
_LEAST_SHARE = 0.6
"""A side's own points are within so many times the most roughness of its line; so many must be its own."""

_MASK_SIGMA_PX = 0.8
"""How far the outline as a whole may be off: nothing in it tells."""

_CORRELATED_POINTS = 9
"""Neighbouring points of an outline err alike, over about so many of them."""

_TUKEY = 4.0
_MIN_SCATTER_PX = 0.3
_ITERATIONS = 4


@dataclass(frozen=True)
class OutlineFit:
    """Lines fitted to the outlines of M markings.

    ``corners_pinhole_px`` (M, 4, 2), ``covariance`` (M, 8, 8) px^2, ``found`` (M, 4) corners between two
    sides that the outline shows to be straight; the others are nan, and zero in the covariance.
    """

    corners_pinhole_px: FloatArray
    covariance: FloatArray
    found: BoolArray


def fit_outlines(outlines_pinhole_px: Sequence[FloatArray], start: FloatArray) -> OutlineFit:
    """Fit four lines to each outline (N, 2) near the sides of its quadrilateral of ``start`` (M, 4, 2)."""
    tangent, normal, length = side_frames(start)
    middle = (start + following(start)) / 2
    reach = np.maximum(_MIN_OFFSET_PX, _MAX_OFFSET_SHARE * length.min(axis=1))
    half = 0.5 * _CENTRAL_SHARE * length
    marking = np.repeat(np.arange(len(start)), [len(outline) for outline in outlines_pinhole_px])
    relative = np.concatenate(outlines_pinhole_px)[:, None] - middle[marking]
    along = (relative * tangent[marking]).sum(axis=2) / half[marking]
    across = (relative * normal[marking]).sum(axis=2)
    point, side = np.nonzero((np.abs(along) < 1) & (np.abs(across) < reach[marking, None]))
    along, across = along[point, side], across[point, side]
    side += 4 * marking[point]
    first = _straight_lines(_Parts.of(side, along, across, length.size))
    # Points of other sides and of what touches the marking are near, too.
    rough_px = np.maximum(_MAX_ROUGHNESS_PX, _MAX_ROUGHNESS_SHARE * length)
    off = np.abs(across - first.offset[side] - first.slope[side] * along)
    own = off < _GATE * rough_px.ravel()[side]
    lines = _straight_lines(_Parts.of(side[own], along[own], across[own], length.size))
    own_share = lines.points / np.maximum(np.bincount(side, minlength=length.size), 1)
    known = (lines.known & (own_share >= _LEAST_SHARE)).reshape(-1, 4)
    offset, slope, roughness, points = (
        part.reshape(-1, 4) for part in (lines.offset, lines.slope, lines.roughness, lines.points)
    )
    straight = known & (roughness <= rough_px)
    level = np.hypot(_MASK_SIGMA_PX, roughness * np.sqrt(_CORRELATED_POINTS / np.maximum(points, 1)))
    sigma = np.stack([level, 2 * level / length], axis=-1)
    tilted = normal - (slope / half)[..., None] * tangent
    corners = intersect_sides(middle + offset[..., None] * normal, tilted)
    found = np.asarray(np.isfinite(corners).all(axis=-1) & straight & preceding(straight, -1))
    found &= np.abs(corners - start).max(axis=-1) < 2 * reach[:, None]
    usable = np.where(found[..., None], corners, start)
    found &= is_convex(usable)[:, None]
    covariance = corner_covariance(usable, middle, tangent, tilted, _diagonal(sigma**2), found)
    return OutlineFit(np.where(found[..., None], corners, np.nan), covariance, found)


@dataclass(frozen=True)
class _Parts:
    """The outline's points near each of S sides, in parts along it.

    ``count`` (S, bins), their mean place ``along`` the side, -1 to 1, mean ``across`` it and ``variance``.
    """

    count: FloatArray
    along: FloatArray
    across: FloatArray
    variance: FloatArray

    @classmethod
    def of(cls, side: np.ndarray, along: FloatArray, across: FloatArray, sides: int) -> _Parts:
        """Gather points (N,) that are near the side of that index."""
        part = side * _BINS + np.minimum(((along + 1) / 2 * _BINS).astype(np.intp), _BINS - 1)
        count, first, second, square = (
            np.bincount(part, values, minlength=sides * _BINS).reshape(sides, _BINS)
            for values in (None, along, across, across * across)
        )
        total = np.maximum(count, 1)
        mean = second / total
        return cls(count.astype(np.float64), first / total, mean, np.maximum(square / total - mean**2, 0))


@dataclass(frozen=True)
class _Lines:
    """Lines along S sides: ``slope`` is over half a side's central part; each (S,), see :class:`_Parts`."""

    offset: FloatArray
    slope: FloatArray
    roughness: FloatArray
    points: FloatArray
    known: BoolArray


def _straight_lines(parts: _Parts) -> _Lines:
    """Robust lines by Tukey's weights through the parts of S sides."""
    seen = parts.count > 0
    middle = np.maximum(seen.sum(axis=1, keepdims=True) - 1, 0) // 2
    weight = seen.astype(np.float64)
    for _ in range(_ITERATIONS):
        total = np.maximum(weight.sum(axis=1), 1e-9)
        mean_x, mean_y = (
            (weight * parts.along).sum(axis=1) / total,
            (weight * parts.across).sum(axis=1) / total,
        )
        x = parts.along - mean_x[:, None]
        weighted = weight * x
        slope = (weighted * parts.across).sum(axis=1) / np.maximum((weighted * x).sum(axis=1), 1e-9)
        residual = parts.across - mean_y[:, None] - slope[:, None] * x
        ordered = np.sort(np.where(seen, np.abs(residual), np.inf), axis=1)
        scatter = np.maximum(1.4826 * np.take_along_axis(ordered, middle, axis=1), _MIN_SCATTER_PX)
        weight = seen * np.maximum(1 - (residual / (_TUKEY * scatter)) ** 2, 0) ** 2
    used = weight > 0
    points = (used * parts.count).sum(axis=1)
    known = (points >= _MIN_POINTS) & (used.sum(axis=1) >= _LEAST_BINS)
    square = (used * parts.count * (residual**2 + parts.variance)).sum(axis=1) / np.maximum(points, 1)
    return _Lines(mean_y - slope * mean_x, slope, np.sqrt(square), points, np.asarray(known))


def _diagonal(variance: FloatArray) -> FloatArray:
    """Matrices (M, 4, 2, 2) with the variances (M, 4, 2) on their diagonal."""
    return np.asarray(variance[..., None] * np.eye(2))
