"""How probable it is that a line is one of a lane: a logistic function of what speaks for it.

The weights, in ``score.json`` beside this file, belong to the network; they are those that
``python -m tests.benchmarks.detector_lanes --write`` fits to renders which no benchmark shows.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes.points import IntArray, Line, LinePoints
from v2hdm.records import BoolArray, FloatArray

SCORE_FILE = Path(__file__).with_name("score.json")

FEATURES = (
    "best_crossings",
    "log_length_m",
    "log_length_px",
    "log_rows",
    "along_road",
    "log_near_m",
    "painted",
    "paint_odds",
    "solid",
    "clutter",
    "double",
)
"""In this order: log odds of the three surest crossings; how long the line is on the ground, in the image
and down the image (upright things are as tall as they are long); how much likelier it is along the road; how
near it comes; whether it shows paint, the log odds of its surest paint, how much of that is solid; likely
crossings beside it, a row; whether it is the middle of two."""

_BEST = 3
_MOST_LOG_RATIO = 6.0
_ROW_STEP_PX = 8.0


def log_odds(lines: Sequence[Line], points: LinePoints, view: CameraView) -> FloatArray:
    """Log odds (N,) of N lines through an image's points."""
    weights, bias = fitted()
    return np.asarray(evidence(lines, points, view) @ weights + bias)


def evidence(lines: Sequence[Line], points: LinePoints, view: CameraView) -> FloatArray:
    """What speaks for N lines (N, F), in the order of :data:`FEATURES`."""
    if not lines:
        return np.empty((0, len(FEATURES)))
    members = np.concatenate([line.certain for line in lines])
    count = np.array([len(line.certain) for line in lines])
    begins = np.cumsum(count) - count
    is_paint, odds = points.is_paint[members], points.odds[members]
    at_px, ground = points.points_px[members], points.ground[members]
    low_px, high_px = np.minimum.reduceat(at_px, begins), np.maximum.reduceat(at_px, begins)
    size_m = np.maximum.reduceat(ground, begins) - np.minimum.reduceat(ground, begins)
    size = (high_px - low_px) / view.info.width
    paint = np.add.reduceat(is_paint.astype(np.float64), begins)
    solid = np.add.reduceat(points.is_solid[members].astype(np.float64), begins)
    paint_odds = np.maximum.reduceat(np.where(is_paint, odds, -np.inf), begins)
    ratio = np.array([line.log_ratio for line in lines])
    columns = (
        _best_crossings(np.where(is_paint, -np.inf, odds), begins, count),
        np.log(np.hypot(*size_m.T) + 0.1),
        np.log(np.hypot(*size.T) + 0.005),
        np.log(size[:, 1] + 0.005),
        np.clip(ratio, -_MOST_LOG_RATIO, _MOST_LOG_RATIO),
        np.log(np.minimum.reduceat(view.range_m(ground), begins) + 0.1),
        paint > 0,
        np.where(paint > 0, paint_odds, 0.0),
        solid / np.maximum(paint, 1),
        np.log1p(_beside(points, is_paint, odds, begins, low_px[:, 1], high_px[:, 1])),
        np.array([line.double for line in lines]),
    )
    return np.column_stack(columns).astype(np.float64)


def _best_crossings(odds: FloatArray, begins: IntArray, count: IntArray) -> FloatArray:
    """Mean log odds (N,) of the surest crossings of each line, 0 where it has none; paint's are -inf."""
    order = np.lexsort((-odds, np.repeat(np.arange(len(count)), count)))
    first = begins[:, None] + np.minimum(np.arange(_BEST), count[:, None] - 1)
    best = odds[order[first]]
    there = np.isfinite(best) & (np.arange(_BEST) < count[:, None])
    return np.asarray(np.where(there, best, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1))


def _beside(
    points: LinePoints,
    is_paint: BoolArray,
    odds: FloatArray,
    begins: IntArray,
    low: FloatArray,
    high: FloatArray,
) -> FloatArray:
    """Likely crossings a row (N,) that lie beside each line, on rows from ``low`` to ``high`` (N,) px."""
    rows = np.sort(points.points_px[~points.is_paint & (points.odds > 0), 1])
    between = np.searchsorted(rows, high, side="right") - np.searchsorted(rows, low)
    own = np.add.reduceat((~is_paint & (odds > 0)).astype(np.float64), begins)
    return np.asarray(np.maximum(between - own, 0) / ((high - low) / _ROW_STEP_PX + 1))


@cache
def fitted() -> tuple[FloatArray, float]:
    """Weights (F,) and bias of the logistic function, from :data:`SCORE_FILE`."""
    content = json.loads(SCORE_FILE.read_text(encoding="utf-8"))
    return np.array([content["weights"][name] for name in FEATURES]), float(content["bias"])
