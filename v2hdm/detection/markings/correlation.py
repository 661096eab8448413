"""What correlated residuals do to the variance of a fit."""

from __future__ import annotations

import numpy as np

from v2hdm.records import FloatArray


def variance_inflation(first: np.ndarray, second: np.ndarray, weight: np.ndarray, most: float) -> FloatArray:
    """Factor (...) by which a fit's variance grows if its residuals are correlated: (1 + r) / (1 - r).

    That is what a first-order autoregressive process with correlation r does to the variance of a mean
    (Bartlett, Journal of the Royal Statistical Society, 1946).

    Args:
        first: residuals (..., N).
        second: those of their neighbours (..., N).
        weight: what each pair counts (..., N).
        most: r is taken to lie between 0 and this.
    """
    power = (weight * (first * first + second * second)).sum(axis=-1) / 2
    r = np.clip((weight * first * second).sum(axis=-1) / np.maximum(power, 1e-12), 0.0, most)
    return np.asarray((1 + r) / (1 - r), dtype=np.float64)
