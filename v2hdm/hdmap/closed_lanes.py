"""Where two lane lines run beside each other and bound a lane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from v2hdm.records import FloatArray, IntArray

LANE_WIDTH_M = (2.55, 5.1)
"""Lines that are closer have no room for a truck, 2.55 m wide (Directive 96/53/EC, annex I, 1.1), and those
farther apart have room for two."""


@dataclass(frozen=True)
class ClosedLane:
    """A stretch of a lane between two lines, in the direction of the first line that bounds it.

    ``left`` and ``right`` are a line's number, and its vertices in the order of that direction.
    """

    left: tuple[int, IntArray]
    right: tuple[int, IntArray]


def closed_lanes(lines_map: Sequence[FloatArray]) -> list[ClosedLane]:
    """The lanes between polylines (N, 2) m: stretches longer than wide, in the order of their first line.

    A lane lies between a line and the nearest one that is met across it, at a lane's width.
    """
    found = []
    for number, line in enumerate(lines_map):
        if len(line) < 2:
            continue
        for side in (1, -1):
            other, nearest, gap_m = _across(lines_map, number, side)
            for begin, end in _stretches(other, gap_m):
                if other[begin] < number:  # found from there
                    continue
                across = lines_map[other[begin]]
                own = np.arange(begin, end + 1)
                first, last = nearest[begin], nearest[end]
                its = np.arange(first, last + 1) if first <= last else np.arange(first, last - 1, -1)
                shortest_m = min(_length(line[own]), _length(across[its]))
                if shortest_m > gap_m[begin : end + 1].max():
                    bounds = ((number, own), (int(other[begin]), its))
                    left, right = bounds if side < 0 else bounds[::-1]
                    found.append(ClosedLane(left, right))
    return found


def _across(lines_map: Sequence[FloatArray], number: int, side: int) -> tuple[IntArray, IntArray, FloatArray]:
    """Of each vertex of a line (N,): the line met first on its left (1) or right (-1), -1 where none is.

    And the vertex of that line nearest to where it is met, and how far away that is, m.
    """
    line = lines_map[number]
    tangent = np.gradient(line, axis=0)
    normal = side * np.column_stack([-tangent[:, 1], tangent[:, 0]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    other = np.full(len(line), -1)
    nearest = np.zeros(len(line), dtype=np.int64)
    gap_m = np.full(len(line), LANE_WIDTH_M[1])
    for candidate, points in enumerate(lines_map):
        if candidate == number or len(points) < 2:
            continue
        for k, (place, away) in enumerate(zip(line, normal, strict=True)):
            offset = points - place
            ahead, beside = offset @ away, offset[:, 0] * away[1] - offset[:, 1] * away[0]
            crosses = np.flatnonzero((beside[:-1] * beside[1:] <= 0) & (beside[:-1] != beside[1:]))
            if not len(crosses):
                continue
            part = beside[crosses] / (beside[crosses] - beside[crosses + 1])
            met_m = ahead[crosses] + part * (ahead[crosses + 1] - ahead[crosses])
            met_m[met_m <= 0] = np.inf
            best = int(np.argmin(met_m))
            if met_m[best] < gap_m[k]:
                other[k], gap_m[k] = candidate, met_m[best]
                nearest[k] = crosses[best] + round(float(part[best]))
    return other, nearest, gap_m


def _stretches(other: IntArray, gap_m: FloatArray) -> list[tuple[int, int]]:
    """First and last vertex of each run that meets the same line at a lane's width."""
    meets = np.where(gap_m > LANE_WIDTH_M[0], other, -1)
    runs = [(key, list(group)) for key, group in groupby(range(len(meets)), key=lambda k: int(meets[k]))]
    return [(run[0], run[-1]) for key, run in runs if key >= 0 and len(run) > 1]


def _length(points: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
