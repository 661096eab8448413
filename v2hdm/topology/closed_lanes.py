"""Lanes between lane lines that run beside each other, and how one lane continues in the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import length_along, turned_left
from v2hdm.records import FloatArray, IntArray

LANE_WIDTH_M = (2.55, 5.1)
"""Lines that are closer have no room for a truck, 2.55 m wide (Directive 96/53/EC, annex I, 1.1), and those
farther apart have room for two."""

_LONGEST_CONNECTION_M = 40.0
"""Longest way from lane to lane of which the line that bounds both is evidence: the taper of a lane that
begins at 50 km/h is 30 to 40 m long (RASt 06, 6.1.4)."""

_AT_ONCE = 64  # neighbouring vertices that are compared with the segments around them at once; chosen


class Bound(NamedTuple):
    """A stretch of a line on one side of a lane, in the lane's direction."""

    line: int  # number of the line
    order: IntArray  # (N,) vertices of the line


@dataclass(frozen=True)
class ClosedLane:
    """A stretch of a lane between two lines, in the direction of the one with the smaller number."""

    left: Bound
    right: Bound

    @property
    def turned(self) -> ClosedLane:
        """The same lane in the other direction."""
        left, right = (Bound(bound.line, bound.order[::-1]) for bound in (self.right, self.left))
        return ClosedLane(left, right)


@dataclass(frozen=True)
class Connection:
    """The way from the end of the lane ``before`` to the start of the lane ``after``, both by number.

    ``left`` and ``right`` are bounds as those of a lane, or None on a side on which no one line bounds both
    lanes: where lanes split, merge, or paint is interrupted.
    """

    before: int
    after: int
    left: Bound | None
    right: Bound | None


def connections(lanes: Sequence[ClosedLane], lines_map: Sequence[FloatArray]) -> list[Connection]:
    """How lanes that do not touch continue, split and merge: along a line that bounds one and then the other.

    Lanes that end where no line of theirs goes on, as at a crossing, are left unconnected: nothing that is
    painted says how they continue.
    """
    connection_of_pair = {}
    for side in ("left", "right"):
        for before, after in _next_along(lanes, side).items():
            left = _bound_between(lanes[before], lanes[after], "left")
            right = _bound_between(lanes[before], lanes[after], "right")
            shared = left if side == "left" else right
            if _is_way(lanes[before], lanes[after], shared, lines_map):
                connection_of_pair[before, after] = Connection(before, after, left, right)
    return [connection_of_pair[pair] for pair in sorted(connection_of_pair)]


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


def _bound_between(before: ClosedLane, after: ClosedLane, side: str) -> Bound | None:
    """The line on one ``side`` from the end of a lane to the start of another; None where there is no gap."""
    (line, end) = getattr(before, side)
    (other, start) = getattr(after, side)
    turn = 1 if end[-1] > end[0] else -1
    if line != other or (start[0] - end[-1]) * turn <= 0:
        return None
    return Bound(line, np.arange(end[-1], start[0] + turn, turn))


def _is_way(
    before: ClosedLane, after: ClosedLane, shared: Bound | None, lines_map: Sequence[FloatArray]
) -> bool:
    """Whether the stretch of line that two lanes share is a lane's way, with both sides in its direction."""
    if shared is None:  # the lanes touch, or part where they touch
        return False
    stretch = lines_map[shared.line][shared.order]
    way = stretch[-1] - stretch[0]
    gaps = [
        lines_map[start.line][start.order[0]] - lines_map[end.line][end.order[-1]]
        for end, start in ((before.left, after.left), (before.right, after.right))
    ]
    is_short = length_along(stretch)[-1] <= _LONGEST_CONNECTION_M
    return bool(is_short and all(gap @ way > 0 for gap in gaps))


