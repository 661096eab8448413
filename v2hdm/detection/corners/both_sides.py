"""Where along a slim piece there is paint: brighter than the ground on both of its long sides.

Beside a seam of the surface a network takes the strip between line and seam for paint, and the piece of a
dash runs on along it, or joins two dashes. Such a tail is no brighter than the ground on one
of its sides. Shade and flecks of sun change the ground beside the paint too; where the light is another than
beside the rest, nothing is concluded from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.foreground import Foreground
from v2hdm.detection.corners.grey import GreyBand, log_grey
from v2hdm.geometry.ipm import apply_homography
from v2hdm.geometry.quadrilateral import following
from v2hdm.records import BoolArray, FloatArray

LONGEST_DASH_M = 12.0
"""No road code has a longer dash, an initial IPM that is decimetres off allowed for."""

_STATIONS = 48
_INSIDE = np.linspace(0, 1, 8, dtype=np.float32)
_BESIDE = np.linspace(0, 1, 3, dtype=np.float32)
_GAP_PX = 1.5
_BESIDE_SHARE, _BESIDE_LIMITS_PX = 0.5, (2.0, 12.0)
"""Across each station the grey is looked up inside, and on either side: from the gap outside the piece's own
side, which may be off by that, over this share of its width, within limits: the grey is known no farther."""

_IN = slice(len(_BESIDE), -len(_BESIDE))
_STEP_QUANTILE = 0.8
_LEAST_STEP = 0.25
_STEP_SHARE = 0.4
"""The step of paint is this quantile of all of a piece's, if not too small to tell from texture; where there
is less than this share of it there is no paint."""

_SAME_LIGHT = 0.4
"""Ground in one light differs by less than this in log grey."""

_PENALTY = 2.0
_LEAST_TAIL_M, _LEAST_TAIL_PX = 0.5, 4.0
_LEAST_GAP_M = 1.0
_LEAST_STRETCH_M = 0.7
_LEAST_GOOD_SHARE = 0.7
"""A metre without paint outweighs so many with it; shorter tails are left to the corner fit, shorter gaps are
worn paint, and shorter stretches, or such with less paint, are none."""

_LEAST_DOUBT = 1.0
"""The network's log odds of a tail are less than those of the paint by this: it is seldom as sure of it."""

_OUTER = 0.75
"""Wear takes paint from its edges and adds none: the outer quartile of what is seen is where they were."""

_LEAST_EDGES = 4
"""A third of a stretch with so many stations tells which way its side goes."""


@dataclass(frozen=True)
class _Across:
    """Grey across M pieces at n stations from one end to the other, evenly spaced in the image.

    On the ground, in m: ``axes`` (M, 2, 2) unit vectors along and across each piece; along it ``ends_m``
    (M, 2) and the stations ``along_m`` (M, n); across it the two sides ``beside_m`` (M, 2). In the image:
    ``step_px`` (M,) from station to station; ``place`` (M, n, k) where the log grey ``logs`` (M, n, k) was
    looked up, in widths from the first side to the second, nan where it is not known; ``odds`` (M, n) the
    network's log odds of paint in the middle.
    """

    axes: FloatArray
    ends_m: FloatArray
    along_m: FloatArray
    beside_m: FloatArray
    step_px: FloatArray
    place: np.ndarray
    logs: np.ndarray
    odds: FloatArray

    @property
    def step_m(self) -> FloatArray:
        """The length of ground (M, n) that each station stands for."""
        step = np.nan_to_num(np.diff(self.along_m, axis=1))
        middle = (step[:, 1:] + step[:, :-1]) / 2
        return np.asarray(np.concatenate([step[:, :1], middle, step[:, -1:]], axis=1))


