"""The lane graph of a map, from its lane lines and stop lines and the paths of the drives that mapped it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.planar import length_along
from v2hdm.records import FloatArray, HDMap, Trajectory
from v2hdm.topology.answers import Answer, stated_pair
from v2hdm.topology.closed_lanes import Bound, ClosedLane, Connection, closed_lanes, connections
from v2hdm.topology.curves import End, arc_between, side_along
from v2hdm.topology.directions import DirectedLanes, directed, end_of, start_of
from v2hdm.topology.graph import Border, Direction, LaneGraph, LaneOfGraph, Link, Question
from v2hdm.topology.junctions import TURN_RAD, joined, turn_rad
from v2hdm.topology.lines import tangents, usable_lines
from v2hdm.topology.paths import Path, paths_of
from v2hdm.topology.questions import questions_of
from v2hdm.topology.rights import stated_rights
from v2hdm.topology.stays import LaneShape
from v2hdm.topology.stop_lines import tied
from v2hdm.topology.ways import Cut, DrivenWays, Way, WayFinder

_ROUNDS = 4  # times that lanes are cut where paths leave or enter them; chosen
_LONGEST_IN_JUNCTION_M = 40.0  # longest lane, m, that lies in a junction as a whole; chosen
_IN_JUNCTION_M = 10.0  # length of the piece of a longer one that does, m; chosen


def lane_graph(
    hd_map: HDMap, trajectories: Sequence[Trajectory] = (), answers: Sequence[Answer] = ()
) -> LaneGraph:
    """The lanes between a map's lines, directed and linked as the drives that are ``trajectories`` went.

    Without trajectories lanes have the direction of their lines, and no ways through crossings are known:
    only lines that bound two lanes lead from one to the other. ``answers`` are those of a person to the
    questions of such a graph; MapFileError where they contradict drives or paint.
    """
    lines = usable_lines(hd_map.lanes)
    paths = paths_of(trajectories)
    builder = _Builder(lines.xyz_map, paths, bool(trajectories), answers)
    graph = builder.graph()
    tied_lines = tied(graph, hd_map.markings)
    graph = replace(graph, stop_lines=tuple(tied_lines.stop_lines))
    graph = replace(graph, stated_rights=stated_rights(graph, answers))
    questions = [*lines.questions, *graph.questions, *tied_lines.questions]
    questions += questions_of(graph, bool(trajectories))
    is_open = [not any(answer.closes(question) for answer in answers) for question in questions]
    return replace(graph, questions=tuple(compress(questions, is_open)))


class Refusal(NamedTuple):
    """An answer that cannot be followed, and why."""

    answer: Answer
    reason: str


class Answered(NamedTuple):
    """A lane graph with the answers that it follows, and those that it does not."""

    graph: LaneGraph
    followed: tuple[Answer, ...]
    refused: tuple[Refusal, ...]


def answered_graph(hd_map: HDMap, trajectories: Sequence[Trajectory], answers: Sequence[Answer]) -> Answered:
    """The :func:`lane_graph` with those answers that contradict neither drives nor the map."""
    try:
        return Answered(lane_graph(hd_map, trajectories, answers), tuple(answers), ())
    except MapFileError:
        graph = lane_graph(hd_map, trajectories)
    followed: list[Answer] = []
    refused: list[Refusal] = []
    for answer in answers:
        try:
            graph = lane_graph(hd_map, trajectories, [*followed, answer])
        except MapFileError as error:
            refused.append(Refusal(answer, str(error)))
        else:
            followed.append(answer)
    return Answered(graph, tuple(followed), tuple(refused))


class _Builder:
    """Cuts lines into lanes, and lanes again where paths leave them, until nothing is left to cut."""

    def __init__(
        self,
        lines_xyz: Sequence[FloatArray],
        paths: Sequence[Path],
        has_drives: bool,
        answers: Sequence[Answer],
    ) -> None:
        self._has_drives = has_drives
        self._answers = answers
        self._xyz = lines_xyz
        self._lines = [xyz[:, :2] for xyz in lines_xyz]
        self._ahead = [tangents(line) for line in self._lines]
        self._paths = paths

    def graph(self) -> LaneGraph:
        """The graph, without its stop lines."""
        cuts: list[Cut] = []
        for number in range(_ROUNDS):
            closed = closed_lanes(self._lines, cuts)
            lanes = directed(closed, self._lines, self._paths, self._has_drives, self._answers)
            painted = connections(lanes.lanes, self._lines)
            links = [(connection.before, connection.after) for connection in painted]
            ways = WayFinder(lanes, self._lines, self._paths, links).find()
            graph = self._assembled(lanes, painted, ways)
            more = [cut for cut in [*ways.cuts, *self._cuts_of_long(lanes, graph)] if cut not in cuts]
            if not more or number == _ROUNDS - 1:
                break
            cuts += more
        return graph

    def _assembled(
        self, directed_lanes: DirectedLanes, painted: Sequence[Connection], ways: DrivenWays
    ) -> LaneGraph:
        closed = directed_lanes.lanes
        lanes = [
            LaneOfGraph(self._border(lane.left), self._border(lane.right), direction, drives)
            for lane, direction, drives in zip(
                closed, directed_lanes.direction, directed_lanes.drives, strict=True
            )
        ]
        starts = {start_of(lane): number for number, lane in enumerate(closed)}
        links = [
            Link(number, starts[end_of(lane)]) for number, lane in enumerate(closed) if end_of(lane) in starts
        ]
        questions = [*directed_lanes.questions, *ways.questions]
        for connection in painted:
            lane = self._along_line(connection, closed)
            pair = (connection.before, connection.after)
            drives = tuple(sorted(ways.followed.get(pair, ())))
            if self._has_drives and not drives and abs(turn_rad(lane.centre_map)) > TURN_RAD:
                text = "a line leads around this corner, and no drive took it; may one turn there?"
                questions.append(Question("connection", text, lane.centre_map[0], pair, lane.centre_map[-1]))
                continue
            direction = directed_lanes.direction[connection.before]
            self._add(lanes, links, replace(lane, direction=direction, drives=drives), pair)
        for way in ways.ways:
            drives = tuple(sorted(ways.followed[way.before, way.after]))
            self._add(lanes, links, replace(self._along_path(way, closed), drives=drives), way[:2])
        for answer in self._answers:
            if answer.subject == "connection" and answer.answer == "yes":
                pair = stated_pair([LaneShape(lane, self._lines) for lane in closed], answer)
                if not {after for before, after in links if before == pair[0]} & {
                    before for before, after in links if after == pair[1]
                }:
                    self._add(lanes, links, self._stated(pair, closed), pair)
        for answer in self._answers:
            if answer.subject == "speed":
                lanes = [replace(lane, speed_kmh=answer.speed_kmh) for lane in lanes]
        result = joined(lanes, links)
        return LaneGraph(tuple(result.lanes), tuple(links), tuple(result.junctions), (), tuple(questions))

    @staticmethod
    def _add(lanes: list[LaneOfGraph], links: list[Link], lane: LaneOfGraph, pair: tuple[int, int]) -> None:
        """Add a connecting lane between the two of a pair."""
        before, after = pair
        links += [Link(before, len(lanes)), Link(len(lanes), after)]
        lanes.append(lane)

    def _border(self, bound: Bound) -> Border:
        return Border(self._xyz[bound.line][bound.order], bound)

    def _along_line(self, connection: Connection, closed: Sequence[ClosedLane]) -> LaneOfGraph:
        """The connecting lane along a line that bounds both lanes."""
        before = closed[connection.before]
        after = closed[connection.after]
        sides = []
        for bound, end, start in (
            (connection.left, before.left, after.left),
            (connection.right, before.right, after.right),
        ):
            if bound is not None:
                sides.append(self._border(bound))
                continue
            places = [self._xyz[end.line][end.order[-1]], self._xyz[start.line][start.order[0]]]
            sides.append(Border(np.stack(places)))
        return LaneOfGraph(sides[0], sides[1], Direction.DRIVEN, is_connecting=True)

    def _along_path(self, way: Way, closed: Sequence[ClosedLane]) -> LaneOfGraph:
        """The connecting lane along the path of a drive."""
        path_map = self._paths[way.path].points_map[way.first : way.last + 1]
        sides = []
        for side in ("left", "right"):
            end: Bound = getattr(closed[way.before], side)
            start: Bound = getattr(closed[way.after], side)
            curve = side_along(path_map, self._end(end, -1), self._end(start, 0))
            share = length_along(curve)
            heights_m = [self._xyz[end.line][end.order[-1], 2], self._xyz[start.line][start.order[0], 2]]
            z = np.interp(share / share[-1], [0.0, 1.0], heights_m)
            sides.append(Border(np.column_stack([curve, z])))
        return LaneOfGraph(sides[0], sides[1], Direction.DRIVEN, is_connecting=True)

    def _stated(self, pair: tuple[int, int], closed: Sequence[ClosedLane]) -> LaneOfGraph:
        """The connecting lane that a person states: each side a cubic from one lane to the other."""
        sides = []
        for side in ("left", "right"):
            end: Bound = getattr(closed[pair[0]], side)
            start: Bound = getattr(closed[pair[1]], side)
            curve = arc_between(self._end(end, -1), self._end(start, 0))
            heights_m = [self._xyz[end.line][end.order[-1], 2], self._xyz[start.line][start.order[0], 2]]
            z = np.linspace(heights_m[0], heights_m[1], len(curve))
            sides.append(Border(np.column_stack([curve, z])))
        return LaneOfGraph(sides[0], sides[1], Direction.STATED, is_connecting=True)

    def _end(self, bound: Bound, which: int) -> End:
        """The first (0) or last (-1) vertex of a bound, and the direction in which it passes it."""
        vertex = int(bound.order[which])
        sign = 1.0 if bound.order[-1] > bound.order[0] else -1.0
        return End(self._lines[bound.line][vertex], sign * self._ahead[bound.line][vertex])

    def _cuts_of_long(self, directed_lanes: DirectedLanes, graph: LaneGraph) -> list[Cut]:
        """Where lanes are to end that lie in a junction but are too long for one."""
        cuts = []
        for number, closed in enumerate(directed_lanes.lanes):
            lane = graph.lanes[number]
            at_m = length_along(self._lines[closed.left.line][closed.left.order])
            if not lane.is_connecting or at_m[-1] < _LONGEST_IN_JUNCTION_M:
                continue
            splits = any(len(graph.after(before)) > 1 for before in graph.before(number))
            merges = any(len(graph.before(after)) > 1 for after in graph.after(number))
            wanted_m = [_IN_JUNCTION_M] * splits + [at_m[-1] - _IN_JUNCTION_M] * merges
            vertices = [int(np.argmin(np.abs(at_m - place_m))) for place_m in wanted_m]
            cuts += [(closed.left.line, int(closed.left.order[vertex])) for vertex in vertices]
        return cuts
