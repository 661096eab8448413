"""The normal distribution over arrays, without scipy."""

from __future__ import annotations

import numpy as np

_INV_SQRT_2PI = 0.3989422804014327


def normal_pdf_cdf(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Density and cumulative distribution of the standard normal, to 1e-5, in the type of ``x``.

    Abramowitz and Stegun, Handbook of Mathematical Functions, 26.2.16.
    """
    kind = x.dtype.type
    density = np.exp(kind(-0.5) * x * x)
    density *= kind(_INV_SQRT_2PI)
    t = kind(1) / (kind(1) + kind(0.33267) * np.abs(x))
    tail = density * t * (kind(0.4361836) + t * (kind(-0.1201676) + t * kind(0.9372980)))
    return density, np.where(x > 0, kind(1) - tail, tail)