def painted_parts(
    grey: GreyBand, foreground: Foreground, view: CameraView, corners_pinhole_px: FloatArray
) -> dict[int, list[FloatArray]]:
    """What is paint of slim quadrilaterals (M, 4, 2) that are not all paint.

    Args:
        grey: the image's grey values.
        foreground: what the network says of the image.
        view: the camera.
        corners_pinhole_px: the quadrilaterals; their corners lie on the ground before the camera.

    Returns:
        By index the stretches (4, 2), pinhole px, as narrow as the grey shows them, the best first; corners 0
        and 3 are one end. What is longer than any dash and holds no shorter one has none. Those that are
        missing show paint all over, or nothing that is surely none.
    """
    grey = grey.at_limit
    across = _look_across(grey, foreground, view, corners_pinhole_px)
    good, bad = _judge(across)
    step_m = across.step_m
    score = np.where(good, 1.0, np.where(bad, -_PENALTY, 0.0)) * step_m
    tail_m = np.maximum(_LEAST_TAIL_M, _LEAST_TAIL_PX * step_m / across.step_px[:, None])
    long = np.diff(across.ends_m, axis=1)[:, 0] > LONGEST_DASH_M
    asked = ((bad * step_m / tail_m).sum(axis=1) >= 1) & good.any(axis=1)
    parts: dict[int, list[FloatArray]] = {}
    for m in np.flatnonzero(asked | long).tolist():
        found = _stretches(score[m], step_m[m], tail_m[m])
        if found == [(0, _STATIONS)] and not long[m]:
            continue
        found = [part for part in found if step_m[m, slice(*part)].sum() <= LONGEST_DASH_M]
        if found or long[m]:
            parts[m] = [_quadrilateral(across, m, *part, good[m], view) for part in found]
    return _seen_closer(grey, foreground, view, parts)


def _seen_closer(
    grey: GreyBand, foreground: Foreground, view: CameraView, parts: dict[int, list[FloatArray]]
) -> dict[int, list[FloatArray]]:
    """The same stretches with the sides that a second look finds: the first was too coarse for the fit."""
    flat = [quad for quads in parts.values() for quad in quads]
    usable = [quad for quad in flat if np.isfinite(view.ground(quad)).all()]
    if not usable:
        return {m: [] for m in parts}
    across = _look_across(grey, foreground, view, np.stack(usable))
    good, _ = _judge(across)
    closer = {
        id(quad): _quadrilateral(across, k, 0, _STATIONS, good[k], view) if good[k].any() else quad
        for k, quad in enumerate(usable)
    }
    return {m: [closer[id(quad)] for quad in quads if id(quad) in closer] for m, quads in parts.items()}


def _look_across(grey: GreyBand, foreground: Foreground, view: CameraView, corners: FloatArray) -> _Across:
    """Look across the smallest rectangles on the ground along quadrilaterals (M, 4, 2), pinhole px."""
    count = len(corners)
    ground = view.ground(corners.reshape(-1, 2)).reshape(corners.shape)
    axes = _axes(ground)
    within = np.sort(ground @ axes.swapaxes(1, 2), axis=1)
    # A side may be askew: it ends where its middle does, and what is inside must be seen whole.
    ends_m = np.stack([within[:, :2, 0].mean(axis=1), within[:, 2:, 0].mean(axis=1)], axis=1)
    beside_m = within[:, [0, 3], 1]
    ends = np.stack([ends_m, np.broadcast_to(beside_m.mean(axis=1)[:, None], ends_m.shape)], axis=-1)
    ends_px = _to_pinhole(ends, axes, view)
    share = (np.arange(_STATIONS) + 0.5)[:, None] / _STATIONS
    middle_px = ends_px[:, :1] + share * (ends_px[:, 1:] - ends_px[:, :1])
    along_m = (view.ground(middle_px.reshape(-1, 2)).reshape(middle_px.shape) @ axes[:, 0, :, None])[..., 0]
    sides = np.empty((count, 2, _STATIONS, 2))
    sides[..., 0] = along_m[:, None]
    sides[..., 1] = beside_m[..., None]
    foot = view.distort(_to_pinhole(sides.reshape(count, -1, 2), axes, view).reshape(-1, 2))
    foot = foot.reshape(sides.shape).astype(np.float32)
    first, step = foot[:, 0], foot[:, 1] - foot[:, 0]
    axis = (ends_px[:, 1] - ends_px[:, 0]).astype(np.float32)
    long_px = np.maximum(np.hypot(axis[:, 0], axis[:, 1]), 1e-6)
    axis /= long_px[:, None]
    wide_px = np.maximum(np.abs(step[..., 0] * axis[:, 1:] - step[..., 1] * axis[:, :1]), 0.3)
    reach = np.clip(_BESIDE_SHARE * wide_px, *_BESIDE_LIMITS_PX) / wide_px
    beside = (_GAP_PX / wide_px)[..., None] + reach[..., None] * _BESIDE
    inside = np.broadcast_to(_INSIDE, (*reach.shape, len(_INSIDE)))
    place = np.concatenate([-beside[..., ::-1], inside, 1 + beside], axis=-1)
    points = first[:, :, None] + place[..., None] * step[:, :, None]
    values = grey.sample(points.reshape(-1, place.shape[-1], 2)).reshape(place.shape)
    logs = log_grey(values)
    odds = foreground.odds_at(first + step / 2)
    step_px = long_px / _STATIONS
    return _Across(axes, ends_m, along_m, beside_m, step_px, place, logs, odds)


