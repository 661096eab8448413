"""Image points on the ground in metres, with the covariance that pixels and calibration leave them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.records import Calibration, FloatArray


@dataclass(frozen=True)
class GroundPoints:
    """Points on the ground plane: ``points_vehicle`` (N, 2), m, nan where a pixel shows no ground.

    ``by_px`` (N, 2, 2) and ``by_mounting`` (N, 2, 6) are their derivatives by the recorded pixel and by the
    tangent of ``cam_from_vehicle``, whose covariance is ``mounting_covariance`` (6, 6).
    """

    points_vehicle: FloatArray
    by_px: FloatArray
    by_mounting: FloatArray
    mounting_covariance: FloatArray

    def __getitem__(self, part: slice) -> GroundPoints:
        """Some of the points."""
        return GroundPoints(
            self.points_vehicle[part], self.by_px[part], self.by_mounting[part], self.mounting_covariance
        )

    def joint_covariance(self, covariance_px: FloatArray) -> FloatArray:
        """Covariance (2N, 2N), m^2, of the stacked points (x0, y0, x1, ...).

        ``covariance_px`` (2N, 2N) is that of their pixels (u0, v0, u1, ...). The rows and columns of points
        that are not on the ground are nan.
        """
        count = len(self.points_vehicle)
        blocks = np.zeros((count, 2, count, 2))
        blocks[range(count), :, range(count)] = self.by_px
        jacobian = blocks.reshape(2 * count, 2 * count)
        stacked = self.by_mounting.reshape(2 * count, 6)
        return np.asarray(
            jacobian @ covariance_px @ jacobian.T + stacked @ self.mounting_covariance @ stacked.T
        )

    def single_covariances(self, sigma_px: float | FloatArray) -> FloatArray:
        """Covariance (N, 2, 2), m^2, of each point, its pixel being off by ``sigma_px`` in u and v alike.

        ``sigma_px`` is one for all or one for each, (N,).
        """
        covariance = np.square(sigma_px)[..., None, None] * self.by_px @ np.swapaxes(self.by_px, 1, 2)
        return np.asarray(
            covariance + self.by_mounting @ self.mounting_covariance @ np.swapaxes(self.by_mounting, 1, 2)
        )


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

    def of(self, points_px: FloatArray) -> GroundPoints:
        """Recorded pixels (N, 2) on the ground; best called once for all points of an image."""
        points_vehicle, by_px, by_mounting = self._linearised(points_px)
        return GroundPoints(points_vehicle, by_px, by_mounting, self._covariance)

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
