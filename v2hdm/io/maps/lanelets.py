"""The lanelets of a lane graph, with the lines that bound them and the rules of stop and give-way lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from v2hdm.io.maps.features import Feature
from v2hdm.io.maps.osm import MOST_VERTICES, PARTS, Document, part
from v2hdm.records import LANE_DASH, FloatArray
from v2hdm.topology.closed_lanes import Bound
from v2hdm.topology.graph import Border, Direction, LaneGraph, LaneOfGraph, Right, StatedRight, StopLine

# Parts of a line, beside its vertices and its pieces:
_LANELETS = MOST_VERTICES + PARTS // 4  # part that those of the lanelets to its right follow
_VIRTUALS = MOST_VERTICES + 3 * PARTS // 8  # part that those of its bounds without paint follow
_RIGHTS = MOST_VERTICES + 5 * PARTS // 16  # part that those of stated rights of way follow
_INNER = MOST_VERTICES + 7 * PARTS // 16  # part that those of the nodes of such bounds follow
_TOGETHER_M = 0.6  # distance, m, of points half a metre apart along curves that are one line; chosen

_RULE = {"type": "regulatory_element"}


class _StopEdges(NamedTuple):
    """The edge of a stop line at which one stops, and the other one, each (2, 3) m."""

    stop: FloatArray
    other: FloatArray


class _Virtual(NamedTuple):
    """A bound that no paint shows, by its id, and its points (N, 3), m, between its ends."""

    number: int
    inner_xyz: FloatArray


class Lanelets:
    """The lanelets of a map's ``graph`` between ``lines``, its open features in the graph's order."""

    def __init__(self, document: Document, graph: LaneGraph, lines: Sequence[Feature]) -> None:
        self._document = document
        self._graph = graph
        self._lines = lines
        self.vertices = {line.id: document.nodes(line, line.xyz_map) for line in lines}
        self._stop_of_lane: dict[int, int] = {}
        self._rights: Counter[int] = Counter()
        self._rules: list[list[int]] = [[] for _ in graph.lanes]
        self._bounds: dict[tuple[int, int, int], int] = {}
        self._counts: Counter[int] = Counter()
        self._virtuals: Counter[int] = Counter()
        self._virtuals_between: dict[frozenset[int], list[_Virtual]] = {}
        self._inner: Counter[int] = Counter()
        self._numbers = [self._number(lane) for lane in range(len(graph.lanes))]

    def _owner(self, lane: int) -> Feature:
        """The line that a lanelet's id follows from: its left one, or that of the lane before it."""
        bound = self._graph.lanes[lane].left.bound
        if bound is None or self._graph.lanes[lane].right.bound is None:
            bound = self._graph.lanes[self._graph.before(lane)[0]].left.bound
        assert bound is not None  # lanes without paint lead from lanes with it
        return self._lines[bound.line]

    def _number(self, lane: int) -> int:
        owner = self._owner(lane)
        self._counts[owner.id] += 1
        return part(owner, _LANELETS + self._counts[owner.id])

    def write_stop_line(self, feature: Feature, stop_line: StopLine) -> None:
        """Write what a painted line asks for: a traffic sign, or the right of way of those that it names."""
        corners = feature.xyz_map[feature.ring]
        edges = _stop_edges(corners, self._direction(stop_line, corners[:, :2].mean(axis=0)))
        stop_id, sign_id, rule_id = (part(feature, MOST_VERTICES + k) for k in range(3))
        stop_nodes = self._document.nodes(feature, edges.stop, MOST_VERTICES + 10)
        self._document.way(stop_id, stop_nodes, {"type": "stop_line"})
        if stop_line.right is Right.GIVE_WAY and stop_line.yields_to:
            self._right_of_way(rule_id, stop_id, stop_line.lanes, stop_line.yields_to)
        else:
            sign_nodes = self._document.nodes(feature, edges.other, MOST_VERTICES + 20)
            kind = "stop_sign" if stop_line.right is Right.STOP else "yield_sign"
            sign_tags = {"type": "traffic_sign", "subtype": kind, "virtual": "yes"}
            self._document.way(sign_id, sign_nodes, sign_tags)
            members = [("way", sign_id, "refers"), ("way", stop_id, "ref_line")]
            self._document.relation(rule_id, members, _RULE | {"subtype": "traffic_sign"})
        for lane in stop_line.lanes:
            self._rules[lane].append(rule_id)
            self._stop_of_lane[lane] = stop_id

    def write_right(self, right: StatedRight) -> None:
        """Write that a lane gives way as stated, at the line that it ends at if one is painted."""
        owner = self._owner(right.lane)
        self._rights[owner.id] += 1
        rule_id = part(owner, _RIGHTS + self._rights[owner.id])
        self._right_of_way(rule_id, self._stop_of_lane.get(right.lane), (right.lane,), right.yields_to)
        self._rules[right.lane].append(rule_id)

    def _right_of_way(
        self, rule_id: int, stop_id: int | None, yielding: Sequence[int], first: Sequence[int]
    ) -> None:
        """Write the rule that lanes ``yielding`` wait for lanes that go ``first``."""
        members = [] if stop_id is None else [("way", stop_id, "ref_line")]
        members += [("relation", self._numbers[lane], "yield") for lane in yielding]
        members += [("relation", self._numbers[lane], "right_of_way") for lane in first]
        self._document.relation(rule_id, members, _RULE | {"subtype": "right_of_way"})

    def _direction(self, stop_line: StopLine, place_map: FloatArray) -> FloatArray | None:
        """The direction (2,) in which the lanes of a stop line pass it, None without lanes."""
        if not stop_line.lanes:
            return None
        centre = self._graph.lanes[stop_line.lanes[0]].centre_map
        nearest = int(np.argmin(((centre - place_map) ** 2).sum(axis=1)))
        return np.asarray(np.gradient(centre, axis=0)[nearest])

    def write(self) -> None:
        """Write a lanelet of each lane, with the lines that it needs as bounds."""
        for number, lane in enumerate(self._graph.lanes):
            sides = [self._side(number, lane.left, "left"), self._side(number, lane.right, "right")]
            members = [("way", way, role) for way, role in zip(sides, ("left", "right"), strict=True)]
            members += [("relation", rule, "regulatory_element") for rule in self._rules[number]]
            self._document.relation(self._numbers[number], members, _tags(lane))

    def _side(self, lane: int, side: Border, name: str) -> int:
        """The line string of one side of a lane."""
        if side.bound is not None:
            return self._bound(side.bound)
        before = getattr(self._graph.lanes[self._graph.before(lane)[0]], name).bound
        after = getattr(self._graph.lanes[self._graph.after(lane)[0]], name).bound
        return self._virtual(before, after, side.xyz_map[1:-1])

    def _virtual(self, end: Bound, start: Bound, inner_xyz: FloatArray) -> int:
        """A bound that no paint shows, from where one lane's ends to where another's starts.

        Ways beside each other share it, also where they lead in opposite directions (Autoware's vm-01-04).
        """
        owner = self._lines[end.line]
        last = self.vertices[owner.id][end.order[-1]]
        first = self.vertices[self._lines[start.line].id][start.order[0]]
        ends = frozenset((last, first))
        for virtual in self._virtuals_between.get(ends, ()):
            if _lie_together(virtual.inner_xyz, inner_xyz):
                return virtual.number
        self._virtuals[owner.id] += 1
        number = part(owner, _VIRTUALS + self._virtuals[owner.id])
        inner = self._document.nodes(owner, inner_xyz, _INNER + self._inner[owner.id])
        self._inner[owner.id] += len(inner)
        self._virtuals_between.setdefault(ends, []).append(_Virtual(number, inner_xyz))
        self._document.way(number, [last, *inner, first], {"type": "virtual", "lane_change": "no"})
        return number

    def _bound(self, bound: Bound) -> int:
        """The line string of a bound: that of the line where the bound is all of it, else that of a piece."""
        owner = self._lines[bound.line]
        first, last = sorted((int(bound.order[0]), int(bound.order[-1])))
        if last - first + 1 == len(owner.points_map):
            return owner.id
        key = (bound.line, first, last)
        if key not in self._bounds:
            pieces = sum(1 for line, _, _ in self._bounds if line == bound.line)
            self._bounds[key] = part(owner, MOST_VERTICES + 1 + pieces)
            nodes = self.vertices[owner.id][first : last + 1]
            self._document.way(self._bounds[key], nodes, line_tags(owner) | {"part_of": str(owner.id)})
        return self._bounds[key]


