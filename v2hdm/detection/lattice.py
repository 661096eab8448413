"""The pixels that show where a marking's sides are: a coarse grid all over it, a lattice about its sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.network import as_probability
from v2hdm.detection.patch import LensFrames, Patches
from v2hdm.geometry.quadrilateral import Quad
from v2hdm.records import BoolArray, FloatArray, IntArray

KNOTS = 6
"""Knots of the light along a marking: its two ends are as many fifths of it apart as a shadow needs."""

_OUTSIDE_PX = 3.0
_INSIDE_PX = 4.0
_MEDIAN_STRIDE = 3
_MAX_PIXELS = 350
_MOST_PIXELS = 600  # a band of more pixels is thinned: all markings of an image are padded to the most
_MAX_BETWEEN, _MAX_AT_ENDS = 160, 260
_END_PX = 2.0
_MOST_ENDS = 1 / 3
"""Ends of at most this share of the length make a quadrilateral slim; they reach that far past corners."""

_SEARCH_ALONG, _SEARCH_ACROSS = 40, 12  # rows and columns of the coarse grid on which a fit begins
_MARGIN_ALONG, _MARGIN_ACROSS = 0.2, 0.4
"""How far it reaches beyond a quadrilateral, in its lengths and widths."""

_GREY_FIRST = 1.2
"""By how many times clearer red or blue must be for grey to be left: grey has the least noise."""


@dataclass(frozen=True)
class Lattice:
    """Up to N pixels about each of M markings.

    ``points`` (M, 3, N) float32 are (x, y, 1) in the markings' frames; ``values`` (M, N) float32 log grey;
    ``use`` (M, N) float32 1 where a pixel takes part, else 0; ``limited`` (M, N) where the sensor was at its
    limit; ``clipped`` (M, 1) the share of those. ``neighbours`` (M, 2, N) is the place in the list of the
    lattice's next pixel to the right and below, 0 for none as near as any is. ``of_side`` (M, 4, N) float32
    is 1 for the side that is nearest. ``hats`` (M, KNOTS, N) interpolate between knots along the marking,
    ``across`` (M, N) runs from -1 to 1 across it. ``count`` (M, 1) of the N pixels are there, the first ones.
    """

    points: np.ndarray
    values: np.ndarray
    use: np.ndarray
    limited: np.ndarray
    clipped: FloatArray
    neighbours: np.ndarray
    of_side: np.ndarray
    hats: np.ndarray
    across: np.ndarray
    count: IntArray

    @classmethod
    def about(
        cls,
        frames: LensFrames,
        quad: Quad,
        pixels: FloatArray,
        looked: tuple[np.ndarray, np.ndarray, np.ndarray],
        neighbours: np.ndarray,
        count: IntArray,
    ) -> Lattice:
        """Pixels (M, N, 2) about quadrilaterals in their frames, of which :meth:`Patches.look` is known."""
        light, used, limited = looked
        points = np.ones((len(pixels), 3, pixels.shape[1]), dtype=np.float32)
        points[:, :2] = frames.from_image(pixels).swapaxes(1, 2)
        outside = quad.outward.astype(np.float32) @ points
        inside = np.asarray(outside.max(axis=1) < 0, dtype=np.float32)
        of_side = np.asarray(outside.argmax(axis=1)[:, None] == np.arange(4)[:, None], dtype=np.float32)
        hats, across = _light_basis(quad, points)
        clipped = limited.sum(axis=1, keepdims=True) / np.maximum(used.sum(axis=1, keepdims=True), 1)
        values = _clearest(light, used, inside)
        of_side *= used[:, None]
        lists = points, values, used, limited, clipped, neighbours, of_side, hats, across
        return cls(*lists, count[:, None])

    def take(self, rows: IntArray) -> Lattice:
        """Some of the markings, in lists that are no longer than they need."""
        most = int(self.count[rows].max(initial=1))
        return Lattice(*(value[..., :most].take(rows, axis=0) for value in vars(self).values()))

    def median_used(self, values: np.ndarray, use: np.ndarray) -> np.ndarray:
        """Median (M,) of every few values of (M, N) over the pixels of ``use``; 0 where there is none."""
        there = use[:, ::_MEDIAN_STRIDE] > 0
        ordered = np.sort(np.where(there, values[:, ::_MEDIAN_STRIDE], np.float32(np.inf)), axis=1)
        count = there.sum(axis=1)
        median = ordered[np.arange(len(values)), np.maximum(count // 2 - 1, 0)]
        return np.asarray(np.where(count > 0, median, np.float32(0)))


def lay_grid(
    patches: Patches, frames: LensFrames, corners_px: FloatArray
) -> tuple[Lattice, np.ndarray, FloatArray]:
    """A coarse grid all over quadrilaterals ``corners_px`` (M, 4, 2), recorded px, and beyond them.

    Returns:
        The lattice, the network's probability of paint there (M, N), and how far apart its points are (M,),
        px.
    """
    quad = Quad(frames.from_image(corners_px))
    along = np.linspace(-_MARGIN_ALONG, 1 + _MARGIN_ALONG, _SEARCH_ALONG)
    across = np.linspace(-_MARGIN_ACROSS, 1 + _MARGIN_ACROSS, _SEARCH_ACROSS)
    a, b = (part.ravel() for part in np.meshgrid(along, across))
    pixels = np.clip(np.round(frames.to_px(quad.long_first().at(a, b))), -(10**6), 10**6)
    shape = pixels.shape[:2]
    u, v = pixels.reshape(-1, 2).astype(np.intp).T
    light, use, clipped = patches.look(u, v, np.repeat(np.arange(shape[0]), shape[1]))
    looked = (light.reshape(3, *shape), use.reshape(shape).astype(np.float32), clipped.reshape(shape))
    paint = as_probability(patches.output.odds_at(pixels)).astype(np.float32)
    spacing = quad.length.max(axis=1) * (1 + 2 * _MARGIN_ALONG) / _SEARCH_ALONG
    none, count = np.zeros((shape[0], 0, shape[1]), dtype=np.intp), np.full(shape[0], shape[1])
    return Lattice.about(frames, quad, pixels, looked, none, count), paint, spacing


def lay_lattice(patches: Patches, frames: LensFrames, corners_px: FloatArray) -> Lattice:
    """The pixels about the sides of quadrilaterals ``corners_px`` (M, 4, 2), recorded px."""
    bow_px = frames.bow_px(corners_px)
    spare = np.ceil(bow_px)[:, None].astype(np.intp) + int(_OUTSIDE_PX)
    low = np.floor(corners_px.min(axis=1)).astype(np.intp) - spare
    size = np.ceil(corners_px.max(axis=1)).astype(np.intp) + spare + 1 - low
    in_box = Quad(corners_px - low[:, None])
    columns, rows = _columns_and_rows(in_box, size)
    across, down = columns.shape[1], rows.shape[1]
    band = _in_band(in_box, bow_px, columns, rows)
    band[..., -1] = band[:, -1] = False
    cell = np.flatnonzero(band)
    marking, within = np.divmod(cell, across * down)
    i, j = np.divmod(within, across)
    u, v = low[marking, 0] + columns[marking, j], low[marking, 1] + rows[marking, i]
    count = np.bincount(marking, minlength=len(low))
    place = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
    thin = -(-count // _MOST_PIXELS)
    kept = place % thin[marking] == 0
    cell, marking, i, j, u, v = (part[kept] for part in (cell, marking, i, j, u, v))
    place, count = place[kept] // thin[marking], -(-count // thin)
    shape = len(low), max(1, int(count.max()))
    pixels = np.repeat(corners_px.mean(axis=1)[:, None], shape[1], axis=1)
    pixels[marking, place] = np.column_stack([u, v])
    place_of_cell = np.zeros(band.size, dtype=np.intp)
    place_of_cell[cell] = np.where(thin[marking] == 1, place, 0)
    neighbours = np.zeros((shape[0], 2, shape[1]), dtype=np.intp)
    for axis, places, at, step in ((0, columns, j, 1), (1, rows, i, across)):
        near = _near_the_next(places, size[:, axis])[marking, at]
        neighbours[marking, axis, place] = np.where(near, place_of_cell[cell + step], 0)
    # Where a band is thinned, the next in its row is the neighbour.
    thinned = np.flatnonzero((thin[marking[:-1]] > 1) & (marking[1:] == marking[:-1]) & (i[1:] == i[:-1]))
    neighbours[marking[thinned], 0, place[thinned]] = place[thinned] + 1
    light, use, clipped = patches.look(u, v, marking)
    planes = np.zeros((3, *shape), dtype=np.float32)
    planes[:, marking, place] = light
    used, limited = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.bool_)
    used[marking, place], limited[marking, place] = use, clipped
    quad = Quad(frames.from_image(corners_px))
    return Lattice.about(frames, quad, pixels, (planes, used, limited), neighbours, count)


def _clearest(light: np.ndarray, used: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Log grey, red or blue (M, N), in which a marking's inside differs most from its outside, of (3, M, N).

    Yellow paint on light ground is as bright in grey, but darker in blue.
    """
    apart, variance = np.float32(0), np.float32(0)
    for part, sign in ((inside * used, 1), ((1 - inside) * used, -1)):
        count = np.maximum(part.sum(axis=1), 1)
        mean = (light * part).sum(axis=2) / count
        apart = apart + sign * mean
        variance = variance + ((light - mean[..., None]) ** 2 * part).sum(axis=2) / count
    clear = np.abs(apart) / np.sqrt(variance + 1e-4)
    clear[0] *= _GREY_FIRST
    return np.asarray(light[clear.argmax(axis=0), np.arange(light.shape[1])])


