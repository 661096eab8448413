"""One image file as the detector takes it, or a reason why not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.safe.pixels import read_pixels

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
"""What counts as an image in a folder."""

# Depth and channels as stored, so that what does not fit is seen instead of converted without a word.
_AS_STORED = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR


def read_bgr(path: Path) -> np.ndarray:
    """Decode an image file, in colour or grey, to (H, W, 3) uint8 BGR.

    Raises:
        DriveError: the file is missing, truncated, damaged or not of 8 bits.
    """
    pixels = read_pixels(path, _AS_STORED)
    if pixels.dtype != np.uint8:
        raise DriveError(
            f"{path}: the image has {8 * pixels.dtype.itemsize} bits a channel; convert it to 8 bits"
        )
    if pixels.ndim == 2:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    return np.asarray(pixels)
