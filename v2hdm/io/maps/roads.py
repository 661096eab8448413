"""The roads of a lane graph as OpenDRIVE knows them: one lane to the right of a course, with its marks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import length_along
from v2hdm.io.maps.features import Feature
from v2hdm.io.maps.road_curves import Course
from v2hdm.records import LANE_DASH, BoolArray, FloatArray
from v2hdm.topology.graph import Border, Direction, LaneGraph, LaneOfGraph
from v2hdm.topology.lines import tangents

_LEAST_STEP_M = 1e-3  # least length of a piece of a reference line, m: readers refuse shorter geometries
_SHORTEST_M = 0.3  # length, m, below which a way on one side of a lane is a point; chosen


class Marks(NamedTuple):
    """The types of the marks on both sides of a lane from a place on."""

    s_m: float
    left: str
    right: str


@dataclass(frozen=True)
class Road:
    """A road with one lane; ``before`` and ``after`` are numbers of roads, ``junction`` where it lies."""

    course: Course
    heights_m: FloatArray  # (N,) at the course's stations
    widths_m: FloatArray  # (N,) at the course's stations
    marks: tuple[Marks, ...]
    lanes: tuple[int, ...] = ()  # of the graph, one after the other
    junction: int | None = None
    before: int | None = None
    after: int | None = None
    speed_kmh: float | None = None
    kind: str = "driving"

    @cached_property
    def tree(self) -> FloatArray:
        """The points (N, 2) of its course."""
        return self.course.stations.points


@dataclass
class Roads:
    """All roads, those outside junctions first; ``left_out`` counts ways too short to be a road."""

    roads: list[Road] = field(default_factory=list)
    left_out: int = 0

    @property
    def of_lane(self) -> dict[int, list[int]]:
        """The numbers of the roads that each lane of the graph is part of."""
        roads: dict[int, list[int]] = {}
        for number, road in enumerate(self.roads):
            for lane in road.lanes:
                roads.setdefault(lane, []).append(number)
        return roads


def roads_of(graph: LaneGraph, lines: Sequence[Feature]) -> Roads:
    """A road for each lane, or for several in a row, and one for each way through a junction.

    A way through a junction leads from a road that enters it to one that leaves it.
    """
    drawing = _Drawing(graph, lines)
    result = Roads()
    for chain in _chains(graph):
        result.roads.append(drawing.road(chain))
    ends = {road.lanes[-1]: number for number, road in enumerate(result.roads)}
    starts = {road.lanes[0]: number for number, road in enumerate(result.roads)}
    for number, road in enumerate(result.roads):
        around = [lane for lane in graph.after(road.lanes[-1]) if lane == road.lanes[0]]
        if around:  # a ring
            result.roads[number] = replace(road, before=number, after=number)
    for junction, through in enumerate(graph.junctions):
        for chain in _ways_through(graph, through.lanes):
            before = next((ends[lane] for lane in graph.before(chain[0]) if lane in ends), None)
            after = next((starts[lane] for lane in graph.after(chain[-1]) if lane in starts), None)
            road = drawing.road(chain)
            if road.course.length_m < _SHORTEST_M:
                result.left_out += 1
                continue
            outer = [None if end is None else result.roads[end] for end in (before, after)]
            road = _fitted(road, *outer)
            result.roads.append(replace(road, junction=junction, before=before, after=after))
    return result


def _chains(graph: LaneGraph) -> Iterator[list[int]]:
    """Lanes outside junctions, each with those that follow it directly."""
    outside = [number for number, lane in enumerate(graph.lanes) if not lane.is_connecting]
    following = {
        number: after
        for number in outside
        for after in graph.after(number)
        if not graph.lanes[after].is_connecting
    }
    inner = set(following.values())
    in_a_chain: set[int] = set()
    for start in [*(number for number in outside if number not in inner), *outside]:
        if start in in_a_chain:
            continue
        chain = [start]
        while (after := following.get(chain[-1])) is not None and after != start:
            chain.append(after)
        in_a_chain |= set(chain)
        yield chain


def _ways_through(graph: LaneGraph, members: Sequence[int]) -> Iterator[list[int]]:
    """The lanes of each way through a junction, from its border to its border."""
    pending = [
        [number] for number in members if not any(before in members for before in graph.before(number))
    ]
    while pending:
        way = pending.pop(0)
        inner = [after for after in graph.after(way[-1]) if after in members and after not in way]
        pending += [[*way, after] for after in inner]
        if not inner:
            yield way


class _Drawing:
    """Draws roads along the left sides of lanes."""

    def __init__(self, graph: LaneGraph, lines: Sequence[Feature]) -> None:
        self._graph = graph
        self._lines = lines
        self._ahead = [tangents(line.points_map) for line in lines]

    def road(self, chain: Sequence[int]) -> Road:
        """The road of lanes that follow each other, as wide as they are."""
        lanes = [self._graph.lanes[number] for number in chain]
        lefts = [self._left(number) for number in chain]
        xyz = np.concatenate([side.xyz if k == 0 else side.xyz[1:] for k, side in enumerate(lefts)])
        ahead = np.concatenate([side.ahead if k == 0 else side.ahead[1:] for k, side in enumerate(lefts)])
        right = np.concatenate([lane.right.points_map for lane in lanes])
        ends_m = np.cumsum([0.0, *(length_along(side.xyz[:, :2])[-1] for side in lefts)])
        is_apart = _is_apart(xyz)
        xyz = xyz[is_apart]
        ahead = ahead[is_apart]
        if len(xyz) < 2:  # the way turns about one point
            xyz = np.stack([xyz[0], xyz[0]])
            xyz[1, :2] += _LEAST_STEP_M * ahead[0]
            ahead = np.stack([ahead[0], ahead[0]])
        course = Course.through(xyz[:, :2], ahead)
        way_m = length_along(xyz[:, :2])
        scale = course.length_m / way_m[-1]
        stations = course.stations
        marks = [
            Marks(start_m * scale, self._mark(lane.left), self._mark(lane.right))
            for start_m, lane in zip(ends_m, lanes, strict=False)
        ]
        return Road(
            course=course,
            heights_m=np.interp(stations.s_m, way_m * scale, xyz[:, 2]),
            widths_m=stations.widths_m(spaced(right)),
            marks=tuple(_changed(marks)),
            lanes=tuple(chain),
            speed_kmh=lanes[0].speed_kmh,
            kind="restricted" if _is_asked(lanes) else "driving",
        )

    def _left(self, number: int) -> _Side:
        """The left side of a lane, with directions that agree with those of lanes before and after it."""
        left = self._graph.lanes[number].left
        if left.bound is not None:
            return _Side(left.xyz_map, self._along(left))
        ahead = tangents(left.points_map)
        neighbours = (self._graph.before(number), -1, 0), (self._graph.after(number), 0, -1)
        for others, end_of_other, end in neighbours:
            side = self._graph.lanes[others[0]].left if others else left
            if side.bound is not None:
                ahead[end] = self._along(side)[end_of_other]
        return _Side(left.xyz_map, ahead)

    def _along(self, side: Border) -> FloatArray:
        assert side.bound is not None
        line, order = side.bound
        return np.asarray(self._ahead[line][order] * (1.0 if order[-1] > order[0] else -1.0))

    def _mark(self, side: Border) -> str:
        """The type of a side's mark; that of a double line goes from left to right in its lane's direction.

        OpenDRIVE 1.7: in the centre from left to right, else from the inside out, on a road's right here.
        """
        if side.bound is None:
            return "none"
        line = self._lines[side.bound.line]
        left_to_right = line.lines or (line.kind,)
        if side.bound.order[-1] < side.bound.order[0]:
            left_to_right = left_to_right[::-1]
        return " ".join("broken" if kind == LANE_DASH else "solid" for kind in left_to_right)


class _Side(NamedTuple):
    """The side of a lane that its road runs along."""

    xyz: FloatArray  # (N, 3) m
    ahead: FloatArray  # (N, 2) unit directions


def _is_asked(lanes: Sequence[LaneOfGraph]) -> bool:
    return any(lane.direction is Direction.ASKED for lane in lanes)


def spaced(line: FloatArray) -> FloatArray:
    """A polyline (N, 2 or 3) without vertices that lie upon one another: a single one where all do."""
    return np.asarray(line[_is_apart(line)])


def _is_apart(line: FloatArray) -> BoolArray:
    """Whether each vertex lies apart from the one before it, from above."""
    return np.insert(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1) > _LEAST_STEP_M, 0, True)


def _changed(marks: Sequence[Marks]) -> Iterator[Marks]:
    """The marks that differ from those before them."""
    for k, mark in enumerate(marks):
        if k == 0 or mark[1:] != marks[k - 1][1:]:
            yield mark


def _fitted(road: Road, before: Road | None, after: Road | None) -> Road:
    """The road with the widths at its ends of those that it connects."""
    widths_m = road.widths_m
    share = road.course.stations.s_m / road.course.length_m
    start_m = 0.0 if before is None else before.widths_m[-1] - widths_m[0]
    end_m = 0.0 if after is None else after.widths_m[0] - widths_m[-1]
    return replace(road, widths_m=widths_m + (1 - share) * start_m + share * end_m)
