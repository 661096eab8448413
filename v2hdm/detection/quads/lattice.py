"""The pixels that show where a marking's sides are.

A coarse grid lies all over a marking, and a lattice of pixels about its sides. The lists of pixels of all
markings of an image are in one array; those shorter than the longest are padded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from v2hdm.detection.network import as_probability
from v2hdm.detection.quads.patch import LensFrames, Looked, Patches
from v2hdm.geometry.planar import Quad
from v2hdm.native import kernels
from v2hdm.records import BoolArray, FloatArray, IntArray

KNOTS = 6  # knots of the light along a marking: its two ends are as many fifths of it apart as a shadow needs

_FAR_PX = 200  # from the image, px, up to which pixels about a side are listed: none beyond shows paint
_OUTSIDE_PX = 3.0  # distance outside a side, px, up to which pixels are looked at
_INSIDE_PX = 4.0  # distance inside a side, px, up to which pixels are looked at
_MEDIAN_STRIDE = 3  # a median is taken over every third value: that is as good, and faster

_MAX_PIXELS = 350  # pixels of a band to which the choice of columns and rows aims
_MOST_PIXELS = 600  # a band of more pixels is thinned: all markings of an image are padded to the most

_MAX_BETWEEN = 160  # pixels to which the choice of places aims between the ends of a slim quadrilateral
_MAX_AT_ENDS = 260  # pixels to which it aims at the two ends of a slim quadrilateral
_END_PX = 2.0  # distance, px, that the ends of a slim quadrilateral reach past its corners
_MOST_ENDS = 1 / 3  # share of the length that the two ends of a slim quadrilateral take at most

_SEARCH_ALONG = 40  # points of the coarse grid, on which a fit begins, along a marking
_SEARCH_ACROSS = 12  # points of the coarse grid across a marking
_MARGIN_ALONG = 0.2  # reach of the coarse grid beyond the ends of a quadrilateral, in lengths
_MARGIN_ACROSS = 0.4  # reach of the coarse grid beyond its long sides, in widths

_GREY_FIRST = 1.2  # how many times clearer red or blue must be for grey to be left: it has the least noise


@dataclass(frozen=True)
class Lattice:
    """Up to N pixels about each of M markings, float32."""

    points: np.ndarray  # (M, 3, N) (x, y, 1) in the markings' frames
    values: np.ndarray  # (M, N) log grey
    use: np.ndarray  # (M, N) 1 where a pixel takes part, else 0
    limited: np.ndarray  # (M, N) where the sensor was at its limit
    clipped: FloatArray  # (M, 1) the share of those
    neighbours: np.ndarray  # (M, 2, N) place of the next pixel right and below, 0 for none
    of_side: np.ndarray  # (M, 4, N) 1 for the side that is nearest
    hats: np.ndarray  # (M, KNOTS, N) interpolate between knots along the marking
    across: np.ndarray  # (M, N) from -1 to 1 across it
    count: IntArray  # (M, 1) of the N are there, the first ones

    @classmethod
    def about(
        cls,
        frames: LensFrames,
        quad: Quad,
        pixels: FloatArray,
        looked: Looked,
        neighbours: np.ndarray,
        count: IntArray,
    ) -> Lattice:
        """The lattice of pixels (M, N, 2) about quadrilaterals in their frames, as they were ``looked`` at.

        The fields of ``looked`` are (3, M, N), (M, N) float32 and (M, N); ``neighbours`` is (M, 2, N) and
        ``count`` (M,).
        """
        points = np.ones((len(pixels), 3, pixels.shape[1]), dtype=np.float32)
        points[:, :2] = frames.from_image(pixels).swapaxes(1, 2)
        outside = quad.outward.astype(np.float32) @ points
        nearest = outside.max(axis=1, keepdims=True)
        inside = (nearest[:, 0] < 0).astype(np.float32)
        of_side = (outside == nearest).astype(np.float32)
        hats, across = _light_basis(quad, points)
        use = looked.use
        limited = looked.clipped
        of_side *= use[:, None]
        return cls(
            points=points,
            values=_clearest(looked.light, use, inside),
            use=use,
            limited=limited,
            clipped=limited.sum(axis=1, keepdims=True) / np.maximum(use.sum(axis=1, keepdims=True), 1),
            neighbours=neighbours,
            of_side=of_side,
            hats=hats,
            across=across,
            count=count[:, None],
        )

    @classmethod
    def seen(cls, patches: Patches, frames: LensFrames, quad: Quad, pixels: IntArray) -> Lattice:
        """The lattice of pixels (2, M, N), columns and rows, about quadrilaterals in their frames."""
        u, v = pixels
        compiled = kernels()
        if compiled is not None:
            return cls(**compiled.look(patches.source, _placed(patches, frames, quad), u, v, _GREY_FIRST))
        flat = patches.look(u.ravel(), v.ravel(), np.repeat(np.arange(len(u)), u.shape[1]))
        looked = Looked(
            light=flat.light.reshape(3, *u.shape),
            use=flat.use.reshape(u.shape).astype(np.float32),
            clipped=flat.clipped.reshape(u.shape),
        )
        no_neighbours = np.zeros((len(u), 0, u.shape[1]), dtype=np.intp)
        count = np.full(len(u), u.shape[1])
        return cls.about(
            frames, quad, np.stack([u, v], axis=2).astype(np.float64), looked, no_neighbours, count
        )

    def take(self, rows: IntArray) -> Lattice:
        """Some of the markings, in lists that are no longer than they need."""
        most = int(self.count[rows].max(initial=1))
        return Lattice(**{name: array[..., :most].take(rows, axis=0) for name, array in vars(self).items()})

    def median_used(self, values: np.ndarray, use: np.ndarray) -> np.ndarray:
        """Median (M,) of every few values of (M, N) over the pixels of ``use``; 0 where there is none."""
        used = use[:, ::_MEDIAN_STRIDE] > 0
        ordered = np.sort(np.where(used, values[:, ::_MEDIAN_STRIDE], np.float32(np.inf)), axis=1)
        count = used.sum(axis=1)
        median = ordered[np.arange(len(values)), np.maximum(count // 2 - 1, 0)]
        return np.asarray(np.where(count > 0, median, np.float32(0)))


class Grid(NamedTuple):
    """A coarse grid all over M quadrilaterals."""

    lattice: Lattice
    paint: np.ndarray  # (M, N) float32 probability of paint by the network
    spacing_px: FloatArray  # (M,) between its points, along


def lay_grid(patches: Patches, frames: LensFrames, corners_px: FloatArray) -> Grid:
    """The coarse grid all over quadrilaterals (M, 4, 2), recorded px."""
    quad = Quad(frames.from_image(corners_px))
    along = np.linspace(-_MARGIN_ALONG, 1 + _MARGIN_ALONG, _SEARCH_ALONG)
    across = np.linspace(-_MARGIN_ACROSS, 1 + _MARGIN_ACROSS, _SEARCH_ACROSS)
    a, b = (part.ravel() for part in np.meshgrid(along, across))
    pixels = np.clip(np.round(frames.to_px(quad.long_first().at(a, b))), -(10**6), 10**6)
    paint = as_probability(patches.output.odds_at(pixels)).astype(np.float32)
    spacing_px = quad.length.max(axis=1) * (1 + 2 * _MARGIN_ALONG) / _SEARCH_ALONG
    lattice = Lattice.seen(
        patches, frames, quad, np.ascontiguousarray(np.moveaxis(pixels, 2, 0), dtype=np.intp)
    )
    return Grid(lattice, paint, spacing_px)


def lay_lattice(patches: Patches, frames: LensFrames, corners_px: FloatArray) -> Lattice:
    """The pixels about the sides of quadrilaterals ``corners_px`` (M, 4, 2), recorded px."""
    # A corner may lie anywhere, where the lens is nothing like its polynomial.
    image_px = np.array(patches.source.image.shape[1::-1])
    bow_px = np.minimum(frames.bow_px(corners_px), _FAR_PX)
    spare = np.ceil(bow_px)[:, None].astype(np.intp) + int(_OUTSIDE_PX)
    high = np.minimum(np.ceil(corners_px.max(axis=1)).astype(np.intp) + spare + 1, image_px + _FAR_PX)
    low = np.maximum(np.floor(corners_px.min(axis=1)).astype(np.intp) - spare, -_FAR_PX)
    low = np.minimum(low, high - 1)
    size = high - low
    in_box = Quad(corners_px - low[:, None])
    columns, rows = _columns_and_rows(in_box, size)
    compiled = kernels()
    if compiled is not None:
        band = _Band(
            columns=columns,
            rows=rows,
            size=size,
            low=low,
            near_right=_near_the_next(columns, size[:, 0]),
            near_below=_near_the_next(rows, size[:, 1]),
            outward=in_box.outward.astype(np.float32),
            spare_px=bow_px.astype(np.float32),
        )
        placed = _placed(patches, frames, Quad(frames.from_image(corners_px)))
        return Lattice(**compiled.lay_lattice(patches.source, placed, band, _GREY_FIRST))
    chosen = _chosen_pixels(_in_band(in_box, bow_px, columns, rows, size))
    marking = chosen.marking
    place = chosen.place
    u = low[marking, 0] + columns[marking, chosen.column]
    v = low[marking, 1] + rows[marking, chosen.row]
    shape = (len(low), max(1, int(chosen.list_length.max())))
    pixels = np.repeat(corners_px.mean(axis=1)[:, None], shape[1], axis=1)
    pixels[marking, place] = np.column_stack([u, v])
    neighbours = _neighbours(chosen, columns, rows, size, shape)
    flat = patches.look(u, v, marking)
    looked = Looked(
        light=np.zeros((3, *shape), dtype=np.float32),
        use=np.zeros(shape, dtype=np.float32),
        clipped=np.zeros(shape, dtype=np.bool_),
    )
    looked.light[:, marking, place] = flat.light
    looked.use[marking, place] = flat.use
    looked.clipped[marking, place] = flat.clipped
    quad = Quad(frames.from_image(corners_px))
    return Lattice.about(frames, quad, pixels, looked, neighbours, chosen.list_length)


class _Placed(NamedTuple):
    """Where M markings are, for the compiled kernels."""

    pieces: IntArray  # (M, 2) first and last piece of paint of each
    middle: FloatArray  # (M, 2) of their frames
    scale: FloatArray  # (M, 2, 2)
    outward: np.ndarray  # (M, 4, 3) float32 to distances outside their sides
    axes: np.ndarray  # (M, 2, 3) float32 of the light


def _placed(patches: Patches, frames: LensFrames, quad: Quad) -> _Placed:
    """Where quadrilaterals in their frames are."""
    return _Placed(
        patches.pieces, frames.middle, frames.scale, quad.outward.astype(np.float32), _light_axes(quad)
    )


class _Band(NamedTuple):
    """Where the bands about the sides of M markings are, for the compiled kernel."""

    columns: IntArray  # (M, W) places that are looked at
    rows: IntArray  # (M, H)
    size: IntArray  # (M, 2) of the box that they lie in, px
    low: IntArray  # (M, 2) its first pixel
    near_right: BoolArray  # (M, W) whether the next place is as near as any
    near_below: BoolArray  # (M, H)
    outward: np.ndarray  # (M, 4, 3) float32 to distances outside the sides, in the box
    spare_px: np.ndarray  # (M,) float32, bow of the sides
    outside_px: float = _OUTSIDE_PX
    inside_px: float = _INSIDE_PX
    most: int = _MOST_PIXELS


class _Chosen(NamedTuple):
    """The n pixels that M markings have in their lists together, in order."""

    cell: IntArray  # (n,) flat place in the band (M, H, W)
    marking: IntArray  # (n,) whose list each is in
    row: IntArray  # (n,) of the marking's box
    column: IntArray  # (n,)
    place: IntArray  # (n,) in the list of its marking
    thin: IntArray  # (M,) every so many-th pixel of the band is in the list
    list_length: IntArray  # (M,) pixels of each list
    band_shape: tuple[int, ...]  # M, H, W


def _chosen_pixels(band: BoolArray) -> _Chosen:
    """The pixels of a band (M, H, W), thinned where they are too many."""
    down, across = band.shape[1:]
    cell = np.flatnonzero(band)
    marking, within = np.divmod(cell, across * down)
    row, column = np.divmod(within, across)
    count = np.bincount(marking, minlength=len(band))
    place = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
    thin = -(-count // _MOST_PIXELS)
    stays = place % thin[marking] == 0
    marking = marking[stays]
    return _Chosen(
        cell=cell[stays],
        marking=marking,
        row=row[stays],
        column=column[stays],
        place=place[stays] // thin[marking],
        thin=thin,
        list_length=-(-count // thin),
        band_shape=band.shape,
    )


def _neighbours(
    chosen: _Chosen, columns: np.ndarray, rows: np.ndarray, size: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """The places (M, 2, N) in its list of the next pixel to the right of and below each, 0 for none."""
    marking = chosen.marking
    place = chosen.place
    is_thinned = chosen.thin[marking] > 1
    place_of_cell = np.zeros(int(np.prod(chosen.band_shape)), dtype=np.intp)
    place_of_cell[chosen.cell] = np.where(is_thinned, 0, place)
    neighbours = np.zeros((shape[0], 2, shape[1]), dtype=np.intp)
    to_the_row_below = chosen.band_shape[2]
    for axis, places, at, step in (
        (0, columns, chosen.column, 1),
        (1, rows, chosen.row, to_the_row_below),
    ):
        is_near = _near_the_next(places, size[:, axis])[marking, at]
        neighbours[marking, axis, place] = np.where(is_near, place_of_cell[chosen.cell + step], 0)
    # Where a band is thinned, the next in its row is the neighbour.
    same_row = (marking[1:] == marking[:-1]) & (chosen.row[1:] == chosen.row[:-1])
    thinned = np.flatnonzero(is_thinned[:-1] & same_row)
    neighbours[marking[thinned], 0, place[thinned]] = place[thinned] + 1
    return neighbours


def _clearest(light: np.ndarray, use: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Log grey, red or blue (M, N) of (3, M, N), in which inside and outside differ most: yellow in blue."""
    difference = np.float32(0)
    variance = np.float32(0)
    for part, sign in ((inside * use, 1), ((1 - inside) * use, -1)):
        count = np.maximum(part.sum(axis=1), 1)
        mean = (light * part).sum(axis=2) / count
        difference = difference + sign * mean
        variance = variance + ((light - mean[..., None]) ** 2 * part).sum(axis=2) / count
    clearness = np.abs(difference) / np.sqrt(variance + 1e-4)
    clearness[0] *= _GREY_FIRST
    return np.asarray(light[clearness.argmax(axis=0), np.arange(light.shape[1])])


