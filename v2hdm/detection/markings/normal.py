"""The normal distribution over arrays, without scipy."""

from __future__ import annotations

import cv2
import numpy as np

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
