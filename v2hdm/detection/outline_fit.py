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
    offset, slope, sigma = np.zeros(4), np.zeros(4), np.zeros((4, 2))
    straight = np.zeros(4, dtype=np.bool_)
    for side in range(4):
        line = _line(along[near[:, side], side] / half[side], across[near[:, side], side])
        if line is None:
            continue
        offset[side], slope[side], roughness, points = line[0], line[1] / half[side], *line[2:]
        straight[side] = roughness <= max(_MAX_ROUGHNESS_PX, _MAX_ROUGHNESS_SHARE * length[side])
        # Neighbouring points of an outline err alike, over about four of them.
        level = np.hypot(_MASK_SIGMA_PX, 2 * roughness / np.sqrt(points))
        sigma[side] = level, 2 * level / length[side]
    tilted = normal - slope[:, None] * tangent
    corners = intersect_sides(middle + offset[:, None] * normal, tilted)
    found = straight & np.roll(straight, 1)
    found &= np.isfinite(corners).all(axis=1) & (np.abs(corners - quad).max(axis=1) < 2 * reach)
    found &= is_convex(np.where(found[:, None], corners, quad)[None])[0]
    covariance = _covariance(np.where(found[:, None], corners, quad), middle, tangent, tilted, sigma)
    keep = np.repeat(found, 2).astype(np.float64)
    return np.where(found[:, None], corners, np.nan), covariance * np.outer(keep, keep), found


def _line(along: FloatArray, across: FloatArray) -> tuple[float, float, float, int] | None:
    """Offset, slope, scatter and points of a robust line (Tukey's weights) over ``along`` from -1 to 1."""
    if len(along) < _MIN_POINTS:
        return None
    weight = np.ones(len(along))
    for _ in range(_ITERATIONS):
        total = weight.sum()
        mean_x, mean_y = (weight @ along) / total, (weight @ across) / total
        spread = weight @ (along - mean_x) ** 2
        slope = (weight * (along - mean_x)) @ (across - mean_y) / max(spread, 1e-9)
        residual = across - mean_y - slope * (along - mean_x)
        scatter = max(1.4826 * float(np.median(np.abs(residual))), 0.05)
        weight = np.clip(1 - (residual / (_TUKEY * scatter)) ** 2, 0, None) ** 2
        if np.count_nonzero(weight) < _MIN_POINTS:
            return None
    used = weight > 0
    parts = np.unique(np.floor((along[used] + 1) / 2 * _BINS))
    if used.mean() < 0.6 or len(parts) < _LEAST_BINS:
        return None
    return float(mean_y - slope * mean_x), float(slope), float(residual[used].std()), int(used.sum())


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
