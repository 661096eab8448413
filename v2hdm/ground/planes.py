"""The plane of the ground in a camera: what bare ground tells the adjustment of a mounting."""

from __future__ import annotations

import numpy as np

from v2hdm.geometry.ground_plane import by_tangent, plane_in
from v2hdm.records import Calibration, FloatArray, GroundPlane

_HEIGHT_SHARE = 0.015
"""Standard deviation of a height, relative to it, by what no match shows, such as errors of a lens within a
pixel: heights were 1.4 % low on KITTI 0011, against markings and survey, and 2.7 +- 1.6 % on PandaSet 002,
against its lidar."""


def plane_of(calibration: Calibration, by_lens: FloatArray) -> GroundPlane | None:
    """The plane under a mounting, with its information; ``by_lens`` (2, 6) are the mounting's tangents.

    Yaw and place of the mounting rest on the recorded poses and the survey, and are left to these. None
    without a covariance.
    """
    matrix = calibration.cam_from_vehicle
    if calibration.covariance is None:
        return None
    plane = plane_in(matrix)
    slope = by_tangent(matrix)
    # Two directions across the normal, and the height: a normal has no length to err in.
    across = np.linalg.svd(plane[None, :3])[2][1:]
    axes = np.zeros((3, 4))
    axes[:2, :3] = across
    axes[2, 3] = 1.0
    covariance = axes @ slope @ calibration.covariance @ slope.T @ axes.T
    covariance[2, 2] += (_HEIGHT_SHARE * plane[3]) ** 2
    root = np.linalg.inv(np.linalg.cholesky(covariance)) @ axes
    return GroundPlane(plane, root, by_lens @ slope.T)
