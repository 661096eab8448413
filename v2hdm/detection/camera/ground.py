"""Inverse perspective mapping in numpy: pinhole pixels to the ground plane and back.

``vehicle_from_pinhole_px`` is the paper's H: the homography that takes pinhole pixels to the
ground plane z = 0 of the vehicle frame. Its inverse has the columns K [r1 r2 t] of
``cam_from_vehicle`` (Hartley and Zisserman, Multiple View Geometry, 2nd ed., eq. 8.1).
"""

from __future__ import annotations

import numpy as np

from v2hdm.records import CameraInfo, FloatArray


def ipm_from_extrinsic(info: CameraInfo, cam_from_vehicle: FloatArray) -> FloatArray:
    """The IPM ``vehicle_from_pinhole_px`` (3 x 3) of a camera at ``cam_from_vehicle`` (4 x 4)."""
    pinhole_px_from_vehicle = info.intrinsic @ cam_from_vehicle[:3][:, [0, 1, 3]]
    ipm = np.linalg.inv(pinhole_px_from_vehicle)
    return np.asarray(ipm / np.linalg.norm(ipm))


def apply_homography(dst_from_src: FloatArray, points_src: FloatArray) -> FloatArray:
    """Map points (N, 2) by a homography (3 x 3); points at infinity come out as inf or nan."""
    homogeneous = points_src @ dst_from_src.T[:2] + dst_from_src.T[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


def homography_jacobian(dst_from_src: FloatArray, points_src: FloatArray) -> FloatArray:
    """Derivative (N, 2, 2) of :func:`apply_homography` with respect to the points."""
    homogeneous = np.column_stack([points_src, np.ones(len(points_src))]) @ dst_from_src.T
    depth = homogeneous[:, 2][:, None, None]
    mapped = (homogeneous[:, :2] / homogeneous[:, 2:])[:, :, None]
    return np.asarray((dst_from_src[None, :2, :2] - mapped * dst_from_src[2:, :2][None]) / depth)


def extrinsic_from_ipm(info: CameraInfo, ipm: FloatArray, seen_vehicle: FloatArray) -> FloatArray:
    """The ``cam_from_vehicle`` (4 x 4) nearest to an IPM: the inverse of :func:`ipm_from_extrinsic`.

    A homography solved from clicked points is not exactly K [r1 r2 t]; its first two columns are
    scaled to a mean length of one and replaced by the nearest orthonormal pair (Zhang, A flexible
    new technique for camera calibration, 2000, section 3.1 and appendix C).

    Args:
        info: the camera's intrinsics.
        ipm: ``vehicle_from_pinhole_px`` (3 x 3), at any scale.
        seen_vehicle: a ground point (2,) m that lies in front of the camera; it settles the sign.
    """
    columns = np.linalg.inv(info.intrinsic) @ np.linalg.inv(ipm)
    columns = columns / np.mean(np.linalg.norm(columns[:, :2], axis=0))
    if columns[2] @ np.append(seen_vehicle, 1.0) < 0:
        columns = -columns
    left, _, right = np.linalg.svd(np.column_stack([columns[:, :2], np.cross(columns[:, 0], columns[:, 1])]))
    cam_from_vehicle = np.eye(4)
    cam_from_vehicle[:3, :3] = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    cam_from_vehicle[:3, 3] = columns[:, 2]
    return cam_from_vehicle
