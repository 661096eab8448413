"""The lanes that painted stop and give-way lines end, and whose way a give-way line's lanes cross."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from v2hdm.records import GIVE_WAY, STOP_LINE, FloatArray, Marking
from v2hdm.topology.graph import LaneGraph, Question, Right, StopLine
from v2hdm.topology.junctions import crossings
from v2hdm.topology.rights import ways_crossed

_AT_START_M = 3.0  # way, m, from a lane's start within which a stop line ends the lane before it; chosen
_BESIDE_M = 0.5  # way, m, that a stop line may lack to the middle of a lane; chosen
_ACROSS = 0.7  # least cosine of the angle between a lane and the normal of a stop line; chosen


class TiedLines(NamedTuple):
    """Stop lines with the lanes that they end, and questions."""

    stop_lines: list[StopLine]
    questions: list[Question]


def tied(graph: LaneGraph, markings: Sequence[Marking]) -> TiedLines:
    """The stop lines among a map's markings, and questions for those that end no lane."""
    stop_lines = []
    questions = []
    centres = [lane.centre_map for lane in graph.lanes]
    for number, marking in enumerate(markings):
        if marking.kind != STOP_LINE:
            continue
        ended = tuple(sorted(set(_ended(graph, centres, marking.corners_map))))
        if not ended and graph.lanes:
            text = "this stop line ends no lane; which one does it belong to?"
            questions.append(Question("stop line", text, marking.corners_map.mean(axis=0)))
        right = Right.GIVE_WAY if marking.variety == GIVE_WAY else Right.STOP
        stop_lines.append(StopLine(number, right, ended))
    held = {lane for stop in stop_lines for lane in stop.lanes}
    weighed = [
        stop if stop.right is Right.STOP else replace(stop, yields_to=_yields_to(graph, centres, stop, held))
        for stop in stop_lines
    ]
    return TiedLines(weighed, questions)


def _ended(graph: LaneGraph, centres: Sequence[FloatArray], corners_map: FloatArray) -> Iterator[int]:
    """The lanes that a line of these corners (4, 2) ends."""
    axis = _axis(corners_map)
    along = axis[1] - axis[0]
    normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    for number, centre in enumerate(centres):
        places_m = crossings(centre, axis)
        if not len(places_m):
            continue
        at_m = float(places_m[0])
        step = np.diff(centre, axis=0)
        segment = min(int(at_m / max(_length(centre), 1e-9) * len(step)), len(step) - 1)
        if abs(float(step[segment] @ normal)) < _ACROSS * float(np.linalg.norm(step[segment])):
            continue
        if graph.lanes[number].is_connecting or at_m < _AT_START_M:
            yield from (lane for lane in graph.before(number) if not graph.lanes[lane].is_connecting)
        else:
            yield number


def _length(line: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def _axis(corners_map: FloatArray) -> FloatArray:
    """The middle (2, 2), m, of a stripe along its longer sides, a little longer."""
    sides = np.linalg.norm(np.roll(corners_map, -1, axis=0) - corners_map, axis=1)
    start = int(sides[1] + sides[3] > sides[0] + sides[2])
    ends = np.stack(
        [
            (corners_map[start] + corners_map[(start + 3) % 4]) / 2,
            (corners_map[start + 1] + corners_map[(start + 2) % 4]) / 2,
        ]
    )
    more = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0]) * _BESIDE_M
    return np.stack([ends[0] - more, ends[1] + more])


def _yields_to(
    graph: LaneGraph, centres: Sequence[FloatArray], stop: StopLine, held: set[int]
) -> tuple[int, ...]:
    """The lanes of a junction that come from no painted line and whose way those behind this line cross."""
    onward = {after for lane in stop.lanes for after in graph.after(lane)}
    others = {number for junction in graph.junctions for number in junction.lanes} - onward
    free = [number for number in sorted(others) if not held & set(graph.before(number))]
    return ways_crossed(graph, centres, onward, free)
