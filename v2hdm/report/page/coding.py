"""Pictures as text, as a page holds them."""

from __future__ import annotations

import base64

import cv2
import numpy as np


def jpeg(pixels: np.ndarray, quality: int) -> str:
    """An image (H, W, 3) BGR as JPEG in base64."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    return as_base64(cv2.imencode(".jpg", pixels, options)[1].tobytes())


def as_base64(content: bytes) -> str:
    """Bytes as text."""
    return base64.b64encode(content).decode("ascii")