def closed_lanes(
    lines_map: Sequence[FloatArray], more_cuts: Sequence[tuple[int, int]] = ()
) -> list[ClosedLane]:
    """The lanes between polylines (N, 2) m, in the order of their first line.

    A lane lies between a line and the nearest one across it, at a lane's width, for longer than it is wide.
    Where one ends, those beside it are cut, too: for lane changes neighbours share all of a bound.
    ``more_cuts`` are numbers of lines and their vertices at which lanes end as well.
    """
    runs = _runs(lines_map)
    cuts = [_Cuts(line) for line in lines_map]
    for number, vertex in more_cuts:
        cuts[number].at(vertex)
    for run in runs:
        for end in (0, -1):
            cuts[run.line].at(run.vertices[end])
            cuts[run.other].at(run.other_vertices[end])
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
    """A stretch of a line beside an ``other`` one."""

    line: int
    vertices: IntArray  # (N,) of the line, rising by one
    other: int
    other_vertices: IntArray  # (N,) of the other line, nearest across from each
    side: int  # on which the other line lies: 1 left, -1 right

    def cut_alike(self, cuts: Sequence[_Cuts]) -> bool:
        """Cut each line where the other one is cut; returns whether a cut was added."""
        before = len(cuts[self.line].vertices) + len(cuts[self.other].vertices)
        for vertex in cuts[self.line].vertices:
            if self.vertices[0] < vertex < self.vertices[-1]:
                cuts[self.other].at(self.other_vertices[vertex - self.vertices[0]])
        for vertex in cuts[self.other].vertices:
            if self.other_vertices.min() < vertex < self.other_vertices.max():
                nearest = np.argmin(np.abs(self.other_vertices - vertex))
                cuts[self.line].at(self.vertices[nearest])
        return len(cuts[self.line].vertices) + len(cuts[self.other].vertices) > before

    def lanes(self, cuts: Sequence[_Cuts]) -> list[ClosedLane]:
        """The lanes between one cut and the next."""
        first = cuts[self.line].at(self.vertices[0])
        last = cuts[self.line].at(self.vertices[-1])
        line_cuts = [vertex for vertex in cuts[self.line].vertices if first <= vertex <= last]
        places = np.clip(np.array(line_cuts) - self.vertices[0], 0, len(self.other_vertices) - 1)
        other_cuts = [cuts[self.other].at(vertex) for vertex in self.other_vertices[places]]
        lanes = []
        for (begin, end), (start, stop) in zip(pairwise(line_cuts), pairwise(other_cuts), strict=True):
            if start == stop:
                continue
            turn = 1 if start < stop else -1
            bound = Bound(self.line, np.arange(begin, end + 1))
            other_bound = Bound(self.other, np.arange(start, stop + turn, turn))
            is_right = self.side < 0
            lanes.append(ClosedLane(bound, other_bound) if is_right else ClosedLane(other_bound, bound))
        return lanes


def _runs(lines_map: Sequence[FloatArray]) -> list[_Run]:
    """Stretches of two lines beside each other, longer than they are apart, each pair once."""
    segments = _Segments.of(lines_map)
    runs = []
    for number, line in enumerate(lines_map):
        if len(line) < 2:
            continue
        for side in (1, -1):
            across = segments.across(number, line, side)
            for begin, end in _stretches(across.line, across.gap_m):
                other = int(across.line[begin])
                if other < number:  # this pair was looked at from the other line
                    continue
                run = slice(begin, end + 1)
                beside = lines_map[other][across.vertex[run]]
                length_m = min(length_along(line[run])[-1], length_along(beside)[-1])
                if length_m > across.gap_m[run].max():
                    runs.append(_Run(number, np.arange(begin, end + 1), other, across.vertex[run], side))
    return runs


class _Across(NamedTuple):
    """The lines across from each of N vertices of a line."""

    line: IntArray  # (N,) number of the line first met, -1 for none
    vertex: IntArray  # (N,) its vertex nearest to the place
    gap_m: FloatArray  # (N,) distance to it, the upper LANE_WIDTH_M for none


