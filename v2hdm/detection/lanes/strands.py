"""From the lines of an image to the boundaries of its lanes: double lines are one, and no two cross."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from v2hdm.detection.lanes.curves import Horizon, basis, middle_of
from v2hdm.detection.lanes.points import Line, LinePoints, Strands
from v2hdm.records import BoolArray, FloatArray

_ONE_LINE_M = 0.12
_DOUBLE_LINE_M = 0.75
"""Curves nearer than the first are one line; nearer than the second, the two lines of a double one."""

_PARALLEL_M = 0.15
"""The distance between the two lines of a double one changes by less than this."""

_LEAST_PAINT_M = 1.0
_LEAST_PAINT_SHARE = 0.12
"""Each has so much paint, and this share of the better one's: one dash may be all beside a solid line."""

_ABREAST_M = 0.4
"""Points of paint abreast of each other differ by less than this along the line, those of a dash and the next
by more."""

_LEAST_ABREAST = 0.5
"""Of one of the two lines so many points are abreast of points of the other."""

_LEAST_OUTSIDE = 0.5
_CARRIED_ON_M = 0.5
"""A line that repeats another one but for this share of its rows carries that on, if it is so near."""

_LEAST_SOLID = 0.5
"""A strand so much of whose paint is no dashes ends with it."""

_CROSSING_M = 0.3
"""Lines that lie so far to the left of another one here and so far to its right there cross it."""

_CERTAIN_SIGMA_M = 0.3
_SAMPLES = 9


def boundaries(points: LinePoints, lines: Sequence[Line], horizon: Horizon) -> list[Line]:
    """The lines, best first, less those that repeat or cross a better one; of a double line, its middle."""
    kept: list[_Strand] = []
    for line in lines:
        if any(_cross(points, line, strand.best, horizon) for strand in kept):
            continue
        for strand in kept:
            offset_m = _offset_m(points, line, strand.best, horizon)
            if offset_m is not None and np.abs(offset_m).max() <= _DOUBLE_LINE_M:
                strand.take(points, line, offset_m, horizon)
                break
        else:
            kept.append(_Strand(line))
    return [strand.line(points) for strand in kept]


class _Strand:
    """Lines side by side that are one boundary: the ``best``, and the outermost with where they are."""

    def __init__(self, best: Line):
        self.best = best
        self._left: tuple[float, Line | None] = 0.0, None
        self._right: tuple[float, Line | None] = 0.0, None

    def take(self, points: LinePoints, line: Line, offset_m: FloatArray, horizon: Horizon) -> None:
        """A line so far (N,) to the right of the best: what that goes on as, its double or nothing new."""
        double = self._left[1] is not None or self._right[1] is not None
        outside = _outside(points, line, self.best) > _LEAST_OUTSIDE
        if not double and outside and not _side_by_side(points, line, self.best, offset_m):
            if np.abs(offset_m).max() <= _CARRIED_ON_M:
                self.best = _carried_on(points, self.best, line, horizon)
            return
        painted = min(line.paint_m, self.best.paint_m) >= _LEAST_PAINT_M
        even = line.paint_m >= _LEAST_PAINT_SHARE * self.best.paint_m
        if not (painted and even and np.ptp(offset_m) < _PARALLEL_M):
            return
        beside_m = float(offset_m.mean())
        if beside_m < self._left[0] and self._right[0] - beside_m <= _DOUBLE_LINE_M:
            self._left = beside_m, line
        elif beside_m > self._right[0] and beside_m - self._left[0] <= _DOUBLE_LINE_M:
            self._right = beside_m, line

    def line(self, points: LinePoints) -> Line:
        """The boundary."""
        if self._right[0] - self._left[0] <= _ONE_LINE_M:
            return self.best
        left, right = self._left[1] or self.best, self._right[1] or self.best
        members = np.unique(np.concatenate([line.certain for line in (self.best, left, right)]))
        curve = middle_of(left.curve, right.curve)
        whole = replace(self.best, curve=curve, certain=members, double=True)
        (shorter_to, shorter), (longer_to, longer) = sorted(
            ((_seen_to(points, line), line.curve) for line in (left, right)), key=lambda strand: strand[0]
        )
        uneven = shorter_to < longer_to
        return replace(whole, strands=Strands(longer, longer_to, shorter, shorter_to)) if uneven else whole


