"""The way the vehicle takes: a smooth path, points beside it, and the time at which it is where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.records import FloatArray
from v2hdm.simulate.port.config import RouteConfig

_STEP_M = 0.05
_TRANSITION_M = 4.0
_SPEED_SWING = 0.12
_SPEED_PERIOD_S = 23.0


@dataclass(frozen=True)
class Route:
    """A path by its length: ``station_m``, ``yaw_rad``, ``curvature`` (1/m), (N,); ``points_map`` (N, 2)."""

    station_m: FloatArray
    points_map: FloatArray
    yaw_rad: FloatArray
    curvature: FloatArray
    speed_mps: float

    @property
    def length_m(self) -> float:
        """Length of the path."""
        return float(self.station_m[-1])

    def yaw_at(self, station_m: FloatArray) -> FloatArray:
        """Heading (K,) at stations (K,)."""
        return np.interp(station_m, self.station_m, self.yaw_rad)

    def points_at(self, station_m: FloatArray, offset_m: FloatArray | float = 0.0) -> FloatArray:
        """Points (K, 2) at stations (K,), ``offset_m`` to the left of the path."""
        yaw = self.yaw_at(station_m)
        x, y = (np.interp(station_m, self.station_m, self.points_map[:, axis]) for axis in (0, 1))
        return np.column_stack([x - offset_m * np.sin(yaw), y + offset_m * np.cos(yaw)])

    def is_straight(self, station_m: FloatArray) -> FloatArray:
        """Whether (K,) the path is straight at stations (K,)."""
        return np.asarray(np.abs(np.interp(station_m, self.station_m, self.curvature)) < 1e-4)

    def station_at(self, stamp_s: FloatArray) -> FloatArray:
        """Stations (K,) reached at times (K,): the speed swings slowly by an eighth about its mean."""
        swing = _SPEED_PERIOD_S / (2 * np.pi)
        return np.asarray(self.speed_mps * (stamp_s + _SPEED_SWING * swing * (1 - np.cos(stamp_s / swing))))

    def speed_at(self, stamp_s: FloatArray) -> FloatArray:
        """Speed (K,) in m/s at times (K,)."""
        return np.asarray(self.speed_mps * (1 + _SPEED_SWING * np.sin(stamp_s * 2 * np.pi / _SPEED_PERIOD_S)))

    def distance_to(self, points_map: FloatArray) -> FloatArray:
        """Distance (K,) of points (K, 2) from the path."""
        path = self.points_map[:: int(0.5 / _STEP_M)]
        return np.asarray(np.linalg.norm(points_map[:, None] - path[None], axis=2).min(axis=1))


def build_route(config: RouteConfig) -> Route:
    """Integrate the pieces of a route from the map's origin, heading along x.

    Curvature ramps over 4 m between pieces, as a steered vehicle's does.
    """
    curvature = np.concatenate(
        [
            np.full(max(round(length / _STEP_M), 1), np.deg2rad(turn) / length)
            for length, turn in config.pieces
        ]
    )
    window = int(_TRANSITION_M / _STEP_M)
    padded = np.pad(curvature, (window // 2, window - 1 - window // 2), mode="edge")
    curvature = np.convolve(padded, np.full(window, 1.0 / window), mode="valid")
    yaw = np.concatenate([[0.0], np.cumsum(curvature * _STEP_M)])
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    steps = _STEP_M * np.column_stack([np.cos(middle), np.sin(middle)])
    points = np.vstack([[0.0, 0.0], np.cumsum(steps, axis=0)])
    return Route(
        station_m=np.linspace(0.0, len(curvature) * _STEP_M, len(yaw)),
        points_map=points,
        yaw_rad=yaw,
        curvature=np.append(curvature, curvature[-1]),
        speed_mps=config.speed_mps,
    )
