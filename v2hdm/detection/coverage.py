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

from v2hdm.detection.normal import normal_pdf, normal_pdf_cdf
from v2hdm.detection.quad import side_frames

_CELLS_PER_BLUR = 32
_REACH = 4.5


def blurred_coverage(
    corners: np.ndarray, points: np.ndarray, blur_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Coverage of pixels by convex quadrilaterals and its derivative by their sides.

    Args:
        corners: (M, 4, 2) px, in the order of :mod:`v2hdm.detection.quad`, from a point near each
            quadrilateral, so that float32 keeps a ten-thousandth of a pixel.
        points: (M, 3, N) float32, the pixel centres (u, v, 1) from the same point.
        blur_px: standard deviation of the point spread, pixel aperture included.

    Returns:
        Coverage (M, N) in [0, 1] and its derivative (M, 8, N) per px by which a side's start (elements
        0 to 3) or end (4 to 7) moves along the side's outward normal, both float32.
    """
    tangent, normal, length = side_frames(corners)
    # Rows of a matrix that takes (u, v, 1) to the outward distance, and to the side's start and end.
    rows = np.empty((3, len(corners), 4, 3))
    rows[0, ..., :2], rows[0, ..., 2] = normal, -(normal * corners).sum(axis=-1)
    rows[1:, ..., :2] = -tangent
    rows[1, ..., 2] = (tangent * corners).sum(axis=-1)
    rows[2, ..., 2] = rows[1, ..., 2] + length
    across, start, end = (rows / blur_px).astype(np.float32) @ points
    pdf_start, cdf_start = normal_pdf_cdf(start)
    pdf_end, cdf_end = normal_pdf_cdf(end)
    share = np.subtract(cdf_end, cdf_start, out=cdf_end)
    by_end = np.subtract(pdf_start, pdf_end, out=pdf_start)
    by_end -= start * share
    by_end /= np.maximum(length / blur_px, 1e-3).astype(np.float32)[..., None]
    share -= by_end
    density = normal_pdf(across)
    density *= np.float32(1 / blur_px)
    derivative = np.empty((len(corners), 8, points.shape[2]), dtype=np.float32)
    np.multiply(density, share, out=derivative[:, :4])
    np.multiply(density, by_end, out=derivative[:, 4:])
    return _coverage(across, start, end), derivative


def _coverage(across: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    flat = (-1, across.shape[-1])
    table = owen_table()
    row = _table_index(np.abs(across), 0).reshape(flat)
    beyond = [
        cv2.remap(table, _table_index(s, _REACH).reshape(flat), row, cv2.INTER_LINEAR) for s in (start, end)
    ]
    term = np.copysign(np.float32(1), across)
    term *= (beyond[1] - beyond[0]).reshape(across.shape)
    coverage = term.sum(axis=1)
    coverage += (across < 0).all(axis=1)
    return np.asarray(coverage)


def _table_index(x: np.ndarray, first: float) -> np.ndarray:
    """Fractional index of x in a table from ``-first`` to ``_REACH``, kept inside: borders are slow."""
    index = x + np.float32(first)
    index *= np.float32(_CELLS_PER_BLUR)
    return np.clip(index, 0, np.float32((first + _REACH) * _CELLS_PER_BLUR - 1.01), out=index)


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
