"""How probable it is that a line is one of a lane: a logistic function of features of the line.

First each line is judged alone, then with its span and among the others of its image. A
road's lines run beside each other, a lane apart: kerbs, joints and edges of shadows run closer. The weights,
in ``lane_score.json``, belong to the network. ``python -m train.ship`` fits them to renders
which no benchmark shows.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes.curve import Horizon, Line, LinePoints, basis
from v2hdm.detection.markings.foreground import Foreground
from v2hdm.detection.odds import as_probability
from v2hdm.detection.weights import LANE_SCORE_FILE
from v2hdm.records import LANE_DASH, FloatArray, IntArray

ALONE = (
    "best_crossings",
    "log_length_m",
    "log_length_px",
    "log_rows",
    "along_road",
    "paint_odds",
    "paint_along",
    "dash_share",
)
"""Features of a line by itself: log odds of its three surest crossings; its length on the ground, in the
image and down the image (upright things are as tall as they are long); the log ratio of its being along the
road; the log odds of its surest paint; the mean log odds of paint along it, and the share of that which the
network takes for dashes."""

SPAN = ("likelihood", "present_m", "painted_m", "painted_share")
"""Features of a line's span: the root of its log likelihood, the length of ground on which it is present,
that on which it shows paint between its points, and the share of rows there that do."""

AMONG = ("alone", "near_horizon", *SPAN, "a_lane_apart", "too_near")
"""Features of a line among others: its log odds alone, how far from the horizon it begins, its span; and of
the others that run beside it, weighed by their probability, the likest one a lane away and the number of
those nearer than a lane can be."""

_NO_PAINT = -3.0
"""Log odds of the surest paint of a line that shows none."""

_BEST = 3
_MOST_LOG_RATIO = 6.0
_UNKNOWN = (2.3, 0.4)
"""The last two of a line in an image of which the paint is not known: the median of true lines."""

_PLACES = 24
_ON_M = np.linspace(-0.25, 0.25, 7)
"""Paint of a line, be it a double one, is within such a distance of where it is drawn."""

_LEAST_WEIGHT = 0.05
"""Places without paint have this weight, that of paint being one."""

_LANE_M, _LANE_SIGMA_M = 3.2, 0.65
"""Lanes of roads are 2.5 to 4 m wide."""

_TOO_NEAR_M = 1.8
_MOST_NEAR = 2.0
"""More lines than this add nothing."""

_CHANGE_M, _CHANGE_SHARE = 0.15, 0.06
"""The distance between lines that run beside each other changes by so much and by this share of it."""


def log_odds_alone(
    lines: Sequence[Line],
    points: LinePoints,
    view: CameraView,
    horizon: Horizon,
    foreground: Foreground | None,
) -> FloatArray:
    """Log odds (N,) of N lines through an image's points, each by itself."""
    weights, bias = fitted()["alone"]
    return np.asarray(features_alone(lines, points, view, horizon, foreground) @ weights + bias)


def log_odds(lines: Sequence[Line], points: LinePoints, horizon: Horizon) -> FloatArray:
    """Log odds (N,) of N lines, all there are in an image; they have their spans and their log odds alone."""
    weights, bias = fitted()["among"]
    return np.asarray(features_among(lines, points, horizon) @ weights + bias)


def features_among(lines: Sequence[Line], points: LinePoints, horizon: Horizon) -> FloatArray:
    """The features (N, F) of N lines, all there are in an image, in the order of :data:`AMONG`."""
    if not lines:
        return np.empty((0, len(AMONG)))
    far = [points.below[line.members].min() for line in lines]
    spans = [_span_features(line, points) for line in lines]
    return np.column_stack(
        [[line.log_odds for line in lines], np.log(far), spans, _company(points, lines, horizon)]
    )


def _span_features(line: Line, points: LinePoints) -> tuple[float, float, float, float]:
    span, own = line.span, points.below[line.members]
    assert span is not None
    seen = (span.below >= own.min()) & (span.below <= own.max())
    return (
        float(np.sqrt(max(span.log_likelihood, 0.0))),
        float(span.length_m @ span.present),
        float(span.length_m[seen] @ span.painted[seen]),
        float(span.painted[seen].sum() / max(seen.sum(), 1)),
    )


