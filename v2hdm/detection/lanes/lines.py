"""From crossings of row anchors and pieces of lane paint to the whole lines of lanes.

Crossings and paint that one curve explains are one line (:mod:`v2hdm.detection.lanes.cluster`). A hidden
Markov model finds from where to where it runs (:mod:`v2hdm.detection.lanes.span`), and a logistic function
gives its probability (:mod:`v2hdm.detection.lanes.score`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from v2hdm.detection.camera.view import FARTHEST_M, CameraView
from v2hdm.detection.lanes.cluster import find_chains, find_lines
from v2hdm.detection.lanes.curve import Horizon, Line, LinePoints
from v2hdm.detection.lanes.score import log_odds, log_odds_alone
from v2hdm.detection.lanes.span import boundaries, draw, with_spans
from v2hdm.detection.markings.foreground import Foreground
from v2hdm.detection.sight import AnchorRow
from v2hdm.records import FloatArray, IntArray, LaneDetection

LEAST_LOG_ODDS = -0.5
"""Lines less sure are not given. A bound of -1.4 gives .7 points more of TuSimple's accuracy and 40 % more
false lines on renders."""

_DOUBTFUL = 1.5
"""Lines by so much in log odds less sure than is asked for alone may be sure enough among the others."""

_SIGMA_PX = (0.4, 2.7)
"""Crossings err by s + t / exp(log odds), in px of the resolution looked at; measured on renders."""

_PAINT_SIGMA_PX = 1.0
_LEAST_PAINT_LENGTH_M = 0.8
_MAX_PAINT_SLOPE = 8.0
"""Paint that runs flatter across the view, px along the horizon per px down, is on no curve of ours."""


def link_anchors(
    rows: Sequence[AnchorRow],
    view: CameraView,
    paint: Sequence[LaneDetection] = (),
    paint_step_m: float = 0.5,
    foreground: Foreground | None = None,
    row_step_px: float = 8.0,
) -> list[LaneDetection]:
    """The whole lines of one image.

    Args:
        rows: Its row anchors, near to far; crossings unlikely by themselves help to follow a line.
        view: Its camera.
        paint: The centre lines of its lane paint, points ``paint_step_m`` apart.
        paint_step_m: That distance.
        foreground: What the network says of paint, if that is known.
        row_step_px: How far apart row anchors are, twice as far where half the resolution is looked at.
    """
    horizon = Horizon(view)
    points, lines = propose(rows, view, horizon, paint, paint_step_m, foreground, row_step_px)
    drawn = [draw(line, points, view, horizon) for line in lines]
    return _identified([lane for lane in drawn if lane is not None], view)


def propose(
    rows: Sequence[AnchorRow],
    view: CameraView,
    horizon: Horizon,
    paint: Sequence[LaneDetection],
    paint_step_m: float,
    foreground: Foreground | None,
    row_step_px: float,
    least_log_odds: float | None = None,
) -> tuple[LinePoints, list[Line]]:
    """The points of an image and the boundaries of lanes through them that are sure enough, best first."""
    least_log_odds = LEAST_LOG_ODDS if least_log_odds is None else least_log_odds
    points = _crossings(rows, view, horizon)
    # At, above and just below the horizon lines meet; a comparison with nan is false.
    points = points.where(view.range_m(points.ground) <= FARTHEST_M)
    groups = find_chains(points)
    points, on_paint = _with_paint(points, paint, view, horizon)
    lines = find_lines(points, groups + on_paint, horizon, paint_step_m)
    lines = _surest(
        lines, log_odds_alone(lines, points, view, horizon, foreground), least_log_odds - _DOUBTFUL
    )
    lines = with_spans(lines, points, view, horizon, foreground, row_step_px)
    lines = boundaries(lines, points, horizon)
    return points, _surest(lines, log_odds(lines, points, horizon), least_log_odds)


def _surest(lines: Sequence[Line], odds: FloatArray, least_log_odds: float) -> list[Line]:
    """The lines of more than such log odds (N,), best first."""
    order = [k for k in np.argsort(-odds, kind="stable").tolist() if odds[k] > least_log_odds]
    return [replace(lines[k], log_odds=float(odds[k])) for k in order]


def _crossings(rows: Sequence[AnchorRow], view: CameraView, horizon: Horizon) -> LinePoints:
    u = np.concatenate([np.empty(0), *(row.u_px for row in rows)])
    v = np.repeat([row.v_px for row in rows], [len(row.u_px) for row in rows]) if rows else np.empty(0)
    odds = np.concatenate([np.empty(0), *(row.odds for row in rows)])
    scale = np.where(view.coarse(v), 2.0, 1.0)
    sigma_px = scale * (_SIGMA_PX[0] + _SIGMA_PX[1] * np.exp(-odds))
    return LinePoints.of(view, horizon, np.column_stack([u, v]), odds, sigma_px)


def _with_paint(
    points: LinePoints, paint: Sequence[LaneDetection], view: CameraView, horizon: Horizon
) -> tuple[LinePoints, list[IntArray]]:
    """The points with those of pieces of paint after them, and which those are, piece by piece."""
    pieces = _along_the_view(paint, view, horizon)
    if not pieces:
        return points, []
    length = [len(lane.points_px) for lane in pieces]
    odds = np.repeat([_logit(lane.score) for lane in pieces], length)
    points_px = np.concatenate([lane.points_px for lane in pieces])
    painted = LinePoints.of(view, horizon, points_px, odds, np.full(len(odds), _PAINT_SIGMA_PX))
    painted = replace(painted, is_paint=np.ones(len(odds), dtype=np.bool_))
    ends_at = len(points.odds) + np.cumsum(length)
    groups = [np.arange(end - n, end) for end, n in zip(ends_at, length, strict=True)]
    both = {name: np.concatenate([getattr(points, name), getattr(painted, name)]) for name in vars(points)}
    return LinePoints(**both), groups


def _along_the_view(
    paint: Sequence[LaneDetection], view: CameraView, horizon: Horizon
) -> list[LaneDetection]:
    """Pieces of paint that are long enough to have a direction, and not one across the view."""
    if not paint:
        return []
    ends_px = view.undistort(np.concatenate([lane.points_px[[0, -1]] for lane in paint]))
    length_m = np.linalg.norm(np.diff(view.ground(ends_px).reshape(-1, 2, 2), axis=1)[:, 0], axis=1)
    along, below = (np.abs(np.diff(at.reshape(-1, 2)))[:, 0] for at in horizon.coordinates(ends_px))
    # False where the length is nan.
    usable = (length_m >= _LEAST_PAINT_LENGTH_M) & (along <= _MAX_PAINT_SLOPE * below)
    return [lane for lane, use in zip(paint, usable, strict=True) if use]


def _logit(probability: float) -> float:
    clipped = min(max(probability, 1e-3), 1 - 1e-3)
    return float(np.log(clipped / (1 - clipped)))


def _identified(lanes: list[LaneDetection], view: CameraView) -> list[LaneDetection]:
    """Number the lines from the vehicle outwards, by where each is beside the vehicle."""
    if not lanes:
        return []
    ground = view.ground(view.undistort(np.concatenate([lane.points_px for lane in lanes])))
    parts = np.split(ground, np.cumsum([len(lane.points_px) for lane in lanes])[:-1])
    beside_m = np.array([_lateral_m(part, view) for part in parts])
    order = np.argsort(beside_m)
    left = [k for k in order if beside_m[k] >= 0]
    right = [k for k in order[::-1] if beside_m[k] < 0]
    identity = {int(k): n for n, k in enumerate(left, start=1)} | {
        int(k): -n for n, k in enumerate(right, start=1)
    }
    return [replace(lane, identity=identity.get(k)) for k, lane in enumerate(lanes)]


def _lateral_m(ground: FloatArray, view: CameraView) -> float:
    """How far left of the vehicle a line (N, 2) is, its near half carried on to there; nan if unknown."""
    ground = ground[np.isfinite(ground).all(axis=1)]
    near = ground[: max(2, len(ground) // 2)]
    if len(near) < 2:
        return float("nan")
    along = near[:, 0] - view.foot_vehicle[0]
    if np.ptp(along) < 0.5:
        return float(near[0, 1])
    apart = along - along.mean()
    slope = float(apart @ near[:, 1] / (apart @ apart))
    beside = float(near[:, 1].mean()) - slope * float(along.mean())
    return float(beside if abs(slope) < 1 else near[0, 1])
