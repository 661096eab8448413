"""A route in steps of a metre, and lines and planes fitted there under a Gaussian along the path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.records import FloatArray

STATION_M = 1.0
"""Poses nearer together than this are one station: a vehicle that stands drives no path in its noise."""

_WINDOW_SIGMAS = 3.0
"""A Gaussian is cut off here; 0.3 % of it lies beyond."""

_END_RIDGE = 0.2
"""Keeps lines through few or near stations from being steep, as a share of the Gaussian's width."""


@dataclass(frozen=True)
class Stations:
    """Places along a route, each the mean of the successive poses within a metre.

    Attributes:
        first: (N + 1,) index of each station's first pose, and the number of poses at the end.
        points_map: (N, 2) m.
        path_m: (N,) way driven to each.
    """

    first: np.ndarray
    points_map: FloatArray
    path_m: FloatArray

    def mean(self, values: FloatArray) -> FloatArray:
        """Means (N, ...) over the poses of each station of their ``values`` (P, ...)."""
        return _means(values, self.first)

    def at_poses(self, values: FloatArray) -> FloatArray:
        """Values (P, C) at the poses, between those (N, C) of the stations."""
        centre = 0.5 * (self.first[:-1] + self.first[1:] - 1)
        poses = np.arange(self.first[-1])
        return np.column_stack([np.interp(poses, centre, column) for column in values.T])

    def around(self, k: int, width_m: float) -> tuple[slice, FloatArray]:
        """The stations within reach of a Gaussian around station ``k``, and their weights."""
        reach = _WINDOW_SIGMAS * width_m
        low, high = np.searchsorted(self.path_m, [self.path_m[k] - reach, self.path_m[k] + reach])
        near = slice(int(low), max(int(high), k + 1))
        weight = np.exp(-0.5 * ((self.path_m[near] - self.path_m[k]) / width_m) ** 2)
        return near, weight


def along_route(points_map: FloatArray) -> Stations:
    """The stations of poses at ``points_map`` (P, 2)."""
    first = [0]
    x0, y0 = points_map[0].tolist()
    for p, (x, y) in enumerate(points_map.tolist()):
        if (x - x0) ** 2 + (y - y0) ** 2 >= STATION_M**2:
            first.append(p)
            x0, y0 = x, y
    starts = np.array([*first, len(points_map)])
    centres = _means(points_map, starts)
    steps_m = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    return Stations(starts, centres, np.concatenate([[0.0], np.cumsum(steps_m)]))


def local_lines(stations: Stations, values: FloatArray, width_m: float) -> FloatArray:
    """``values`` (N, C) smoothed by the line fitted around each station."""
    smooth = np.empty_like(values)
    for k, here in enumerate(stations.path_m):
        near, weight = stations.around(k, width_m)
        weight = weight / weight.sum()
        offset = stations.path_m[near] - here
        centred = offset - weight @ offset
        spread = weight @ centred**2 + (_END_RIDGE * width_m) ** 2
        mean = weight @ values[near]
        smooth[k] = mean - (weight @ offset) * ((weight * centred) @ values[near]) / spread
    return smooth


def local_planes(
    stations: Stations, height: FloatArray, slope: FloatArray, width_m: float, trust_m2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The plane around each station that fits heights and slopes there.

    Args:
        stations: the N places.
        height: (N, C) m, C sets of them.
        slope: (N, 2, C) what is known of the planes' slope apart from the heights.
        width_m: standard deviation of the Gaussian.
        trust_m2: (N,) mean squared leverage, m^2, at which heights say as much as these slopes.

    Returns:
        Heights (N, C) and slopes (N, 2, C) of the planes at the stations.
    """
    fitted, inclined = np.empty_like(height), np.empty_like(slope)
    for k in range(len(height)):
        near, weight = stations.around(k, width_m)
        weight = weight / weight.sum()
        offset = stations.points_map[near] - stations.points_map[k]
        mean = weight @ offset
        lever = (offset - mean) * weight[:, None]
        normal = lever.T @ offset + trust_m2[k] * np.eye(2)
        known = np.tensordot(weight, slope[near], axes=1)
        inclined[k] = np.linalg.solve(normal, lever.T @ height[near] + trust_m2[k] * known)
        fitted[k] = weight @ height[near] - mean @ inclined[k]
    return fitted, inclined


def _means(values: FloatArray, first: np.ndarray) -> FloatArray:
    count = np.diff(first).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(np.add.reduceat(values, first[:-1], axis=0) / count)