def features_alone(
    lines: Sequence[Line],
    points: LinePoints,
    view: CameraView,
    horizon: Horizon,
    foreground: Foreground | None,
) -> FloatArray:
    """The features (N, F) of N lines by themselves, in the order of :data:`ALONE`."""
    if not lines:
        return np.empty((0, len(ALONE)))
    members = np.concatenate([line.members for line in lines])
    count = np.array([len(line.members) for line in lines])
    begins = np.cumsum(count) - count
    is_paint, odds = points.is_paint[members], points.odds[members]
    at_px, ground = points.points_px[members], points.ground[members]
    size_m = np.maximum.reduceat(ground, begins) - np.minimum.reduceat(ground, begins)
    size = np.maximum.reduceat(at_px, begins) - np.minimum.reduceat(at_px, begins)
    size = size / view.info.width
    length_m = np.hypot(*size_m.T)
    paint_odds = np.maximum.reduceat(np.where(is_paint, odds, -np.inf), begins)
    ratio = np.array([line.log_ratio for line in lines])
    columns = (
        _best_crossings(np.where(is_paint, -np.inf, odds), begins, count),
        np.log(length_m + 0.1),
        np.log(np.hypot(*size.T) + 0.005),
        np.log(size[:, 1] + 0.005),
        np.clip(ratio, -_MOST_LOG_RATIO, _MOST_LOG_RATIO),
        np.where(np.isfinite(paint_odds), paint_odds, _NO_PAINT),
        _paint_along(lines, points, view, horizon, foreground),
    )
    return np.column_stack(columns).astype(np.float64)


def _best_crossings(odds: FloatArray, begins: IntArray, count: IntArray) -> FloatArray:
    """Mean log odds (N,) of the surest crossings of each line, 0 where it has none; paint's are -inf."""
    order = np.lexsort((-odds, np.repeat(np.arange(len(count)), count)))
    first = begins[:, None] + np.minimum(np.arange(_BEST), count[:, None] - 1)
    best = odds[order[first]]
    there = np.isfinite(best) & (np.arange(_BEST) < count[:, None])
    return np.asarray(np.where(there, best, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1))


def _paint_along(
    lines: Sequence[Line],
    points: LinePoints,
    view: CameraView,
    horizon: Horizon,
    foreground: Foreground | None,
) -> FloatArray:
    """Mean log odds of paint along each line where it is seen, and the share of dashes in that (N, 2)."""
    if foreground is None:
        return np.tile(_UNKNOWN, (len(lines), 1))
    own = [points.below[line.members] for line in lines]
    below = np.linspace([b.min() for b in own], [b.max() for b in own], _PLACES, axis=1)
    phi = basis(below.ravel()).reshape(len(lines), _PLACES, 3)
    along = np.einsum("npk,nk->np", phi, np.array([line.curve.parameters for line in lines]))
    across = along[..., None] + horizon.px_per_m * below[..., None] * _ON_M
    rows = np.broadcast_to(below[..., None], across.shape)
    places_px = view.distort(horizon.pinhole_px(across.ravel(), rows.ravel())).reshape(*across.shape, 2)
    paint = foreground.odds_at(places_px).max(axis=2)
    weight = as_probability(paint) + _LEAST_WEIGHT
    dashes = foreground.shares_at(places_px[:, :, len(_ON_M) // 2])[:, foreground.classes.index(LANE_DASH)]
    return np.column_stack([paint.mean(axis=1), (dashes * weight).sum(axis=1) / weight.sum(axis=1)])


def _company(points: LinePoints, lines: Sequence[Line], horizon: Horizon) -> FloatArray:
    """How much the likest other line is a lane away, and how many are too near (N, 2)."""
    if len(lines) < 2:
        return np.zeros((len(lines), 2))
    apart = _apart_m(points, lines, horizon)
    gap = np.abs(apart[1])
    change = np.ptp(apart, axis=0) / (_CHANGE_M + _CHANGE_SHARE * gap)
    beside = as_probability(np.array([line.log_odds for line in lines])) * np.exp(-0.5 * change**2)
    np.fill_diagonal(beside, 0.0)
    lane = beside * np.exp(-0.5 * ((gap - _LANE_M) / _LANE_SIGMA_M) ** 2)
    near = np.where(gap < _TOO_NEAR_M, beside, 0.0).sum(axis=1)
    return np.column_stack([lane.max(axis=1), np.minimum(near, _MOST_NEAR)])


def _apart_m(points: LinePoints, lines: Sequence[Line], horizon: Horizon) -> FloatArray:
    """How far lines are apart along the horizon (3, N, N), m, at the far end, middle and near end of each."""
    parameters = np.array([line.curve.parameters for line in lines])
    spans = np.array([np.ptp(points.below[line.members]) for line in lines])
    low = np.array([points.below[line.members].min() for line in lines])
    below = (low + spans * np.array([[0.0], [0.5], [1.0]])).ravel()
    # Each line's own rows, at which all the others are looked at.
    rows = (basis(below) / (horizon.px_per_m * below)[:, None]).reshape(3, len(lines), 3)
    return np.asarray(np.einsum("sik,ijk->sij", rows, parameters[:, None] - parameters))


@cache
def fitted() -> dict[str, tuple[FloatArray, float]]:
    """Weights and bias of the logistic functions of a line ``alone`` and ``among`` others, from the file."""
    content = json.loads(LANE_SCORE_FILE.read_text(encoding="utf-8"))
    return {
        name: (np.array([content[name]["weights"][key] for key in keys]), float(content[name]["bias"]))
        for name, keys in (("alone", ALONE), ("among", AMONG))
    }
