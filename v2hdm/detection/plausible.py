"""What a blob can be, judged by its size on the ground.

The initial IPM may be decimetres wrong, so sizes only rule out what is far off.
"""

from __future__ import annotations

import cv2
import numpy as np

from v2hdm.detection.blobs import Blob
from v2hdm.detection.view import CameraView
from v2hdm.records import DIAMOND, LANE_DASH, LANE_LINE, FloatArray

_SIZE_LIMITS_M: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    DIAMOND: ((0.15, 5.0), (0.1, 3.0)),
    LANE_DASH: ((0.3, 12.0), (0.03, 0.8)),
    LANE_LINE: ((0.3, np.inf), (0.03, 4.0)),
}
"""Least and largest length and width of each class. A line's box is wide where the line bends."""


def plausible_kind(blob: Blob, outline_pinhole_px: FloatArray, view: CameraView) -> tuple[str, float] | None:
    """The likeliest class that the blob's size on the ground allows, with its score; None for other paint.

    Args:
        blob: the blob.
        outline_pinhole_px: its outline (N, 2).
        view: its camera.
    """
    length_m, width_m = _ground_size(view.ground(outline_pinhole_px))
    if not np.isfinite(length_m):
        return None
    kinds = sorted(blob.class_score, key=blob.class_score.__getitem__, reverse=True)
    if kinds[0] not in _SIZE_LIMITS_M:
        return None
    # Runners-up are considered only between classes that look alike.
    for kind in kinds[:2]:
        limits = _SIZE_LIMITS_M.get(kind)
        if limits and limits[0][0] <= length_m <= limits[0][1] and limits[1][0] <= width_m <= limits[1][1]:
            return kind, blob.class_score[kind]
    return None


def _ground_size(outline_vehicle: FloatArray) -> tuple[float, float]:
    """Length and width (m) of the smallest rectangle around the points on the ground (N, 2)."""
    points = outline_vehicle[np.isfinite(outline_vehicle).all(axis=1)]
    if len(points) < 3:
        return np.nan, np.nan
    _, size, _ = cv2.minAreaRect(points.astype(np.float32))
    return float(max(size)), float(min(size))