def _light_basis(quad: Quad, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Hat functions (M, KNOTS, N) along the longest side, and a slope (M, N) across it."""
    along = quad.tangent[np.arange(len(points)), quad.length.argmax(axis=1)]
    axes = np.stack([along, along[:, ::-1] * [-1.0, 1.0]], axis=1)
    within = quad.corners @ axes.swapaxes(1, 2)
    middle = (within.max(axis=1) + within.min(axis=1)) / 2
    half = np.ptp(within, axis=1) / 2 + _OUTSIDE_PX
    rows = np.concatenate([axes / half[..., None], -(middle / half)[..., None]], axis=-1).astype(np.float32)
    placed = np.clip(rows @ points, -1, 1)
    at = (placed[:, :1] + 1) * np.float32((KNOTS - 1) / 2)
    hats = np.maximum(1 - np.abs(at - np.arange(KNOTS, dtype=np.float32)[:, None]), 0)
    return hats, placed[:, 1]


def _near_the_next(places: np.ndarray, size: np.ndarray) -> BoolArray:
    """Which places (M, n) along an axis, of those up to ``size`` (M,), are as near to the next as any is."""
    apart = np.diff(places, append=places[:, -1:] + 1)
    within = places + apart < size[:, None]
    return np.asarray(apart == np.where(within, apart, apart.max()).min(axis=1, keepdims=True))


def _columns_and_rows(quad: Quad, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns (M, W) and rows (M, H) that leave about ``_MAX_PIXELS`` of the bands about sides, or some more.

    Neighbouring pixels say nearly the same, so a large marking needs only some of them; columns or rows
    are left out along the marking's longer extent, the finer sampling staying across it. Of a slim one few
    are left out at its two ends, which show how long it is, but more between. ``size`` (M, 2) is that of the
    box from whose first pixel the corners count, px.
    """
    each = np.arange(len(size))
    along = np.where(size[:, 0] >= size[:, 1], 0, 1)
    longest, area = quad.length.max(axis=1), quad.area
    band = area + _OUTSIDE_PX * (quad.length.sum(axis=1) + 4 * _OUTSIDE_PX)
    band -= np.maximum(longest - 2 * _INSIDE_PX, 0) * np.maximum(area / longest - 2 * _INSIDE_PX, 0)
    ratio = np.maximum(band / _MAX_PIXELS, 1.0)
    longer = np.ceil(ratio / np.maximum(ratio / 4, 1))
    step = np.empty_like(size)
    step[each, along], step[each, 1 - along] = longer, np.ceil(ratio / longer)
    place, extent = np.sort(quad.corners[each, :, along], axis=1), size[each, along]
    head = np.ceil(np.minimum(place[:, 1], place[:, 0] + quad.width) + _END_PX).astype(np.intp)
    tail = np.floor(np.maximum(place[:, 2], place[:, 3] - quad.width) - _END_PX).astype(np.intp)
    slim = (step[each, along] > 1) & (head + extent - tail < _MOST_ENDS * extent)
    per_place = band / extent
    between = np.ceil(per_place * (tail - head) / _MAX_BETWEEN).astype(np.intp)
    at_ends = np.ceil(per_place * (head + extent - tail) / _MAX_AT_ENDS).astype(np.intp)
    step[slim] = 1
    step[each[slim], along[slim]] = np.maximum(between[slim], 1)
    outer = np.ones_like(step)
    outer[each[slim], along[slim]] = at_ends[slim]
    bounds = np.zeros((len(size), 2, 2), dtype=np.intp)
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


def _in_band(quad: Quad, bow_px: FloatArray, columns: np.ndarray, rows: np.ndarray) -> BoolArray:
    """Which pixels (M, H, W) of a lattice are near a side; sides are bowed by up to ``bow_px`` (M,)."""
    outward = quad.outward.astype(np.float32)
    u, v = columns[:, None, :].astype(np.float32), rows[:, :, None].astype(np.float32)
    reach = np.full((len(u), rows.shape[1], columns.shape[1]), -np.inf, dtype=np.float32)
    for side in range(4):
        by_u, by_v, offset = outward[:, side, :, None, None].swapaxes(0, 1)
        np.maximum(reach, by_u * u + (by_v * v + offset), out=reach)
    spare = bow_px.astype(np.float32)[:, None, None]
    return np.asarray((reach < spare + np.float32(_OUTSIDE_PX)) & (reach > -spare - np.float32(_INSIDE_PX)))
