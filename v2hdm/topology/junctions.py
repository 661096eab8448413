"""Junctions: which lanes lie where others split, merge, turn or cross, and how they turn there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, groupby

import numpy as np

from v2hdm.geometry.planar import cross, length_along
from v2hdm.records import FloatArray
from v2hdm.topology.graph import Junction, LaneOfGraph, Link, Turn

TURN_RAD = np.deg2rad(30.0)  # least angle between the directions of a turning lane's ends; chosen
_BACK_RAD = np.deg2rad(150.0)  # angle from which on a turn leads back; chosen


@dataclass(frozen=True)
class Junctions:
    """The lanes with what lies in a junction marked so, and the junctions."""

    lanes: list[LaneOfGraph]
    junctions: list[Junction]


def joined(lanes: Sequence[LaneOfGraph], links: Sequence[Link]) -> Junctions:
    """Gather the lanes that lie between others into junctions.

    A lane lies in a junction if it was made to connect two, or if a lane before it leads elsewhere as well,
    or the lane after it comes from elsewhere, too.
    """
    starts = _grouped(links, 0)
    ends = _grouped(links, 1)
    connecting = {number for number, lane in enumerate(lanes) if lane.is_connecting}
    for before, after in links:
        if {before, after} & connecting:
            continue
        if len(starts[before]) > 1:
            connecting.add(after)
        elif len(ends[after]) > 1:
            connecting.add(before)
    groups = _Groups(sorted(connecting))
    for lists in (starts, ends):
        for numbers in lists.values():
            together = [number for number in numbers if number in connecting]
            for second in together[1:]:
                groups.join(together[0], second)
    for before, after in links:
        if before in connecting and after in connecting:
            groups.join(before, after)
    crossing = set()
    centres = {number: lanes[number].centre_map for number in connecting}
    for first, second in combinations(sorted(connecting), 2):
        if cross_each_other(centres[first], centres[second]):
            groups.join(first, second)
            crossing |= {first, second}
    angle_rad = {number: turn_rad(centre) for number, centre in centres.items()}
    result = Junctions([*lanes], [])
    for members in groups.groups():
        turns = [abs(angle_rad[number]) > TURN_RAD for number in members]
        is_crossing = any(turns) or bool(crossing & set(members))
        result.junctions.append(Junction(tuple(members), is_crossing))
        for number in members:
            turn = _turn(angle_rad[number]) if is_crossing else None
            result.lanes[number] = replace(lanes[number], is_connecting=True, turn=turn)
    return result


def _grouped(links: Sequence[Link], key: int) -> dict[int, list[int]]:
    """For each lane those that it leads to (key 0), or that lead to it (key 1)."""
    by_key = sorted(links, key=lambda link: link[key])
    return {
        lane: [link[1 - key] for link in group] for lane, group in groupby(by_key, lambda link: link[key])
    }


class _Groups:
    """Numbers in groups that can be joined."""

    def __init__(self, numbers: Sequence[int]) -> None:
        self._group = {number: number for number in numbers}

    def join(self, first: int, second: int) -> None:
        lower, higher = sorted((self._group[first], self._group[second]))
        self._group = {number: lower if group == higher else group for number, group in self._group.items()}

    def groups(self) -> Iterator[list[int]]:
        for group in sorted(set(self._group.values())):
            yield [number for number, other in self._group.items() if other == group]


def turn_rad(centre: FloatArray) -> float:
    """The angle, rad, that a lane turns to the left from start to end; beyond pi for loops."""
    steps = np.diff(centre, axis=0)
    steps = steps[np.linalg.norm(steps, axis=1) > 1e-6]
    turns = np.arctan2(cross(steps[:-1], steps[1:]), (steps[:-1] * steps[1:]).sum(axis=1))
    return float(turns.sum())


def _turn(angle_rad: float) -> Turn:
    if abs(angle_rad) <= TURN_RAD:
        return Turn.STRAIGHT
    return Turn.LEFT if angle_rad > 0 else Turn.RIGHT


def leads_back(start: FloatArray, end: FloatArray) -> bool:
    """Whether a way from one unit direction (2,) to another leads back to where it came from."""
    return bool(start @ end < np.cos(_BACK_RAD))


def cross_each_other(first: FloatArray, second: FloatArray) -> bool:
    """Whether two polylines (N, 2) and (M, 2) cross away from their ends."""
    if (first.max(axis=0) < second.min(axis=0)).any() or (second.max(axis=0) < first.min(axis=0)).any():
        return False
    return len(crossings(first, second)) > 0


def crossings(line: FloatArray, other_line: FloatArray) -> FloatArray:
    """The ways (K,) along a polyline (N, 2), m, at which it crosses another (M, 2)."""
    step = np.diff(line, axis=0)[:, None]
    other_step = np.diff(other_line, axis=0)[None]
    between = other_line[None, :-1] - line[:-1, None]
    area = cross(step, other_step)
    is_parallel = np.abs(area) < 1e-12
    divisor = np.where(is_parallel, 1.0, area)
    part = cross(between, other_step) / divisor
    other_part = cross(between, step) / divisor
    meets = ~is_parallel & (part > 0) & (part <= 1) & (other_part > 0) & (other_part <= 1)
    at_m = length_along(line)
    places: FloatArray = (at_m[:-1, None] + part * np.diff(at_m)[:, None])[meets]
    return places
