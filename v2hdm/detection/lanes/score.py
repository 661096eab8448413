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
_LEAST_M = 0.1  # length, m, added to a line's before its logarithm
_LEAST_PX_SHARE = 0.005  # length, in image widths, added to a line's before its logarithm

_PLACES = 24  # places along a line at which its paint is sampled
_ON_M = np.linspace(
    -0.25, 0.25, 7
)  # offsets across a line, m, within which paint, also of double lines, lies
_LEAST_WEIGHT = 0.05  # weight of places without paint, that of paint being one

_LANE_M = 3.2  # mean width of lanes, m
_LANE_SIGMA_M = 0.65  # standard deviation of the width of lanes, m: those of roads are 2.5 to 4 m wide
_TOO_NEAR_M = 1.8  # distance, m, below which lines do not bound one lane
_MOST_NEAR = 2.0  # number of lines that are too near from which more add nothing
_CHANGE_M = 0.15  # standard deviation of the change of the distance between parallel lines, m
_CHANGE_SHARE = 0.06  # standard deviation of that change besides, in parts of the distance


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


def _span_features(line: Line, points: LinePoints) -> list[float]:
    """The features (4,) of a line's span, in the order of :data:`_SPAN`."""
    span = line.span
    points_below = points.below[line.members]
    assert span is not None
    between = (span.below >= points_below.min()) & (span.below <= points_below.max())
    return [
        float(np.sqrt(max(span.log_likelihood, 0.0))),
        float(span.length_m @ span.present),
        float(span.length_m[between] @ span.painted[between]),
        float(span.painted[between].sum() / max(between.sum(), 1)),
    ]


def features_alone(lines: Sequence[Line], points: LinePoints, image: LaneImage) -> FloatArray:
    """Features (N, F) of N lines by themselves, in the order of :data:`ALONE`."""
    if not lines:
        return np.empty((0, len(ALONE)))
    members = np.concatenate([line.members for line in lines])
    count = np.array([len(line.members) for line in lines])
    begins = np.cumsum(count) - count
    is_paint = points.is_paint[members]
    odds = points.odds[members]
    points_px = points.points_px[members]
    ground = points.ground[members]
    size_m = np.maximum.reduceat(ground, begins) - np.minimum.reduceat(ground, begins)
    size_px = np.maximum.reduceat(points_px, begins) - np.minimum.reduceat(points_px, begins)
    size = size_px / image.camera.info.width
    paint_odds = np.maximum.reduceat(np.where(is_paint, odds, -np.inf), begins)
    ratio = np.array([line.log_ratio for line in lines])
    columns = (
        _best_crossings(np.where(is_paint, -np.inf, odds), begins, count),
        np.log(np.hypot(size_m[:, 0], size_m[:, 1]) + _LEAST_M),
        np.log(np.hypot(size[:, 0], size[:, 1]) + _LEAST_PX_SHARE),
        np.log(size[:, 1] + _LEAST_PX_SHARE),
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
    is_crossing = np.isfinite(best) & (np.arange(_BEST) < count[:, None])
    return np.asarray(np.where(is_crossing, best, 0.0).sum(axis=1) / np.maximum(is_crossing.sum(axis=1), 1))


def _paint_along(lines: Sequence[Line], points: LinePoints, image: LaneImage) -> FloatArray:
    """Mean log odds of paint along each line between its points, and the share of dashes in that (N, 2)."""
    output = image.output
    horizon = image.horizon
    if output is None:
        return np.tile(_UNKNOWN, (len(lines), 1))
    members_below = [points.below[line.members] for line in lines]
    farthest = [below.min() for below in members_below]
    nearest = [below.max() for below in members_below]
    below = np.linspace(farthest, nearest, _PLACES, axis=1)
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
    distance_m = _distances_m(points, lines, image)
    gap = np.abs(distance_m[1])
    change = np.ptp(distance_m, axis=0) / (_CHANGE_M + _CHANGE_SHARE * gap)
    beside = as_probability(np.array([line.log_odds for line in lines])) * np.exp(-0.5 * change**2)
    np.fill_diagonal(beside, 0.0)
    a_lane_away = beside * np.exp(-0.5 * ((gap - _LANE_M) / _LANE_SIGMA_M) ** 2)
    too_near = np.where(gap < _TOO_NEAR_M, beside, 0.0).sum(axis=1)
    return np.column_stack([a_lane_away.max(axis=1), np.minimum(too_near, _MOST_NEAR)])


def _distances_m(points: LinePoints, lines: Sequence[Line], image: LaneImage) -> FloatArray:
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
