"""How much of each pixel a blurred quadrilateral covers, in closed form, and how that changes with its sides.

Let h be a pixel's distance from a side's line, s0 and s1 the side's ends along that line, seen from the
pixel's foot, all in units of the blur b. A radial Gaussian separates along and across any side, hence

    coverage = [pixel inside] + sum over sides of sign(h) (T(|h|, s1) - T(|h|, s0)),
    change of coverage by a shift w(s) of the side outwards = pdf(h) integral_s0^s1 w(s) pdf(s) ds / b,

with T(h, s) the Gaussian's mass in the triangle between the pixel and the line beyond [0, s]: Owen's T
function of h and s / h (Owen, Annals of Mathematical Statistics, 1956), taken from a table.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from v2hdm.geometry.planar import Quad

_LOG_SQRT_2PI = 0.9189385332046727  # logarithm of the standard normal's divisor, sqrt(2 pi)
_LEAST_EXPONENT = -40.0  # least exponent of a density: e^-40 is still a normal number of float32


def normal_pdf(x: np.ndarray) -> np.ndarray:
    """Density of the standard normal, float32; at least 1e-18, as denormal numbers are slow."""
    flat = x.reshape(-1, x.shape[-1])
    exponent = np.asarray(cv2.multiply(flat, flat, scale=-0.5)) - np.float32(_LOG_SQRT_2PI)
    np.maximum(exponent, np.float32(_LEAST_EXPONENT), out=exponent)
    # OpenCV's exponential takes a quarter of the time of numpy's.
    return np.asarray(cv2.exp(exponent, dst=exponent)).reshape(x.shape)


def normal_share(x: np.ndarray) -> np.ndarray:
    """Share of the standard normal between 0 and ``x``, negative to the left, float32, to 1.4e-4.

    The logistic function of 1.5976 x + 0.07056 x^3 (Bowling et al., Journal of Industrial Engineering and
    Management, 2009): only slopes are made of it, and slopes this wrong do not move what a fit settles at.
    Counted from the middle, differences far out are 0 instead of denormal numbers.
    """
    half_odds = x * x
    half_odds *= np.float32(0.03528)
    half_odds += np.float32(0.7988)
    half_odds *= x
    np.tanh(half_odds, out=half_odds)
    half_odds *= np.float32(0.5)
    return np.asarray(half_odds)


_CELLS_PER_BLUR = 32  # cells of the table of T to a blur, in either direction
_REACH = 4.5  # blurs from which T is constant: 3e-6 of a normal distribution lies beyond

TABLE = {"cells_per_blur": _CELLS_PER_BLUR, "reach": _REACH}
"""The axes of :func:`owen_table`, for the compiled kernel."""

# Largest row and columns that the table is read at, to leave a cell for the interpolation.
_LAST_CELL = (_CELLS_PER_BLUR * _REACH * np.array([1, 2, 2])[:, None, None, None] - 1.01).astype(np.float32)


def blurred_coverage(
    quad: Quad, points: np.ndarray, blur_px: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Coverage (M, N) in [0, 1] of pixels by M convex quadrilaterals, and its derivative (M, 9, N) per px.

    The derivatives are by moves of a side's start (0 to 3) or end (4 to 7) along its outward normal, and by
    the blur (8); all are float32. ``points`` (M, 3, N) are pixel centres (u, v, 1) from a point near each
    quadrilateral, ``blur_px`` the point spread's sigma, pixel aperture included.
    """
    tangent = quad.tangent
    length = quad.length
    per_blur = 1 / np.reshape(blur_px, (-1, 1, 1))
    # Matrices (3, M, 4, 3) that take (u, v, 1) to a side's outward distance, and to its start and end.
    matrices = np.empty((3, len(tangent), 4, 3))
    matrices[0] = quad.outward
    matrices[1:, ..., :2] = -tangent
    matrices[1, ..., 2] = (tangent * quad.corners).sum(axis=-1)
    matrices[2, ..., 2] = matrices[1, ..., 2] + length
    matrices *= per_blur
    placed = matrices.astype(np.float32) @ points
    across, start = placed[:2]
    density, pdf_start, pdf_end = normal_pdf(placed)
    to_start, to_end = normal_share(placed[1:])
    # Arrays that are needed no more take the next result: none of this size is made twice.
    share = np.subtract(to_end, to_start, out=to_end)
    by_end = np.subtract(pdf_start, pdf_end, out=pdf_start)
    by_end -= np.multiply(start, share, out=pdf_end)
    by_end *= (1 / np.maximum(length[..., None] * per_blur, 1e-3)).astype(np.float32)
    density *= per_blur.astype(np.float32)
    derivative = np.empty((len(tangent), 9, points.shape[2]), dtype=np.float32)
    by_start = np.multiply(density, share, out=derivative[:, :4])
    np.multiply(density, by_end, out=derivative[:, 4:8])
    # A wider blur is a smaller picture: each side comes nearer to the pixel in proportion to its distance.
    np.multiply(by_start, across, out=share).sum(axis=1, out=derivative[:, 8])
    by_start -= derivative[:, 4:8]
    return _coverage(placed), derivative


def _coverage(placed: np.ndarray) -> np.ndarray:
    """Coverage (M, N) by the sides' distances, starts and ends ``placed`` (3, M, 4, N), in blurs.

    It overwrites ``placed``.
    """
    across = placed[0]
    inside = (across < 0).all(axis=1)
    sign = np.copysign(np.float32(1), across)
    np.abs(across, out=across)
    placed[1:] += np.float32(_REACH)
    placed *= np.float32(_CELLS_PER_BLUR)
    np.clip(placed, 0, _LAST_CELL, out=placed)
    row, start, end = placed.reshape(3, -1, placed.shape[-1])
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
    """T(h, s), float32, ``_CELLS_PER_BLUR`` cells a blur: h from 0, s from ``-_REACH``; constant beyond."""
    h = np.arange(0, round(_REACH * _CELLS_PER_BLUR) + 1) / _CELLS_PER_BLUR
    s = h[None, :]
    angle = np.arctan2(s, h[:, None])
    nodes, weights = np.polynomial.legendre.leggauss(24)
    total = np.zeros(angle.shape)
    for node, weight in zip(nodes, weights, strict=True):
        cosine = np.maximum(np.cos(angle * (1 + node) / 2), 1e-9)
        total += weight / 2 * np.exp(-0.5 * (h[:, None] / cosine) ** 2)
    positive = total * angle / (2 * np.pi)
    positive[-2:] = 0.0
    return np.ascontiguousarray(np.hstack([-positive[:, :0:-1], positive]).astype(np.float32))