def _axes(ground: FloatArray) -> FloatArray:
    """Unit vectors (M, 2, 2) along and across the longer sides of quadrilaterals (M, 4, 2)."""
    side = following(ground) - ground
    pairs = side[:, :2] - side[:, 2:]
    length = np.hypot(pairs[..., 0], pairs[..., 1])
    along = pairs[np.arange(len(ground)), length.argmax(axis=1)]
    along = along / np.maximum(length.max(axis=1), 1e-9)[:, None]
    return np.stack([along, along[:, ::-1] * [-1.0, 1.0]], axis=1)


def _to_pinhole(points_m: FloatArray, axes: FloatArray, view: CameraView) -> FloatArray:
    """Pinhole px (M, k, 2) of points (M, k, 2) along and across the axes of their piece."""
    ground = points_m @ axes
    return apply_homography(view.pinhole_px_from_vehicle, ground.reshape(-1, 2)).reshape(points_m.shape)


def _judge(across: _Across) -> tuple[BoolArray, BoolArray]:
    """Which stations (M, n) show paint, and which, in the same light, show none."""
    logs = across.logs
    beside = np.stack([logs[..., : len(_BESIDE)], logs[..., -len(_BESIDE) :]], axis=1)
    known = np.isfinite(logs).all(axis=-1)
    inside, ground = logs[..., _IN].max(axis=-1), beside.min(axis=-1)
    # What is beside the paint may be lighter a little farther off, so the darkest counts.
    step = _median_of_three(np.where(known, inside - ground.max(axis=1), np.float32(0)))
    typical = np.sort(step, axis=1)[:, int(_STEP_QUANTILE * _STATIONS), None]
    good = known & (step >= _STEP_SHARE * typical) & (typical >= _LEAST_STEP)
    light = beside.mean(axis=-1)
    same = (np.abs(light - _typical(light, good[:, None])[..., None]) < _SAME_LIGHT).all(axis=1)
    doubtful = across.odds < _typical(across.odds, good)[:, None] - _LEAST_DOUBT
    bad = known & ~good & same & doubtful
    return np.asarray(good), np.asarray(bad)


def _typical(values: np.ndarray, mask: BoolArray) -> np.ndarray:
    """Median (...) of values (..., n) under a mask, the lower of two; inf where there is none."""
    ordered = np.sort(np.where(mask, values, np.inf), axis=-1)
    middle = np.maximum(np.broadcast_to(mask, values.shape).sum(axis=-1, keepdims=True) - 1, 0) // 2
    return np.asarray(np.take_along_axis(ordered, middle, axis=-1)[..., 0])


def _median_of_three(values: np.ndarray) -> np.ndarray:
    """Each value (..., n) replaced by the median of itself and its neighbours."""
    padded = np.concatenate([values[..., :1], values, values[..., -1:]], axis=-1)
    low, middle, high = padded[..., :-2], padded[..., 1:-1], padded[..., 2:]
    return np.asarray(np.maximum(np.minimum(low, middle), np.minimum(np.maximum(low, middle), high)))


def _stretches(score: FloatArray, step_m: FloatArray, tail_m: FloatArray) -> list[tuple[int, int]]:
    """Ranges of stations, best first, that are paint but for little.

    Args:
        score: (n,) what speaks for paint at each station, m, or against it.
        step_m: (n,) the length of ground that it stands for.
        tail_m: (n,) what is cut off must be longer than this there.
    """
    score = _without_short_gaps(score, step_m)
    found: list[tuple[int, int]] = []
    left = [(0, len(score))]
    while left:
        first, last = left.pop()
        begin, end = _best_range(score[first:last])
        begin, end = first + begin, first + end
        if score[begin:end].sum() < _LEAST_STRETCH_M:
            continue
        if step_m[begin:end][score[begin:end] > 0].sum() < _LEAST_GOOD_SHARE * step_m[begin:end].sum():
            continue
        begin = first if (step_m / tail_m)[first:begin].sum() < 1 else begin
        end = last if (step_m / tail_m)[end:last].sum() < 1 else end
        found.append((begin, end))
        left += [(first, begin), (end, last)]
    return sorted(found, key=lambda part: -float(score[part[0] : part[1]].sum()))


