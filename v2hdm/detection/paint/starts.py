"""Where the corner fit of a blob starts: the quadrilateral that covers it best."""

from __future__ import annotations

import cv2
import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.paint.stripe import stripe_of
from v2hdm.geometry.ipm import apply_homography
from v2hdm.geometry.quadrilateral import order_corners, quad_from_hull
from v2hdm.records import CROSSWALK_BAR, LANE_DASH, STOP_LINE, FloatArray

_RECTANGLES = (LANE_DASH, STOP_LINE, CROSSWALK_BAR)
"""What is painted as a rectangle. The hull of a bar a few px wide says little of its corners, its direction
on the ground says much."""

_LEAST_STRIPE_PX = 48.0
_WELL_FILLED = 0.9
_LEAST_OF_STRIPE = 0.6
_MUCH_SLIMMER = 0.87
"""What is so large and fills less than this of its hull may be a stripe to which something sticks: one that
shows its sides over most of its length, and is much slimmer than what is around all."""


def starting_corners(
    kind: str, outline_pinhole_px: FloatArray, outline_vehicle: FloatArray, paint_px2: float, view: CameraView
) -> tuple[FloatArray, float] | None:
    """Corners (4, 2), pinhole px, around the outline (N, 2) of a marking, and how much of them it fills.

    Args:
        kind: its class.
        outline_pinhole_px: (N, 2) in the image.
        outline_vehicle: (N, 2) on the ground, m.
        paint_px2: the area of what it encloses, px^2.
        view: the camera.

    Returns:
        The tighter of the quadrilateral around the hull and, for rectangles, the rectangle on the ground,
        with the share of it that the hull fills. Of rectangles whose paint fills little of the hull it is
        the stripe that most of the outline is of, with the share that shows its sides. None where there is
        neither. It need not be convex where a rectangle reaches behind the camera.
    """
    first = outline_pinhole_px[0]
    points = (outline_pinhole_px - first).astype(np.float32)
    outermost = cv2.convexHull(points, returnPoints=False)[:, 0]
    hull = points[outermost, None]
    hull_px2 = cv2.contourArea(hull)
    quad = quad_from_hull(hull)
    candidates = [None if quad is None else quad + first]
    if kind in _RECTANGLES and np.isfinite(outline_vehicle).all():
        # All before the camera, so that what is outermost in the image is so on the ground.
        candidates.append(_ground_rectangle(outline_vehicle[outermost], view))
    best: tuple[FloatArray, float] | None = None
    for corners in candidates:
        if corners is None:
            continue
        share = hull_px2 / max(_area_px2(corners), 1e-6)
        if best is None or share > best[1]:
            best = corners, share
    large = float(np.ptp(points, axis=0).max()) >= _LEAST_STRIPE_PX
    if best is not None and kind in _RECTANGLES and large and paint_px2 < _WELL_FILLED * hull_px2:
        stripe = stripe_of(outline_pinhole_px, view)
        slimmer = stripe is not None and _area_px2(stripe[0]) < _MUCH_SLIMMER * _area_px2(best[0])
        if stripe is not None and slimmer and stripe[1] > _LEAST_OF_STRIPE:
            return stripe
    return best


def _area_px2(corners: FloatArray) -> float:
    return float(cv2.contourArea(corners.astype(np.float32)))


def _ground_rectangle(outline_vehicle: FloatArray, view: CameraView) -> FloatArray | None:
    """The smallest rectangle on the ground around an outline (N, 2), m, as corners (4, 2) in pinhole px."""
    if len(outline_vehicle) < 3:
        return None
    centre = outline_vehicle.mean(axis=0)
    box = cv2.boxPoints(cv2.minAreaRect((outline_vehicle - centre).astype(np.float32)))
    corners = apply_homography(view.pinhole_px_from_vehicle, box.astype(np.float64) + centre)
    return order_corners(corners) if np.isfinite(corners).all() else None
