"""Pixels as files without loss."""

from __future__ import annotations

import cv2
import numpy as np

_QUICK = (cv2.IMWRITE_PNG_COMPRESSION, 1)


def png(pixels: np.ndarray) -> bytes:
    """The PNG file of an image, (H, W) or (H, W, 3) BGR uint8, quick rather than small."""
    done, data = cv2.imencode(".png", pixels, _QUICK)
    assert done
    return data.tobytes()
