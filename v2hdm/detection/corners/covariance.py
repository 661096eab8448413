"""Covariance of corners that are where the lines of neighbouring sides meet."""

from __future__ import annotations

import numpy as np

from v2hdm.geometry.quadrilateral import preceding
from v2hdm.records import BoolArray, FloatArray


def corner_covariance(
    corners: FloatArray,
    middle: FloatArray,
    tangent: FloatArray,
    normal: FloatArray,
    line_covariance: FloatArray,
    found: BoolArray,
) -> FloatArray:
    """Covariance (M, 8, 8), px^2: neighbours share a side, so they correlate.

    A line's offset and slope move a corner by N dx = d_offset + s d_slope, N the two lines' normals and s
    how far along the side the corner is.

    Args:
        corners: (M, 4, 2).
        middle: (M, 4, 2) the points of the sides where s is 0.
        tangent: (M, 4, 2) direction in which s is counted.
        normal: (M, 4, 2) the lines' normals, of the length that makes the offset's unit one px.
        line_covariance: (M, 4, 2, 2) of each line's offset, px, and slope.
        found: (M, 4) the corners that there are; the others' rows and columns are zero.
    """
    before = preceding(normal)
    determinant = before[..., 0] * normal[..., 1] - before[..., 1] * normal[..., 0]
    inverse = np.where(found, 1 / np.where(found, determinant, 1.0), 0.0)[..., None]
    by_own = np.stack([-before[..., 1], before[..., 0]], axis=-1) * inverse
    by_last = np.stack([normal[..., 1], -normal[..., 0]], axis=-1) * inverse
    variance, tilt = np.sqrt(line_covariance[..., 0, 0]), line_covariance[..., 1, 0]
    root = np.zeros_like(line_covariance)
    root[..., 0, 0] = variance
    root[..., 1, 0] = tilt / np.maximum(variance, 1e-12)
    root[..., 1, 1] = np.sqrt(np.maximum(line_covariance[..., 1, 1] - root[..., 1, 0] ** 2, 0.0))
    jacobian = np.zeros((len(corners), 4, 2, 4, 2))
    for side, by_side in ((np.arange(4), by_own), (np.arange(4) - 1, by_last)):
        s = ((corners - middle[:, side]) * tangent[:, side]).sum(axis=-1)
        moved = root[:, side, 0] + s[..., None] * root[:, side, 1]
        jacobian[:, np.arange(4), :, side] = (by_side[..., :, None] * moved[..., None, :]).swapaxes(0, 1)
    flat = jacobian.reshape(-1, 8, 8)
    return np.asarray(flat @ flat.swapaxes(1, 2))
