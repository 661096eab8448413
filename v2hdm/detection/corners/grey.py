"""The band of an image in linear grey values, and how to look grey values up."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import cv2
import numpy as np

_GREY_WEIGHTS_BGR = (0.114, 0.587, 0.299)
_CLIPPED = 250
"""Codes from here on are those of a sensor at its limit, noise and white balance allowed for."""

_DARK = 0.01
"""Added to grey values before taking logarithms: in shade a step is as large as in the sun, noise is not."""

_SUM = np.ones((1, 3), dtype=np.float32)
_CODED = np.arange(256) / 255
_LINEAR_FROM_SRGB = np.where(_CODED <= 0.04045, _CODED / 12.92, ((_CODED + 0.055) / 1.055) ** 2.4)


def log_grey(values: np.ndarray) -> np.ndarray:
    """Logarithms of linear grey values, float32, in which light and shade differ by a constant."""
    return np.asarray(np.log(np.maximum(values, 0) + np.float32(_DARK)))


@dataclass(frozen=True)
class GreyBand:
    """Linear grey ``values`` (h, w) float32 of the image rows from ``top`` on.

    NaN where it was not looked at, +inf where the sensor was at its limit and the true value is unknown;
    ``clipped`` says whether there is any of that.
    """

    values: np.ndarray
    top: int
    clipped: bool

    @cached_property
    def at_limit(self) -> GreyBand:
        """The same with the sensor's limit where it was reached, so that edges seem farther outside."""
        if not self.clipped:
            return self
        return GreyBand(np.minimum(self.values, np.float32(1)), self.top, False)

    def sample(self, points_px: np.ndarray) -> np.ndarray:
        """Bilinear look-up at recorded pixels (n, m, 2); not finite where one of the four pixels is not.

        The result is (n, m) float32.
        """
        u = points_px[..., 0].astype(np.float32)
        v = (points_px[..., 1] - self.top).astype(np.float32)
        return np.asarray(
            cv2.remap(self.values, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
        )


def linear_grey(
    image_bgr: np.ndarray, top: int, bottom: int, boxes: np.ndarray, linear_response: bool
) -> GreyBand:
    """Rows ``top`` to ``bottom`` of an image (H, W, 3) uint8 as grey in [0, 1], proportional to radiance.

    Only the ``boxes`` (M, 4) of left, top, right, bottom in px, the last two exclusive, are converted,
    and what lies outside all of them is NaN: markings cover a small part of the image. sRGB coding is
    undone unless ``linear_response``: fitting edges on coded values pushes each side of a bright
    marking outwards by about a fifth of the blur. Clipped values do the same, by up to the whole blur.
    """
    table = _table(linear_response)
    values = np.full((bottom - top, image_bgr.shape[1]), np.nan, dtype=np.float32)
    low = np.maximum(boxes[:, :2], [0, top])
    high = np.minimum(boxes[:, 2:], [image_bgr.shape[1], bottom])
    clipped = False
    for (left, first), (right, last) in zip(low.tolist(), high.tolist(), strict=True):
        if left < right and first < last:
            grey = cv2.transform(cv2.LUT(image_bgr[first:last, left:right], table), _SUM)
            values[first - top : last - top, left:right] = grey
            clipped |= bool(grey.max() > 1)
    return GreyBand(values, top, clipped)


def linear_bgr(coded: np.ndarray, linear_response: bool) -> np.ndarray:
    """Pixels (..., 3) uint8 in [0, 1], proportional to radiance; float32."""
    return np.asarray(_linear(linear_response)[coded], dtype=np.float32)


def grey_of(bgr: np.ndarray) -> np.ndarray:
    """Grey values (...) of linear pixels (..., 3)."""
    return np.asarray(bgr @ np.array(_GREY_WEIGHTS_BGR, dtype=np.float32))


def _linear(linear_response: bool) -> np.ndarray:
    """Radiance (256,) in [0, 1] of each byte."""
    return np.asarray(_CODED if linear_response else _LINEAR_FROM_SRGB)


@cache
def _table(linear_response: bool) -> np.ndarray:
    """What each channel's byte adds to the grey value (1, 256, 3)."""
    table = np.where(np.arange(256) >= _CLIPPED, np.inf, _linear(linear_response))
    return np.asarray(table[None, :, None] * _GREY_WEIGHTS_BGR, dtype=np.float32)
