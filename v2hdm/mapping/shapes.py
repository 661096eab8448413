"""Comparing quadrilaterals whose first corner is arbitrary."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from v2hdm.records import BoolArray, FloatArray

SHIFTS = (np.arange(4)[:, None] + np.arange(4)[None, :]) % 4
"""Row s lists, for corner c of one quadrilateral, corner (c + s) mod 4 of the other."""


class Alignment(NamedTuple):
    """How quadrilaterals b lie against quadrilaterals a under the best cyclic shift.

    ``shift``: corner c of a matches corner (c + shift) mod 4 of b; ``offset`` (..., 2) is the mean
    displacement of b's corners; ``deformation_m`` the largest deviation of a corner from that mean;
    ``common`` the number of corners valid in both (fewer than two: nothing can be said, the
    deformation is infinite).
    """

    shift: NDArray[np.int64]
    offset: FloatArray
    deformation_m: FloatArray
    common: NDArray[np.int64]


def align(a: FloatArray, valid_a: BoolArray, b: FloatArray, valid_b: BoolArray) -> Alignment:
    """Align quadrilaterals ``b`` (..., 4, 2) to ``a`` (..., 4, 2); leading dimensions broadcast.

    The shift is the one with the least mean squared distance over the common valid corners: sense
    of rotation is known, so there are four candidates and no mirror images.
    """
    both = valid_a[..., None, :] & valid_b[..., SHIFTS]
    difference = np.where(both[..., None], b[..., SHIFTS, :] - a[..., None, :, :], 0.0)
    common = both.sum(axis=-1)
    count = np.maximum(common, 1)
    squared = np.sum(difference**2, axis=(-1, -2)) / count
    shift = np.argmin(np.where(common >= 2, squared, np.inf), axis=-1)
    chosen = shift[..., None]
    mean = difference.sum(axis=-2) / count[..., None]
    offset = np.take_along_axis(mean, chosen[..., None], axis=-2)[..., 0, :]
    deviation = np.linalg.norm(difference - mean[..., None, :], axis=-1)
    worst = np.max(np.where(both, deviation, 0.0), axis=-1)
    common = np.take_along_axis(common, chosen, axis=-1)[..., 0]
    worst = np.take_along_axis(worst, chosen, axis=-1)[..., 0]
    return Alignment(shift, offset, np.where(common >= 2, worst, np.inf), common)


def diameters(corners: FloatArray, valid: BoolArray) -> FloatArray:
    """Largest distance (...) between two valid corners of quadrilaterals (..., 4, 2)."""
    difference = corners[..., :, None, :] - corners[..., None, :, :]
    distance = np.linalg.norm(difference, axis=-1)
    return np.asarray(
        np.max(np.where(valid[..., :, None] & valid[..., None, :], distance, 0.0), axis=(-1, -2))
    )


def signed_area(corners: FloatArray) -> FloatArray:
    """Shoelace area (...) of polygons (..., N, 2); positive when counter-clockwise."""
    after = np.roll(corners, -1, axis=-2)
    return np.asarray(
        0.5 * np.sum(corners[..., 0] * after[..., 1] - corners[..., 1] * after[..., 0], axis=-1)
    )


def is_convex(corners: FloatArray) -> BoolArray:
    """Whether polygons (..., N, 2) are convex and counter-clockwise."""
    edge = np.roll(corners, -1, axis=-2) - corners
    after = np.roll(edge, -1, axis=-2)
    turn = edge[..., 0] * after[..., 1] - edge[..., 1] * after[..., 0]
    return np.asarray((turn > 0).all(axis=-1))
