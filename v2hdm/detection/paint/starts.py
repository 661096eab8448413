"""Where the corner fit of a blob starts: the quadrilateral that covers it best."""

from __future__ import annotations

import cv2
import numpy as np

from v2hdm.detection.camera.ground import apply_homography
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.quad import order_corners, quad_from_hull
from v2hdm.records import CROSSWALK_BAR, LANE_DASH, STOP_LINE, FloatArray

_RECTANGLES = (LANE_DASH, STOP_LINE, CROSSWALK_BAR)
"""What is painted as a rectangle. The hull of a bar a few px wide says little of its corners, its direction
on the ground says much."""


def starting_corners(
    kind: str, outline_pinhole_px: FloatArray, outline_vehicle: FloatArray, view: CameraView
) -> tuple[FloatArray, float] | None:
    """Corners (4, 2), pinhole px, around the outline (N, 2) of a marking, and how much of them it fills.

    Returns:
        The tighter of the quadrilateral around the hull and, for rectangles, the rectangle on the ground,
        with the share of it that the hull fills; None where there is neither. It need not be convex where
        a rectangle reaches behind the camera.
    """
    first = outline_pinhole_px[0]
    points = (outline_pinhole_px - first).astype(np.float32)
    outermost = cv2.convexHull(points, returnPoints=False)[:, 0]
    hull = points[outermost, None]
    quad = quad_from_hull(hull)
    candidates = [None if quad is None else quad + first]
    if kind in _RECTANGLES and np.isfinite(outline_vehicle).all():
        # All before the camera, so that what is outermost in the image is so on the ground.
        candidates.append(_ground_rectangle(outline_vehicle[outermost], view))
    best: tuple[FloatArray, float] | None = None
    for corners in candidates:
        if corners is None:
            continue
        share = cv2.contourArea(hull) / max(cv2.contourArea(corners.astype(np.float32)), 1e-6)
        if best is None or share > best[1]:
            best = corners, share
    return best


def _ground_rectangle(outline_vehicle: FloatArray, view: CameraView) -> FloatArray | None:
    """The smallest rectangle on the ground around an outline (N, 2), m, as corners (4, 2) in pinhole px."""
    if len(outline_vehicle) < 3:
        return None
    centre = outline_vehicle.mean(axis=0)
    box = cv2.boxPoints(cv2.minAreaRect((outline_vehicle - centre).astype(np.float32)))
    corners = apply_homography(view.pinhole_px_from_vehicle, box.astype(np.float64) + centre)
    return order_corners(corners) if np.isfinite(corners).all() else None
