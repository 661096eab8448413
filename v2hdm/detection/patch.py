"""From coded pixels to radiance and its logarithm.

Markings through a lens: coordinates in which what is straight on the ground is straight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.camera import CameraView
from v2hdm.geometry.lens import has_distortion
from v2hdm.geometry.quadrilateral import block_diagonal, following
from v2hdm.records import BoolArray, FloatArray

_GREY_WEIGHTS_BGR = (0.114, 0.587, 0.299)
"""Weights of ITU-R BT.601."""

CLIPPED = 250
"""Codes from here on are those of a sensor at its limit, noise and white balance allowed for."""

_DARK = 0.01
"""Added to radiance before taking logarithms: in shade a step is as large as in the sun, noise is not."""

_CODED = np.arange(256) / 255
_LINEAR_FROM_SRGB = np.where(_CODED <= 0.04045, _CODED / 12.92, ((_CODED + 0.055) / 1.055) ** 2.4)
"""Radiance of sRGB codes (IEC 61966-2-1).

Edges fitted to coded values lie outwards of those of a bright marking by about a fifth of the blur.
"""


def linear_bgr(coded: np.ndarray, linear_response: bool) -> np.ndarray:
    """Pixels (..., 3) uint8 in [0, 1], proportional to radiance; float32."""
    table = _CODED if linear_response else _LINEAR_FROM_SRGB
    return np.asarray(table.astype(np.float32)[coded])


def grey_of(bgr: np.ndarray) -> np.ndarray:
    """Grey values (...) of linear pixels (..., 3)."""
    return np.asarray(bgr @ np.array(_GREY_WEIGHTS_BGR, dtype=np.float32))


def log_grey(values: np.ndarray) -> np.ndarray:
    """Logarithms of radiance, float32, in which light and shade differ by a constant."""
    return np.asarray(np.log(np.maximum(values, 0) + np.float32(_DARK)))


_SEEN_BOW_PX = 0.25
"""What is looked up beside the sides of a quadrilateral is not changed by less."""


@dataclass(frozen=True)
class StraightFrames:
    """One frame for each of M markings: pinhole px from its middle in the image, scaled to recorded ones.

    So a recorded pixel, and what blurs it, is about as large and as round in them as in the image, also near
    the border of a wide lens. ``middle`` (M, 2) is in pinhole px, ``scale`` (M, 2, 2) leads to recorded ones.
    """

    view: CameraView
    middle: FloatArray
    scale: FloatArray

    @classmethod
    def about(cls, view: CameraView, corners_px: FloatArray) -> StraightFrames:
        """Those of markings with recorded ``corners_px`` (M, 4, 2)."""
        # Beyond the image a lens model may fold, and has no scale.
        within = np.clip(corners_px.mean(axis=1), 0.0, [view.info.width - 1, view.info.height - 1])
        middle = view.undistort(within)
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

    def to_px(self, points: FloatArray) -> FloatArray:
        """Recorded px (M, N, 2) of points (M, N, 2) of each marking."""
        return self.view.distort(self.to_pinhole(points).reshape(-1, 2)).reshape(points.shape)

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
        recorded = self.to_px((corners + following(corners)) / 2)
        chords = (corners_px + following(corners_px)) / 2
        return np.asarray(np.linalg.norm(recorded - chords, axis=-1).max(axis=1))


@dataclass(frozen=True)
class Quads:
    """M quadrilaterals whose sides are straight between their ``corners`` (M, 4, 2).

    Those are the recorded ``corners_px``, but for those ``bowed`` (M,) by the lens: their places are in
    ``frames`` (of them alone), and :meth:`px` tells where they are in the image.
    """

    corners_px: FloatArray
    corners: FloatArray
    bowed: BoolArray
    frames: StraightFrames | None

    @classmethod
    def straight(cls, corners_px: FloatArray) -> Quads:
        """Those (M, 4, 2) in an image without distortion."""
        return cls(corners_px, corners_px, np.zeros(len(corners_px), dtype=np.bool_), None)

    @classmethod
    def seen(cls, view: CameraView, corners_px: FloatArray) -> Quads:
        """Those with recorded corners (M, 4, 2)."""
        if not has_distortion(view.info) or not len(corners_px):
            return cls.straight(corners_px)
        frames = StraightFrames.about(view, corners_px)
        bowed = frames.bow_px(corners_px) > _SEEN_BOW_PX
        if not bowed.any():
            return cls.straight(corners_px)
        frames, corners = frames.take(bowed), corners_px.copy()
        corners[bowed] = frames.from_image(corners_px[bowed])
        return cls(corners_px, corners, bowed, frames)

    def take(self, rows: np.ndarray) -> Quads:
        """Some of them, which may come several times."""
        bowed = self.bowed[rows]
        place = np.cumsum(self.bowed) - 1
        frames = None if self.frames is None else self.frames.take(place[rows][bowed])
        return Quads(self.corners_px[rows], self.corners[rows], bowed, frames)

    def px(self, points: FloatArray) -> FloatArray:
        """Recorded px (M, ..., 2) of points (M, ..., 2) laid out about each one's corners."""
        if self.frames is None or not self.bowed.any():
            return points
        points = points.copy()
        flat = points[self.bowed].reshape(int(self.bowed.sum()), -1, 2)
        points[self.bowed] = self.frames.to_px(flat).reshape(-1, *points.shape[1:])
        return points
