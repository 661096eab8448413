"""Which of an image's crossings and pieces of paint are one line, and which of the lines are to be believed.

Groups of points are joined as long as they are more likely one line than two, the likeliest pair first
(Bayesian hierarchical clustering); what joins a far dash to a near one is the curve that both suggest and the
road that they lie along, not how far they are apart.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes.curves import Evidence, Horizon
from v2hdm.detection.lanes.looks import Looks
from v2hdm.detection.lanes.points import Line, LinePoints
from v2hdm.detection.lanes.road import Road, find_road
from v2hdm.detection.lanes.score import log_odds, log_odds_alone
from v2hdm.detection.lanes.strands import boundaries
from v2hdm.records import BoolArray, FloatArray, IntArray

_GATE_SIGMAS = 3.0
_GATE_PX = 16.0
"""Crossings on no line yet join one that passes so near."""

_NONE = np.empty(0, dtype=np.int64)

_DOUBTFUL = 1.0
"""Lines by so much in log odds less sure than is asked for may yet be a part of a better one."""


def find_lines(
    points: LinePoints,
    groups: list[IntArray],
    view: CameraView,
    horizon: Horizon,
    paint_step_m: float,
    looks: Looks,
    least_log_odds: float,
) -> list[Line]:
    """The lines through ``groups`` of points, best first, each with the stray crossings that lie on it."""
    if not groups:
        return []
    evidence = points.evidence(horizon, groups, points.slopes(groups))
    road = find_road(evidence, horizon)
    groups = _join(evidence, groups, road)
    slopes = points.slopes(groups)
    evidence = points.evidence(horizon, groups, slopes)
    _, along = road.judge(evidence)
    paint_m = [paint_step_m * float(points.is_paint[group].sum()) for group in groups]
    priors = [road.drawn_by(log_ratio) for log_ratio in along.tolist()]
    curves = evidence.curves(priors, horizon.centre_px)
    candidates = [
        Line(curve, group, _NONE, *rest)
        for curve, group, *rest in zip(curves, groups, paint_m, priors, along.tolist(), strict=True)
    ]
    odds = log_odds_alone(candidates, points, view, horizon, looks)
    believed = [k for k in np.argsort(-odds).tolist() if odds[k] > least_log_odds - _DOUBTFUL]
    free = ~points.is_paint
    for k in believed:
        free[groups[k]] = False
    lines = []
    for k in believed:
        line = _gathered(points, candidates[k], evidence[k : k + 1], slopes[k : k + 1], free, horizon)
        free[line.perhaps] = False
        lines.append(line)
    found = boundaries(points, lines, horizon)
    # What was joined on the way tells of it too, and so do the others.
    sure = [
        replace(line, log_odds=odds)
        for line, odds in zip(found, log_odds(found, points, view, horizon, looks).tolist(), strict=True)
        if odds > least_log_odds
    ]
    return sorted(sure, key=lambda line: -line.log_odds)


def _join(evidence: Evidence, groups: list[IntArray], road: Road) -> list[IntArray]:
    groups = list(groups)
    alone = road.judge(evidence)[0]
    count = len(groups)
    first, second = np.triu_indices(count, 1)
    gain = np.full((count, count), -np.inf)
    gain[first, second] = road.judge(evidence[first] + evidence[second])[0] - (alone[first] + alone[second])
    left = np.ones(count, dtype=np.bool_)
    while left.sum() > 1:
        a, b = divmod(int(np.argmax(gain)), count)
        if not gain[a, b] > 0:
            break
        groups[a] = np.concatenate([groups[a], groups[b]])
        for total in (evidence.information, evidence.moment, evidence.square):
            total[a] += total[b]
            total[b] = 0
        left[b] = False
        gain[b], gain[:, b] = -np.inf, -np.inf
        # With that of b, which is nought now, comes what the two are together.
        together = road.judge(evidence[np.full(count, a)] + evidence)[0]
        alone[a] = together[b]
        left[a] = False
        others = np.flatnonzero(left)
        left[a] = True
        low, high = np.minimum(others, a), np.maximum(others, a)
        gain[low, high] = together[others] - alone[a] - alone[others]
    return [groups[k] for k in np.flatnonzero(left)]


def _gathered(
    points: LinePoints, line: Line, own: Evidence, slope: FloatArray, free: BoolArray, horizon: Horizon
) -> Line:
    """The line, of such ``own`` evidence, with the free crossings on it, at most one of each row."""
    group, row = line.certain, points.points_px[:, 1]
    rows = row.astype(np.intp)  # they are some px apart
    has_one = np.zeros(rows.max() + 1, dtype=np.bool_)
    has_one[rows[group[~points.is_paint[group]]]] = True
    candidates = np.flatnonzero(free & ~has_one[rows])
    phi = points.phi[candidates]
    off = np.abs(points.along[candidates] - line.curve.along(phi))
    sigma = np.hypot(line.curve.sigma(phi), points.sigma_px[candidates])
    misfit = off / np.minimum(_GATE_SIGMAS * sigma, _GATE_PX * np.hypot(1, slope[0]))
    order = np.argsort(misfit)
    order = order[misfit[order] < 1]
    _, nearest = np.unique(row[candidates[order]], return_index=True)
    perhaps = candidates[order[nearest]]
    if not len(perhaps):
        return line
    evidence = own + points.evidence(horizon, [perhaps], slope)
    return replace(line, curve=evidence.curve(line.prior, horizon.centre_px), perhaps=perhaps)
