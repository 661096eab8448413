"""How much every pixel counts in a fit.

A pixel counts by Cauchy's weight over the variance of the side that is nearest. Neighbouring pixels err
alike, along a seam or a frayed edge; their variances are inflated by as much.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from v2hdm.detection.quads.lattice import Lattice
from v2hdm.records import SIGMA_OF_MAD, FloatArray

_PAINT_SIGMA = 0.25  # how far the network's probability of paint is from the coverage
_MIN_SCATTER = 0.01  # least scatter of log grey: quantisation and noise of the best sensor
_SHARED_PIXELS = 20.0  # a side's variance is drawn to that of all sides as if by so many pixels
_CAUCHY = 2.385  # Cauchy's scale for 95 % efficiency (Holland and Welsch, 1977)
_MAX_CORRELATION = 0.7  # largest correlation of neighbouring residuals: beyond it few pixels would settle all

RULES = {
    "sigma_of_mad": SIGMA_OF_MAD,
    "min_scatter": _MIN_SCATTER,
    "shared_pixels": _SHARED_PIXELS,
    "cauchy": _CAUCHY,
    "max_correlation": _MAX_CORRELATION,
    "paint_sigma": _PAINT_SIGMA,
}
"""The constants of this module, for the compiled kernel."""


def variance_inflation(first: np.ndarray, second: np.ndarray, weight: np.ndarray, most: float) -> FloatArray:
    """Factor (...) by which a fit's variance grows if residuals (..., N) correlate with their neighbours.

    That is (1 + r) / (1 - r), as of a first-order autoregressive process (Bartlett, Journal of the Royal
    Statistical Society, 1946); pairs have a ``weight`` (..., N), and r is between 0 and ``most``.
    """
    power = (weight * (first * first + second * second)).sum(axis=-1) / 2
    r = np.clip((weight * first * second).sum(axis=-1) / np.maximum(power, 1e-12), 0.0, most)
    return np.asarray((1 + r) / (1 - r), dtype=np.float64)


class PixelWeights(NamedTuple):
    """How much the pixels of M markings count."""

    weight: np.ndarray  # (M, N) Cauchy's weight of every pixel over its side's inflated variance
    scatter: FloatArray  # (M, 4) standard deviation of log grey by side
    inliers: FloatArray  # (M,) mean of Cauchy's weights


def pixel_weights(
    residual: np.ndarray, use: np.ndarray, lattice: Lattice, least_scatter: float
) -> PixelWeights:
    """Weights by residuals (M, N) of log grey, where pixels are of ``use`` (M, N)."""
    size = np.abs(residual)
    scale = np.maximum(SIGMA_OF_MAD * lattice.median_used(size, use), max(_MIN_SCATTER, least_scatter))
    robust = use / (1 + (size / (_CAUCHY * scale[:, None])) ** 2)
    square = robust * residual * residual
    total = square.sum(axis=1)
    count = robust.sum(axis=1)
    shared = total / np.maximum(count, 1)
    by_side = np.stack([square, robust], axis=1) @ lattice.of_side.swapaxes(1, 2)
    variance = (by_side[:, 0] + _SHARED_PIXELS * shared[:, None]) / (by_side[:, 1] + _SHARED_PIXELS)
    variance = np.maximum(variance.astype(np.float64), _MIN_SCATTER**2)
    inflation = np.ones(len(residual))
    first_of_marking = residual.shape[1] * np.arange(len(residual))[:, None]
    for neighbour in lattice.neighbours.swapaxes(0, 1):
        flat = neighbour + first_of_marking
        pair_weight = robust * robust.take(flat) * (neighbour > 0)
        inflation *= variance_inflation(residual, residual.take(flat), pair_weight, _MAX_CORRELATION)
    per_pixel = 1 / (variance * inflation[:, None])
    weight = robust * (per_pixel.astype(np.float32)[:, None] @ lattice.of_side)[:, 0]
    inliers = (count / np.maximum(use.sum(axis=1), 1)).astype(np.float64)
    return PixelWeights(weight, np.sqrt(variance), inliers)


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
