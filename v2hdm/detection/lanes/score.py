"""How probable it is that a line is one of a lane: a logistic function of what speaks for it.

First each line is judged alone, then among the others of its image (:mod:`v2hdm.detection.lanes.company`).
The weights, in ``lane_score.json``, belong to the network; they are those that
``python -m train.fit_lane_score --write`` fits to renders which no benchmark shows.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes.company import COMPANY, company
from v2hdm.detection.lanes.curves import Horizon
from v2hdm.detection.lanes.looks import LOOKS, Looks
from v2hdm.detection.lanes.points import Line, LinePoints
from v2hdm.detection.odds import as_probability
from v2hdm.detection.weights import LANE_SCORE_FILE
from v2hdm.records import FloatArray, IntArray

FEATURES = (
    "best_crossings",
    "log_length_m",
    "log_length_px",
    "log_rows",
    "along_road",
    "painted",
    "paint_odds",
    "paint_share",
    "solid",
    *LOOKS,
)
"""In this order: log odds of the three surest crossings; how long the line is on the ground, in the image
and down the image (upright things are as tall as they are long); how much likelier it is along the road;
whether it shows paint, the log odds of its surest paint, for how much of its length, how much of that is
solid; and what the image shows along it."""

TOLD = ("alone", "faint_crossings", *COMPANY)
"""What tells of a line among others: its log odds alone, how many crossings too unlikely by themselves lie on
it, and its company."""

_BEST = 3
_MOST_LOG_RATIO = 6.0


_MOST_PAINT_SHARE = 2.0
"""Of a double line there is twice as much paint as the line is long."""


def log_odds_alone(
    lines: Sequence[Line], points: LinePoints, view: CameraView, horizon: Horizon, looks: Looks
) -> FloatArray:
    """Log odds (N,) of N lines through an image's points, each by itself."""
    weights, bias = fitted()["alone"]
    return np.asarray(evidence(lines, points, view, horizon, looks) @ weights + bias)


def log_odds(
    lines: Sequence[Line], points: LinePoints, view: CameraView, horizon: Horizon, looks: Looks
) -> FloatArray:
    """Log odds (N,) of N lines, all there are in an image."""
    weights, bias = fitted()["among"]
    alone = log_odds_alone(lines, points, view, horizon, looks)
    return np.asarray(told(lines, points, horizon, alone) @ weights + bias)


def told(lines: Sequence[Line], points: LinePoints, horizon: Horizon, alone: FloatArray) -> FloatArray:
    """What tells of N lines (N, T) of such log odds (N,) by themselves, in the order of :data:`TOLD`."""
    faint = np.log1p([len(line.perhaps) for line in lines])
    others = company(points, lines, horizon, as_probability(alone))
    return np.column_stack([alone, faint, others])


def evidence(
    lines: Sequence[Line], points: LinePoints, view: CameraView, horizon: Horizon, looks: Looks
) -> FloatArray:
    """What speaks for N lines by themselves (N, F), in the order of :data:`FEATURES`."""
    if not lines:
        return np.empty((0, len(FEATURES)))
    members = np.concatenate([line.certain for line in lines])
    count = np.array([len(line.certain) for line in lines])
    begins = np.cumsum(count) - count
    is_paint, odds = points.is_paint[members], points.odds[members]
    at_px, ground = points.points_px[members], points.ground[members]
    size_m = np.maximum.reduceat(ground, begins) - np.minimum.reduceat(ground, begins)
    size = np.maximum.reduceat(at_px, begins) - np.minimum.reduceat(at_px, begins)
    size = size / view.info.width
    length_m = np.hypot(*size_m.T)
    paint = np.add.reduceat(is_paint.astype(np.float64), begins)
    solid = np.add.reduceat(points.is_solid[members].astype(np.float64), begins)
    paint_odds = np.maximum.reduceat(np.where(is_paint, odds, -np.inf), begins)
    ratio = np.array([line.log_ratio for line in lines])
    paint_m = np.array([line.paint_m for line in lines])
    columns = (
        _best_crossings(np.where(is_paint, -np.inf, odds), begins, count),
        np.log(length_m + 0.1),
        np.log(np.hypot(*size.T) + 0.005),
        np.log(size[:, 1] + 0.005),
        np.clip(ratio, -_MOST_LOG_RATIO, _MOST_LOG_RATIO),
        paint > 0,
        np.where(paint > 0, paint_odds, 0.0),
        np.minimum(paint_m / np.maximum(length_m, 1.0), _MOST_PAINT_SHARE),
        solid / np.maximum(paint, 1),
        looks.along(lines, points, view, horizon),
    )
    return np.column_stack(columns).astype(np.float64)


def _best_crossings(odds: FloatArray, begins: IntArray, count: IntArray) -> FloatArray:
    """Mean log odds (N,) of the surest crossings of each line, 0 where it has none; paint's are -inf."""
    order = np.lexsort((-odds, np.repeat(np.arange(len(count)), count)))
    first = begins[:, None] + np.minimum(np.arange(_BEST), count[:, None] - 1)
    best = odds[order[first]]
    there = np.isfinite(best) & (np.arange(_BEST) < count[:, None])
    return np.asarray(np.where(there, best, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1))


@cache
def fitted() -> dict[str, tuple[FloatArray, float]]:
    """Weights and bias of the logistic functions of a line ``alone`` and ``among`` others, from the file."""
    content = json.loads(LANE_SCORE_FILE.read_text(encoding="utf-8"))
    return {
        name: (np.array([content[name]["weights"][key] for key in keys]), float(content[name]["bias"]))
        for name, keys in (("alone", FEATURES), ("among", TOLD))
    }
