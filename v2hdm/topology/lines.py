"""The lane lines that lanes can lie between."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import cross
from v2hdm.records import FloatArray, Lane
from v2hdm.topology.graph import Question

_AT_ONCE = 256  # pieces of a line that are compared with all of it at once; chosen


class UsableLines(NamedTuple):
    """Lines by their number in the map, (N, 3) m, empty for those that bound no lane; and questions."""

    xyz_map: list[FloatArray]
    questions: list[Question]


def usable_lines(lanes: Sequence[Lane]) -> UsableLines:
    """The lines of a map without those that cross themselves, whose sides are undefined."""
    lines = []
    questions = []
    for number, lane in enumerate(lanes):
        heights_m = np.zeros(len(lane.points_map)) if lane.heights_m is None else lane.heights_m
        xyz = np.column_stack([lane.points_map, heights_m])
        place = crosses_itself(lane.points_map)
        if place is not None:
            name = number + 1 if lane.id is None else lane.id
            questions.append(Question("line", f"lane line {name} crosses itself; how does it run?", place))
            xyz = np.empty((0, 3))
        lines.append(xyz)
    return UsableLines(lines, questions)


def crosses_itself(line: FloatArray) -> FloatArray | None:
    """The place (2,) where a polyline (N, 2) first crosses itself, None where it does not."""
    begin = line[:-1]
    end = line[1:]
    numbers = np.arange(len(begin))
    low = np.minimum(begin, end)
    high = np.maximum(begin, end)
    for first in range(0, len(begin), _AT_ONCE):
        piece = slice(first, first + _AT_ONCE)
        is_near = ((high >= low[piece].min(axis=0)) & (low <= high[piece].max(axis=0))).all(axis=1)
        others = numbers[is_near & (numbers < first + _AT_ONCE)]
        step = (end - begin)[piece, None]
        other_step = (end - begin)[others]
        between = begin[others] - begin[piece, None]
        area = cross(step, other_step)
        divisor = np.where(np.abs(area) < 1e-12, 1.0, area)
        part = cross(between, other_step) / divisor
        other_part = cross(between, step) / divisor
        is_apart = others < numbers[piece, None] - 1
        inside = (part > 0) & (part < 1) & (other_part > 0) & (other_part < 1)
        crosses = np.argwhere(is_apart & inside & (np.abs(area) >= 1e-12))
        if len(crosses):
            k, other = crosses[0]
            return np.asarray(begin[first + k] + part[k, other] * step[k, 0])
    return None


def tangents(line: FloatArray) -> FloatArray:
    """Unit directions (N, 2) of a polyline (N, 2) at its vertices."""
    if len(line) < 2:
        return np.tile([1.0, 0.0], (len(line), 1))
    ahead = np.gradient(line, axis=0)
    return np.asarray(ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12))
