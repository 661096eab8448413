"""Patches of images that show a word best, upright in each of four directions.

A word is a rectangle on the ground. A patch is that ground, sampled from one image and turned so that one of
its four sides is above.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.planar import side_frames, signed_area, smallest_rectangle, turned_left
from v2hdm.records import Camera, FloatArray, Image
from v2hdm.site.living.wear import Footage
from v2hdm.words.recogniser import HEIGHT_PX

Grey = NDArray[np.uint8]

DIRECTIONS = 4  # sides of a word's rectangle that may be above

_NEAR_M = 16.0  # largest range, m, at which an image resolves letters: half a metre is 15 px at 1280 px
_MOST_VIEWS = 5  # most images of a word; errors of more repeat
_APART_M = 1.0  # least distance of the cameras of two images, m: things before a word move with the view
_BORDER_PX = 2  # least distance of a word from the border of an image, px
_MARGIN = 0.12  # ground around a word on each side, in shares of its shorter side
_STRETCH = 1.5
"""Width of a patch over its true one: letters on roads are one to four times as tall as usual, and the
network reads those of half the usual width to twice as well (75 words drawn so)."""
_WIDTHS_PX = (48, 960)  # least and largest width of a patch, px
_NEAR_DEPTH_M = 0.3  # least depth, m, of a word's corners
_WIDEST_STROKE_PX = (15, 23)
"""Rows and columns of a patch: a third of a letter's height, which no stroke reaches."""

_GROUND_BLUR_PX = 1.0  # smooths the ground between strokes, px of a patch
_DARK = 3.0  # added to grey values of 8 bits before their ratio: noise of dark pixels
_LEAST_RATIO = 0.1  # least ratio over ground that is full contrast: less is its texture
_QUANTILES = (2.0, 98.0)  # per cent of a patch's ratios that become its darkest and its brightest
_GREYS = (30.0, 225.0)  # those values in the patch, chosen


@dataclass(frozen=True)
class Word:
    """A word's rectangle: ``corners_map`` (4, 2) m, counter-clockwise from above."""

    corners_map: FloatArray

    @classmethod
    def around(cls, outline_map: FloatArray) -> Word:
        """The smallest rectangle around an outline (N, 2)."""
        corners_map = smallest_rectangle(outline_map)
        return cls(corners_map if signed_area(corners_map) > 0 else corners_map[::-1])

    @property
    def middle_map(self) -> FloatArray:
        """Its centre (2,)."""
        return np.asarray(self.corners_map.mean(axis=0))

    @property
    def up_map(self) -> FloatArray:
        """The unit vectors (4, 2) that may be above."""
        return side_frames(self.corners_map).tangent

    @property
    def size_m(self) -> FloatArray:
        """The height (4,) in each direction; its width is that of the next."""
        return side_frames(self.corners_map).length

    def grid(self, direction: int) -> FloatArray:
        """The ground (rows + 1, columns + 1, 2) under the corners of a patch's px, with that side above."""
        size_m = self.size_m[[direction, (direction + 1) % DIRECTIONS]]
        height_m, width_m = size_m + 2 * _MARGIN * size_m.min()
        columns = round(float(np.clip(_STRETCH * HEIGHT_PX * width_m / height_m, *_WIDTHS_PX)))
        up = self.up_map[direction]
        right = -turned_left(up)
        down_m = np.linspace(-0.5, 0.5, HEIGHT_PX + 1) * height_m
        right_m = np.linspace(-0.5, 0.5, columns + 1) * width_m
        return np.asarray(self.middle_map + right_m[:, None] * right - down_m[:, None, None] * up)


class Patch(NamedTuple):
    """The patches (48, W) of a word in one image, by the direction that is above."""

    word: int
    image: int
    upright: list[Grey]


def patches_of(
    words: Sequence[Word],
    views: Sequence[Sequence[int]],
    footage: Footage,
    light: Callable[[Image], NDArray[np.float32]],
    threads: int = 1,
) -> Iterator[Patch]:
    """The patches of each word in its ``views``, indices of images, in the order of the images.

    ``light`` reads an image as grey values (H, W), 0 to 255, in which paint of any colour is bright.
    """
    words_of_image: dict[int, list[int]] = {}
    for number, views_of_word in enumerate(views):
        for index in views_of_word:
            words_of_image.setdefault(index, []).append(number)
    for index, pixels in footage.read(sorted(words_of_image), light, threads):
        for number in words_of_image[index]:
            yield Patch(number, index, _cut(words[number], footage, index, pixels))


