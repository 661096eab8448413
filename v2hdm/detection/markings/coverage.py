"""How much of each pixel a quadrilateral covers, blurred by the point spread, and how that changes.

Let h be a pixel's distance from a side's line, s0 and s1 the side's ends along that line, seen from the
pixel's foot, all in units of the blur b. A radial Gaussian separates along and across any side, hence in
closed form

    coverage = [pixel inside] + sum over sides of sign(h) (T(|h|, s1) - T(|h|, s0)),
    change of coverage by a shift w(s) of the side outwards = pdf(h) integral_s0^s1 w(s) pdf(s) ds / b,

with T(h, s) the Gaussian's mass in the triangle between the pixel and the line beyond [0, s]: Owen's T
function of h and s / h (Owen, Annals of Mathematical Statistics, 1956), taken from a table.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from v2hdm.detection.markings.normal import normal_cdf, normal_pdf
from v2hdm.geometry.quadrilateral import side_frames

_CELLS_PER_BLUR = 32
_REACH = 4.5
_LAST_CELL = (_CELLS_PER_BLUR * _REACH * np.array([1, 2, 2])[:, None, None, None] - 1.01).astype(np.float32)


def blurred_coverage(
    corners: np.ndarray, points: np.ndarray, blur_px: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Coverage of pixels by convex quadrilaterals and its derivative by their sides and by the blur.

    Args:
        corners: (M, 4, 2) px, in the order of :mod:`v2hdm.detection.markings.quad`, from a point near each
            quadrilateral, so that float32 keeps a ten-thousandth of a pixel.
        points: (M, 3, N) float32, the pixel centres (u, v, 1) from the same point.
        blur_px: (M,) or one for all, standard deviation of the point spread, pixel aperture included.

    Returns:
        Coverage (M, N) in [0, 1] and its derivative (M, 9, N) per px by which a side's start (elements
        0 to 3) or end (4 to 7) moves along the side's outward normal or (8) the blur grows, both float32.
    """
    tangent, normal, length = side_frames(corners)
    per_blur = 1 / np.reshape(blur_px, (-1, 1, 1))
    # Rows of a matrix that takes (u, v, 1) to the outward distance, and to the side's start and end.
    rows = np.empty((3, len(corners), 4, 3))
    rows[0, ..., :2], rows[0, ..., 2] = normal, -(normal * corners).sum(axis=-1)
    rows[1:, ..., :2] = -tangent
    rows[1, ..., 2] = (tangent * corners).sum(axis=-1)
    rows[2, ..., 2] = rows[1, ..., 2] + length
    rows *= per_blur
    placed = rows.astype(np.float32) @ points
    across, start = placed[:2]
    density, pdf_start, pdf_end = densities = normal_pdf(placed)
    cdf_start, cdf_end = normal_cdf(placed[1:], densities[1:])
    share = np.subtract(cdf_end, cdf_start, out=cdf_end)
    by_end = np.subtract(pdf_start, pdf_end, out=pdf_start)
    by_end -= np.multiply(start, share, out=pdf_end)
    by_end *= (1 / np.maximum(length[..., None] * per_blur, 1e-3)).astype(np.float32)
    density *= per_blur.astype(np.float32)
    derivative = np.empty((len(corners), 9, points.shape[2]), dtype=np.float32)
    sides = np.multiply(density, share, out=derivative[:, :4])
    ends = np.multiply(density, by_end, out=derivative[:, 4:8])
    # A wider blur is a smaller picture: each side comes nearer to the pixel in proportion to its distance.
    np.multiply(sides, across, out=share).sum(axis=1, out=derivative[:, 8])
    sides -= ends
    return _coverage(placed), derivative


def _coverage(placed: np.ndarray) -> np.ndarray:
    """Coverage (M, N) from the pixels' distance, and the sides' starts and ends (3, M, 4, N), overwritten."""
    pixels = placed.shape[-1]
    across = placed[0]
    inside = (across < 0).all(axis=1)
    sign = np.copysign(np.float32(1), across)
    np.abs(across, out=across)
    placed[1:] += np.float32(_REACH)
    placed *= np.float32(_CELLS_PER_BLUR)
    np.clip(placed, 0, _LAST_CELL, out=placed)
    row, start, end = placed.reshape(3, -1, pixels)
    # Borders are slow in OpenCV; the indices were kept inside.
    sign *= np.subtract(
        cv2.remap(owen_table(), end, row, cv2.INTER_LINEAR),
        cv2.remap(owen_table(), start, row, cv2.INTER_LINEAR),
    ).reshape(sign.shape)
    coverage = sign.sum(axis=1)
    coverage += inside
    return np.asarray(coverage)


@cache
def owen_table() -> np.ndarray:
    """T(h, s), float32: rows h from 0, columns s from ``-_REACH``, ``_CELLS_PER_BLUR`` cells a blur.

    Beyond the table T stays what it is at its border: 0 for large h, constant for large s.
    """
    h = np.arange(0, round(_REACH * _CELLS_PER_BLUR) + 1) / _CELLS_PER_BLUR
    s = h[None, :]
    angle = np.arctan2(s, h[:, None])
    node, weight = np.polynomial.legendre.leggauss(24)
    total = np.zeros(angle.shape)
    for x, w in zip(node, weight, strict=True):
        cosine = np.maximum(np.cos(angle * (1 + x) / 2), 1e-9)
        total += w / 2 * np.exp(-0.5 * (h[:, None] / cosine) ** 2)
    positive = total * angle / (2 * np.pi)
    positive[-2:] = 0.0
    return np.ascontiguousarray(np.hstack([-positive[:, :0:-1], positive]).astype(np.float32))
