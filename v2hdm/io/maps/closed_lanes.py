"""Lanes between lane lines that run beside each other, and how one goes over into the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np

from v2hdm.geometry.planar import length_along, turned_left
from v2hdm.records import FloatArray, IntArray

LANE_WIDTH_M = (2.55, 5.1)
"""Lines that are closer have no room for a truck, 2.55 m wide (Directive 96/53/EC, annex I, 1.1), and those
farther apart have room for two."""

_LONGEST_CONNECTION_M = 40.0
"""Ways from lane to lane that are longer are no longer evident from the line that bounds both: the taper of a
lane that begins at 50 km/h is 30 to 40 m long (RASt 06, 6.1.4)."""

_AT_ONCE = 64  # neighbouring vertices that are compared with the segments around them together


@dataclass(frozen=True)
class ClosedLane:
    """A stretch of a lane between two lines, each its number and vertices, in the first one's direction."""

    left: tuple[int, IntArray]
    right: tuple[int, IntArray]


@dataclass(frozen=True)
class Connection:
    """The way from the end of the lane ``before`` to the start of the lane ``after``, both by number.

    ``left`` and ``right`` are bounds as those of a lane, or None on a side on which no one line bounds both
    lanes: where lanes split, merge, or paint is interrupted.
    """

    before: int
    after: int
    left: tuple[int, IntArray] | None
    right: tuple[int, IntArray] | None


def connections(lanes: Sequence[ClosedLane], lines_map: Sequence[FloatArray]) -> list[Connection]:
    """How lanes that do not touch continue, split and merge: along a line that bounds one and then the other.

    Lanes that end where no line of theirs goes on, as at a crossing, are left unconnected: nothing that is
    painted says how they continue.
    """
    found = {}
    for side in ("left", "right"):
        for before, after in _next_along(lanes, side).items():
            bounds = {one: _bound_between(lanes[before], lanes[after], one) for one in ("left", "right")}
            if _is_way(lanes[before], lanes[after], bounds[side], lines_map):
                found[before, after] = Connection(before, after, **bounds)
    return [found[key] for key in sorted(found)]


def _next_along(lanes: Sequence[ClosedLane], side: str) -> dict[int, int]:
    """For each lane that has one, the next lane along the line on one ``side`` of both."""
    starts: dict[tuple[int, int], list[tuple[int, int]]] = {}
    ends = []
    for number, lane in enumerate(lanes):
        line, order = getattr(lane, side)
        turn = 1 if order[-1] > order[0] else -1
        starts.setdefault((line, turn), []).append((turn * int(order[0]), number))
        ends.append(((line, turn), turn * int(order[-1])))
    after = {}
    for number, (way, end) in enumerate(ends):
        beyond = [start for start in starts[way] if start[0] >= end]
        if beyond:
            after[number] = min(beyond)[1]
    return after


def _bound_between(before: ClosedLane, after: ClosedLane, side: str) -> tuple[int, IntArray] | None:
    (line, end) = getattr(before, side)
    (other, start) = getattr(after, side)
    turn = 1 if end[-1] > end[0] else -1
    if line != other or (start[0] - end[-1]) * turn <= 0:
        return None
    return line, np.arange(end[-1], start[0] + turn, turn)


def _is_way(
    before: ClosedLane,
    after: ClosedLane,
    shared: tuple[int, IntArray] | None,
    lines_map: Sequence[FloatArray],
) -> bool:
    """Whether the stretch of line that two lanes share is a lane's way, with both sides in its direction."""
    if shared is None:  # the lanes touch, or part where they touch
        return False
    line, order = shared
    stretch = lines_map[line][order]
    way = stretch[-1] - stretch[0]
    gaps = [
        lines_map[start[0]][start[1][0]] - lines_map[end[0]][end[1][-1]]
        for end, start in ((before.left, after.left), (before.right, after.right))
    ]
    return bool(length_along(stretch)[-1] <= _LONGEST_CONNECTION_M and all(gap @ way > 0 for gap in gaps))


def closed_lanes(lines_map: Sequence[FloatArray]) -> list[ClosedLane]:
    """The lanes between polylines (N, 2) m, in the order of their first line.

    A lane lies between a line and the nearest one across it, at a lane's width, for longer than it is wide.
    Where one ends, those beside it are cut, too: for lane changes neighbours share all of a bound.
    """
    runs = _runs(lines_map)
    cuts = [_Cuts(line) for line in lines_map]
    for run in runs:
        for end in (0, -1):
            cuts[run.line].at(run.own[end])
            cuts[run.other].at(run.met[end])
    while sum(run.cut_alike(cuts) for run in runs):
        pass
    return [lane for run in runs for lane in run.lanes(cuts)]


class _Cuts:
    """Vertices at which a line is cut, at least the width of a narrow lane apart along it."""

    def __init__(self, line: FloatArray) -> None:
        self._along_m = length_along(line)
        self.vertices: list[int] = []

    def at(self, vertex: int) -> int:
        """The cut at a vertex: one that is near it, else it is made there."""
        for cut in self.vertices:
            if abs(self._along_m[cut] - self._along_m[vertex]) < LANE_WIDTH_M[0]:
                return cut
        self.vertices = sorted([*self.vertices, int(vertex)])
        return int(vertex)


