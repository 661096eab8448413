"""Detections drawn over their image, to be looked at."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from v2hdm.records import (
    ARROW,
    CHEVRON,
    CROSSWALK_BAR,
    DIAMOND,
    LANE_BOUNDARY,
    LANE_DASH,
    LANE_LINE,
    STOP_LINE,
    FloatArray,
    LaneDetection,
    MarkingDetection,
)

_COLOUR_BGR = {
    DIAMOND: (60, 200, 60),
    LANE_DASH: (240, 160, 40),
    LANE_LINE: (40, 160, 255),
    LANE_BOUNDARY: (230, 90, 230),
    ARROW: (60, 230, 230),
    STOP_LINE: (120, 120, 255),
    CROSSWALK_BAR: (230, 230, 90),
    CHEVRON: (160, 220, 160),
}
_OTHER_BGR = (200, 200, 200)
_INVALID_BGR = (60, 60, 230)
_SHIFT = 4
_FAR_PX = 30000.0
_TEXT_SCALE, _LEAST_TEXT_SCALE, _FULL_WIDTH_PX = 0.45, 0.35, 1280


def draw_detections(
    image_bgr: np.ndarray, markings: Sequence[MarkingDetection], lanes: Sequence[LaneDetection]
) -> np.ndarray:
    """A copy of the image with the detections on it.

    Markings: outline, corners (red where not valid), class and score. Lanes: the line, its points and, for
    whole lines, which one it is.
    """
    canvas = image_bgr.copy()
    for lane in lanes:
        _draw_lane(canvas, lane)
    for marking in markings:
        _draw_marking(canvas, marking)
    return canvas


def _draw_lane(canvas: np.ndarray, lane: LaneDetection) -> None:
    colour = _COLOUR_BGR.get(lane.kind, _OTHER_BGR)
    points = _fixed(lane.points_px)
    if not len(points):
        return
    cv2.polylines(canvas, [points], False, colour, 1, cv2.LINE_AA, _SHIFT)
    for point in points:
        cv2.circle(canvas, point.tolist(), 2 << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)
    if lane.identity is not None:
        _write(canvas, f"{lane.identity:+d}", lane.points_px[0], colour)


def _draw_marking(canvas: np.ndarray, marking: MarkingDetection) -> None:
    colour = _COLOUR_BGR.get(marking.kind, _OTHER_BGR)
    shape_px = marking.outline_px if len(marking.outline_px) else marking.corners_px
    shape = _fixed(shape_px)
    cv2.polylines(canvas, [shape], True, colour, 1, cv2.LINE_AA, _SHIFT)
    if not len(marking.outline_px):
        for corner, valid in zip(shape, marking.corner_valid, strict=True):
            dot = colour if valid else _INVALID_BGR
            cv2.circle(canvas, corner.tolist(), 3 << _SHIFT, dot, 1, cv2.LINE_AA, _SHIFT)
    right_px = shape_px[np.argmax(shape_px[:, 0])]
    _write(canvas, f"{marking.kind} {marking.score:.2f}", right_px, colour)


def _write(canvas: np.ndarray, text: str, at_px: FloatArray, colour: tuple[int, int, int]) -> None:
    """Text to the right of a point, with a shadow so that it shows on paint."""
    scale = max(_LEAST_TEXT_SCALE, _TEXT_SCALE * min(1.0, canvas.shape[1] / _FULL_WIDTH_PX))
    u, v = (int(c) for c in np.clip(np.nan_to_num(at_px), -_FAR_PX, _FAR_PX))
    for shift, tone in ((1, (0, 0, 0)), (0, colour)):
        at = (u + 6 + shift, v + 4 + shift)
        cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, tone, 1, cv2.LINE_AA)


def _fixed(points_px: FloatArray) -> np.ndarray:
    """Points as OpenCV's fixed-point integers."""
    near = np.clip(np.nan_to_num(points_px), -_FAR_PX, _FAR_PX)
    return np.asarray(np.round(near * (1 << _SHIFT)).astype(np.int32))
