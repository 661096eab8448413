"""How much each pixel counts in a fit: Cauchy's weights, and a variance for each side of its own.

Neighbouring pixels err alike, along a seam or a frayed edge; their variances are inflated by as much.
"""

from __future__ import annotations

import numpy as np

from v2hdm.detection.markings.correlation import variance_inflation
from v2hdm.detection.markings.lattice import Lattice
from v2hdm.records import FloatArray

_PAINT_SIGMA = 0.25
"""How far the network's probability of paint is from the coverage."""

_MIN_SCATTER = 0.01
"""Least scatter of log grey: quantisation and noise of the best sensor."""

_SHARED_PIXELS = 20.0
"""A side's variance is drawn to that of all sides as if by so many pixels."""

_CAUCHY = 2.385
"""Cauchy's scale for 95 % efficiency (Holland and Welsch, 1977)."""

_MAX_CORRELATION = 0.7
"""Of the residuals of neighbouring pixels; beyond it few pixels would settle all."""


def pixel_weights(
    residual: np.ndarray, use: np.ndarray, lattice: Lattice, least_scatter: float
) -> tuple[np.ndarray, FloatArray, FloatArray]:
    """What every pixel (M, N) weighs, 1 / variance; the scatter (M, 4) by side; the mean robust weight (M,).

    The robust weight is Cauchy's; the variance is that of a side's own pixels, inflated by the correlation of
    neighbours.
    """
    size = np.abs(residual)
    scale = np.maximum(1.4826 * lattice.median_used(size, use), max(_MIN_SCATTER, least_scatter))
    robust = use / (1 + (size / (_CAUCHY * scale[:, None])) ** 2)
    square = robust * residual * residual
    total, count = square.sum(axis=1), robust.sum(axis=1)
    shared = total / np.maximum(count, 1)
    by_side = np.stack([square, robust], axis=1) @ lattice.of_side
    variance = (by_side[:, 0] + _SHARED_PIXELS * shared[:, None]) / (by_side[:, 1] + _SHARED_PIXELS)
    variance = np.maximum(variance.astype(np.float64), _MIN_SCATTER**2)
    inflation = np.ones(len(residual))
    rows = np.arange(len(residual))[:, None]
    for neighbour in lattice.neighbours:
        pair = robust * robust[rows, neighbour] * (neighbour > 0)
        inflation *= variance_inflation(residual, residual[rows, neighbour], pair, _MAX_CORRELATION)
    per_pixel = 1 / (variance * inflation[:, None])
    weight = robust * (per_pixel.astype(np.float32)[:, None] @ lattice.of_side.swapaxes(1, 2))[:, 0]
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
