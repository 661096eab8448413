r"""What surveyed points say of a camera's mounting: the likelihood of their pixels.

A point k of the ground, X_k, was surveyed with an error of ``survey_m`` a coordinate and clicked with one of
``pixel_px``. To first order the recorded pixel then differs from the predicted one by r_k, of covariance

    q V_k,   V_k = pixel_px^2 I + G_k G_k' survey_m^2,   G_k the derivative of the pixel by the ground point.

A share of the points is wrong altogether, a slip of hand or pen: their pixels may be anywhere in the image.
So p(r_k) = (1 - e) N(r_k; 0, q V_k) + e / (width height). The factor q corrects the stated errors. Its prior
is a scaled inverse chi-square about 1: the statement counts as much as :data:`STATED_AS` observations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from v2hdm.calibration.points import SurveyedPoints
from v2hdm.geometry.ipm import homography_jacobian, pinhole_px_from_ground
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.rigid import hat
from v2hdm.geometry.tensors import apply, inverse_depth
from v2hdm.records import CameraInfo, FloatArray

WRONG_SHARE = 0.02
"""Prior probability that a point is wrong altogether: one slip in five tables of ten."""

STATED_AS = 4.0
"""Observations that the stated errors count for: people know theirs to a factor of about 1.4."""

_BESIDE_M = 1e-9
"""Variance that keeps V invertible where neither error is stated, px^2."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations a coordinate: of clicking, ``pixel_px``, and of surveying, ``survey_m``."""

    pixel_px: float = 0.5
    survey_m: float = 0.01


@dataclass(frozen=True)
class Seen:
    """N points and their camera: recorded pixels, pinhole pixels and the lens between them.

    ``by_pinhole`` (N, 2, 2) is the derivative of the recorded pixel by the pinhole pixel.
    """

    info: CameraInfo
    points_px: FloatArray
    pinhole_px: FloatArray
    by_pinhole: FloatArray
    points_vehicle: FloatArray
    noise: Noise

    @classmethod
    def of(cls, points: SurveyedPoints, info: CameraInfo, noise: Noise) -> Seen:
        """The points as the camera ``info`` saw them."""
        return cls.of_pixels(points.points_px, points.points_vehicle, info, noise)

    @classmethod
    def of_pixels(
        cls, points_px: FloatArray, points_vehicle: FloatArray, info: CameraInfo, noise: Noise
    ) -> Seen:
        """Recorded pixels (N, 2) of ground points (N, 2) as the camera ``info`` saw them."""
        pinhole_px = undistort_points(info, points_px)
        steps = 0.5 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        moved = distort_points(info, (pinhole_px[:, None] + steps).reshape(-1, 2)).reshape(-1, 4, 2)
        by_pinhole = np.stack([moved[:, 0] - moved[:, 1], moved[:, 2] - moved[:, 3]], axis=2)
        return cls(info, points_px, pinhole_px, by_pinhole, points_vehicle, noise)

    @property
    def count(self) -> int:
        """N."""
        return len(self.points_px)

    @property
    def log_anywhere(self) -> float:
        """Log density of the pixel of a wrong point."""
        return -float(np.log(self.info.width * self.info.height))

    def covariance(self, cam_from_vehicle: FloatArray) -> FloatArray:
        """V (..., N, 2, 2), px^2, under mountings (..., 4, 4)."""
        pinhole_from_ground = pinhole_px_from_ground(self.info.intrinsic, cam_from_vehicle)
        by_ground = self.by_pinhole @ homography_jacobian(pinhole_from_ground, self.points_vehicle)
        # A point behind the camera has no pixel to err by.
        by_ground = np.nan_to_num(by_ground, nan=0.0, posinf=0.0, neginf=0.0)
        clicked = (self.noise.pixel_px**2 + _BESIDE_M) * np.eye(2)
        return np.asarray(clicked + self.noise.survey_m**2 * by_ground @ np.swapaxes(by_ground, -1, -2))

    def residual_px(self, cam_from_vehicle: FloatArray) -> FloatArray:
        """Predicted less recorded pixels (..., N, 2), to first order; far off behind the camera."""
        matrices = torch.as_tensor(cam_from_vehicle)
        return np.asarray(self.residual(matrices).numpy())

    def residual(self, cam_from_vehicle: Tensor) -> Tensor:
        """As :meth:`residual_px`, differentiable."""
        ground = torch.as_tensor(np.column_stack([self.points_vehicle, np.zeros(self.count)]))
        cam = apply(cam_from_vehicle, ground)
        reciprocal, _ = inverse_depth(cam[..., 2])
        intrinsic = torch.as_tensor(self.info.intrinsic)
        rays = cam[..., :2] * reciprocal[..., None]
        predicted = rays @ intrinsic[:2, :2].mT + intrinsic[:2, 2]
        off = predicted - torch.as_tensor(self.pinhole_px)
        return (torch.as_tensor(self.by_pinhole) @ off[..., None])[..., 0]

    def jacobian(self, cam_from_vehicle: FloatArray) -> FloatArray:
        """Derivative (N, 2, 6) of :meth:`residual_px` by the left tangent of ``cam_from_vehicle``."""
        cam = np.column_stack([self.points_vehicle, np.zeros(self.count)]) @ cam_from_vehicle[:3, :3].T
        cam = cam + cam_from_vehicle[:3, 3]
        reciprocal, slope = (part.numpy() for part in inverse_depth(torch.as_tensor(cam[:, 2])))
        by_cam = np.zeros((self.count, 2, 3))
        by_cam[:, :, :2] = reciprocal[:, None, None] * np.eye(2)
        by_cam[:, :, 2] = cam[:, :2] * slope[:, None]
        moved = np.concatenate([np.broadcast_to(np.eye(3), (self.count, 3, 3)), -hat(cam)], axis=2)
        return np.asarray(self.by_pinhole @ self.info.intrinsic[:2, :2] @ by_cam @ moved)


def squared(residual_px: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared residuals (..., N) in standard deviations, for q = 1."""
    solved = np.linalg.solve(covariance, residual_px[..., None])[..., 0]
    return np.asarray((residual_px * solved).sum(axis=-1))


def log_right(square: FloatArray, covariance: FloatArray, factor: FloatArray) -> FloatArray:
    """Log density (..., N) of right points; ``factor`` (...) is q."""
    determinant = np.linalg.det(covariance)
    q = np.asarray(factor)[..., None]
    return np.asarray(-square / (2 * q) - np.log(2 * np.pi * q * np.sqrt(determinant)))


def mixture(seen: Seen, log_of_right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Log density (..., N) of points that may be wrong, and the probability (..., N) that each is right."""
    right = np.log1p(-WRONG_SHARE) + log_of_right
    total = np.logaddexp(right, np.log(WRONG_SHARE) + seen.log_anywhere)
    return total, np.asarray(np.exp(right - total))


def log_prior_of_factor(factor: FloatArray) -> FloatArray:
    """Log prior density of log q, up to a constant: 0 at q = 1."""
    return np.asarray(-0.5 * STATED_AS * (np.log(factor) + 1 / factor - 1))
