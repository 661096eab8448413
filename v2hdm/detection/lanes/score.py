"""The probability that a line bounds a lane: a logistic function of its features.

They are first those of the line alone, then those with its span and among the other lines of its image, which
run a lane apart; kerbs, joints and shadows run closer. The weights in ``lane_score.json`` belong to the
network; ``python -m train.ship`` fits them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache

import numpy as np

from v2hdm.detection.lanes.curves import LaneImage, Line, LinePoints
from v2hdm.detection.network import as_probability
from v2hdm.detection.weights import LANE_SCORE_FILE
from v2hdm.records import LANE_DASH, FloatArray, IntArray

ALONE = (
    "best_crossings", "log_length_m", "log_length_px", "log_rows", "along_road", "paint_odds", "paint_along",
    "dash_share",
)  # fmt: skip
"""Features of a line by itself: mean log odds of its three best crossings; its length on the ground, in the
image and down the image (upright objects are as tall as they are long); the log likelihood ratio of running
along the road; the log odds of its best paint; the mean log odds of paint along it, and the share of dashes
in that paint."""

_SPAN = ("likelihood", "present_m", "painted_m", "painted_share")
"""Features of a line's span: the root of its log likelihood; the ground, m, on which it is present, and on
which it shows paint between its points; and the share of rows between them with paint."""

AMONG = ("alone", "near_horizon", *_SPAN, "a_lane_apart", "too_near")
"""Features of a line among others: its log odds alone, the log distance of its far end from the horizon, its
span; and of the lines beside it, weighted by their probability, the best one a lane away and the number of
those nearer than a lane."""

_NO_PAINT = -3.0  # log odds of the best paint of a line without any
_BEST = 3  # crossings whose log odds are averaged
_MOST_LOG_RATIO = 6.0  # largest size of the log ratio along the road
_UNKNOWN = (2.3, 0.4)  # features of the paint along a line without network output: true lines' medians
_PLACES = 24  # along a line at which its paint is sampled
_ON_M = np.linspace(-0.25, 0.25, 7)  # across it: paint, also of double lines, lies within
_LEAST_WEIGHT = 0.05  # of places without paint, that of paint being one
_LANE_M = 3.2
_LANE_SIGMA_M = 0.65  # lanes of roads are 2.5 to 4 m wide
_TOO_NEAR_M = 1.8  # lines nearer than this do not bound one lane
_MOST_NEAR = 2.0  # more lines than this add nothing
_CHANGE_M = 0.15
_CHANGE_SHARE = 0.06  # sigma of the distance of parallel lines, m, and relative to it


def log_odds_alone(lines: Sequence[Line], points: LinePoints, image: LaneImage) -> FloatArray:
    """Log odds (N,) of N lines through an image's points, each by itself."""
    weights, bias = (image.score or fitted())["alone"]
    return np.asarray(features_alone(lines, points, image) @ weights + bias)


def log_odds(lines: Sequence[Line], points: LinePoints, image: LaneImage) -> FloatArray:
    """Log odds (N,) of all N lines of an image, with their spans and their log odds alone."""
    weights, bias = (image.score or fitted())["among"]
    return np.asarray(features_among(lines, points, image) @ weights + bias)


def features_among(lines: Sequence[Line], points: LinePoints, image: LaneImage) -> FloatArray:
    """Features (N, F) of all N lines of an image, in the order of :data:`AMONG`."""
    if not lines:
        return np.empty((0, len(AMONG)))
    far = np.log([points.below[line.members].min() for line in lines])
    spans = [_span_features(line, points) for line in lines]
    return np.column_stack([[line.log_odds for line in lines], far, spans, _company(points, lines, image)])


def _span_features(line: Line, points: LinePoints) -> tuple[float, float, float, float]:
    span = line.span
    own = points.below[line.members]
    assert span is not None
    between = (span.below >= own.min()) & (span.below <= own.max())
    return (
        float(np.sqrt(max(span.log_likelihood, 0.0))),
        float(span.length_m @ span.present),
        float(span.length_m[between] @ span.painted[between]),
        float(span.painted[between].sum() / max(between.sum(), 1)),
    )