def _light_basis(quad: Quad, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Hat functions (M, KNOTS, N) along the longest side, and a slope (M, N) across it."""
    placed = np.clip(_light_axes(quad) @ points, -1, 1)
    knot = (placed[:, :1] + 1) * np.float32((KNOTS - 1) / 2)
    hats = np.maximum(1 - np.abs(knot - np.arange(KNOTS, dtype=np.float32)[:, None]), 0)
    return hats, placed[:, 1]


def _light_axes(quad: Quad) -> np.ndarray:
    """Rows (M, 2, 3), float32, that take (x, y, 1) to places along and across, -1 to 1 within the marking."""
    along = quad.tangent[np.arange(len(quad.corners)), quad.length.argmax(axis=1)]
    axes = np.stack([along, along[:, ::-1] * [-1.0, 1.0]], axis=1)
    within = quad.corners @ axes.swapaxes(1, 2)
    middle = (within.max(axis=1) + within.min(axis=1)) / 2
    half = np.ptp(within, axis=1) / 2 + _OUTSIDE_PX
    return np.concatenate([axes / half[..., None], -(middle / half)[..., None]], axis=-1).astype(np.float32)


def _near_the_next(places: np.ndarray, size: np.ndarray) -> BoolArray:
    """Which places (M, n) along an axis, of those up to ``size`` (M,), are as near to the next as any is."""
    gap = np.diff(places, append=places[:, -1:] + 1)
    within = places + gap < size[:, None]
    return np.asarray(gap == np.where(within, gap, gap.max()).min(axis=1, keepdims=True))


class _Steps(NamedTuple):
    """The places of M boxes that are looked at, along both axes."""

    bounds: IntArray  # (M, 2, 2) first and last place between the ends, by axis
    step: IntArray  # (M, 2) every so many-th place is looked at between the bounds
    outer: IntArray  # (M, 2) every so many-th place is looked at before and after them


def _columns_and_rows(quad: Quad, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns (M, W) and rows (M, H) that leave about ``_MAX_PIXELS`` of the bands about sides, or some more.

    ``size`` (M, 2), px, is that of the box from whose first pixel the corners count.
    """
    steps = _steps_of(quad, size)
    columns, rows = (
        _places(steps.bounds[:, axis], steps.step[:, axis], steps.outer[:, axis], size[:, axis])
        for axis in (0, 1)
    )
    return columns, rows


def _steps_of(quad: Quad, size: np.ndarray) -> _Steps:
    """How the boxes of :func:`_columns_and_rows` are thinned.

    Neighbouring pixels say nearly the same: some are left out along a marking's longer extent, fewer at its
    ends, never across.
    """
    marking = np.arange(len(size))
    along = np.where(size[:, 0] >= size[:, 1], 0, 1)
    extent = size[marking, along]
    longest = quad.length.max(axis=1)
    area = quad.area
    # Pixels of the band: of the quadrilateral and a margin about it, less what is far inside.
    band = area + _OUTSIDE_PX * (quad.length.sum(axis=1) + 4 * _OUTSIDE_PX)
    band -= np.maximum(longest - 2 * _INSIDE_PX, 0) * np.maximum(area / longest - 2 * _INSIDE_PX, 0)
    ratio = np.maximum(band / _MAX_PIXELS, 1.0)
    step_along = np.ceil(ratio / np.maximum(ratio / 4, 1))
    step = np.empty_like(size)
    step[marking, along] = step_along
    step[marking, 1 - along] = np.ceil(ratio / step_along)
    outer = np.ones_like(step)
    bounds = np.zeros((len(size), 2, 2), dtype=np.intp)
    bounds[..., 1] = size
    # Slim ones have two ends, apart from each other, and a stretch between them.
    corner_places = np.sort(quad.corners[marking, :, along], axis=1)
    first_end = np.minimum(corner_places[:, 1], corner_places[:, 0] + quad.width) + _END_PX
    last_end = np.maximum(corner_places[:, 2], corner_places[:, 3] - quad.width) - _END_PX
    # Corners may lie outside of the box, which ends not far from the image.
    head = np.clip(np.ceil(first_end).astype(np.intp), 0, extent)
    tail = np.clip(np.floor(last_end).astype(np.intp), 0, extent)
    at_ends = head + extent - tail
    slim = np.flatnonzero((step[marking, along] > 1) & (at_ends < _MOST_ENDS * extent))
    per_place = band / extent
    step_between = np.ceil(per_place * (tail - head) / _MAX_BETWEEN).astype(np.intp)
    step_at_ends = np.ceil(per_place * at_ends / _MAX_AT_ENDS).astype(np.intp)
    step[slim] = 1
    step[slim, along[slim]] = np.maximum(step_between[slim], 1)
    outer[slim, along[slim]] = np.maximum(step_at_ends[slim], 1)
    bounds[slim, along[slim]] = np.column_stack([head, tail])[slim]
    return _Steps(bounds, step, outer)


def _places(bounds: np.ndarray, step: np.ndarray, outer: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Places (M, n) up to ``size`` (M,): every ``step``-th within ``bounds`` (M, 2), else ``outer``-th."""
    head, tail = bounds.T
    before = -(-head // outer)
    between = -(-(tail - head) // step)
    count = before + between + np.maximum(-(-(size - tail) // outer), 0)
    k = np.arange(int(count.max()) + 1)
    head, tail, step, outer, before, between = (
        column[:, None] for column in (head, tail, step, outer, before, between)
    )
    middle = head + (k - before) * step
    last = tail + (k - before - between) * outer
    return np.asarray(np.where(k < before, k * outer, np.where(k < before + between, middle, last)))


def _in_band(
    quad: Quad, bow_px: FloatArray, columns: np.ndarray, rows: np.ndarray, size: np.ndarray
) -> BoolArray:
    """Which pixels (M, H, W) of a lattice are near a side, bowed by up to ``bow_px`` (M,), within the box."""
    band = np.zeros((len(size), rows.shape[1], columns.shape[1]), dtype=np.bool_)
    widths = (columns < size[:, :1]).sum(axis=1)
    heights = (rows < size[:, 1:]).sum(axis=1)
    outward = quad.outward.astype(np.float32)
    spare = bow_px.astype(np.float32)
    columns = columns.astype(np.float32)
    rows = rows.astype(np.float32)
    # One by one: the largest box is many times as large as most.
    for m, (width, height) in enumerate(zip(widths.tolist(), heights.tolist(), strict=True)):
        by_u, by_v, offset = outward[m].T[:, :, None]
        across = by_u * columns[m, :width]
        down = by_v * rows[m, :height] + offset
        outside = (down[:, :, None] + across[:, None]).max(axis=0)
        band[m, :height, :width] = (outside < spare[m] + _OUTSIDE_PX) & (outside > -spare[m] - _INSIDE_PX)
    return band
