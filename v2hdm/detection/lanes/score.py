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
from v2hdm.detection.lanes.points import Line, LinePoints
from v2hdm.records import FloatArray

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
    rows = points.points_px[:, 1]
    likely = np.sort(rows[~points.is_paint & (points.odds > 0)])
    return np.array([_evidence(line, points, likely, view) for line in lines]).reshape(-1, len(FEATURES))


def _evidence(line: Line, points: LinePoints, likely_rows: FloatArray, view: CameraView) -> list[float]:
    """One line's; ``likely_rows`` are those of the image's likely crossings, ascending."""
    members = line.certain
    is_paint, odds = points.is_paint[members], points.odds[members]
    crossings, paint = np.sort(odds[~is_paint]), odds[is_paint]
    at_px = points.points_px[members]
    low, high = at_px.min(axis=0), at_px.max(axis=0)
    size_px = high - low
    between = np.searchsorted(likely_rows, high[1], side="right") - np.searchsorted(likely_rows, low[1])
    others = max(int(between) - int((crossings > 0).sum()), 0)
    ground = points.ground[members]
    return [
        float(crossings[-_BEST:].mean()) if len(crossings) else 0.0,
        float(np.log(np.hypot(*np.ptp(ground, axis=0)) + 0.1)),
        float(np.log(np.hypot(*size_px) / view.info.width + 0.005)),
        float(np.log(size_px[1] / view.info.width + 0.005)),
        min(max(line.log_ratio, -_MOST_LOG_RATIO), _MOST_LOG_RATIO),
        float(np.log(view.range_m(ground).min() + 0.1)),
        float(len(paint) > 0),
        float(paint.max()) if len(paint) else 0.0,
        float(points.is_solid[members][is_paint].mean()) if len(paint) else 0.0,
        float(np.log1p(others / (size_px[1] / _ROW_STEP_PX + 1))),
        float(line.double),
    ]


@cache
def fitted() -> tuple[FloatArray, float]:
    """Weights (F,) and bias of the logistic function, from :data:`SCORE_FILE`."""
    content = json.loads(SCORE_FILE.read_text(encoding="utf-8"))
    return np.array([content["weights"][name] for name in FEATURES]), float(content["bias"])