@dataclass(frozen=True)
class _Run:
    """Vertices ``own`` (N,) of a ``line`` near those ``met`` (N,) of an ``other`` on one ``side``."""

    line: int
    own: IntArray
    other: int
    met: IntArray
    side: int

    def cut_alike(self, cuts: Sequence[_Cuts]) -> bool:
        """Cut each line where the other is; whether there was anything to do."""
        before = len(cuts[self.line].vertices) + len(cuts[self.other].vertices)
        for vertex in cuts[self.line].vertices:
            if self.own[0] < vertex < self.own[-1]:
                cuts[self.other].at(self.met[vertex - self.own[0]])
        for vertex in cuts[self.other].vertices:
            if self.met.min() < vertex < self.met.max():
                cuts[self.line].at(self.own[np.argmin(np.abs(self.met - vertex))])
        return len(cuts[self.line].vertices) + len(cuts[self.other].vertices) > before

    def lanes(self, cuts: Sequence[_Cuts]) -> list[ClosedLane]:
        """The lanes between one cut and the next."""
        first, last = (cuts[self.line].at(self.own[end]) for end in (0, -1))
        own = [vertex for vertex in cuts[self.line].vertices if first <= vertex <= last]
        places = np.clip(np.array(own) - self.own[0], 0, len(self.met) - 1)
        met = [cuts[self.other].at(vertex) for vertex in self.met[places]]
        lanes = []
        for (begin, end), (start, stop) in zip(pairwise(own), pairwise(met), strict=True):
            if start == stop:
                continue
            turn = 1 if start < stop else -1
            own_bound = (self.line, np.arange(begin, end + 1))
            bounds = (own_bound, (self.other, np.arange(start, stop + turn, turn)))
            lanes.append(ClosedLane(*(bounds if self.side < 0 else bounds[::-1])))
        return lanes


def _runs(lines_map: Sequence[FloatArray]) -> list[_Run]:
    """Stretches of two lines beside each other, longer than they are apart, each pair once."""
    segments = _Segments.of(lines_map)
    runs = []
    for number, line in enumerate(lines_map):
        if len(line) < 2:
            continue
        for side in (1, -1):
            other, nearest, gap_m = segments.across(number, line, side)
            for begin, end in _stretches(other, gap_m):
                if other[begin] < number:  # found from there
                    continue
                run = slice(begin, end + 1)
                met = lines_map[other[begin]][nearest[run]]
                if min(length_along(line[run])[-1], length_along(met)[-1]) > gap_m[run].max():
                    own = np.arange(begin, end + 1)
                    runs.append(_Run(number, own, int(other[begin]), nearest[run], side))
    return runs


@dataclass(frozen=True)
class _Segments:
    """All lines' segments: both ends (S, 2) m, the line that each is of, and its place along it."""

    start: FloatArray
    end: FloatArray
    line: IntArray
    index: IntArray

    @classmethod
    def of(cls, lines_map: Sequence[FloatArray]) -> _Segments:
        none = np.empty((0, 2))
        counts = [max(len(line) - 1, 0) for line in lines_map]
        start = np.concatenate([none, *(line[:-1] for line in lines_map)])
        end = np.concatenate([none, *(line[1:] for line in lines_map)])
        index = np.concatenate([np.arange(0), *map(np.arange, counts)])
        return cls(start, end, np.repeat(np.arange(len(lines_map)), counts), index)

    def across(self, number: int, line: FloatArray, side: int) -> tuple[IntArray, IntArray, FloatArray]:
        """The line first met left (1) or right (-1) of each vertex (N,), -1 for none; its vertex; m away."""
        tangent = np.gradient(line, axis=0)
        normal = side * turned_left(tangent)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        pieces = [
            self._met(number, line[at : at + _AT_ONCE], normal[at : at + _AT_ONCE])
            for at in range(0, len(line), _AT_ONCE)
        ]
        other, nearest, gap_m = zip(*pieces, strict=True)
        return np.concatenate(other), np.concatenate(nearest), np.concatenate(gap_m)

    def _met(
        self, number: int, places: FloatArray, away: FloatArray
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """The result of :meth:`across` for neighbouring places (N, 2) and directions ``away`` (N, 2)."""
        low = places.min(axis=0) - LANE_WIDTH_M[1]
        high = places.max(axis=0) + LANE_WIDTH_M[1]
        near = (np.maximum(self.start, self.end) >= low) & (np.minimum(self.start, self.end) <= high)
        candidates = np.flatnonzero(near.all(axis=1) & (self.line != number))
        if not len(candidates):
            nothing = np.zeros(len(places), dtype=np.int64)
            return nothing - 1, nothing, np.full(len(places), LANE_WIDTH_M[1])
        ahead = []
        beside = []
        for ends in (self.start, self.end):
            offset = ends[candidates] - places[:, None]
            ahead.append(np.einsum("nsi,ni->ns", offset, away))
            beside.append(offset[..., 0] * away[:, None, 1] - offset[..., 1] * away[:, None, 0])
        crosses = (beside[0] * beside[1] <= 0) & (beside[0] != beside[1])
        part = beside[0] / np.where(crosses, beside[0] - beside[1], 1.0)
        met_m = ahead[0] + part * (ahead[1] - ahead[0])
        met_m[~crosses | (met_m <= 0)] = np.inf
        rows = np.arange(len(places))
        best = np.argmin(met_m, axis=1)
        met_at = candidates[best]
        gap_m = met_m[rows, best]
        reached = gap_m < LANE_WIDTH_M[1]
        nearest = self.index[met_at] + np.rint(np.where(reached, part[rows, best], 0.0)).astype(np.int64)
        return np.where(reached, self.line[met_at], -1), nearest, np.where(reached, gap_m, LANE_WIDTH_M[1])


def _stretches(other: IntArray, gap_m: FloatArray) -> list[tuple[int, int]]:
    """First and last vertex of each run that meets the same line at a lane's width."""
    meets = np.where(gap_m > LANE_WIDTH_M[0], other, -1)
    runs = [(key, list(group)) for key, group in groupby(range(len(meets)), key=lambda k: int(meets[k]))]
    return [(run[0], run[-1]) for key, run in runs if key >= 0 and len(run) > 1]
