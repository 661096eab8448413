"""Where along a route the ground is no plane as far as a camera reaches: crests, dips, banked ramps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.records import FloatArray, Road

_HALF_WIDTH_M = 3.5
"""How far to either side of the path the ground counts, m: a lane's width."""


@dataclass(frozen=True)
class Unevenness:
    """The ground's worst deviation from the plane beneath the vehicle.

    Attributes:
        value_m: height of the ground above or below that plane.
        distance_m: from the vehicle to where it is so. A vehicle that rolls and pitches by ``sigma`` rad has
            ``sigma * distance_m`` there, too.
        at_map: (2,) m, where the vehicle is then.
        station_m: its way along the route.
    """

    value_m: float
    distance_m: float
    at_map: FloatArray
    station_m: float


def unevenness(road: Road, reach_m: float) -> Unevenness:
    """Where the ground between half of ``reach_m`` and all of it is worst, by deviation over distance.

    The ground is known along the path by its heights, beside it by its slope; it counts to 3.5 m on either
    side, so a road whose cross-fall changes deviates, too.
    """
    steps_m = np.linalg.norm(np.diff(road.points_map, axis=0), axis=1)
    station_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    left = _left(road.points_map)
    worst = Unevenness(0.0, reach_m, road.points_map[0], 0.0)
    for k, here_m in enumerate(station_m):
        low, high = np.searchsorted(station_m, [here_m - reach_m, here_m + reach_m])
        near = slice(int(low), int(high))
        offset = road.points_map[near] - road.points_map[k]
        distance_m = np.linalg.norm(offset, axis=1)
        far = distance_m >= 0.5 * reach_m
        if not far.any():
            continue
        change = road.slope[near] - road.slope[k]
        along_m = road.height_m[near] - road.height_m[k] - offset @ road.slope[k]
        across_m = _HALF_WIDTH_M * np.einsum("ni,ni->n", change, left[near])
        deviation_m = np.where(far, np.abs(along_m) + np.abs(across_m), 0.0)
        j = int(np.argmax(deviation_m / np.maximum(distance_m, 0.5 * reach_m)))
        if deviation_m[j] * worst.distance_m > worst.value_m * distance_m[j]:
            worst = Unevenness(float(deviation_m[j]), float(distance_m[j]), road.points_map[k], float(here_m))
    return worst


def _left(points_map: FloatArray) -> FloatArray:
    """Unit vectors (P, 2) to the left of the path, zero where it is a point."""
    if len(points_map) < 2:
        return np.zeros_like(points_map)
    ahead = np.gradient(points_map, axis=0)
    length = np.linalg.norm(ahead, axis=1, keepdims=True)
    return np.asarray(np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.maximum(length, 1e-9))
