"""Coordinates about a marking in which what is straight on the ground is straight, whatever the lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.found import block_diagonal
from v2hdm.detection.corners.quad import following
from v2hdm.records import FloatArray


@dataclass(frozen=True)
class StraightFrames:
    """One frame for each of M markings: pinhole px from its middle, scaled to recorded ones there.

    So a recorded pixel, and what blurs it, is about as large and as round in them as in the image, also near
    the border of a wide lens. ``middle`` (M, 2) is in pinhole px, ``scale`` (M, 2, 2) leads to recorded ones.
    """

    view: CameraView
    middle: FloatArray
    scale: FloatArray

    @classmethod
    def about(cls, view: CameraView, corners_px: FloatArray) -> StraightFrames:
        """Those of markings with recorded ``corners_px`` (M, 4, 2)."""
        middle = view.undistort(corners_px.reshape(-1, 2)).reshape(corners_px.shape).mean(axis=1)
        return cls(view, middle, view.distort_jacobian(middle))

    def take(self, rows: np.ndarray) -> StraightFrames:
        """Those of some of the markings, which may come several times."""
        return StraightFrames(self.view, self.middle[rows], self.scale[rows])

    def from_image(self, points_px: FloatArray) -> FloatArray:
        """Recorded points (M, N, 2) of each marking."""
        pinhole = self.view.undistort(points_px.reshape(-1, 2)).reshape(points_px.shape)
        return np.asarray((pinhole - self.middle[:, None]) @ self.scale.swapaxes(1, 2))

    def to_pinhole(self, points: FloatArray) -> FloatArray:
        """Pinhole px (M, N, 2) of points (M, N, 2) of each marking."""
        return np.asarray(points @ np.linalg.inv(self.scale).swapaxes(1, 2) + self.middle[:, None])

    def to_image(self, corners: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Corners (M, 4, 2) and their covariance (M, 8, 8) in recorded px."""
        pinhole = self.to_pinhole(corners).reshape(-1, 2)
        slope = self.view.distort_jacobian(pinhole).reshape(-1, 4, 2, 2) @ np.linalg.inv(self.scale)[:, None]
        jacobian = block_diagonal(slope)
        px = self.view.distort(pinhole).reshape(corners.shape)
        return px, np.asarray(jacobian @ covariance @ jacobian.swapaxes(1, 2))

    def bow_px(self, corners_px: FloatArray) -> FloatArray:
        """By how much (M,) the lens bows the sides of quadrilaterals with recorded corners (M, 4, 2)."""
        corners = self.from_image(corners_px)
        middles = self.to_pinhole((corners + following(corners)) / 2)
        recorded = self.view.distort(middles.reshape(-1, 2)).reshape(corners.shape)
        chords = (corners_px + following(corners_px)) / 2
        return np.asarray(np.linalg.norm(recorded - chords, axis=-1).max(axis=1))