def features_alone(lines: Sequence[Line], points: LinePoints, image: LaneImage) -> FloatArray:
    """Features (N, F) of N lines by themselves, in the order of :data:`ALONE`."""
    if not lines:
        return np.empty((0, len(ALONE)))
    members = np.concatenate([line.members for line in lines])
    count = np.array([len(line.members) for line in lines])
    begins = np.cumsum(count) - count
    is_paint = points.is_paint[members]
    odds = points.odds[members]
    at_px = points.points_px[members]
    ground = points.ground[members]
    size_m = np.maximum.reduceat(ground, begins) - np.minimum.reduceat(ground, begins)
    size = np.maximum.reduceat(at_px, begins) - np.minimum.reduceat(at_px, begins)
    size = size / image.camera.info.width
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
        _paint_along(lines, points, image),
    )
    return np.column_stack(columns).astype(np.float64)


def _best_crossings(odds: FloatArray, begins: IntArray, count: IntArray) -> FloatArray:
    """Mean log odds (N,) of the best crossings of each line, 0 without any; ``odds`` of paint are -inf."""
    order = np.lexsort((-odds, np.repeat(np.arange(len(count)), count)))
    first = begins[:, None] + np.minimum(np.arange(_BEST), count[:, None] - 1)
    best = odds[order[first]]
    there = np.isfinite(best) & (np.arange(_BEST) < count[:, None])
    return np.asarray(np.where(there, best, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1))


def _paint_along(lines: Sequence[Line], points: LinePoints, image: LaneImage) -> FloatArray:
    """Mean log odds of paint along each line between its points, and the share of dashes in that (N, 2)."""
    output = image.output
    horizon = image.horizon
    if output is None:
        return np.tile(_UNKNOWN, (len(lines), 1))
    own = [points.below[line.members] for line in lines]
    below = np.linspace([b.min() for b in own], [b.max() for b in own], _PLACES, axis=1)
    phi = horizon.basis(below.ravel()).reshape(len(lines), _PLACES, 3)
    along = np.einsum("npk,nk->np", phi, np.array([line.curve.parameters for line in lines]))
    across = along[..., None] + horizon.px_per_m * below[..., None] * _ON_M
    places_px = image.places_px(across, below[..., None])
    paint = output.odds_at(places_px).max(axis=2)
    weight = as_probability(paint) + _LEAST_WEIGHT
    dashes = output.shares_at(places_px[:, :, len(_ON_M) // 2])[output.classes.index(LANE_DASH)]
    return np.column_stack([paint.mean(axis=1), (dashes * weight).sum(axis=1) / weight.sum(axis=1)])


def _company(points: LinePoints, lines: Sequence[Line], image: LaneImage) -> FloatArray:
    """Weight of the best other line a lane away, and weighted number of lines too near (N, 2)."""
    if len(lines) < 2:
        return np.zeros((len(lines), 2))
    apart = _apart_m(points, lines, image)
    gap = np.abs(apart[1])
    change = np.ptp(apart, axis=0) / (_CHANGE_M + _CHANGE_SHARE * gap)
    beside = as_probability(np.array([line.log_odds for line in lines])) * np.exp(-0.5 * change**2)
    np.fill_diagonal(beside, 0.0)
    lane = beside * np.exp(-0.5 * ((gap - _LANE_M) / _LANE_SIGMA_M) ** 2)
    near = np.where(gap < _TOO_NEAR_M, beside, 0.0).sum(axis=1)
    return np.column_stack([lane.max(axis=1), np.minimum(near, _MOST_NEAR)])


def _apart_m(points: LinePoints, lines: Sequence[Line], image: LaneImage) -> FloatArray:
    """Distances (3, N, N), m, of lines along the horizon at the far end, middle and near end of each."""
    parameters = np.array([line.curve.parameters for line in lines])
    spans = np.array([np.ptp(points.below[line.members]) for line in lines])
    low = np.array([points.below[line.members].min() for line in lines])
    below = (low + spans * np.array([[0.0], [0.5], [1.0]])).ravel()
    horizon = image.horizon
    # The distances are taken on each line's own rows.
    rows = (horizon.basis(below) / (horizon.px_per_m * below)[:, None]).reshape(3, len(lines), 3)
    return np.asarray(np.einsum("sik,ijk->sij", rows, parameters[:, None] - parameters))


@cache
def fitted() -> dict[str, tuple[FloatArray, float]]:
    """Weights and bias of the logistic functions of a line ``alone`` and ``among`` others, from the file."""
    content = json.loads(LANE_SCORE_FILE.read_text(encoding="utf-8"))
    return {
        name: (np.array([content[name]["weights"][key] for key in keys]), float(content[name]["bias"]))
        for name, keys in (("alone", ALONE), ("among", AMONG))
    }