def _seen_to(points: LinePoints, line: Line) -> float:
    """The row, px below the horizon, down to which a strand is seen; infinite for dashes, which go on."""
    painted = line.certain[points.is_paint[line.certain]]
    is_solid = points.is_solid[painted].mean() >= _LEAST_SOLID
    return float(points.below[line.certain].max()) if is_solid else np.inf


def _carried_on(points: LinePoints, line: Line, more: Line, horizon: Horizon) -> Line:
    """A line and the one that it goes on as, in one."""
    certain = np.concatenate([line.certain, more.certain])
    evidence = points.evidence(horizon, [certain], points.slopes([certain]))
    paint_m = line.paint_m + more.paint_m
    whole = Line.through(certain, evidence, horizon, line.prior, paint_m, line.log_ratio)
    perhaps, row = np.concatenate([line.perhaps, more.perhaps]), points.points_px[:, 1]
    return replace(whole, perhaps=perhaps[~np.isin(row[perhaps], row[certain])])


def _side_by_side(points: LinePoints, line: Line, other: Line, offset_m: FloatArray) -> bool:
    """Whether two lines, so far (N,) apart, are seen abreast: one line is never seen twice."""
    if np.abs(offset_m).min() <= _ONE_LINE_M:
        return False
    own, others = (points.ground[each.certain] for each in (line, other))
    apart_m = np.linalg.norm(own[:, None] - others, axis=2)
    reach_m = np.hypot(_ABREAST_M, np.abs(offset_m).max())
    share = max((apart_m.min(axis=k) < reach_m).mean() for k in (0, 1))
    return bool(share > _LEAST_ABREAST)


def _outside(points: LinePoints, line: Line, other: Line) -> float:
    """The share of a line's rows that another one does not reach."""
    own, others = points.below[line.certain], points.below[other.certain]
    common = min(own.max(), others.max()) - max(own.min(), others.min())
    return 1 - max(float(common), 0.0) / max(float(np.ptp(own)), 1.0)


def _cross(points: LinePoints, first: Line, second: Line, horizon: Horizon) -> bool:
    """Whether two lines cross where both are known, up to where the nearer one begins."""
    spans = [points.below[line.certain] for line in (first, second)]
    low, high = max(span.min() for span in spans), max(span.max() for span in spans)
    offset_m, known = _apart_m(first, second, np.linspace(low, high, _SAMPLES), horizon)
    beside_m = offset_m[known.all(axis=0)]
    return bool((beside_m < -_CROSSING_M).any() and (beside_m > _CROSSING_M).any())


def _offset_m(points: LinePoints, first: Line, second: Line, horizon: Horizon) -> FloatArray | None:
    """How far (N,) a line is to the right of a second one where both are seen, else where the first is.

    None where the second is not known there.
    """
    spans = [points.below[line.certain] for line in (first, second)]
    low, high = max(span.min() for span in spans), min(span.max() for span in spans)
    if low > high:
        low, high = spans[0].min(), spans[0].max()
    offset_m, known = _apart_m(first, second, np.linspace(low, high, _SAMPLES), horizon)
    return offset_m if known[1].all() else None


def _apart_m(first: Line, second: Line, below: FloatArray, horizon: Horizon) -> tuple[FloatArray, BoolArray]:
    """How far (N,) a line is to the right of another, ``below`` (N,) the horizon, and where each is known."""
    phi, px_per_m = basis(below), horizon.px_per_m * np.maximum(below, 1.0)
    sigma_m = np.stack([line.curve.sigma(phi) for line in (first, second)]) / px_per_m
    return (first.curve.along(phi) - second.curve.along(phi)) / px_per_m, sigma_m < _CERTAIN_SIGMA_M
