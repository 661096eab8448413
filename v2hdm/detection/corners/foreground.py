"""What the network says of each part of an image, as the corner fits ask for it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from v2hdm.records import FloatArray

_MOST_ODDS = 6.0
"""Log odds beyond this differ by chance only."""


@dataclass(frozen=True)
class Foreground:
    """Log odds of paint, ``odds`` (h, w), and which blob owns each: ``owner`` (h, w) 1 + index or 0.

    They are ``stride`` px apart, from image row ``top`` on; element (0, 0) covers stride x stride px.
    """

    odds: np.ndarray
    owner: np.ndarray
    stride: int
    top: int

    def odds_at(self, points_px: FloatArray) -> FloatArray:
        """Log odds of paint, at most 6 either way, at recorded px (..., 2); outside, those of the border."""
        middle = (self.stride - 1) / 2
        u = ((points_px[..., 0] - middle) / self.stride).astype(np.float32).reshape(1, -1)
        v = ((points_px[..., 1] - self.top - middle) / self.stride).astype(np.float32).reshape(1, -1)
        found = cv2.remap(self.odds, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(np.clip(found, -_MOST_ODDS, _MOST_ODDS), np.float64).reshape(points_px.shape[:-1])
