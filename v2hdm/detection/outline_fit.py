"""Corners from the network's outline alone: for markings that no edge of the image shows as a whole.

Where the border of a shadow crosses a marking, or where much of its paint is gone, its sides are no single
step of grey, and the fits to the image fail. The network has seen such markings and draws their shape all the
same. Straight lines through its outline give corners that are a few times less certain, and say so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.detection.quad import intersect_sides, is_convex, side_frames
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
"""A side is known if its outline is seen in so many of its parts."""

_MASK_SIGMA_PX = 0.4
"""How far the outline as a whole may be off: nothing in it tells."""

_TUKEY = 4.0
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
    fits = [_fit(outline, quad) for outline, quad in zip(outlines_pinhole_px, start, strict=True)]
    corners, covariance, found = (np.stack(part) for part in zip(*fits, strict=True))
    return OutlineFit(corners, covariance, found)


def _fit(outline: FloatArray, quad: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Corners (4, 2), covariance (8, 8) and which were found (4,), of one marking."""
    tangent, normal, length = side_frames(quad)
    middle = (quad + np.roll(quad, -1, axis=0)) / 2
    relative = outline[:, None] - middle
    along, across = (relative * tangent).sum(axis=2), (relative * normal).sum(axis=2)
    reach = max(_MIN_OFFSET_PX, _MAX_OFFSET_SHARE * float(length.min()))
    half = 0.5 * _CENTRAL_SHARE * length
    near = (np.abs(along) < half) & (np.abs(across) < reach)
    lines = _straight_lines(along / half, across, near)
    offset, slope = lines.offset, lines.slope / half
    straight = lines.known & (lines.roughness <= np.maximum(_MAX_ROUGHNESS_PX, _MAX_ROUGHNESS_SHARE * length))
    # Neighbouring points of an outline err alike, over about four of them.
    level = np.hypot(_MASK_SIGMA_PX, 2 * lines.roughness / np.sqrt(np.maximum(lines.points, 1)))
    sigma = np.stack([level, 2 * level / length], axis=1)
    tilted = normal - slope[:, None] * tangent
    corners = intersect_sides(middle + offset[:, None] * normal, tilted)
    found = straight & np.roll(straight, 1)
    found &= np.isfinite(corners).all(axis=1) & (np.abs(corners - quad).max(axis=1) < 2 * reach)
    found &= is_convex(np.where(found[:, None], corners, quad)[None])[0]
    covariance = _covariance(np.where(found[:, None], corners, quad), middle, tangent, tilted, sigma)
    keep = np.repeat(found, 2).astype(np.float64)
    return np.where(found[:, None], corners, np.nan), covariance * np.outer(keep, keep), found


@dataclass(frozen=True)
class _Lines:
    """Lines along four sides, each (4,): ``offset``, ``slope``, ``roughness``, ``points``, if ``known``."""

    offset: FloatArray
    slope: FloatArray
    roughness: FloatArray
    points: FloatArray
    known: BoolArray


def _straight_lines(along: FloatArray, across: FloatArray, near: BoolArray) -> _Lines:
    """Robust lines by Tukey's weights through the points (N, 4) near each side; ``along`` from -1 to 1."""
    count = near.sum(axis=0)
    weight = near.astype(np.float64)
    for _ in range(_ITERATIONS):
        total = np.maximum(weight.sum(axis=0), 1e-9)
        mean_x, mean_y = (weight * along).sum(axis=0) / total, (weight * across).sum(axis=0) / total
        x = along - mean_x
        slope = (weight * x * (across - mean_y)).sum(axis=0) / np.maximum((weight * x * x).sum(axis=0), 1e-9)
        residual = across - mean_y - slope * x
        ordered = np.sort(np.where(near, np.abs(residual), np.inf), axis=0)
        middle = ordered[np.minimum(count // 2, len(along) - 1), range(4)]
        scatter = np.maximum(1.4826 * np.where(np.isfinite(middle), middle, 1.0), 0.05)
        weight = near * np.clip(1 - (residual / (_TUKEY * scatter)) ** 2, 0, None) ** 2
    used = weight > 0
    points = used.sum(axis=0)
    part = np.clip(((along + 1) / 2 * _BINS).astype(np.intp), 0, _BINS - 1)
    parts = np.zeros((_BINS, 4), dtype=np.bool_)
    point, side = np.nonzero(used)
    parts[part[point, side], side] = True
    known = (points >= _MIN_POINTS) & (points >= 0.6 * count) & (parts.sum(axis=0) >= _LEAST_BINS)
    roughness = np.sqrt((used * residual**2).sum(axis=0) / np.maximum(points, 1))
    return _Lines(mean_y - slope * mean_x, slope, roughness, points.astype(np.float64), known)


def _covariance(
    corners: FloatArray, middle: FloatArray, tangent: FloatArray, normal: FloatArray, sigma: FloatArray
) -> FloatArray:
    """Covariance (8, 8) of corners where lines meet whose offset and slope have ``sigma`` (4, 2)."""
    jacobian = np.zeros((4, 2, 4, 2))
    for corner in range(4):
        sides = [(corner - 1) % 4, corner]
        inverse = np.linalg.inv(normal[sides])
        for n, side in enumerate(sides):
            lever = (corners[corner] - middle[side]) @ tangent[side]
            jacobian[corner, :, side] = np.outer(inverse[:, n], [1.0, lever])
    flat = jacobian.reshape(8, 8) * sigma.ravel()
    return np.asarray(flat @ flat.T)
