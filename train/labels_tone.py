"""Paint inside outlines that are drawn around it: told from the ground by its brightness.

People outline a whole crosswalk, a word or a box, and a line at several times its width. Paint is brighter
than the ground beside it whatever the light, so each place is compared with its own surroundings: with what
is left of the picture when all is taken away that is bright and narrower than the outline (a morphological
opening; Serra, "Image Analysis and Mathematical Morphology", 1982).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.records import BoolArray, FloatArray

_WIDER = 1.3  # sides of what is taken away from an outline of one piece, in thicknesses of the outline
_OF_PIECES = np.array([1 / 5, 1 / 5])
"""Widest bar, stroke or gap in an outline of many, as shares of the outline's width and height."""

_LEAST_PX = np.array([15, 7])  # least sides of what is taken away there, px: width and height
_DARKNESS = 12.0  # grey levels that noise makes of black, added so that it is not taken for paint at night
_LEAST_CONTRAST = 0.1  # least log ratio of paint's brightness to its ground's: that of very worn paint
_PAINT_FROM = 0.55  # share of the contrast near by from which a pixel is paint
_GROUND_TO = 0.3  # share of the contrast near by to which a pixel is ground
_FAINT = 0.35  # paint in one place has at least this share of the contrast of all of the outline's
_BRIGHTEST = 95.0  # percentile of the contrast inside an outline that is that of its paint


class Tone(NamedTuple):
    """Which pixels of a window are ``paint`` and which ``ground``, packed rows; others may be either."""

    left: int
    top: int
    width: int
    paint: np.ndarray
    ground: np.ndarray

    def planes(self) -> tuple[BoolArray, BoolArray]:
        """Paint and ground (height, width) bool."""
        planes = (np.unpackbits(packed, axis=1, count=self.width) for packed in (self.paint, self.ground))
        paint, ground = (plane.astype(np.bool_) for plane in planes)
        return paint, ground


def paint_rectangle(tone: Tone) -> FloatArray | None:
    """Corners (4, 2), px, of the smallest rectangle around the paint; None where there is none."""
    paint, _ = tone.planes()
    rows, columns = np.nonzero(paint)
    if not len(rows):
        return None
    places = np.column_stack([columns + tone.left, rows + tone.top])
    corners = places[:, None] + np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    return np.asarray(
        cv2.boxPoints(cv2.minAreaRect(corners.reshape(-1, 2).astype(np.float32))), dtype=np.float64
    )


def log_light(pixels: np.ndarray) -> np.ndarray:
    """Logarithm (H, W) of an image's (H, W, 3) uint8 BGR light, without blue: paint may be yellow."""
    return np.asarray(np.log(_DARKNESS + pixels[..., 1:].mean(axis=2, dtype=np.float32)))


def tone_of(light: np.ndarray, rings_px: Sequence[FloatArray], of_pieces: bool) -> Tone | None:
    """Paint and ground inside outlines (N, 2), px, of an image's ``light`` (H, W); None if they look alike.

    ``of_pieces`` says that there are many pieces in an outline, such as bars or letters, not just one.
    """
    points = np.concatenate(rings_px)
    if of_pieces:
        side = np.round(np.maximum(_OF_PIECES * np.ptp(points, axis=0), _LEAST_PX)).astype(int)
    else:
        side = np.full(2, round(_WIDER * _thickness(rings_px) + 3))
    kernel = np.ones((side[1], side[0]), np.uint8)
    rows, columns = light.shape
    low = np.maximum(np.floor(points.min(axis=0)).astype(int) - 2 * side, 0)
    high = np.minimum(np.ceil(points.max(axis=0)).astype(int) + 2 * side + 1, (columns, rows))
    if (high - low < 3).any():
        return None
    window = light[low[1] : high[1], low[0] : high[0]]
    inside = np.zeros(window.shape, np.uint8)
    for ring in rings_px:
        cv2.fillPoly(inside, [np.round(ring - low).astype(np.int32)], 1)
    over = window - cv2.morphologyEx(window, cv2.MORPH_OPEN, kernel)
    of_outline = over[inside > 0]
    contrast = float(np.percentile(of_outline, _BRIGHTEST)) if len(of_outline) else 0.0
    if contrast < _LEAST_CONTRAST:
        return None
    brightest = cv2.dilate(np.minimum(over * inside, contrast), kernel)
    near_by = cv2.blur(brightest, (int(side[0]), int(side[1])))
    share = over / np.clip(near_by, _FAINT * contrast, None)
    within = inside > 0
    paint, ground = (np.packbits(within & part, axis=1) for part in (share > _PAINT_FROM, share < _GROUND_TO))
    return Tone(int(low[0]), int(low[1]), window.shape[1], paint, ground)


def _thickness(rings_px: Sequence[FloatArray]) -> float:
    """Twice the greatest distance of a point inside from the outline, px."""
    points = np.concatenate(rings_px)
    low = np.floor(points.min(axis=0)).astype(int) - 1
    width, height = np.ceil(points.max(axis=0)).astype(int) + 2 - low
    mask = np.zeros((height, width), np.uint8)
    for ring in rings_px:
        cv2.fillPoly(mask, [np.round(ring - low).astype(np.int32)], 1)
    return 2 * float(cv2.distanceTransform(mask, cv2.DIST_L2, 3).max())