def _tags(lane: LaneOfGraph) -> dict[str, str]:
    """Tags of a lanelet; one that nobody is known to drive along is closed to vehicles."""
    tags = {"type": "lanelet", "subtype": "road", "location": "urban", "one_way": "yes"}
    is_asked = lane.direction is Direction.ASKED
    tags |= {"participant:vehicle": "no" if is_asked else "yes", "direction": lane.direction.value}
    if lane.turn is not None:
        tags["turn_direction"] = lane.turn.value
    if lane.speed_kmh is not None:
        tags["speed_limit"] = f"{lane.speed_kmh:g}"
    return tags


def _lie_together(first_xyz: FloatArray, second_xyz: FloatArray) -> bool:
    """Whether two curves (N, 3) and (M, 3) between the same ends are one line."""
    if not len(first_xyz) or not len(second_xyz):
        return len(first_xyz) == len(second_xyz)
    apart_m = np.linalg.norm(first_xyz[:, None, :2] - second_xyz[None, :, :2], axis=2)
    return bool(max(apart_m.min(axis=0).max(), apart_m.min(axis=1).max()) < _TOGETHER_M)


def _stop_edges(corners: FloatArray, direction: FloatArray | None) -> _StopEdges:
    """The edges of a stop line's ``corners`` (4, 3).

    Vehicles stop at the edge that they meet first (Autoware's vm-02-01), else at the middle of the paint.
    """
    length = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    start = int(length[1] + length[3] > length[0] + length[2])
    edge = corners[[start, start + 1]]
    other_edge = corners[[(start + 3) % 4, (start + 2) % 4]]
    if direction is None:
        return _StopEdges((edge + other_edge) / 2, other_edge)
    is_first = (other_edge - edge)[:, :2].mean(axis=0) @ direction > 0
    return _StopEdges(edge, other_edge) if is_first else _StopEdges(other_edge, edge)


def line_tags(feature: Feature) -> dict[str, str]:
    """Type, subtype and lane change of a line; the subtype of a double one goes from left to right."""
    dashed = [kind == LANE_DASH for kind in feature.lines or (feature.kind,)]
    if dashed[0] == dashed[-1]:
        words = ["dashed" if dashed[0] else "solid"]  # Lanelet2 has no word for two dashed ones
        subtype = "_".join(words if dashed[0] else words * len(dashed))
        return {"type": "line_thin", "subtype": subtype, "lane_change": "yes" if dashed[0] else "no"}
    subtype = "_".join("dashed" if is_dashed else "solid" for is_dashed in dashed)
    to_right, to_left = ("yes" if is_dashed else "no" for is_dashed in dashed)
    changes = {"lane_change:left": to_left, "lane_change:right": to_right}
    return {"type": "line_thin", "subtype": subtype} | changes
