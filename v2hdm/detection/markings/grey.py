"""From coded pixels to radiance and its logarithm."""

from __future__ import annotations

import numpy as np

_GREY_WEIGHTS_BGR = (0.114, 0.587, 0.299)
"""Weights of ITU-R BT.601."""

CLIPPED = 250
"""Codes from here on are those of a sensor at its limit, noise and white balance allowed for."""

_DARK = 0.01
"""Added to radiance before taking logarithms: in shade a step is as large as in the sun, noise is not."""

_CODED = np.arange(256) / 255
_LINEAR_FROM_SRGB = np.where(_CODED <= 0.04045, _CODED / 12.92, ((_CODED + 0.055) / 1.055) ** 2.4)
"""Radiance of sRGB codes (IEC 61966-2-1).

Edges fitted to coded values lie outwards of those of a bright marking by about a fifth of the blur.
"""


def linear_bgr(coded: np.ndarray, linear_response: bool) -> np.ndarray:
    """Pixels (..., 3) uint8 in [0, 1], proportional to radiance; float32."""
    table = _CODED if linear_response else _LINEAR_FROM_SRGB
    return np.asarray(table.astype(np.float32)[coded])


def grey_of(bgr: np.ndarray) -> np.ndarray:
    """Grey values (...) of linear pixels (..., 3)."""
    return np.asarray(bgr @ np.array(_GREY_WEIGHTS_BGR, dtype=np.float32))


def log_grey(values: np.ndarray) -> np.ndarray:
    """Logarithms of radiance, float32, in which light and shade differ by a constant."""
    return np.asarray(np.log(np.maximum(values, 0) + np.float32(_DARK)))