@dataclass(frozen=True)
class _Segments:
    """The S segments of all lines."""

    start: FloatArray  # (S, 2) m
    end: FloatArray  # (S, 2) m
    line: IntArray  # (S,) number of the line that each is of
    index: IntArray  # (S,) number of each along its line
    first: IntArray  # (L + 1,) number of the first segment of each line, then of all
    boxes: FloatArray  # (L, 2, 2) m, least and largest coordinates of each line

    @classmethod
    def of(cls, lines_map: Sequence[FloatArray]) -> _Segments:
        none = np.empty((0, 2))
        counts = [max(len(line) - 1, 0) for line in lines_map]
        start = np.concatenate([none, *(line[:-1] for line in lines_map)])
        end = np.concatenate([none, *(line[1:] for line in lines_map)])
        index = np.concatenate([np.arange(0), *map(np.arange, counts)])
        first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        nowhere = np.array([[np.inf, np.inf], [-np.inf, -np.inf]])
        boxes = [
            np.stack([line.min(axis=0), line.max(axis=0)]) if len(line) else nowhere for line in lines_map
        ]
        numbers = np.repeat(np.arange(len(lines_map)), counts)
        return cls(start, end, numbers, index, first, np.array(boxes).reshape(-1, 2, 2))

    def across(self, number: int, line: FloatArray, side: int) -> _Across:
        """The first line left (1) or right (-1) of each vertex of a line (N, 2)."""
        tangent = np.gradient(line, axis=0)
        normal = side * turned_left(tangent)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        pieces = [
            self._met(number, line[at : at + _AT_ONCE], normal[at : at + _AT_ONCE])
            for at in range(0, len(line), _AT_ONCE)
        ]
        return _Across(
            line=np.concatenate([piece.line for piece in pieces]),
            vertex=np.concatenate([piece.vertex for piece in pieces]),
            gap_m=np.concatenate([piece.gap_m for piece in pieces]),
        )

    def _met(self, number: int, places: FloatArray, away: FloatArray) -> _Across:
        """The result of :meth:`across` for neighbouring places (N, 2) and directions ``away`` (N, 2)."""
        low = places.min(axis=0) - LANE_WIDTH_M[1]
        high = places.max(axis=0) + LANE_WIDTH_M[1]
        lines_near = np.flatnonzero(((self.boxes[:, 1] >= low) & (self.boxes[:, 0] <= high)).all(axis=1))
        segments = np.concatenate(
            [np.arange(0)]
            + [np.arange(self.first[k], self.first[k + 1]) for k in lines_near.tolist() if k != number]
        )
        start = self.start[segments]
        end = self.end[segments]
        in_reach = (np.maximum(start, end) >= low) & (np.minimum(start, end) <= high)
        candidates = segments[in_reach.all(axis=1)]
        if not len(candidates):
            nothing = np.zeros(len(places), dtype=np.int64)
            return _Across(nothing - 1, nothing, np.full(len(places), LANE_WIDTH_M[1]))
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
        nearest_end = np.rint(np.where(reached, part[rows, best], 0.0)).astype(np.int64)
        return _Across(
            line=np.where(reached, self.line[met_at], -1),
            vertex=self.index[met_at] + nearest_end,
            gap_m=np.where(reached, gap_m, LANE_WIDTH_M[1]),
        )


def _stretches(other: IntArray, gap_m: FloatArray) -> list[tuple[int, int]]:
    """First and last vertex of each run that meets the same line at a lane's width."""
    meets = np.where(gap_m > LANE_WIDTH_M[0], other, -1)
    stretches = []
    for line, group in groupby(range(len(meets)), key=lambda vertex: int(meets[vertex])):
        vertices = list(group)
        if line >= 0 and len(vertices) > 1:
            stretches.append((vertices[0], vertices[-1]))
    return stretches
