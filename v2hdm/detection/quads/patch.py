"""The pixels of an image about its markings, and frames in which the lens bends nothing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.detection.camera import LUT_STEP_PX, RoadCamera
from v2hdm.detection.network import NetworkOutput
from v2hdm.geometry.planar import Quad, block_diagonal, following
from v2hdm.records import BoolArray, FloatArray

_GREY_WEIGHTS_BGR = (0.114, 0.587, 0.299)  # weights of ITU-R BT.601
_CLIPPED = 250  # codes from here on are those of a sensor at its limit, noise and white balance allowed for
_DARK = 0.01  # added to radiance before logarithms: in shade a step is as large as in the sun, noise is not

_CODED = np.arange(256) / 255  # grey values (256,) of the codes of 8 bits, 0 to 1

_LINEAR_FROM_SRGB = np.where(_CODED <= 0.04045, _CODED / 12.92, ((_CODED + 0.055) / 1.055) ** 2.4)
"""Radiance of sRGB codes (IEC 61966-2-1).

Edges fitted to coded values lie outwards of those of a bright marking by about a fifth of the blur.
"""

_BOW_PX = 0.25  # a lens that bows the sides of a quadrilateral by less is as good as none


@cache
def light_tables(linear_response: bool) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of each code and its :func:`log_light` (256,), float32."""
    radiance = (_CODED if linear_response else _LINEAR_FROM_SRGB).astype(np.float32)
    return radiance, log_light(radiance)


def _look_up(coded: np.ndarray, table: np.ndarray) -> np.ndarray:
    # OpenCV's look-up takes a third of the time of numpy's.
    return np.asarray(cv2.LUT(coded.reshape(-1, 1), table)).reshape(coded.shape)


def grey_of(bgr: np.ndarray) -> np.ndarray:
    """Grey values (...) of linear pixels (..., 3)."""
    return np.asarray(bgr @ np.array(_GREY_WEIGHTS_BGR, dtype=np.float32))


def log_light(values: np.ndarray) -> np.ndarray:
    """Logarithms of radiance, float32, in which light and shade differ by a constant."""
    return np.asarray(np.log(np.maximum(values, 0) + np.float32(_DARK)))


class Looked(NamedTuple):
    """The light of an image at n pixels; for the pixels of a lattice n is (M, N)."""

    light: np.ndarray  # (3, n) float32 logarithms of grey, red and blue
    use: np.ndarray  # (n,) which take part
    clipped: np.ndarray  # (n,) which of those are at the sensor's limit


class Source(NamedTuple):
    """The image that pixels are looked up in."""

    image: np.ndarray  # (H, W, 3) uint8 BGR
    owner: np.ndarray  # (h, w) int16: 1 + the index of the piece of paint of an element, 0 for none
    top: int  # the image row of the first element
    stride: int  # px per element
    radiance: np.ndarray  # (256,) float32 of each code
    logs: np.ndarray  # (256,) float32 logarithms of that
    lens: FloatArray | None  # table of the lens, None where nothing is distorted
    lens_step_px: float = float(LUT_STEP_PX)
    grey_weights: np.ndarray = np.array(_GREY_WEIGHTS_BGR, dtype=np.float32)
    clipped: int = _CLIPPED
    dark: float = _DARK


