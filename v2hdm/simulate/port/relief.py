"""The relief of a port: its parts as heights on a grid, and how a vehicle stands upon it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.errors import ConfigError
from v2hdm.io.drive.road import roll_pitch
from v2hdm.records import FloatArray
from v2hdm.simulate.port.config import ReliefConfig
from v2hdm.simulate.port.route import Route
from v2hdm.simulate.render.relief import Relief

_STEP_M, _BORDER_M = 0.25, 60.0
_REACH_M = 20.0  # beside the route; farther out the ground knows nothing of it
_CROWN_M, _BANK_M = 10.0, 8.0  # to either side: as far as the ground falls, or leans undiminished
_EASE_M = 12.0  # over which a ramp begins and ends
_GULLY_M, _KERB_M = 0.4, 0.3  # standard deviation of its section, and its width
_WHEELS_M = np.array([[2.8, 0.8], [2.8, -0.8], [0.0, 0.8], [0.0, -0.8]])
"""Ahead of the vehicle's origin, which is under the rear axle, and to its left: front wheels first."""


def build_relief(config: ReliefConfig, route: Route) -> Relief | None:
    """The heights around a route, None where they make a plane z = 0.

    Raises ConfigError when the ramp is not part of the route.
    """
    if not any((config.grade, config.crown, config.ramp, config.bank, config.gully_m, config.kerb_m)):
        return None
    if config.ramp_at_m + config.ramp_length_m > route.length_m:
        end_m = config.ramp_at_m + config.ramp_length_m
        problem = f"the ramp ends {end_m:g} m along a route of {route.length_m:.0f} m"
        raise ConfigError(f"simulate.relief: {problem}; set a lower ramp_at_m or ramp_length_m")
    low, high = route.points_map.min(axis=0) - _BORDER_M, route.points_map.max(axis=0) + _BORDER_M
    columns, rows = (np.arange(a, b, _STEP_M) for a, b in zip(low, high, strict=True))
    points = np.stack(np.meshgrid(columns, rows), axis=-1)
    heights = config.grade * points[..., 0] + _ramp(config, route, points)
    heights += _beside(config, route, points.reshape(-1, 2)).reshape(heights.shape)
    return Relief(knots=heights, origin_map=(float(low[0]), float(low[1])), step_m=_STEP_M)


def _on_ramp(config: ReliefConfig, station_m: FloatArray) -> FloatArray:
    """How much (...) of the ramp's slopes the ground has at stations: 0 to 1, eased at both ends."""
    way = np.minimum(station_m - config.ramp_at_m, config.ramp_at_m + config.ramp_length_m - station_m)
    share = np.clip(way / min(_EASE_M, config.ramp_length_m / 2), 0.0, 1.0)
    return np.asarray(share * share * (3 - 2 * share))


def _ramp(config: ReliefConfig, route: Route, points: FloatArray) -> FloatArray:
    """Heights (...) at points (..., 2): up in the route's direction at the ramp, and level behind it."""
    (x, y), yaw = route.pose_at(config.ramp_at_m)
    station = config.ramp_at_m + (points - (x, y)) @ (np.cos(yaw), np.sin(yaw))
    steps = config.ramp_at_m + np.linspace(0.0, config.ramp_length_m, 400)
    rise = np.cumsum(config.ramp * _on_ramp(config, steps)) * config.ramp_length_m / 400
    return np.interp(station, steps, rise)


def _beside(config: ReliefConfig, route: Route, points: FloatArray) -> FloatArray:
    """Heights (N,) at points (N, 2) by their distance from the route."""
    away, at = cKDTree(route.points_map).query(points, distance_upper_bound=_REACH_M)
    at, away = np.minimum(at, len(route.yaw_rad) - 1), np.minimum(away, _REACH_M)
    off, yaw = points - route.points_map[at], route.yaw_rad[at]
    left = np.copysign(away, off[:, 1] * np.cos(yaw) - off[:, 0] * np.sin(yaw))
    heights = -config.crown * np.minimum(away, _CROWN_M)
    heights -= config.gully_m * np.exp(-0.5 * ((away - config.gully_offset_m) / _GULLY_M) ** 2)
    fading = np.clip((_REACH_M - away) / (_REACH_M - _BANK_M), 0.0, 1.0)
    heights += config.bank * _on_ramp(config, route.station_m[at]) * left * fading
    heights += config.kerb_m * np.clip((left - config.kerb_offset_m) / _KERB_M + 0.5, 0.0, 1.0)
    return np.asarray(heights)


def stands(relief: Relief | None, points_map: FloatArray, yaw_rad: FloatArray) -> FloatArray:
    """Height, roll and pitch (N, 3) of a vehicle whose wheels are on the ground, at points (N, 2)."""
    if relief is None:
        return np.zeros((len(points_map), 3))
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.stack([np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)], axis=1)
    wheels = relief.height_m(points_map[:, None] + _WHEELS_M @ turn)
    middle = _WHEELS_M.mean(axis=0)
    slope = wheels @ (_WHEELS_M - middle) / ((_WHEELS_M - middle) ** 2).sum(axis=0)
    return np.column_stack([wheels.mean(axis=1) - slope @ middle, roll_pitch(slope)])
