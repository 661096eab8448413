"""The model of a pixel: how much of it a quadrilateral covers, and how much the pixel counts in a fit.

Let h be a pixel's distance from a side's line, s0 and s1 the side's ends along that line, seen from the
pixel's foot, all in units of the blur b. A radial Gaussian separates along and across any side, hence in
closed form

    coverage = [pixel inside] + sum over sides of sign(h) (T(|h|, s1) - T(|h|, s0)),
    change of coverage by a shift w(s) of the side outwards = pdf(h) integral_s0^s1 w(s) pdf(s) ds / b,

with T(h, s) the Gaussian's mass in the triangle between the pixel and the line beyond [0, s]: Owen's T
function of h and s / h (Owen, Annals of Mathematical Statistics, 1956), taken from a table.

A pixel counts by Cauchy's weight over the variance of the side that is nearest. Neighbouring pixels err
alike, along a seam or a frayed edge; their variances are inflated by as much.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from v2hdm.detection.lattice import Lattice
from v2hdm.geometry.quadrilateral import Quad
from v2hdm.records import FloatArray

_INV_SQRT_2PI = 0.3989422804014327
_LEAST_EXPONENT = -40.0


def normal_pdf(x: np.ndarray) -> np.ndarray:
    """Density of the standard normal, in the type of ``x``; at least 1e-18, as denormal numbers are slow."""
    exponent = x * x
    exponent *= x.dtype.type(-0.5)
    np.maximum(exponent, x.dtype.type(_LEAST_EXPONENT), out=exponent)
    # OpenCV's exponential takes a quarter of the time of numpy's.
    density = cv2.exp(exponent.reshape(-1, x.shape[-1])).reshape(x.shape)
    density *= x.dtype.type(_INV_SQRT_2PI)
    return np.asarray(density)


def normal_cdf(x: np.ndarray, density: np.ndarray) -> np.ndarray:
    """Cumulative distribution of the standard normal, to 1e-5, in the type of ``x``, whose density is known.

    Abramowitz and Stegun, Handbook of Mathematical Functions, 26.2.16.
    """
    kind = x.dtype.type
    t = np.abs(x)
    t *= kind(0.33267)
    t += kind(1)
    np.divide(kind(1), t, out=t)
    tail = t * kind(0.9372980)
    tail += kind(-0.1201676)
    tail *= t
    tail += kind(0.4361836)
    tail *= t
    tail *= density
    # The distribution is tail where x <= 0 and 1 - tail elsewhere.
    tail -= kind(0.5)
    np.copysign(tail, x, out=tail)
    tail += kind(0.5)
    return np.asarray(tail)


_CELLS_PER_BLUR = 32
_REACH = 4.5
_LAST_CELL = (_CELLS_PER_BLUR * _REACH * np.array([1, 2, 2])[:, None, None, None] - 1.01).astype(np.float32)


def blurred_coverage(
    quad: Quad, points: np.ndarray, blur_px: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Coverage of pixels by convex quadrilaterals and its derivative by their sides and by the blur.

    Args:
        quad: M quadrilaterals, px, from a point near each, so that float32 keeps a ten-thousandth of a pixel.
        points: (M, 3, N) float32, the pixel centres (u, v, 1) from the same point.
        blur_px: (M,) or one for all, standard deviation of the point spread, pixel aperture included.

    Returns:
        Coverage (M, N) in [0, 1] and its derivative (M, 9, N) per px by which a side's start (elements
        0 to 3) or end (4 to 7) moves along the side's outward normal or (8) the blur grows, both float32.
    """
    tangent, length = quad.tangent, quad.length
    per_blur = 1 / np.reshape(blur_px, (-1, 1, 1))
    # Rows of a matrix that takes (u, v, 1) to the outward distance, and to the side's start and end.
    rows = np.empty((3, len(tangent), 4, 3))
    rows[0] = quad.outward
    rows[1:, ..., :2] = -tangent
    rows[1, ..., 2] = (tangent * quad.corners).sum(axis=-1)
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
    derivative = np.empty((len(tangent), 9, points.shape[2]), dtype=np.float32)
    sides = np.multiply(density, share, out=derivative[:, :4])
    ends = np.multiply(density, by_end, out=derivative[:, 4:8])
    # A wider blur is a smaller picture: each side comes nearer to the pixel in proportion to its distance.
    np.multiply(sides, across, out=share).sum(axis=1, out=derivative[:, 8])
    sides -= ends
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
    return coverage, derivative


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


