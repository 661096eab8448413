"""Lens distortion in numpy: recorded pixels to pinhole pixels and back.

The three models are those of ROS ``camera_info``: ``plumb_bob`` and ``rational_polynomial``
(Brown-Conrady, OpenCV's ``calib3d``) and ``equidistant`` (Kannala-Brandt, OpenCV's ``fisheye``).
"""

from __future__ import annotations

import cv2
import numpy as np

from v2hdm.records import CameraInfo, FloatArray

# OpenCV's default of 5 iterations errs by 0.16 px and more near the image corners.
_UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)


def has_distortion(info: CameraInfo) -> bool:
    """Whether the lens of ``info`` departs from a pinhole at all."""
    return info.distortion_model == "equidistant" or any(info.distortion)


def undistort_points(info: CameraInfo, points_px: FloatArray) -> FloatArray:
    """Recorded pixels (N, 2) to pinhole pixels (N, 2) of the same intrinsic matrix."""
    points = np.ascontiguousarray(points_px, dtype=np.float64).reshape(-1, 1, 2)
    if points.size == 0 or not has_distortion(info):
        return points.reshape(-1, 2).copy()
    coefficients = np.asarray(info.distortion, dtype=np.float64)
    if info.distortion_model == "equidistant":
        out = cv2.fisheye.undistortPoints(
            points, info.intrinsic, coefficients, P=info.intrinsic, criteria=_UNDISTORT_CRITERIA
        )
    else:
        out = cv2.undistortPoints(
            points, info.intrinsic, coefficients, P=info.intrinsic, criteria=_UNDISTORT_CRITERIA
        )
    return np.asarray(out, dtype=np.float64).reshape(-1, 2)


def distort_points(info: CameraInfo, points_pinhole_px: FloatArray) -> FloatArray:
    """Pinhole pixels (N, 2) to recorded pixels (N, 2): the inverse of :func:`undistort_points`."""
    points = np.ascontiguousarray(points_pinhole_px, dtype=np.float64).reshape(-1, 2)
    if points.size == 0 or not has_distortion(info):
        return points.copy()
    rays = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(info.intrinsic).T
    coefficients = np.asarray(info.distortion, dtype=np.float64)
    if info.distortion_model == "equidistant":
        out = cv2.fisheye.distortPoints(rays[:, None, :2].copy(), info.intrinsic, coefficients)
    else:
        out, _ = cv2.projectPoints(rays[:, None, :], np.zeros(3), np.zeros(3), info.intrinsic, coefficients)
    return np.asarray(out, dtype=np.float64).reshape(-1, 2)
