"""One image file as the detector takes it, or a reason why not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from v2hdm.errors import DriveError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
"""What counts as an image in a folder."""

# Depth and channels as stored, so that what does not fit is seen instead of converted without a word.
_AS_STORED = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR


def read_bgr(path: Path) -> np.ndarray:
    """Decode an image file, in colour or grey, to (H, W, 3) uint8 BGR.

    Raises:
        DriveError: the file is missing, truncated or not of 8 bits.
    """
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise DriveError(
            f"{path}: cannot read this image ({error.strerror}); restore it or drop it from the list"
        ) from error
    pixels = cv2.imdecode(data, _AS_STORED) if _is_whole(data) else None
    if pixels is None:
        raise DriveError(f"{path}: the image is truncated or damaged; copy it again or drop it from the list")
    if pixels.dtype != np.uint8:
        raise DriveError(
            f"{path}: the image has {8 * pixels.dtype.itemsize} bits a channel; convert it to 8 bits"
        )
    if pixels.ndim == 2:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    return np.asarray(pixels)


def _is_whole(data: np.ndarray) -> bool:
    """Whether a JPEG or PNG has its end marker.

    OpenCV decodes a truncated file to half an image without a word.
    """
    tail = data[-4096:].tobytes()
    if data[:2].tobytes() == b"\xff\xd8":
        return b"\xff\xd9" in tail
    if data[:4].tobytes() == b"\x89PNG":
        return b"IEND" in tail
    return len(data) > 0
