"""The pixels that show where a marking's sides are, and the model of each.

There is a coarse grid all over a marking and a lattice about its sides. The model says how much of a pixel a
quadrilateral covers, and how much the pixel counts in a fit.

Let h be a pixel's distance from a side's line, s0 and s1 the side's ends along that line, seen from the
pixel's foot, all in units of the blur b. A radial Gaussian separates along and across any side, hence in
closed form

    coverage = [pixel inside] + sum over sides of sign(h) (T(|h|, s1) - T(|h|, s0)),
    change of coverage by a shift w(s) of the side outwards = pdf(h) integral_s0^s1 w(s) pdf(s) ds / b,

with T(h, s) the Gaussian's mass in the triangle between the pixel and the line beyond [0, s]: Owen's T
function of h and s / h (Owen, Annals of Mathematical Statistics, 1956), taken from a table.

A pixel counts by Cauchy's weight over the variance of the side that is nearest. Neighbouring pixels err
alike, along a seam or a frayed edge; their variances are inflated by as much.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from v2hdm.detection.network import as_probability
from v2hdm.detection.quads.patch import LensFrames, Patches
from v2hdm.geometry.planar import Quad
from v2hdm.records import BoolArray, FloatArray, IntArray

KNOTS = 6  # knots of the light along a marking: its two ends are as many fifths of it apart as a shadow needs

_OUTSIDE_PX = 3.0
_INSIDE_PX = 4.0
_MEDIAN_STRIDE = 3
_MAX_PIXELS = 350
_MOST_PIXELS = 600  # a band of more pixels is thinned: all markings of an image are padded to the most
_MAX_BETWEEN = 160
_MAX_AT_ENDS = 260
_END_PX = 2.0
_MOST_ENDS = 1 / 3
"""Ends of at most this share of the length make a quadrilateral slim; they reach that far past corners."""

_SEARCH_ALONG = 40
_SEARCH_ACROSS = 12  # rows and columns of the coarse grid on which a fit begins
_MARGIN_ALONG = 0.2
_MARGIN_ACROSS = 0.4  # how far it reaches beyond a quadrilateral, in lengths and widths

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
        looked: tuple[np.ndarray, np.ndarray, np.ndarray],
        neighbours: np.ndarray,
        count: IntArray,
    ) -> Lattice:
        """Pixels (M, N, 2) about quadrilaterals in their frames, of which :meth:`Patches.look` is known."""
        light, used, limited = looked
        points = np.ones((len(pixels), 3, pixels.shape[1]), dtype=np.float32)
        points[:, :2] = frames.from_image(pixels).swapaxes(1, 2)
        outside = quad.outward.astype(np.float32) @ points
        nearest = outside.max(axis=1, keepdims=True)
        inside = (nearest[:, 0] < 0).astype(np.float32)
        of_side = (outside == nearest).astype(np.float32)
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
    """A coarse grid all over quadrilaterals (M, 4, 2), recorded px, the paint's probability there (M, N).

    The third is how far apart its points are (M,), px.
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
    none = np.zeros((shape[0], 0, shape[1]), dtype=np.intp)
    count = np.full(shape[0], shape[1])
    return Lattice.about(frames, quad, pixels, looked, none, count), paint, spacing


