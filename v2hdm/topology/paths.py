"""The paths of drives: smooth, evenly spaced, and forwards alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.geometry.planar import length_along, points_along
from v2hdm.records import FloatArray, Trajectory

STEP_M = 0.5  # spacing of a path's points, m; chosen
_SMOOTH_M = 1.5
"""Standard deviation, m, of the Gaussian that smooths a path: noise of 2 cm turns its direction by less than
a degree, and a turn of 8 m radius is cut by 14 cm."""

_STILL_M = 0.05  # way, m, below which a vehicle stands: more than the noise of RTK
_LONGEST_GAP_M = 10.0  # longest way, m, between two poses of one path: a second at 36 km/h; chosen
_SHORTEST_M = 5.0  # shortest path, m: a shorter one says nothing of lanes; chosen


@dataclass(frozen=True)
class Path:
    """A stretch that a vehicle drove forwards."""

    drive: int
    points_map: FloatArray  # (N, 2) m, :data:`STEP_M` apart
    ahead: FloatArray  # (N, 2) unit directions


def paths_of(trajectories: Sequence[Trajectory]) -> list[Path]:
    """The forward stretches of drives: where one reverses or its poses are interrupted, a path ends."""
    paths = []
    for drive, trajectory in enumerate(trajectories):
        for points in _stretches(trajectory.map_from_vehicle):
            if length_along(points)[-1] >= _SHORTEST_M:
                paths.append(_smooth(drive, points))
    return paths


def _stretches(map_from_vehicle: FloatArray) -> Iterator[FloatArray]:
    """Positions (N, 2), m, of each stretch driven forwards, without those where the vehicle stands."""
    positions = map_from_vehicle[:, :2, 3]
    ahead = map_from_vehicle[:, :2, 0]
    stretch: list[int] = [0] if len(positions) else []
    for k in range(1, len(positions)):
        step = positions[k] - positions[stretch[-1]]
        length_m = float(np.linalg.norm(step))
        if length_m < _STILL_M:
            continue
        is_forward = step @ (ahead[k] + ahead[stretch[-1]]) > 0
        if length_m > _LONGEST_GAP_M or not is_forward:
            if len(stretch) > 1:
                yield positions[stretch]
            stretch = []
        stretch.append(k)
    if len(stretch) > 1:
        yield positions[stretch]


def _smooth(drive: int, points: FloatArray) -> Path:
    length_m = length_along(points)[-1]
    even = points_along(points, np.linspace(0.0, length_m, max(round(length_m / STEP_M), 2) + 1))
    return Path(drive, *smoothed(even))


def smoothed(even: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Evenly spaced points (N, 2) smoothed, their ends kept, and the unit directions (N, 2) there."""
    reach = min(int(np.ceil(3 * _SMOOTH_M / STEP_M)), len(even) - 1)
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) * STEP_M / _SMOOTH_M) ** 2)
    before = 2 * even[0] - even[reach:0:-1]
    behind = 2 * even[-1] - even[-2 : -reach - 2 : -1]
    longer = np.concatenate([before, even, behind])
    points = np.column_stack([np.convolve(axis, weight / weight.sum(), mode="valid") for axis in longer.T])
    ahead = np.gradient(points, axis=0)
    return points, ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
