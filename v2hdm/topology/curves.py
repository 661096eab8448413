"""The sides of a way that no paint shows: beside a drive's path, from a lane's end to another's start."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import cross, length_along, turned_left
from v2hdm.records import FloatArray
from v2hdm.topology.paths import STEP_M, smoothed

_STEEPEST = 0.5  # largest slope, to the path, with which a side begins or ends; chosen
_NEAR_END = 0.75  # share of a curve from which on its points lie before its end; chosen
_LEAST_PROGRESS = 0.2  # least share of a path's step that a side goes on by; chosen


class End(NamedTuple):
    """An end of a side: its place (2,), m, and the unit direction (2,) in which the side passes it."""

    place: FloatArray
    ahead: FloatArray


def side_along(path_map: FloatArray, start: End, end: End) -> FloatArray:
    """A curve (N, 2), m, beside an evenly spaced path (M, 2), in the direction of its ends at both of them.

    Its distance from the path is a cubic of the way. Inside a turn tighter than this distance, where the
    curve would run backwards, it is cut short.
    """
    if len(path_map) < 3:
        return np.stack([start.place, end.place])
    points, ahead = smoothed(path_map)
    left = turned_left(ahead)
    way_m = length_along(points)
    share = way_m / way_m[-1]
    offsets = [start.place - points[0], end.place - points[-1]]
    across = [float(offset @ left[k]) for offset, k in zip(offsets, (0, -1), strict=True)]
    along = [float(offset @ ahead[k]) for offset, k in zip(offsets, (0, -1), strict=True)]
    slopes = [_slope(ahead[k], side.ahead) * way_m[-1] for side, k in ((start, 0), (end, -1))]
    across_m = _cubic(share, across, slopes)
    along_m = _cubic(share, along, [0.0, 0.0])
    curve = points + across_m[:, None] * left + along_m[:, None] * ahead
    curve[0] = start.place
    curve[-1] = end.place
    return _without_backward(curve, ahead)


def arc_between(start: End, end: End) -> FloatArray:
    """The cubic (N, 2), m, from one end to another in their directions: nearly an arc where one can be."""
    way = end.place - start.place
    chord_m = float(np.linalg.norm(way))
    half_cosine = float(np.sqrt(max((1 + float(start.ahead @ end.ahead)) / 2, 0.0)))
    speed_m = 2 * chord_m / (1 + half_cosine)
    share = np.linspace(0.0, 1.0, max(int(np.ceil(chord_m / STEP_M)), 2) + 1)[:, None]
    return np.asarray(
        start.place * (1 + 2 * share) * (1 - share) ** 2
        + end.place * share**2 * (3 - 2 * share)
        + speed_m * start.ahead * share * (1 - share) ** 2
        - speed_m * end.ahead * share**2 * (1 - share)
    )


def _slope(path: FloatArray, side: FloatArray) -> float:
    """The slope of a side to a path, both by their unit directions (2,)."""
    forward = max(float(path @ side), 1e-6)
    return float(np.clip(cross(path, side) / forward, -_STEEPEST, _STEEPEST))


def _cubic(share: FloatArray, values: list[float], slopes: list[float]) -> FloatArray:
    """The cubic (N,) with these values and slopes where ``share`` is 0 and 1."""
    return np.asarray(
        values[0] * (1 + 2 * share) * (1 - share) ** 2
        + values[1] * share**2 * (3 - 2 * share)
        + slopes[0] * share * (1 - share) ** 2
        - slopes[1] * share**2 * (1 - share)
    )


def _without_backward(curve: FloatArray, ahead: FloatArray) -> FloatArray:
    """The points of a curve (N, 2) that go on from the last one that was taken, and its ends."""
    step_m = float(np.linalg.norm(curve[-1] - curve[0])) / len(curve)
    vertices = [0]
    for k in range(1, len(curve) - 1):
        goes_on = (curve[k] - curve[vertices[-1]]) @ ahead[k] > _LEAST_PROGRESS * step_m
        is_near_end = k > _NEAR_END * len(curve)
        if goes_on and (not is_near_end or (curve[-1] - curve[k]) @ ahead[-1] > 0):
            vertices.append(k)
    return np.asarray(curve[[*vertices, len(curve) - 1]])
