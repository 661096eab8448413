"""Detections drawn over their image, to be looked at."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from v2hdm.records import DIAMOND, LANE_DASH, LANE_LINE, LaneDetection, MarkingDetection

_COLOUR_BGR = {DIAMOND: (60, 200, 60), LANE_DASH: (240, 160, 40), LANE_LINE: (40, 160, 255)}
_OTHER_BGR = (200, 200, 200)
_INVALID_BGR = (60, 60, 230)
_SHIFT = 4


def draw_detections(
    image_bgr: np.ndarray, markings: Sequence[MarkingDetection], lanes: Sequence[LaneDetection]
) -> np.ndarray:
    """A copy of the image with outlines of markings, their corners (red where not valid) and lanes."""
    canvas = image_bgr.copy()
    for lane in lanes:
        colour = _COLOUR_BGR.get(lane.kind, _OTHER_BGR)
        cv2.polylines(canvas, [_fixed(lane.points_px)], False, colour, 1, cv2.LINE_AA, _SHIFT)
        for point in _fixed(lane.points_px):
            cv2.circle(canvas, point.tolist(), 2 << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)
    for marking in markings:
        colour = _COLOUR_BGR.get(marking.kind, _OTHER_BGR)
        corners = _fixed(marking.corners_px)
        cv2.polylines(canvas, [corners], True, colour, 1, cv2.LINE_AA, _SHIFT)
        for corner, valid in zip(corners, marking.corner_valid, strict=True):
            dot = colour if valid else _INVALID_BGR
            cv2.circle(canvas, corner.tolist(), 3 << _SHIFT, dot, 1, cv2.LINE_AA, _SHIFT)
    return canvas


def _fixed(points_px: np.ndarray) -> np.ndarray:
    """Points as OpenCV's fixed-point integers."""
    return np.asarray(np.round(points_px * (1 << _SHIFT)).astype(np.int32))
