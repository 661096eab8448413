"""Which of an image's crossings and pieces of paint are one line, and which of the lines are to be believed.

Groups of points are joined as long as they are more likely one line than two, the likeliest pair first
(Bayesian hierarchical clustering); what joins a far dash to a near one is the curve that both suggest, not
how far they are apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from v2hdm.detection.lane_curves import Curve, Evidence, Horizon, basis, middle_of
from v2hdm.detection.view import CameraView
from v2hdm.records import BoolArray, FloatArray

IntArray = NDArray[np.int64]

NEIGHBOURS = 3.0
"""Points of one line err together: that many tell as much as one."""

_MODEL_SIGMA_M = 0.02
"""By how much painted lines leave the curve."""

_GATE_SIGMAS = 3.0
_GATE_PX = 16.0
"""Crossings on no line yet join one that passes so near."""

_ONE_LINE_M = 0.12
_DOUBLE_LINE_M = 0.75
"""Curves nearer than the first are one line; nearer than the second, the two lines of a double one."""

_LEAST_PAINT_M = 1.0
_DOUBTFUL = 1.0
"""Lines by so much in log odds less sure than is asked for may yet be the other half of a double line."""

_CERTAIN_SIGMA_M = 0.3

_WEIGHTS = (0.50, 0.59, 0.41)
_OFFSET = -2.18
"""Log odds of a line: by its best crossings' odds, log (1 + paint) and log length, m; fitted to renders."""


@dataclass(frozen=True)
class LinePoints:
    """N points of an image that lines may run through.

    ``points_px`` (N, 2) recorded px; ``along`` and ``below`` (N,) their place about the horizon and ``phi``
    (N, 3) the basis of curves there;
    ``sigma_px`` (N,) of each along the horizon; ``odds`` (N,) log odds; ``ground`` (N, 2), vehicle frame;
    ``is_paint`` (N,): on the centre line of a piece of paint, not a crossing of a row anchor.
    """

    points_px: FloatArray
    along: FloatArray
    below: FloatArray
    phi: FloatArray
    sigma_px: FloatArray
    odds: FloatArray
    ground: FloatArray
    is_paint: BoolArray

    @classmethod
    def of(
        cls, view: CameraView, horizon: Horizon, points_px: FloatArray, odds: FloatArray, sigma_px: FloatArray
    ) -> LinePoints:
        """Crossings of row anchors (N, 2) with standard deviations (N,)."""
        pinhole_px = view.undistort(points_px)
        along, below = horizon.coordinates(pinhole_px)
        sigma = np.hypot(sigma_px, _MODEL_SIGMA_M * horizon.px_per_m * np.maximum(below, 0))
        none = np.zeros(len(odds), dtype=np.bool_)
        return cls(points_px, along, below, basis(below), sigma, odds, view.ground(pinhole_px), none)

    def slopes(self, groups: list[IntArray]) -> FloatArray:
        """Px along the horizon per px down (N,) of groups of points that are roughly a line each."""
        members, ends = np.concatenate(groups), np.cumsum([len(group) for group in groups])
        count, begins = np.diff(ends, prepend=0), [0, *ends[:-1]]
        along, below = self.along[members], self.below[members]
        down = below - np.repeat(np.add.reduceat(below, begins) / count, count)
        return np.asarray(
            np.add.reduceat(down * along, begins) / np.maximum(np.add.reduceat(down**2, begins), 1)
        )

    def evidence(self, horizon: Horizon, groups: list[IntArray], slopes: FloatArray) -> Evidence:
        """What each of N groups of points, on lines of such ``slopes`` (N,), says of its line."""
        members, count = np.concatenate(groups), [len(group) for group in groups]
        sigma = self.sigma_px[members] * np.repeat(np.hypot(1, slopes), count) * np.sqrt(NEIGHBOURS)
        u = self.along[members] - horizon.centre_px
        return Evidence.of(self.phi[members], u, sigma, np.cumsum(count).tolist())


@dataclass(frozen=True)
class Line:
    """A line: its curve and the indices of the points that ``certain``ly and ``perhaps`` are on it."""

    curve: Curve
    certain: IntArray
    perhaps: IntArray
    log_odds: float
    paint_m: float
    double: bool = False

    @property
    def members(self) -> IntArray:
        """All its points."""
        return np.concatenate([self.certain, self.perhaps])