def variance_inflation(first: np.ndarray, second: np.ndarray, weight: np.ndarray, most: float) -> FloatArray:
    """Factor (...) by which a fit's variance grows if residuals (..., N) correlate with their neighbours.

    That is (1 + r) / (1 - r), as of a first-order autoregressive process (Bartlett, Journal of the Royal
    Statistical Society, 1946); pairs have a ``weight`` (..., N), and r is between 0 and ``most``.
    """
    power = (weight * (first * first + second * second)).sum(axis=-1) / 2
    r = np.clip((weight * first * second).sum(axis=-1) / np.maximum(power, 1e-12), 0.0, most)
    return np.asarray((1 + r) / (1 - r), dtype=np.float64)


_PAINT_SIGMA = 0.25  # how far the network's probability of paint is from the coverage
_MIN_SCATTER = 0.01  # least scatter of log grey: quantisation and noise of the best sensor
_SHARED_PIXELS = 20.0  # a side's variance is drawn to that of all sides as if by so many pixels
_CAUCHY = 2.385  # Cauchy's scale for 95 % efficiency (Holland and Welsch, 1977)
_MAX_CORRELATION = 0.7  # of the residuals of neighbouring pixels; beyond it few pixels would settle all


def pixel_weights(
    residual: np.ndarray, use: np.ndarray, lattice: Lattice, least_scatter: float
) -> tuple[np.ndarray, FloatArray, FloatArray]:
    """Weight (M, N) of every pixel, 1 / variance; scatter (M, 4) by side; mean robust weight (M,).

    The robust weight is Cauchy's; the variance is that of a side's own pixels, inflated by the correlation of
    neighbours.
    """
    size = np.abs(residual)
    scale = np.maximum(1.4826 * lattice.median_used(size, use), max(_MIN_SCATTER, least_scatter))
    robust = use / (1 + (size / (_CAUCHY * scale[:, None])) ** 2)
    square = robust * residual * residual
    total, count = square.sum(axis=1), robust.sum(axis=1)
    shared = total / np.maximum(count, 1)
    by_side = np.stack([square, robust], axis=1) @ lattice.of_side.swapaxes(1, 2)
    variance = (by_side[:, 0] + _SHARED_PIXELS * shared[:, None]) / (by_side[:, 1] + _SHARED_PIXELS)
    variance = np.maximum(variance.astype(np.float64), _MIN_SCATTER**2)
    inflation = np.ones(len(residual))
    rows = residual.shape[1] * np.arange(len(residual))[:, None]
    for neighbour in lattice.neighbours.swapaxes(0, 1):
        at = neighbour + rows
        pair = robust * robust.take(at) * (neighbour > 0)
        inflation *= variance_inflation(residual, residual.take(at), pair, _MAX_CORRELATION)
    per_pixel = 1 / (variance * inflation[:, None])
    weight = robust * (per_pixel.astype(np.float32)[:, None] @ lattice.of_side)[:, 0]
    inliers = count / np.maximum(use.sum(axis=1), 1)
    return weight, np.sqrt(variance), inliers.astype(np.float64)


def add_paint(
    information: FloatArray,
    gradient: FloatArray,
    coverage: np.ndarray,
    by_shape: np.ndarray,
    paint: np.ndarray,
    use: np.ndarray,
) -> None:
    """Add that the network's probability of paint (M, N) is the coverage, with Cauchy weights."""
    residual = paint - coverage
    weight = use / (_PAINT_SIGMA**2 * (1 + (residual / (_CAUCHY * _PAINT_SIGMA)) ** 2))
    by_side = by_shape[:, :8]
    weighted = by_side * weight[:, None]
    information[:, :8, :8] += weighted @ by_side.swapaxes(1, 2)
    gradient[:, :8] += (weighted @ residual[..., None])[..., 0]
