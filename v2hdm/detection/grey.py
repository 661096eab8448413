"""The band of an image in linear grey values, and how to look grey values up."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

_GREY_WEIGHTS_BGR = (0.114, 0.587, 0.299)
_CODED = np.arange(256) / 255
_LINEAR_FROM_SRGB = np.where(_CODED <= 0.04045, _CODED / 12.92, ((_CODED + 0.055) / 1.055) ** 2.4)


@dataclass(frozen=True)
class GreyBand:
    """Linear grey ``values`` (h, w) float32 of the image rows from ``top`` on."""

    values: np.ndarray
    top: int

    def sample(self, points_px: np.ndarray) -> np.ndarray:
        """Bilinear look-up at recorded pixels (n, m, 2); NaN outside the band. Result (n, m) float32."""
        u = points_px[..., 0].astype(np.float32)
        v = (points_px[..., 1] - self.top).astype(np.float32)
        return np.asarray(
            cv2.remap(self.values, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
        )


def linear_grey(image_bgr: np.ndarray, top: int, bottom: int, linear_response: bool) -> GreyBand:
    """Rows ``top`` to ``bottom`` of an image (H, W, 3) uint8 as grey in [0, 1], proportional to radiance.

    sRGB coding is undone unless ``linear_response``: fitting edges on coded values pushes each side
    of a bright marking outwards by about a fifth of the blur.
    """
    table = _CODED if linear_response else _LINEAR_FROM_SRGB
    rows = image_bgr[top:bottom]
    values = np.zeros(rows.shape[:2], dtype=np.float32)
    for channel, weight in enumerate(_GREY_WEIGHTS_BGR):
        values += cv2.LUT(cv2.extractChannel(rows, channel), (weight * table).astype(np.float32))
    return GreyBand(values, top)
