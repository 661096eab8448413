"""Lens distortion in numpy: recorded pixels to pinhole pixels and back.

The three models are those of ROS ``camera_info``: ``plumb_bob`` and ``rational_polynomial``
(Brown-Conrady, OpenCV's ``calib3d``) and ``equidistant`` (Kannala-Brandt, OpenCV's ``fisheye``).
"""

from __future__ import annotations

import cv2
import numpy as np

from v2hdm.native import kernels
from v2hdm.records import CameraInfo, FloatArray

# OpenCV's default of 5 iterations errs by 0.16 px and more near the image corners.
_UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)


def has_distortion(info: CameraInfo) -> bool:
    """Whether ``info`` departs from a pinhole."""
    return info.distortion_model == "equidistant" or any(info.distortion)


def undistort_points(info: CameraInfo, points_px: FloatArray) -> FloatArray:
    """Recorded pixels (N, 2) to pinhole pixels (N, 2) of the same intrinsic matrix."""
    points = np.ascontiguousarray(points_px, dtype=np.float64).reshape(-1, 1, 2)
    if points.size == 0 or not has_distortion(info):
        return points.reshape(-1, 2).copy()
    coefficients = np.asarray(info.distortion, dtype=np.float64)
    model = cv2.fisheye if info.distortion_model == "equidistant" else cv2
    k = info.intrinsic
    out = model.undistortPoints(points, k, coefficients, P=k, criteria=_UNDISTORT_CRITERIA)
    return np.asarray(out, dtype=np.float64).reshape(-1, 2)


def distort_points(info: CameraInfo, points_pinhole_px: FloatArray) -> FloatArray:
    """Pinhole pixels (N, 2) to recorded pixels (N, 2): the inverse of :func:`undistort_points`."""
    points = np.ascontiguousarray(points_pinhole_px, dtype=np.float64).reshape(-1, 2)
    if points.size == 0 or not has_distortion(info):
        return points.copy()
    if info.distortion_model == "equidistant":
        rays = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(info.intrinsic).T
        coefficients = np.asarray(info.distortion, dtype=np.float64)
        out = cv2.fisheye.distortPoints(rays[:, None, :2].copy(), info.intrinsic, coefficients)
        return np.asarray(out, dtype=np.float64).reshape(-1, 2)
    return _brown_conrady(info, points)


def distort_jacobian(info: CameraInfo, points_pinhole_px: FloatArray) -> FloatArray:
    """Derivative (N, 2, 2) of :func:`distort_points`, by central differences over one pixel."""
    steps = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    moved = distort_points(info, (points_pinhole_px[:, None] + steps).reshape(-1, 2)).reshape(-1, 4, 2)
    return np.stack([moved[:, 0] - moved[:, 1], moved[:, 2] - moved[:, 3]], axis=2)


def _brown_conrady(info: CameraInfo, points_pinhole_px: FloatArray) -> FloatArray:
    """Recorded pixels (N, 2) by OpenCV's ``calib3d`` model of up to eight coefficients; skew is in K alone.

    OpenCV's own function also computes derivatives, which takes several times as long.
    """
    coefficients = (*info.distortion, *(0.0,) * (8 - len(info.distortion)))
    compiled = kernels()
    if compiled is not None:
        points_px = points_pinhole_px.copy()
        compiled.distort(points_px, info.intrinsic, np.array(coefficients, dtype=np.float64))
        return points_px
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    (fx, skew, cx), (_, fy, cy), _ = info.intrinsic
    y = (points_pinhole_px[:, 1] - cy) / fy
    x = (points_pinhole_px[:, 0] - cx - skew * y) / fx
    xy = x * y
    xx = x * x
    yy = y * y
    r2 = xx + yy
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if k4 or k5 or k6:
        radial /= 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    u = x * radial + 2 * p1 * xy + p2 * (r2 + 2 * xx)
    v = y * radial + p1 * (r2 + 2 * yy) + 2 * p2 * xy
    return np.column_stack([fx * u + cx, fy * v + cy])