def _without_short_gaps(score: FloatArray, step_m: FloatArray) -> FloatArray:
    """The score of stations (n,), where short runs between paint that speak against it say nothing."""
    score = score.copy()
    bounds = np.flatnonzero(np.diff(score < 0)) + 1
    for begin, end in pairwise(bounds.tolist()):
        if score[begin] < 0 and step_m[begin:end].sum() < _LEAST_GAP_M and (score[:begin] > 0).any():
            score[begin:end] = 0.0
    return score


def _best_range(score: FloatArray) -> tuple[int, int]:
    """The range with the largest sum, with what speaks neither for nor against at its ends."""
    if not len(score):
        return 0, 0
    total = np.concatenate([[0.0], np.cumsum(score)])
    lowest = np.minimum.accumulate(total)
    end = int(np.argmax(total - lowest))
    begin = int(np.flatnonzero(total[: end + 1] == lowest[end])[-1])
    while begin > 0 and score[begin - 1] == 0:
        begin -= 1
    while end < len(score) and score[end] == 0:
        end += 1
    return begin, end


def _quadrilateral(
    across: _Across, m: int, begin: int, end: int, good: BoolArray, view: CameraView
) -> FloatArray:
    """The stretch of a piece between stations, between where the grey rises and falls across it."""
    along_m, (first, second) = across.along_m[m], across.beside_m[m]
    at = begin + np.flatnonzero(good[begin:end])
    edges = first + (second - first) * _edges(across.logs[m, at], across.place[m, at])
    bounds = np.concatenate([across.ends_m[m, :1], (along_m[1:] + along_m[:-1]) / 2, across.ends_m[m, 1:]])
    ends = bounds[[begin, end]]
    # Round the quadrilateral: out along the first side, which is on the right, and back along the second.
    low = _resistant_line(along_m[at], edges[0], ends, 1 - _OUTER)
    high = _resistant_line(along_m[at], edges[1], ends, _OUTER)
    quad = np.column_stack([ends[[0, 1, 1, 0]], [low[0], low[1], high[1], high[0]]])
    return np.asarray(_to_pinhole(quad[None], across.axes[m : m + 1], view)[0])


def _edges(logs: np.ndarray, place: np.ndarray) -> FloatArray:
    """Where (2, n) along profiles (n, k) the paint about the brightest place ends: half way down."""
    k, pick = logs.shape[1], np.arange(len(logs))
    grey = np.exp(logs)
    top = len(_BESIDE) + grey[:, _IN].argmax(axis=1)
    edges = []
    for values, at, start in ((grey[:, ::-1], place[:, ::-1], k - 1 - top), (grey, place, top)):
        half = (grey[pick, top] + values[:, -len(_BESIDE) :].min(axis=1)) / 2
        below = (values < half[:, None]) & (np.arange(k) > start[:, None])
        last = np.where(below.any(axis=1), below.argmax(axis=1), k - 1)
        before, after = values[pick, last - 1], values[pick, last]
        share = np.clip((before - half) / np.maximum(before - after, 1e-6), 0, 1)
        edges.append(at[pick, last - 1] + share * (at[pick, last] - at[pick, last - 1]))
    return np.stack(edges).astype(np.float64)


def _resistant_line(x: FloatArray, y: FloatArray, wanted: FloatArray, quantile: float) -> FloatArray:
    """The line through that quantile of the first and the last third of points (n,), at ``wanted`` (k,)."""
    third = len(x) // 3
    if third < _LEAST_EDGES:
        return np.full(len(wanted), np.sort(y)[int(quantile * len(y))])
    x0, x1 = x[third // 2], x[-1 - third // 2]
    y0, y1 = (np.sort(part)[int(quantile * third)] for part in (y[:third], y[-third:]))
    return np.asarray(y0 + (wanted - x0) / (x1 - x0) * (y1 - y0))