class Patches:
    """The pixels of an image (H, W, 3) uint8 about M markings.

    Fit and classifier look at these alone. ``owner`` (h, w) is 1 + the index of the piece of paint that each
    element of the output's paint is of, and ``pieces`` (M, 2) the first and last piece of each marking:
    pixels of others take no part.
    """

    def __init__(
        self,
        image_bgr: np.ndarray,
        camera: RoadCamera,
        output: NetworkOutput,
        owner: np.ndarray,
        pieces: np.ndarray,
    ):
        self.output = output
        self.pieces = pieces
        radiance, logs = light_tables(camera.camera.linear_response)
        self.source = Source(
            image=np.ascontiguousarray(image_bgr),
            owner=owner,
            top=output.top,
            stride=output.stride,
            radiance=radiance,
            logs=logs,
            lens=camera.lens.table if camera.distorted else None,
        )
        self._last_px = np.array([image_bgr.shape[1] - 1, image_bgr.shape[0] - 1])

    def look(self, u: np.ndarray, v: np.ndarray, marking: np.ndarray) -> Looked:
        """The light at columns ``u`` and rows ``v`` (n,), each looked at for its ``marking`` (n,)."""
        last_u, last_v = self._last_px.tolist()
        use = (u >= 0) & (u <= last_u) & (v >= 0) & (v <= last_v)
        u = np.clip(u, 0, last_u)
        v = np.clip(v, 0, last_v)
        coded = self.source.image.reshape(-1, 3).take(v * (last_u + 1) + u, axis=0)
        rows, columns = self.source.owner.shape
        stride = self.output.stride
        row = np.clip((v - self.output.top) // stride, 0, rows - 1)
        owner = self.source.owner.take(row * columns + np.minimum(u // stride, columns - 1))
        first, last = self.pieces.take(marking, axis=0).T
        use &= (owner == 0) | ((owner >= first + 1) & (owner <= last + 1))
        radiance, logs = (_look_up(coded, table) for table in (self.source.radiance, self.source.logs))
        light = np.stack([log_light(grey_of(radiance)), logs[:, 2], logs[:, 0]])
        return Looked(light, use, use & (coded >= _CLIPPED).any(axis=1))

    def light_at(self, points_px: FloatArray) -> np.ndarray:
        """Radiance (..., 3), BGR, at points (..., 2), interpolated."""
        u, v = np.moveaxis(points_px, -1, 0).astype(np.float32).reshape(2, len(points_px), -1)
        coded = cv2.remap(self.source.image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        radiance = _look_up(coded, self.source.radiance)
        return radiance.reshape(*points_px.shape[:-1], 3)

    def outside(self, points_px: FloatArray) -> BoolArray:
        """Which points (..., 2) are outside the image."""
        u, v = np.moveaxis(points_px, -1, 0)
        return np.asarray((u < 0) | (u > self._last_px[0]) | (v < 0) | (v > self._last_px[1]))


@dataclass(frozen=True)
class LensFrames:
    """One frame for each of M markings: pinhole px from its middle, as large as recorded ones there."""

    camera: RoadCamera
    middle: FloatArray  # (M, 2) pinhole px
    scale: FloatArray  # (M, 2, 2) to recorded ones

    @classmethod
    def about(cls, camera: RoadCamera, corners_px: FloatArray) -> LensFrames:
        """The frames of markings with recorded ``corners_px`` (M, 4, 2)."""
        # Beyond the image a lens model may fold, and has no scale.
        within = np.clip(corners_px.mean(axis=1), 0.0, [camera.info.width - 1, camera.info.height - 1])
        middle = camera.undistort(within)
        return cls(camera, middle, camera.distort_jacobian(middle))

    @cached_property
    def from_px(self) -> FloatArray:
        """Inverses (M, 2, 2) of the scales."""
        return np.asarray(np.linalg.inv(self.scale))

    def take(self, rows: np.ndarray) -> LensFrames:
        """Some of the frames, which may come several times."""
        return LensFrames(self.camera, self.middle[rows], self.scale[rows])

    def from_image(self, points_px: FloatArray) -> FloatArray:
        """Recorded points (M, N, 2) of each marking."""
        pinhole = self.camera.undistort(points_px.reshape(-1, 2)).reshape(points_px.shape)
        return np.asarray((pinhole - self.middle[:, None]) @ self.scale.swapaxes(1, 2))

    def to_pinhole(self, points: FloatArray) -> FloatArray:
        """Pinhole px (M, N, 2) of points (M, N, 2) of each marking."""
        return np.asarray(points @ self.from_px.swapaxes(1, 2) + self.middle[:, None])

    def to_px(self, points: FloatArray) -> FloatArray:
        """Recorded px (M, N, 2) of points (M, N, 2) of each marking."""
        return self.camera.distort(self.to_pinhole(points).reshape(-1, 2)).reshape(points.shape)

    def jacobian(self, corners: FloatArray) -> FloatArray:
        """Derivative (M, 8, 8) of the recorded px of corners (M, 4, 2) by the corners."""
        slope = self.camera.distort_jacobian(self.to_pinhole(corners).reshape(-1, 2)).reshape(-1, 4, 2, 2)
        return block_diagonal(slope @ self.from_px[:, None])

    def bow_px(self, corners_px: FloatArray) -> FloatArray:
        """By how much (M,) the lens bows the sides of quadrilaterals with recorded corners (M, 4, 2)."""
        corners = self.from_image(corners_px)
        recorded = self.to_px((corners + following(corners)) / 2)
        chords = (corners_px + following(corners_px)) / 2
        return np.asarray(np.linalg.norm(recorded - chords, axis=-1).max(axis=1))


@dataclass(frozen=True)
class ImageQuads(Quad):
    """M quadrilaterals of an image, recorded px or, where the lens bows their sides, in their ``frames``."""

    bowed: BoolArray  # (M,)
    frames: LensFrames | None  # of the bowed ones alone

    @classmethod
    def of(cls, camera: RoadCamera, corners_px: FloatArray) -> ImageQuads:
        """The patches with recorded corners (M, 4, 2)."""
        if not camera.distorted:
            return cls(corners_px, np.zeros(len(corners_px), dtype=np.bool_), None)
        frames = LensFrames.about(camera, corners_px)
        bowed = frames.bow_px(corners_px) > _BOW_PX
        frames = frames.take(bowed)
        corners = corners_px.copy()
        corners[bowed] = frames.from_image(corners_px[bowed])
        return cls(corners, bowed, frames)

    def take(self, rows: np.ndarray) -> ImageQuads:
        """Some of them, which may come several times."""
        bowed = self.bowed[rows]
        place = np.cumsum(self.bowed) - 1
        frames = None if self.frames is None else self.frames.take(place[rows][bowed])
        return ImageQuads(self.corners[rows], bowed, frames)

    def px(self, points: FloatArray) -> FloatArray:
        """Recorded px (M, ..., 2) of points (M, ..., 2) laid out about each one's corners."""
        if self.frames is None or not self.bowed.any():
            return points
        points = points.copy(order="K")
        flat = points[self.bowed].reshape(int(self.bowed.sum()), -1, 2)
        points[self.bowed] = self.frames.to_px(flat).reshape(-1, *points.shape[1:])
        return points