def _cut(word: Word, footage: Footage, index: int, pixels: NDArray[np.float32]) -> list[Grey]:
    upright = [_sampled(word.grid(direction), footage, index, pixels) for direction in range(DIRECTIONS // 2)]
    # With the opposite side above, the same px are upside down.
    return [*upright, *(np.ascontiguousarray(patch[::-1, ::-1]) for patch in upright)]


def _sampled(
    corners_map: FloatArray, footage: Footage, index: int, pixels: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """The patch whose px have these corners (rows + 1, columns + 1, 2) on the ground."""
    info = footage.calibrations[footage.images[index].camera].info
    px = distort_points(info, footage.pinhole_px(index, corners_map.reshape(-1, 2))[0])
    corners_px = px.reshape(corners_map.shape).astype(np.float32)
    # As many samples a px of the patch as the image has: none of its px is skipped.
    finer = max(math.ceil(np.linalg.norm(np.diff(corners_px[:, 0], axis=0), axis=1).max()), 1)
    # Within a px of a patch the view is as good as a parallel one.
    rows_px = _between(corners_px, finer)
    places_px = _between(rows_px.swapaxes(0, 1), finer).swapaxes(0, 1)
    sampled = cv2.remap(pixels, places_px[..., 0], places_px[..., 1], cv2.INTER_LINEAR)
    size = (corners_map.shape[1] - 1, corners_map.shape[0] - 1)
    return _levelled(cv2.resize(sampled, size, interpolation=cv2.INTER_AREA))


def _between(corners: NDArray[np.float32], finer: int) -> NDArray[np.float32]:
    """The middles (N * finer, ...) of ``finer`` parts of each interval between N + 1 corners (N + 1, ...)."""
    share = ((np.arange(finer, dtype=np.float32) + 0.5) / finer)[:, None, None]
    parts = corners[:-1, None] + share * np.diff(corners, axis=0)[:, None]
    return np.asarray(parts.reshape(-1, *corners.shape[1:]), dtype=np.float32)


def _levelled(patch: np.ndarray) -> Grey:
    """A patch as its ratio to the ground beside the strokes, in full contrast: in sun and shade alike.

    The ground remains when everything bright that is narrow enough to be a stroke is taken away
    (morphological opening). The edge of a shadow stays where it is.
    """
    ground = cv2.morphologyEx(patch, cv2.MORPH_OPEN, np.ones(_WIDEST_STROKE_PX))
    ratio = (patch + _DARK) / (cv2.GaussianBlur(ground, (0, 0), _GROUND_BLUR_PX) + _DARK)
    low, high = np.percentile(ratio, _QUANTILES)
    share = (ratio - low) / max(float(high - low), _LEAST_RATIO)
    return np.asarray(np.clip(_GREYS[0] + share * (_GREYS[1] - _GREYS[0]), 0.0, 255.0), dtype=np.uint8)


def best_views(words: Sequence[Word], footage: Footage, cameras: Mapping[str, Camera]) -> list[list[int]]:
    """The images of each word that show it whole, not under the own vehicle, the sharpest first."""
    if not words:
        return []
    tree = cKDTree([word.middle_map for word in words])
    views: list[list[tuple[float, int]]] = [[] for _ in words]
    for index, (image, pose) in enumerate(zip(footage.images, footage.map_from_vehicle, strict=True)):
        if image.camera not in footage.calibrations:
            continue
        info = footage.calibrations[image.camera].info
        mask = cameras[image.camera].own_vehicle
        for number in tree.query_ball_point(pose[:2, 3], _NEAR_M):
            corners_map = words[number].corners_map
            pinhole, depth_m = footage.pinhole_px(index, corners_map)
            if (depth_m <= _NEAR_DEPTH_M).any():
                continue
            px = distort_points(info, pinhole)
            last_px = (info.width - 1 - _BORDER_PX, info.height - 1 - _BORDER_PX)
            if (px < _BORDER_PX).any() or (px > last_px).any() or (mask is not None and _covers(mask, px)):
                continue
            sides_px = np.linalg.norm(np.roll(px, -1, axis=0) - px, axis=1)
            views[number].append((float((sides_px / words[number].size_m).min()), index))
    ranked = ([index for _, index in sorted(views_of_word, reverse=True)] for views_of_word in views)
    return [_apart(indices, footage) for indices in ranked]


def _apart(indices: Sequence[int], footage: Footage) -> list[int]:
    """The first images of a list that were taken at least ``_APART_M`` from all chosen before them."""
    chosen: list[int] = []
    centres: list[FloatArray] = []
    for index in indices:
        calibration = footage.calibrations[footage.images[index].camera]
        centre = footage.map_from_vehicle[index][:3, :3] @ calibration.centre_vehicle
        centre = centre + footage.map_from_vehicle[index][:3, 3]
        if all(np.linalg.norm(centre - other) >= _APART_M for other in centres):
            chosen.append(index)
            centres.append(centre)
        if len(chosen) == _MOST_VIEWS:
            break
    return chosen


def _covers(mask: NDArray[np.bool_], px: FloatArray) -> bool:
    """Whether a mask (H, W) of the own vehicle hides part of a quadrilateral (4, 2)."""
    word = np.zeros(mask.shape, dtype=np.uint8)
    cv2.fillConvexPoly(word, np.round(px).astype(np.int32), 1)
    return bool((mask & (word > 0)).any())