def lay_lattice(patches: Patches, frames: LensFrames, corners_px: FloatArray) -> Lattice:
    """The pixels about the sides of quadrilaterals ``corners_px`` (M, 4, 2), recorded px."""
    bow_px = frames.bow_px(corners_px)
    spare = np.ceil(bow_px)[:, None].astype(np.intp) + int(_OUTSIDE_PX)
    low = np.floor(corners_px.min(axis=1)).astype(np.intp) - spare
    size = np.ceil(corners_px.max(axis=1)).astype(np.intp) + spare + 1 - low
    in_box = Quad(corners_px - low[:, None])
    columns, rows = _columns_and_rows(in_box, size)
    across = columns.shape[1]
    down = rows.shape[1]
    band = _in_band(in_box, bow_px, columns, rows, size)
    cell = np.flatnonzero(band)
    marking, within = np.divmod(cell, across * down)
    i, j = np.divmod(within, across)
    u = low[marking, 0] + columns[marking, j]
    v = low[marking, 1] + rows[marking, i]
    count = np.bincount(marking, minlength=len(low))
    place = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
    thin = -(-count // _MOST_PIXELS)
    kept = place % thin[marking] == 0
    cell, marking, i, j, u, v = (part[kept] for part in (cell, marking, i, j, u, v))
    place = place[kept] // thin[marking]
    count = -(-count // thin)
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
    used = np.zeros(shape, dtype=np.float32)
    limited = np.zeros(shape, dtype=np.bool_)
    used[marking, place] = use
    limited[marking, place] = clipped
    quad = Quad(frames.from_image(corners_px))
    return Lattice.about(frames, quad, pixels, (planes, used, limited), neighbours, count)


def _clearest(light: np.ndarray, used: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Log grey, red or blue (M, N) of (3, M, N), in which inside and outside differ most: yellow in blue."""
    apart = np.float32(0)
    variance = np.float32(0)
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

    Neighbouring pixels say nearly the same: some are left out along a marking's longer extent, fewer at its
    ends, never across. ``size`` (M, 2), px, is that of the box from whose first pixel the corners count.
    """
    each = np.arange(len(size))
    along = np.where(size[:, 0] >= size[:, 1], 0, 1)
    longest = quad.length.max(axis=1)
    area = quad.area
    band = area + _OUTSIDE_PX * (quad.length.sum(axis=1) + 4 * _OUTSIDE_PX)
    band -= np.maximum(longest - 2 * _INSIDE_PX, 0) * np.maximum(area / longest - 2 * _INSIDE_PX, 0)
    ratio = np.maximum(band / _MAX_PIXELS, 1.0)
    longer = np.ceil(ratio / np.maximum(ratio / 4, 1))
    step = np.empty_like(size)
    step[each, along] = longer
    step[each, 1 - along] = np.ceil(ratio / longer)
    place = np.sort(quad.corners[each, :, along], axis=1)
    extent = size[each, along]
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
    """Places (M, n) up to ``size`` (M,): every ``step``-th within ``bounds`` (M, 2), else ``outer``-th."""
    head, tail = bounds.T
    first = -(-head // outer)
    between = -(-(tail - head) // step)
    count = first + between + np.maximum(-(-(size - tail) // outer), 0)
    k = np.arange(int(count.max()) + 1)
    head = head[:, None]
    tail = tail[:, None]
    step = step[:, None]
    outer = outer[:, None]
    first = first[:, None]
    between = between[:, None]
    middle = head + (k - first) * step
    last = tail + (k - first - between) * outer
    return np.asarray(np.where(k < first, k * outer, np.where(k < first + between, middle, last)))


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
        reach = (down[:, :, None] + across[:, None]).max(axis=0)
        band[m, :height, :width] = (reach < spare[m] + _OUTSIDE_PX) & (reach > -spare[m] - _INSIDE_PX)
    return band


_LOG_SQRT_2PI = 0.9189385332046727
_LEAST_EXPONENT = -40.0


def normal_pdf(x: np.ndarray) -> np.ndarray:
    """Density of the standard normal, float32; at least 1e-18, as denormal numbers are slow."""
    flat = x.reshape(-1, x.shape[-1])
    exponent = np.asarray(cv2.multiply(flat, flat, scale=-0.5)) - np.float32(_LOG_SQRT_2PI)
    np.maximum(exponent, np.float32(_LEAST_EXPONENT), out=exponent)
    # OpenCV's exponential takes a quarter of the time of numpy's.
    return np.asarray(cv2.exp(exponent, dst=exponent)).reshape(x.shape)


def normal_share(x: np.ndarray) -> np.ndarray:
    """Share of the standard normal between 0 and ``x``, negative to the left, float32, to 1.4e-4.

    The logistic function of 1.5976 x + 0.07056 x^3 (Bowling et al., Journal of Industrial Engineering and
    Management, 2009): only slopes are made of it, and slopes this wrong do not move what a fit settles at.
    Counted from the middle, differences far out are 0 instead of denormal numbers.
    """
    half_odds = x * x
    half_odds *= np.float32(0.03528)
    half_odds += np.float32(0.7988)
    half_odds *= x
    np.tanh(half_odds, out=half_odds)
    half_odds *= np.float32(0.5)
    return np.asarray(half_odds)


_CELLS_PER_BLUR = 32
_REACH = 4.5
_LAST_CELL = (_CELLS_PER_BLUR * _REACH * np.array([1, 2, 2])[:, None, None, None] - 1.01).astype(np.float32)


def blurred_coverage(
    quad: Quad, points: np.ndarray, blur_px: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Coverage (M, N) in [0, 1] of pixels by M convex quadrilaterals, and its derivative (M, 9, N) per px.

    That is by which a side's start (0 to 3) or end (4 to 7) moves along its outward normal, or (8) the blur
    grows; all float32. ``points`` (M, 3, N) are pixel centres (u, v, 1) from a point near each quadrilateral,
    ``blur_px`` the point spread's sigma, pixel aperture included.
    """
    tangent = quad.tangent
    length = quad.length
    per_blur = 1 / np.reshape(blur_px, (-1, 1, 1))
    # Rows of a matrix that takes (u, v, 1) to the outward distance, and to the side's start and end.
    rows = np.empty((3, len(tangent), 4, 3))
    rows[0] = quad.outward
    rows[1:, ..., :2] = -tangent
    rows[1, ..., 2] = (tangent * quad.corners).sum(axis=-1)
    rows[2, ..., 2] = rows[1, ..., 2] + length
    rows *= per_blur
    placed = rows.astype(np.float32) @ points
    across, start = placed[:2]
    density, pdf_start, pdf_end = normal_pdf(placed)
    to_start, to_end = normal_share(placed[1:])
    share = np.subtract(to_end, to_start, out=to_end)
    by_end = np.subtract(pdf_start, pdf_end, out=pdf_start)
    by_end -= np.multiply(start, share, out=pdf_end)
    by_end *= (1 / np.maximum(length[..., None] * per_blur, 1e-3)).astype(np.float32)
    density *= per_blur.astype(np.float32)
    derivative = np.empty((len(tangent), 9, points.shape[2]), dtype=np.float32)
    sides = np.multiply(density, share, out=derivative[:, :4])
    ends = np.multiply(density, by_end, out=derivative[:, 4:8])
    # A wider blur is a smaller picture: each side comes nearer to the pixel in proportion to its distance.
    np.multiply(sides, across, out=share).sum(axis=1, out=derivative[:, 8])
    sides -= ends
    inside = (across < 0).all(axis=1)
    sign = np.copysign(np.float32(1), across)
    np.abs(across, out=across)
    placed[1:] += np.float32(_REACH)
    placed *= np.float32(_CELLS_PER_BLUR)
    np.clip(placed, 0, _LAST_CELL, out=placed)
    row, start, end = placed.reshape(3, -1, placed.shape[-1])
    # Borders are slow in OpenCV; the indices were kept inside.
    sign *= np.subtract(
        cv2.remap(owen_table(), end, row, cv2.INTER_LINEAR),
        cv2.remap(owen_table(), start, row, cv2.INTER_LINEAR),
    ).reshape(sign.shape)
    coverage = sign.sum(axis=1)
    coverage += inside
    return coverage, derivative


@cache
def owen_table() -> np.ndarray:
    """T(h, s), float32, ``_CELLS_PER_BLUR`` cells a blur: h from 0, s from ``-_REACH``; constant beyond."""
    h = np.arange(0, round(_REACH * _CELLS_PER_BLUR) + 1) / _CELLS_PER_BLUR
    s = h[None, :]
    angle = np.arctan2(s, h[:, None])
    node, weight = np.polynomial.legendre.leggauss(24)
    total = np.zeros(angle.shape)
    for x, w in zip(node, weight, strict=True):
        cosine = np.maximum(np.cos(angle * (1 + x) / 2), 1e-9)
        total += w / 2 * np.exp(-0.5 * (h[:, None] / cosine) ** 2)
    positive = total * angle / (2 * np.pi)
    positive[-2:] = 0.0
    return np.ascontiguousarray(np.hstack([-positive[:, :0:-1], positive]).astype(np.float32))


def variance_inflation(first: np.ndarray, second: np.ndarray, weight: np.ndarray, most: float) -> FloatArray:
    """Factor (...) by which a fit's variance grows if residuals (..., N) correlate with their neighbours.

    That is (1 + r) / (1 - r), as of a first-order autoregressive process (Bartlett, Journal of the Royal
    Statistical Society, 1946); pairs have a ``weight`` (..., N), and r is between 0 and ``most``.
    """
    power = (weight * (first * first + second * second)).sum(axis=-1) / 2
    r = np.clip((weight * first * second).sum(axis=-1) / np.maximum(power, 1e-12), 0.0, most)
    return np.asarray((1 + r) / (1 - r), dtype=np.float64)


_PAINT_SIGMA = 0.25  # how far the network's probability of paint is from the coverage
_MIN_SCATTER = 0.01  # least scatter of log grey: quantisation and noise of the best sensor
_SHARED_PIXELS = 20.0  # a side's variance is drawn to that of all sides as if by so many pixels
_CAUCHY = 2.385  # Cauchy's scale for 95 % efficiency (Holland and Welsch, 1977)
_MAX_CORRELATION = 0.7  # of the residuals of neighbouring pixels; beyond it few pixels would settle all


def pixel_weights(
    residual: np.ndarray, use: np.ndarray, lattice: Lattice, least_scatter: float
) -> tuple[np.ndarray, FloatArray, FloatArray]:
    """Weight (M, N) of every pixel: Cauchy's over its side's inflated variance; scatter (M, 4); mean (M,)."""
    size = np.abs(residual)
    scale = np.maximum(1.4826 * lattice.median_used(size, use), max(_MIN_SCATTER, least_scatter))
    robust = use / (1 + (size / (_CAUCHY * scale[:, None])) ** 2)
    square = robust * residual * residual
    total = square.sum(axis=1)
    count = robust.sum(axis=1)
    shared = total / np.maximum(count, 1)
    by_side = np.stack([square, robust], axis=1) @ lattice.of_side.swapaxes(1, 2)
    variance = (by_side[:, 0] + _SHARED_PIXELS * shared[:, None]) / (by_side[:, 1] + _SHARED_PIXELS)
    variance = np.maximum(variance.astype(np.float64), _MIN_SCATTER**2)
    inflation = np.ones(len(residual))
    rows = residual.shape[1] * np.arange(len(residual))[:, None]
    for neighbour in lattice.neighbours.swapaxes(0, 1):
        at = neighbour + rows
        pair = robust * robust.take(at) * (neighbour > 0)
        inflation *= variance_inflation(residual, residual.take(at), pair, _MAX_CORRELATION)
    per_pixel = 1 / (variance * inflation[:, None])
    weight = robust * (per_pixel.astype(np.float32)[:, None] @ lattice.of_side)[:, 0]
    return weight, np.sqrt(variance), (count / np.maximum(use.sum(axis=1), 1)).astype(np.float64)


def add_paint(
    information: FloatArray,
    gradient: FloatArray,
    coverage: np.ndarray,
    by_shape: np.ndarray,
    paint: np.ndarray,
    use: np.ndarray,
) -> None:
    """Add that the network's probability of paint (M, N) is the coverage, with Cauchy weights."""
    residual = paint - coverage
    weight = use / (_PAINT_SIGMA**2 * (1 + (residual / (_CAUCHY * _PAINT_SIGMA)) ** 2))
    by_side = by_shape[:, :8]
    weighted = by_side * weight[:, None]
    information[:, :8, :8] += weighted @ by_side.swapaxes(1, 2)
    gradient[:, :8] += (weighted @ residual[..., None])[..., 0]