def find_lines(
    points: LinePoints, groups: list[IntArray], horizon: Horizon, paint_step_m: float, least_log_odds: float
) -> list[Line]:
    """The lines through ``groups`` of points, best first, each with the stray crossings that lie on it."""
    if not groups:
        return []
    believed = []
    for group in _join(points, groups, horizon):
        paint_m = paint_step_m * float(points.is_paint[group].sum())
        log_odds = _log_odds(points, group, paint_m)
        if log_odds > least_log_odds - _DOUBTFUL:
            believed.append((log_odds, paint_m, group))
    believed.sort(key=lambda found: -found[0])
    free = ~points.is_paint
    for _, _, group in believed:
        free[group] = False
    lines = []
    for log_odds, paint_m, group in believed:
        curve, perhaps = _gather(points, group, free, horizon)
        free[perhaps] = False
        lines.append(Line(curve, group, perhaps, log_odds, paint_m))
    return [line for line in _apart(points, lines, horizon) if line.log_odds > least_log_odds]


def _join(points: LinePoints, groups: list[IntArray], horizon: Horizon) -> list[IntArray]:
    evidence = points.evidence(horizon, groups, points.slopes(groups))
    groups = list(groups)
    alone = evidence.log_evidence(horizon)
    count = len(groups)
    first, second = np.triu_indices(count, 1)
    gain = np.full((count, count), -np.inf)
    gain[first, second] = (evidence[first] + evidence[second]).log_evidence(horizon) - (
        alone[first] + alone[second]
    )
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
        together = (evidence[np.full(count, a)] + evidence).log_evidence(horizon)
        alone[a] = together[b]
        left[a] = False
        others = np.flatnonzero(left)
        left[a] = True
        low, high = np.minimum(others, a), np.maximum(others, a)
        gain[low, high] = together[others] - alone[a] - alone[others]
    return [groups[k] for k in np.flatnonzero(left)]


def _gather(points: LinePoints, group: IntArray, free: BoolArray, horizon: Horizon) -> tuple[Curve, IntArray]:
    """The curve of a group, and the free crossings on it, at most one of each row."""
    slope = points.slopes([group])
    evidence = points.evidence(horizon, [group], slope)
    curve = evidence.curve(horizon)
    row = points.points_px[:, 1]
    candidates = np.flatnonzero(free & ~np.isin(row, row[group[~points.is_paint[group]]]))
    phi = points.phi[candidates]
    off = np.abs(points.along[candidates] - curve.along(phi))
    sigma = np.hypot(curve.sigma(phi), points.sigma_px[candidates])
    misfit = off / np.minimum(_GATE_SIGMAS * sigma, _GATE_PX * np.hypot(1, slope[0]))
    order = np.argsort(misfit)
    order = order[misfit[order] < 1]
    _, nearest = np.unique(row[candidates[order]], return_index=True)
    perhaps = candidates[order[nearest]]
    if len(perhaps):
        curve = (evidence + points.evidence(horizon, [perhaps], slope)).curve(horizon)
    return curve, perhaps


def _log_odds(points: LinePoints, group: IntArray, paint_m: float) -> float:
    """How sure it is that a group of points is a lane's line."""
    crossings = np.sort(points.odds[group[~points.is_paint[group]]])
    best = float(crossings[-3:].mean()) if len(crossings) else 0.0
    length_m = float(np.linalg.norm(np.ptp(points.ground[group], axis=0)))
    return float(np.dot(_WEIGHTS, (best, np.log1p(paint_m), np.log(length_m + 0.1))) + _OFFSET)


def _apart(points: LinePoints, lines: list[Line], horizon: Horizon) -> list[Line]:
    """The lines, best first, less those that repeat a better one; of a double line, its middle.

    The two lines of a double one are one boundary of a lane.
    """
    kept: list[Line] = []
    for line in lines:
        for k, better in enumerate(kept):
            distance_m = _distance_m(points, line, better, horizon)
            if distance_m is None or distance_m.max() > _DOUBLE_LINE_M:
                continue
            painted = min(line.paint_m, better.paint_m) >= _LEAST_PAINT_M
            if painted and not better.double and distance_m.mean() > _ONE_LINE_M:
                middle = middle_of(line.curve, better.curve)
                members = np.concatenate([better.certain, line.certain])
                kept[k] = Line(middle, members, better.perhaps, better.log_odds, better.paint_m, double=True)
            break
        else:
            kept.append(line)
    return kept


def _distance_m(points: LinePoints, first: Line, second: Line, horizon: Horizon) -> FloatArray | None:
    """How far two lines are apart across the view where both are seen, else where the first is.

    None where the second is not known there.
    """
    spans = [points.below[line.certain] for line in (first, second)]
    low, high = max(span.min() for span in spans), min(span.max() for span in spans)
    if low > high:
        low, high = spans[0].min(), spans[0].max()
    below = np.linspace(low, high, 9)
    px_per_m = horizon.px_per_m * np.maximum(below, 1.0)
    phi = basis(below)
    if (second.curve.sigma(phi) > _CERTAIN_SIGMA_M * px_per_m).any():
        return None
    return np.asarray(np.abs(first.curve.along(phi) - second.curve.along(phi)) / px_per_m)
