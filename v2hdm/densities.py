"""Densities of distributions, without scipy.stats, which takes every process a second to load."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import betaln, poch, xlog1py, xlogy

from v2hdm.records import FloatArray


def normal_density(
    value: FloatArray | float, mean: FloatArray | float, sigma: FloatArray | float
) -> FloatArray:
    """Density at values of a normal distribution; ``sigma`` is above 0."""
    off = (np.asarray(value, float) - mean) / sigma
    return np.asarray(np.exp(-(off**2) / 2) / math.sqrt(2 * math.pi) / sigma)


def log_normal_density(
    value: FloatArray | float, mean: FloatArray | float, sigma: FloatArray | float
) -> FloatArray:
    """Logarithm of a normal distribution's density at values; ``sigma`` is above 0."""
    off = (np.asarray(value, float) - mean) / sigma
    return np.asarray(-(off**2) / 2 - math.log(math.sqrt(2 * math.pi)) - np.log(sigma))


def log_student_density(
    value: FloatArray | float, freedom: float, mean: FloatArray | float, scale: FloatArray | float
) -> FloatArray:
    """Logarithm of the density at values of Student's t distribution, shifted by ``mean`` and scaled."""
    off = (np.asarray(value, float) - mean) / scale
    at_mean = math.log(poch(freedom / 2, 0.5)) - (math.log(freedom) + math.log(math.pi)) / 2
    return np.asarray(at_mean - (freedom + 1) / 2 * np.log1p(off * off / freedom) - np.log(scale))


def log_beta_density(share: FloatArray | float, a: float, b: float) -> FloatArray:
    """Logarithm of the density at shares, 0 to 1, of a beta distribution with parameters ``a`` and ``b``."""
    share = np.asarray(share, float)
    return np.asarray(xlog1py(b - 1, -share) + xlogy(a - 1, share) - betaln(a, b))
