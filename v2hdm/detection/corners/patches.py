"""The pixels that tell where a marking's sides are: a lattice over a band along them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from v2hdm.detection.corners.grey import GreyBand
from v2hdm.detection.corners.straight import StraightFrames
from v2hdm.geometry.planar import signed_area
from v2hdm.geometry.quadrilateral import side_frames, width
from v2hdm.records import BoolArray, FloatArray

_OUTSIDE_PX = 3.0
_INSIDE_PX = 4.0
_MEDIAN_STRIDE = 3
_MAX_PIXELS = 350
_MAX_BETWEEN, _MAX_AT_ENDS = 160, 260
_END_PX = 2.0
_MOST_ENDS = 1 / 3
"""What has two ends that make up no more than this share of its length is slim; an end reaches so far past
its corners."""


@dataclass(frozen=True)
class Patches:
    """Up to N pixels about each of M markings.

    ``points`` (M, 3, N) float32 are (x, y, 1) in the markings' frames; ``values``
    (M, N) float32 grey; ``use`` (M, N) float32 1 where a pixel takes part, else 0; ``neighbours``
    (2, M, N) the place in the list of the lattice's next pixel to the right and below, 0 for none that is as
    near as any is;
    ``clipped`` (M,) the share of pixels left out since the sensor was at its limit there.
    """

    points: np.ndarray
    values: np.ndarray
    use: np.ndarray
    neighbours: np.ndarray
    clipped: np.ndarray

    def take(self, rows: BoolArray) -> Patches:
        """The markings under the mask (M,)."""
        if rows.all():
            return self
        return Patches(
            self.points[rows],
            self.values[rows],
            self.use[rows],
            self.neighbours[:, rows],
            self.clipped[rows],
        )

    def every(self, stride: int) -> Patches:
        """Every ``stride``-th pixel, without neighbours."""
        return Patches(
            np.ascontiguousarray(self.points[..., ::stride]),
            np.ascontiguousarray(self.values[:, ::stride]),
            np.ascontiguousarray(self.use[:, ::stride]),
            self.neighbours[..., :0],
            self.clipped,
        )

    def median_used(self, values: np.ndarray) -> np.ndarray:
        """Median (M,) of every few values of (M, N) over the pixels that take part; 0 where there is none."""
        unused, place, known = self._of_median
        ordered = np.sort(values[:, ::_MEDIAN_STRIDE] + unused, axis=1)
        return np.where(known, ordered[np.arange(len(values)), place], np.float32(0))

    @cached_property
    def _of_median(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What puts pixels that take no part behind the others, and where the median is, if there is one."""
        use = self.use[:, ::_MEDIAN_STRIDE] > 0
        count = use.sum(axis=1)
        return np.where(use, np.float32(0), np.float32(np.inf)), np.maximum(count // 2 - 1, 0), count > 0


def cut_patches(
    grey: GreyBand,
    owner: np.ndarray,
    owner_stride: int,
    blobs: np.ndarray,
    frames: StraightFrames,
    corners_px: FloatArray,
) -> Patches:
    """The pixels about the sides of quadrilaterals ``corners_px`` (M, 4, 2), without those of other blobs.

    Args:
        grey: the image's grey values.
        owner: (h, w) 1 + index of the blob on each logit of the same band.
        owner_stride: pixels per logit.
        blobs: (M,) index of each marking's own blob.
        frames: those of the markings.
        corners_px: starting corners, recorded px.
    """
    bow_px = frames.bow_px(corners_px)
    spare = np.ceil(bow_px)[:, None].astype(np.intp) + int(_OUTSIDE_PX)
    low = np.floor(corners_px.min(axis=1)).astype(np.intp) - spare
    size = np.ceil(corners_px.max(axis=1)).astype(np.intp) + spare + 1 - low
    columns, rows = _lattice(corners_px - low[:, None], size)
    across, down = columns.shape[1], rows.shape[1]
    band = _in_band(corners_px - low[:, None], bow_px, columns, rows)
    band[..., -1] = band[:, -1] = False
    cell = np.flatnonzero(band)
    marking, within = np.divmod(cell, across * down)
    i, j = np.divmod(within, across)
    u, v = low[marking, 0] + columns[marking, j], low[marking, 1] + rows[marking, i] - grey.top
    use = (u >= 0) & (u < grey.values.shape[1]) & (v >= 0) & (v < grey.values.shape[0])
    u[~use] = v[~use] = 0
    cell_owner = owner[v // owner_stride, u // owner_stride]
    use &= (cell_owner == 0) | (cell_owner == blobs[marking] + 1)
    count = np.bincount(marking, minlength=len(low))
    place = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
    patches = _empty(len(low), max(1, int(count.max())))
    pixels = np.repeat(corners_px.mean(axis=1)[:, None], patches.values.shape[1], axis=1)
    pixels[marking, place] = np.column_stack([u, v + grey.top])
    patches.points[:, :2] = frames.from_image(pixels).swapaxes(1, 2)
    values = grey.values[v, u]
    known = np.isfinite(values)
    patches.values[marking, place] = np.where(known, values, np.float32(0))
    patches.use[marking, place] = use & known
    patches.clipped[:] = np.bincount(marking, np.isposinf(values), len(low)) / np.maximum(count, 1)
    place_of_cell = np.zeros(band.size, dtype=np.intp)
    place_of_cell[cell] = place
    near = _near_the_next(columns, size[:, 0])[marking, j], _near_the_next(rows, size[:, 1])[marking, i]
    for axis, following in ((0, 1), (1, across)):
        patches.neighbours[axis, marking, place] = np.where(near[axis], place_of_cell[cell + following], 0)
    return patches


def _near_the_next(places: np.ndarray, size: np.ndarray) -> BoolArray:
    """Which places (M, n) along an axis, of those up to ``size`` (M,), are as near to the next as any is."""
    apart = np.diff(places, append=places[:, -1:] + 1)
    within = places + apart < size[:, None]
    return np.asarray(apart == np.where(within, apart, apart.max()).min(axis=1, keepdims=True))


def _lattice(corners: FloatArray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns (M, W) and rows (M, H) that leave about ``_MAX_PIXELS`` of the bands about sides, or some more.

    Neighbouring pixels say nearly the same, so a large marking needs only some of them; columns or rows
    are left out along the marking's longer extent, the finer sampling staying across it. Of a slim one few
    are left out at its two ends, which tell how long it is, but more between.

    Args:
        corners: (M, 4, 2) px from the box's first pixel.
        size: (M, 2) the box, px.
    """
    each = np.arange(len(corners))
    along = np.where(size[:, 0] >= size[:, 1], 0, 1)
    step, band = _lattice_steps(corners, along)
    place, extent = np.sort(corners[each, :, along], axis=1), size[each, along]
    thick = width(corners)
    head = np.ceil(np.minimum(place[:, 1], place[:, 0] + thick) + _END_PX).astype(np.intp)
    tail = np.floor(np.maximum(place[:, 2], place[:, 3] - thick) - _END_PX).astype(np.intp)
    slim = (step[each, along] > 1) & (head + extent - tail < _MOST_ENDS * extent)
    per_place = band / extent
    between = np.ceil(per_place * (tail - head) / _MAX_BETWEEN).astype(np.intp)
    at_ends = np.ceil(per_place * (head + extent - tail) / _MAX_AT_ENDS).astype(np.intp)
    step[slim] = 1
    step[each[slim], along[slim]] = np.maximum(between[slim], 1)
    outer = np.ones_like(step)
    outer[each[slim], along[slim]] = at_ends[slim]
    bounds = np.zeros((len(corners), 2, 2), dtype=np.intp)
    bounds[..., 1] = size
    bounds[each[slim], along[slim]] = np.column_stack([head, tail])[slim]
    columns, rows = (_steps(bounds[:, axis], step[:, axis], outer[:, axis], size[:, axis]) for axis in (0, 1))
    return columns, rows


def _steps(bounds: np.ndarray, step: np.ndarray, outer: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Places (M, n), every ``step``-th (M,) within ``bounds`` (M, 2) and every ``outer``-th without.

    They go up to ``size`` (M,) and one farther, so that the last have no neighbour.
    """
    head, tail = bounds.T
    first, between = -(-head // outer), -(-(tail - head) // step)
    count = first + between + np.maximum(-(-(size - tail) // outer), 0)
    k = np.arange(int(count.max()) + 1)
    head, tail, step, outer = head[:, None], tail[:, None], step[:, None], outer[:, None]
    first, between = first[:, None], between[:, None]
    middle, last = head + (k - first) * step, tail + (k - first - between) * outer
    return np.asarray(np.where(k < first, k * outer, np.where(k < first + between, middle, last)))


def _lattice_steps(corners: FloatArray, along: np.ndarray) -> tuple[np.ndarray, FloatArray]:
    """Steps (M, 2) along u and v that leave about ``_MAX_PIXELS`` of the band (M,) px about the sides."""
    _, _, length = side_frames(corners)
    longest, area = length.max(axis=1), np.abs(signed_area(corners))
    band = area + _OUTSIDE_PX * (length.sum(axis=1) + 4 * _OUTSIDE_PX)
    band -= np.maximum(longest - 2 * _INSIDE_PX, 0) * np.maximum(area / longest - 2 * _INSIDE_PX, 0)
    ratio = np.maximum(band / _MAX_PIXELS, 1.0)
    longer = np.ceil(ratio / np.maximum(ratio / 4, 1))
    other = np.ceil(ratio / longer)
    wide = along[:, None] == 0
    step = np.where(wide, np.stack([longer, other], 1), np.stack([other, longer], 1)).astype(np.intp)
    return step, band


def _in_band(corners: FloatArray, bow_px: FloatArray, columns: np.ndarray, rows: np.ndarray) -> BoolArray:
    """Which pixels (M, H, W) of a lattice are near the nearest side of quadrilaterals (M, 4, 2).

    The sides are bowed by up to ``bow_px`` (M,).
    """
    _, normal, _ = side_frames(corners)
    offset = (normal * corners).sum(axis=-1).astype(np.float32)
    normal = normal.astype(np.float32)
    u, v = columns[:, None, :].astype(np.float32), rows[:, :, None].astype(np.float32)
    reach = np.full((len(corners), rows.shape[1], columns.shape[1]), -np.inf, dtype=np.float32)
    for side in range(4):
        by_row = normal[:, side, 1, None, None] * v - offset[:, side, None, None]
        np.maximum(reach, normal[:, side, 0, None, None] * u + by_row, out=reach)
    spare = bow_px.astype(np.float32)[:, None, None]
    return np.asarray((reach < spare + np.float32(_OUTSIDE_PX)) & (reach > -spare - np.float32(_INSIDE_PX)))


def _empty(markings: int, pixels: int) -> Patches:
    points = np.zeros((markings, 3, pixels), dtype=np.float32)
    points[:, 2] = 1.0
    blank = np.zeros((markings, pixels), dtype=np.float32)
    neighbours = np.zeros((2, markings, pixels), dtype=np.intp)
    return Patches(points, blank, blank.copy(), neighbours, np.zeros(markings))
