"""Image points on the ground in metres, with the covariance that pixels and calibration leave them."""

from __future__ import annotations

import numpy as np

from v2hdm.detection.view import CameraView
from v2hdm.records import Calibration, FloatArray


class Footprint:
    """Takes recorded pixels of one calibrated camera to the ground plane z = 0 of the vehicle.

    A pinhole pixel shows the ground point X where ``px(cam_from_vehicle X)`` equals it. Perturbing the pixel
    and, on the left, the transform, and holding that equality, gives ``dX = B (dpx - P [I | -[p]x] dxi)``,
    where ``P`` is the derivative of the projection at the camera point ``p`` and ``B`` the inverse of that
    along the ground.
    What is not in the covariance: how the vehicle's body pitches and rolls on its suspension, and that no
    road is a plane.

    Args:
        view: the camera.
        calibration: where it sits, and how well that is known; without covariance it counts as exact.
    """

    def __init__(self, view: CameraView, calibration: Calibration):
        self._view = view
        self._intrinsic = calibration.info.intrinsic
        self._cam_from_vehicle = calibration.cam_from_vehicle
        self._covariance = np.zeros((6, 6)) if calibration.covariance is None else calibration.covariance

    def polygon(self, points_px: FloatArray, covariance_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points whose errors hang together.

        Args:
            points_px: (N, 2).
            covariance_px: (2N, 2N) of the stacked points (u0, v0, u1, ...).

        Returns:
            The points (N, 2), m, vehicle frame, and their covariance (2N, 2N), m^2, likewise stacked; nan
            where a point is not on the ground.
        """
        points_vehicle, by_px, by_mounting = self._linearised(points_px)
        count = len(points_vehicle)
        blocks = np.zeros((count, 2, count, 2))
        blocks[range(count), :, range(count)] = by_px
        jacobian = blocks.reshape(2 * count, 2 * count)
        stacked = by_mounting.reshape(2 * count, 6)
        return points_vehicle, jacobian @ covariance_px @ jacobian.T + stacked @ self._covariance @ stacked.T

    def points(self, points_px: FloatArray, sigma_px: float) -> tuple[FloatArray, FloatArray]:
        """Points (N, 2) on the ground, each with its own covariance (N, 2, 2), m^2.

        Args:
            points_px: (N, 2).
            sigma_px: standard deviation of either coordinate.
        """
        points_vehicle, by_px, by_mounting = self._linearised(points_px)
        covariance = sigma_px**2 * by_px @ np.swapaxes(by_px, 1, 2)
        return points_vehicle, covariance + by_mounting @ self._covariance @ np.swapaxes(by_mounting, 1, 2)

    def _linearised(self, points_px: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points (N, 2) and their derivatives by recorded pixel (N, 2, 2) and by the mounting (N, 2, 6)."""
        pinhole_px = self._view.undistort(points_px)
        points_vehicle = self._view.ground(pinhole_px)
        matrix = self._cam_from_vehicle
        cam = points_vehicle @ matrix[:3, :2].T + matrix[:3, 3]
        project = np.zeros((len(cam), 2, 3))
        project[:, :, :2] = self._intrinsic[:2, :2]
        project[:, :, 2] = self._intrinsic[:2, 2] - pinhole_px
        project /= cam[:, 2, None, None]
        by_pinhole = _inverse(project @ matrix[:3, :2])
        moved = np.zeros((len(cam), 3, 6))
        moved[:, range(3), range(3)] = 1.0
        x, y, z = cam.T
        moved[:, 0, 4], moved[:, 0, 5] = z, -y
        moved[:, 1, 3], moved[:, 1, 5] = -z, x
        moved[:, 2, 3], moved[:, 2, 4] = y, -x
        by_px = by_pinhole @ _inverse(self._view.distort_jacobian(pinhole_px))
        return points_vehicle, by_px, -by_pinhole @ project @ moved


def _inverse(matrices: FloatArray) -> FloatArray:
    """Inverses (N, 2, 2), by Cramer's rule so that nan stays where it is."""
    (a, b), (c, d) = matrices[:, 0].T, matrices[:, 1].T
    adjugate = np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1)
    return np.asarray(adjugate / (a * d - b * c)[:, None, None])
