"""The vehicle's ground as a plane in a camera: what a camera's images of bare ground show of its mounting."""

from __future__ import annotations

import numpy as np

from v2hdm.geometry.rigid import hat
from v2hdm.records import FloatArray


def plane_in(cam_from_vehicle: FloatArray) -> FloatArray:
    """The vehicle's ground in a camera (4,): its normal, upwards, and the camera's height above it, m."""
    normal = cam_from_vehicle[:3, 2]
    return np.append(normal, -normal @ cam_from_vehicle[:3, 3])


def by_tangent(cam_from_vehicle: FloatArray) -> FloatArray:
    """Derivative (4, 6) of :func:`plane_in` by the left tangent of the extrinsic."""
    normal = cam_from_vehicle[:3, 2]
    out = np.zeros((4, 6))
    out[:3, 3:] = -hat(normal)
    out[3, :3] = -normal
    return out
