"""The direction of each lane between two lines, from the drives that pass it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from v2hdm.records import FloatArray
from v2hdm.topology.answers import Answer, stated_directions
from v2hdm.topology.closed_lanes import ClosedLane, connections
from v2hdm.topology.graph import Direction, Question
from v2hdm.topology.paths import Path
from v2hdm.topology.stays import LaneShape, stays_of

_ENOUGH = 0.5  # share of a lane that a drive passes before it says how the lane is driven; chosen
_ENOUGH_M = 20.0  # way, m, that is enough in a long lane; chosen

_End = tuple[int, int, int, int]


@dataclass(frozen=True)
class DirectedLanes:
    """Lanes in their directions, what says so, and the drives that passed each; ``questions`` are open."""

    lanes: list[ClosedLane]
    direction: list[Direction]
    drives: list[tuple[int, ...]]
    questions: list[Question] = field(default_factory=list)


def directed(
    lanes: Sequence[ClosedLane],
    lines_map: Sequence[FloatArray],
    paths: Sequence[Path],
    has_drives: bool,
    answers: Sequence[Answer] = (),
) -> DirectedLanes:
    """Turn ``lanes`` into the direction of the drives; one driven both ways becomes two lanes, one each way.

    A lane that no drive passed goes on as the one that it touches, or that a line leads to it from.
    ``answers`` state the directions of others; MapFileError where they contradict the drives.
    """
    shapes = [LaneShape(lane, lines_map) for lane in lanes]
    ways = _driven(shapes, paths)
    driven_ways = [_ways(way.is_forward, way.is_backward) for way in ways]
    stated = stated_directions(shapes, driven_ways, answers)
    if not has_drives and not stated:
        return DirectedLanes(list(lanes), [Direction.DRAWN] * len(lanes), [()] * len(lanes))
    for number, directions in stated.items():
        ways[number].stated |= directions
    driven_lanes = {number: way for number, way in enumerate(ways) if way.is_forward or way.is_backward}
    result = DirectedLanes([], [], [])
    turned = {number: way.is_backward and not way.is_forward for number, way in driven_lanes.items()}
    turned |= _continued(lanes, lines_map, turned)
    driven = set(turned)
    unclear_lanes = []
    for number in range(len(lanes)):
        if number not in turned:  # lanes that continue each other are one question
            unclear_lanes.append(number)
            turned[number] = False
            turned |= _continued(lanes, lines_map, turned)
    for number, (lane, way) in enumerate(zip(lanes, ways, strict=True)):
        is_known = number in driven
        result.lanes.append(lane.turned if turned[number] else lane)
        says = Direction.STATED if way.stated else Direction.DRIVEN
        result.direction.append(says if is_known else Direction.ASKED)
        drives = way.backward_drives if turned[number] else way.forward_drives
        result.drives.append(tuple(sorted(drives)))
        place = shapes[number].centre[len(shapes[number].centre) // 2]
        if number in unclear_lanes:
            text = "no drive went along this lane; is it driven along this line, against it, or both ways?"
            to = shapes[number].centre[
                min(len(shapes[number].centre) // 2 + 10, len(shapes[number].centre) - 1)
            ]
            result.questions.append(Question("direction", text, place, (len(result.lanes) - 1,), to))
        if way.is_forward and way.is_backward:
            result.lanes.append(lane.turned)
            result.direction.append(says)
            result.drives.append(tuple(sorted(way.backward_drives)))
            numbers = (len(result.lanes) - 2, len(result.lanes) - 1)
            text = "drives went both ways along this lane; is it open both ways?"
            result.questions.append(Question("two ways", text, place, numbers))
    return result


def _ways(is_forward: bool, is_backward: bool) -> set[bool]:
    """The ways of a lane as answers state them."""
    return {way for way, is_driven in ((True, is_forward), (False, is_backward)) if is_driven}


@dataclass
class _Driven:
    """How far drives went along a lane and against it."""

    enough_m: float
    forward_m: dict[int, float] = field(default_factory=dict)
    backward_m: dict[int, float] = field(default_factory=dict)
    stated: set[bool] = field(default_factory=set)  # True along it, False against it

    @property
    def forward_drives(self) -> set[int]:
        return {drive for drive, length_m in self.forward_m.items() if length_m >= self.enough_m}

    @property
    def backward_drives(self) -> set[int]:
        return {drive for drive, length_m in self.backward_m.items() if length_m >= self.enough_m}

    @property
    def is_forward(self) -> bool:
        return bool(self.forward_drives) or True in self.stated

    @property
    def is_backward(self) -> bool:
        return bool(self.backward_drives) or False in self.stated


def _driven(shapes: Sequence[LaneShape], paths: Sequence[Path]) -> list[_Driven]:
    ways = [_Driven(min(_ENOUGH * shape.length_m, _ENOUGH_M)) for shape in shapes]
    for number, path in enumerate(paths):
        for stay in stays_of(number, paths, shapes):
            way = ways[stay.lane]
            lengths_m = way.forward_m if stay.is_forward else way.backward_m
            lengths_m[path.drive] = lengths_m.get(path.drive, 0.0) + stay.length_m
    return ways


def start_of(lane: ClosedLane) -> _End:
    """The vertices at which a lane starts."""
    left, order = lane.left
    right, across = lane.right
    return left, int(order[0]), right, int(across[0])


def end_of(lane: ClosedLane) -> _End:
    """The vertices at which a lane ends."""
    left, order = lane.left
    right, across = lane.right
    return left, int(order[-1]), right, int(across[-1])


def _continued(
    lanes: Sequence[ClosedLane], lines_map: Sequence[FloatArray], turned: dict[int, bool]
) -> dict[int, bool]:
    """Whether lanes of unknown direction are turned, where those of known direction lead to or from them."""
    inferred: dict[int, bool] = {}
    while True:
        directions = turned | inferred
        news = dict(_touching(lanes, directions)) or dict(_along_lines(lanes, lines_map, directions))
        if not news:
            return inferred
        inferred |= news


def _touching(lanes: Sequence[ClosedLane], turned: dict[int, bool]) -> Iterator[tuple[int, bool]]:
    oriented = [lanes[number].turned if turned[number] else lanes[number] for number in turned]
    ends = {end_of(lane) for lane in oriented}
    starts = {start_of(lane) for lane in oriented}
    for number in set(range(len(lanes))) - set(turned):
        for is_turned, lane in ((False, lanes[number]), (True, lanes[number].turned)):
            if start_of(lane) in ends or end_of(lane) in starts:
                yield number, is_turned


def _along_lines(
    lanes: Sequence[ClosedLane], lines_map: Sequence[FloatArray], turned: dict[int, bool]
) -> Iterator[tuple[int, bool]]:
    oriented: list[ClosedLane] = []
    numbers: list[tuple[int, bool | None]] = []
    for number, lane in enumerate(lanes):
        if number in turned:
            oriented.append(lane.turned if turned[number] else lane)
            numbers.append((number, None))
        else:
            oriented += [lane, lane.turned]
            numbers += [(number, False), (number, True)]
    for connection in connections(oriented, lines_map):
        pair = (numbers[connection.before], numbers[connection.after])
        for (_, is_turned), (other, other_turned) in (pair, pair[::-1]):
            if is_turned is None and other_turned is not None:
                yield other, other_turned
