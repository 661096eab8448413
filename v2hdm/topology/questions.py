"""Questions of a lane graph at its crossings: turns that no drive took, speeds, the right of way."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from v2hdm.geometry.planar import cross
from v2hdm.records import FloatArray
from v2hdm.topology.graph import Direction, Junction, LaneGraph, Question
from v2hdm.topology.junctions import TURN_RAD, leads_back
from v2hdm.topology.rights import rights_asked

_NEAR_M = 10.0  # distance from the lanes of a crossing within which a lane that ends belongs to it; chosen


def questions_of(graph: LaneGraph, has_drives: bool) -> list[Question]:
    """The open questions of a graph, whose crossings are known only if drives are."""
    questions = []
    for junction in graph.junctions:
        if junction.is_crossing and has_drives:
            questions += [*_turns(graph, junction), *rights_asked(graph, junction)]
    if graph.lanes and all(lane.speed_kmh is None for lane in graph.lanes):
        place = graph.lanes[0].centre_map[0]
        questions.append(Question("speed", "no speed limit is stated; how fast may one drive?", place))
    return questions


def _turns(graph: LaneGraph, junction: Junction) -> Iterator[Question]:
    """The ways through a crossing, from lane to lane, that no drive took."""
    places = np.concatenate([graph.lanes[number].centre_map for number in junction.lanes])
    arms_in = []
    arms_out = []
    for number, lane in enumerate(graph.lanes):
        if lane.is_connecting or lane.direction is Direction.ASKED:
            continue
        centre = lane.centre_map
        if _is_near(centre[-1], places) and all(after in junction.lanes for after in graph.after(number)):
            arms_in.append(number)
        if _is_near(centre[0], places) and all(before in junction.lanes for before in graph.before(number)):
            arms_out.append(number)
    led = {
        (before, after)
        for number in junction.lanes
        for before in graph.before(number)
        for after in _exits(graph, number)
    }
    for before in arms_in:
        for after in arms_out:
            end = _direction(graph.lanes[before].centre_map, -1)
            start = _direction(graph.lanes[after].centre_map, 0)
            if before == after or (before, after) in led or leads_back(end, start):
                continue
            text = f"no drive {_manoeuvre(end, start)} here; is it allowed?"
            ends = (graph.lanes[before].centre_map[-1], graph.lanes[after].centre_map[0])
            yield Question("connection", text, ends[0], (before, after), ends[1])


def _manoeuvre(end: FloatArray, start: FloatArray) -> str:
    """The manoeuvre of a drive between two unit directions (2,)."""
    angle_rad = float(np.arctan2(cross(end, start), end @ start))
    if abs(angle_rad) <= TURN_RAD:
        return "went straight on"
    return "turned left" if angle_rad > 0 else "turned right"


def _exits(graph: LaneGraph, number: int) -> list[int]:
    """The lanes outside the junction that a lane of it leads to."""
    exits = []
    for after in graph.after(number):
        exits += _exits(graph, after) if graph.lanes[after].is_connecting else [after]
    return exits


def _is_near(place: FloatArray, places: FloatArray) -> bool:
    return bool(np.linalg.norm(places - place, axis=1).min() < _NEAR_M)


def _direction(centre: FloatArray, end: int) -> FloatArray:
    """The unit direction (2,) of a middle at its first (0) or last (-1) point."""
    step = centre[1] - centre[0] if end == 0 else centre[-1] - centre[-2]
    return np.asarray(step / max(float(np.linalg.norm(step)), 1e-12))
