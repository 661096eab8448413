"""The right of way at crossings: which lanes give way, by paint or as a person states, and what is asked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.planar import length_along, points_along
from v2hdm.records import FloatArray
from v2hdm.topology.answers import NEAR_M, Answer
from v2hdm.topology.graph import RIGHT_OF_WAY, Junction, LaneGraph, Question, Right, StatedRight
from v2hdm.topology.junctions import cross_each_other

YIELDS, GOES_FIRST = "yes", "no"  # answers to whether one gives way

_BACK_M = 2.0  # way, m, before the end of a lane at which it is asked, beside questions at the end; chosen


def ways_crossed(
    graph: LaneGraph, centres: Sequence[FloatArray], ways: Iterable[int], others: Iterable[int]
) -> tuple[int, ...]:
    """The lanes among ``others``, of a junction, that cross one of ``ways`` or lead to the same lane."""
    yielding = list(ways)
    return tuple(
        other
        for other in others
        if any(
            cross_each_other(centres[other], centres[way]) or set(graph.after(other)) & set(graph.after(way))
            for way in yielding
        )
    )


def rights_asked(graph: LaneGraph, junction: Junction) -> Iterator[Question]:
    """Whether one gives way, for each lane into a crossing whose ways others cross.

    Nothing is asked where a give-way line is painted: it says who waits, and the others go first.
    """
    arms = _arms(graph, junction)
    if _painted(graph) & set(arms):
        return
    centres = [lane.centre_map for lane in graph.lanes]
    stops = {lane for stop in graph.stop_lines for lane in stop.lanes}
    for arm in arms:
        others = {way for other in arms if other != arm for way in _ways(graph, junction, other)}
        if ways_crossed(graph, centres, _ways(graph, junction, arm), sorted(others)):
            line = "a line says that one stops here" if arm in stops else "no line says who goes first"
            yield Question(
                RIGHT_OF_WAY, f"{line}; does one give way to the others?", _place(graph, arm), (arm,)
            )


def stated_rights(graph: LaneGraph, answers: Sequence[Answer]) -> tuple[StatedRight, ...]:
    """The lanes that are stated to give way, to the ways of those that are stated not to.

    Raises MapFileError where an answer is neither yes nor no, lies at the end of no lane into a crossing, or
    contradicts a give-way line.
    """
    junction_of_arm = {
        arm: junction
        for junction in graph.junctions
        if junction.is_crossing
        for arm in _arms(graph, junction)
    }
    yields = {}
    for answer in answers:
        if answer.subject == RIGHT_OF_WAY:
            arm = _arm_at(graph, list(junction_of_arm), answer)
            yields[arm] = _yields(answer)
            if not yields[arm] and arm in _painted(graph):
                x, y = answer.place_map.tolist()
                problem = f"{answer.where}: a give-way line is painted at ({x:.1f}, {y:.1f})"
                raise MapFileError(f"{problem}; delete the line if it is gone, or drop the answer")
    centres = [lane.centre_map for lane in graph.lanes]
    rights = []
    for arm in sorted(arm for arm, gives_way in yields.items() if gives_way):
        junction = junction_of_arm[arm]
        first = {
            way
            for other in _arms(graph, junction)
            if yields.get(other) is False
            for way in _ways(graph, junction, other)
        }
        crossed = ways_crossed(graph, centres, _ways(graph, junction, arm), sorted(first))
        if crossed:
            rights.append(StatedRight(arm, crossed))
    return tuple(rights)


def _painted(graph: LaneGraph) -> set[int]:
    """The lanes that a give-way line ends."""
    return {lane for stop in graph.stop_lines if stop.right is Right.GIVE_WAY for lane in stop.lanes}


def _arms(graph: LaneGraph, junction: Junction) -> list[int]:
    """The lanes that lead into a junction."""
    return sorted(
        {before for number in junction.lanes for before in graph.before(number)} - set(junction.lanes)
    )


def _ways(graph: LaneGraph, junction: Junction, arm: int) -> set[int]:
    """The lanes of a junction that one of its arms leads to."""
    ways: set[int] = set()
    pending = [arm]
    while pending:
        onward = {after for after in graph.after(pending.pop()) if after in junction.lanes} - ways
        ways |= onward
        pending += sorted(onward)
    return ways


def _place(graph: LaneGraph, arm: int) -> FloatArray:
    """The place (2,), m, on a lane just before its end."""
    centre = graph.lanes[arm].centre_map
    length_m = float(length_along(centre)[-1])
    return np.asarray(points_along(centre, np.array([max(length_m - _BACK_M, length_m / 2)]))[0])


def _arm_at(graph: LaneGraph, arms: Sequence[int], answer: Answer) -> int:
    places = np.array([_place(graph, arm) for arm in arms]).reshape(-1, 2)
    apart_m = np.linalg.norm(places - answer.place_map, axis=1)
    if not len(apart_m) or apart_m.min() > NEAR_M:
        x, y = answer.place_map.tolist()
        problem = f"{answer.where}: no lane leads into a crossing at ({x:.1f}, {y:.1f})"
        raise MapFileError(f"{problem}; put the point on the end of a lane")
    return arms[int(np.argmin(apart_m))]


def _yields(answer: Answer) -> bool:
    if answer.answer not in (YIELDS, GOES_FIRST):
        problem = f"{answer.where}: {answer.answer!r} does not say whether one gives way here"
        raise MapFileError(f"{problem}; give {YIELDS} or {GOES_FIRST}")
    return answer.answer == YIELDS
