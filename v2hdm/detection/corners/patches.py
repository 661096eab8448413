"""The pixels that tell where a marking's sides are: a lattice over a band along them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from v2hdm.detection.corners.grey import GreyBand
from v2hdm.detection.corners.quad import side_frames, signed_area
from v2hdm.records import BoolArray, FloatArray

_OUTSIDE_PX = 3.0
_INSIDE_PX = 4.0
_MEDIAN_STRIDE = 3
_MAX_PIXELS = 350


@dataclass(frozen=True)
class Patches:
    """Up to N pixels about each of M markings.

    ``points`` (M, 3, N) float32 are (u, v, 1) in recorded px from ``origin_px`` (M, 2); ``values``
    (M, N) float32 grey; ``use`` (M, N) float32 1 where a pixel takes part, else 0; ``neighbours``
    (2, M, N) the place in the list of the lattice's next pixel to the right and below, 0 for none;
    ``clipped`` (M,) the share of pixels left out since the sensor was at its limit there.
    """

    origin_px: FloatArray
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
            self.origin_px[rows],
            self.points[rows],
            self.values[rows],
            self.use[rows],
            self.neighbours[:, rows],
            self.clipped[rows],
        )

    def every(self, stride: int) -> Patches:
        """Every ``stride``-th pixel, without neighbours."""
        return Patches(
            self.origin_px,
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
    grey: GreyBand, owner: np.ndarray, owner_stride: int, blobs: np.ndarray, corners_px: FloatArray
) -> Patches:
    """The pixels about the sides of quadrilaterals ``corners_px`` (M, 4, 2), without those of other blobs.

    Args:
        grey: the image's grey values.
        owner: (h, w) 1 + index of the blob on each logit of the same band.
        owner_stride: pixels per logit.
        blobs: (M,) index of each marking's own blob.
        corners_px: starting corners, recorded px.
    """
    low = np.floor(corners_px.min(axis=1)).astype(np.intp) - int(_OUTSIDE_PX)
    size = np.ceil(corners_px.max(axis=1)).astype(np.intp) + int(_OUTSIDE_PX) + 1 - low
    step = _lattice_steps(corners_px, size)
    # One column and row more than needed, so that the lattice's last pixels have no neighbour.
    width, height = (-(-size // step)).max(axis=0) + 1
    columns, rows = step[:, :1] * np.arange(width), step[:, 1:] * np.arange(height)
    band = _in_band(corners_px - low[:, None], columns, rows)
    band[..., -1] = band[:, -1] = False
    cell = np.flatnonzero(band)
    marking, within = np.divmod(cell, width * height)
    i, j = np.divmod(within, width)
    u, v = low[marking, 0] + columns[marking, j], low[marking, 1] + rows[marking, i] - grey.top
    use = (u >= 0) & (u < grey.values.shape[1]) & (v >= 0) & (v < grey.values.shape[0])
    u[~use] = v[~use] = 0
    cell_owner = owner[v // owner_stride, u // owner_stride]
    use &= (cell_owner == 0) | (cell_owner == blobs[marking] + 1)
    count = np.bincount(marking, minlength=len(low))
    place = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
    patches = _empty(low + size // 2, max(1, int(count.max())))
    patches.points[marking, 0, place] = u - patches.origin_px[marking, 0]
    patches.points[marking, 1, place] = v + grey.top - patches.origin_px[marking, 1]
    values = grey.values[v, u]
    known = np.isfinite(values)
    patches.values[marking, place] = np.where(known, values, np.float32(0))
    patches.use[marking, place] = use & known
    patches.clipped[:] = np.bincount(marking, np.isposinf(values), len(low)) / np.maximum(count, 1)
    place_of_cell = np.zeros(band.size, dtype=np.intp)
    place_of_cell[cell] = place
    for axis, following in ((0, 1), (1, width)):
        patches.neighbours[axis, marking, place] = place_of_cell[cell + following]
    return patches


def _lattice_steps(corners_px: FloatArray, size: np.ndarray) -> np.ndarray:
    """Steps (M, 2) along u and v that leave about ``_MAX_PIXELS`` of the band about the sides.

    Neighbouring pixels say nearly the same, so a large marking needs only some of them; columns or rows
    are left out along the marking's longer extent, the finer sampling staying across it.
    """
    _, _, length = side_frames(corners_px)
    longest, area = length.max(axis=1), np.abs(signed_area(corners_px))
    band = area + _OUTSIDE_PX * (length.sum(axis=1) + 4 * _OUTSIDE_PX)
    band -= np.maximum(longest - 2 * _INSIDE_PX, 0) * np.maximum(area / longest - 2 * _INSIDE_PX, 0)
    ratio = np.maximum(band / _MAX_PIXELS, 1.0)
    longer = np.ceil(np.maximum(ratio / np.maximum(ratio / 4, 1), 1))
    other = np.ceil(ratio / longer)
    wide = size[:, 0] >= size[:, 1]
    return np.where(wide[:, None], np.stack([longer, other], 1), np.stack([other, longer], 1)).astype(np.intp)


def _in_band(corners: FloatArray, columns: np.ndarray, rows: np.ndarray) -> BoolArray:
    """Which pixels (M, H, W) of a lattice are near the nearest side of quadrilaterals (M, 4, 2)."""
    _, normal, _ = side_frames(corners)
    offset = (normal * corners).sum(axis=-1).astype(np.float32)
    normal = normal.astype(np.float32)
    u, v = columns[:, None, :].astype(np.float32), rows[:, :, None].astype(np.float32)
    reach = np.full((len(corners), rows.shape[1], columns.shape[1]), -np.inf, dtype=np.float32)
    for side in range(4):
        by_row = normal[:, side, 1, None, None] * v - offset[:, side, None, None]
        np.maximum(reach, normal[:, side, 0, None, None] * u + by_row, out=reach)
    return np.asarray((reach < _OUTSIDE_PX) & (reach > -_INSIDE_PX))


def _empty(origin_px: np.ndarray, pixels: int) -> Patches:
    markings = len(origin_px)
    points = np.zeros((markings, 3, pixels), dtype=np.float32)
    points[:, 2] = 1.0
    blank = np.zeros((markings, pixels), dtype=np.float32)
    neighbours = np.zeros((2, markings, pixels), dtype=np.intp)
    return Patches(origin_px.astype(np.float64), points, blank, blank.copy(), neighbours, np.zeros(markings))
