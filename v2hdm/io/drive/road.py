"""The road under a drive, and the drive's poses with that road laid flat into z = 0, the mapper's ground.

Slopes and height do not concern the markings' plan, but the vehicle's attitude relative to the road does: one
degree of pitch moves a ground point at 15 m by 2.4 m for a camera 1.65 m up. The recorded up-axis, smoothed
over a few metres, gives the road's slope. Integrated along the path it must give the heights; where it does
not, the sensor is not level or the vehicle squats, and the difference, smoothed over a longer way so that
short ramps are not blurred, is the vehicle's.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import length_along, turned_left
from v2hdm.geometry.rigid import heading_rad, rotation_from_euler
from v2hdm.records import BoolArray, FloatArray, Road, Trajectory

_log = logging.getLogger(__name__)

_ROAD_M = 5.0
"""Standard deviation of the Gaussian along the path, m, under which the recorded up-axis is the road's:
shorter waves are the suspension's, which at 1.5 Hz are 3 to 10 m long at 5 to 15 m/s."""

_HEIGHTS_M = 10.0
"""Standard deviation of the Gaussian along the path, m, under which heights are compared with the up-axis:
short enough for a vehicle's squat at a start or stop, long enough for heights of 2 cm to show 1 mrad."""

_SWAY_RAD = 0.003  # slow sway of a vehicle by acceleration and in bends: 0.17 deg, as on KITTI drives
_SWAY_M = 10.0  # way over which that sway is of one piece: a few seconds
HEIGHT_SIGMAS = 1.5  # sigma of a GNSS height by that of a position: no satellite is below the antenna
_HEIGHT_M = 5.0  # way over which an error of the height is of one piece
_CROSS_FALL = 0.02  # slope of a road that drains, expected where only heights along a line are known

_MOUNT_RAD = (0.1, 0.02)
"""How far off level on its vehicle a sensor may be, in pitch and roll. Heights show the pitch whatever is
expected; only turns separate roll from the road's cross-fall, which is no more than 1 deg."""

_REPORTED_RAD = float(np.radians(0.3))  # a sensor that is further off level is reported
_STEEPEST = 0.35  # no road has this slope; up-axes that lean further, in the median, are no ground vehicle's
_ROUNDING = 1e-9  # slope below which a rotation that was made of the heading alone is level
STATION_M = 1.0  # nearer poses are one station: a vehicle that stands drives no path in its noise
_WINDOW_SIGMAS = 3.0  # a Gaussian is cut off here; 0.3 % of it lies beyond
_END_RIDGE = 0.2  # keeps lines through few stations from being steep, as a share of the Gaussian's width
_HALF_WIDTH_M = 3.5  # ground to either side of the path that counts for unevenness: a lane's width


@dataclass(frozen=True)
class Laid:
    """Poses with the road laid flat: z = 0, plan and heading as recorded, attitude relative to the road."""

    trajectory: Trajectory
    road: Road | None  # as recorded, None for the plane z = 0
    mount_rad: FloatArray  # (2,) roll (left side up), pitch (nose down) of the sensor, taken off


def lay_flat(recorded: Trajectory, position_sigma_m: float = 0.02) -> Laid:
    """Lay the road under poses ``map_from_vehicle`` flat into z = 0, recorded with ``position_sigma_m``.

    Roll, or pitch, that is zero throughout was not measured: the vehicle is assumed to follow the road. The
    usual sigma is for the poses of a result.
    """
    poses = recorded.map_from_vehicle
    up = poses[:, :3, 2]
    slope = -up[:, :2] / np.maximum(up[:, 2:], 1e-3)
    if np.median(np.linalg.norm(slope, axis=1)) > _STEEPEST:
        _log.warning("the poses' z axis does not point up: the road beneath them is not laid flat")
        return Laid(recorded, None, np.zeros(2))
    stations = along_route(poses[:, :2, 3])
    height_m = stations.mean(poses[:, 2, 3])
    yaw = heading_rad(poses)
    lean = _turned(slope, -yaw)
    measured = np.abs(lean).max(axis=0) > _ROUNDING
    if not measured.any() and not poses[:, 2, 3].any():
        return Laid(recorded, None, np.zeros(2))
    height_sigma_m = HEIGHT_SIGMAS * position_sigma_m
    if not measured.all():
        # By its heights alone, which hardly say anything of the slope across a straight road.
        pieces = np.sqrt(2.0 * np.pi) * _HEIGHTS_M / _HEIGHT_M
        trust_m2 = np.full(len(height_m), (height_sigma_m / _CROSS_FALL) ** 2 / pieces)
        level = np.zeros((len(height_m), 2, 1))
        by_heights = local_planes(stations, height_m[:, None], level, _HEIGHTS_M, trust_m2)[1][..., 0]
        slope_by_heights = stations.at_poses(by_heights)
        lean[:, ~measured] = _turned(slope_by_heights, -yaw)[:, ~measured]
    leans = stations.mean(_with_mount(lean, yaw, measured))
    ground = _fit(stations, height_m, leans, height_sigma_m)
    relative = lean - _turned(stations.at_poses(ground.slope), -yaw) - ground.mount
    relative[:, ~measured] = 0.0
    flat = poses.copy()
    flat[:, 2, 3] = 0.0
    roll, pitch = roll_pitch(relative).T
    flat[:, :3, :3] = rotation_from_euler(roll, pitch, yaw)
    road = Road(stations.points_map, ground.height_m, ground.slope)
    return Laid(Trajectory(recorded.stamp_s, flat), road, roll_pitch(ground.mount[None])[0])


def log_road(laid: Laid, where: Path) -> None:
    """Log the heights and slopes of the road that was laid flat, and a sensor that is not level."""
    if laid.road is None:
        return
    percent = 100.0 * np.linalg.norm(laid.road.slope, axis=1)
    _log.info(
        "%s: the road is laid flat; recorded heights %.2f to %.2f m, slopes %.1f %% (median) to %.1f %%",
        where, laid.road.height_m.min(), laid.road.height_m.max(), np.median(percent), percent.max(),
    )  # fmt: skip
    if np.abs(laid.mount_rad).max() > _REPORTED_RAD:
        _log.info(
            "%s: on average the recorded attitude is off the road's by %.2f deg of roll (left side up), "
            "%.2f deg of pitch (nose down); this is taken off",
            where, np.degrees(laid.mount_rad[0]), np.degrees(laid.mount_rad[1]),
        )  # fmt: skip


class _Ground(NamedTuple):
    """The ground at N stations, and how the sensor stands on its vehicle."""

    height_m: FloatArray  # (N,)
    slope: FloatArray  # (N, 2) by map x and y
    mount: FloatArray  # (2,) slopes of the sensor forward and left


def _fit(stations: Stations, height_m: FloatArray, leans: FloatArray, height_sigma_m: float) -> _Ground:
    """The ground that heights (N,) and leans (N, 2, 3) agree on."""
    road = local_lines(stations, leans.reshape(len(leans), 6), _ROAD_M).reshape(leans.shape)
    # Heights along the route over a ground of these slopes, from zero at its start.
    steps = np.diff(stations.points_map, axis=0)
    rise = np.einsum("ni,nic->nc", steps, 0.5 * (road[1:] + road[:-1]))
    drawn = np.vstack([np.zeros((1, 3)), np.cumsum(rise, axis=0)])
    missing = np.column_stack([height_m, np.zeros((len(height_m), 2))]) - drawn
    variance = np.full(len(height_m), height_sigma_m**2)
    for _ in range(2):
        # Mean squared leverage at which heights say as much of a slope as the up-axis does.
        trust_m2 = variance * _HEIGHT_M / (_SWAY_RAD**2 * _SWAY_M)
        offset, correction = local_planes(stations, missing, leans - road, _HEIGHTS_M, trust_m2)
        mount = _mount(leans - road - correction)
        with_mount = np.append(1.0, mount)
        # Heights that leave the profile of the up-axes, as where a receiver loses its fix, weigh less.
        misfit = local_lines(stations, ((missing - offset) @ with_mount)[:, None] ** 2, _HEIGHTS_M)[:, 0]
        variance = np.maximum(variance, misfit)
    return _Ground((offset + drawn) @ with_mount, (road + correction) @ with_mount, mount)


def _mount(leans: FloatArray) -> FloatArray:
    """The sensor's slopes (2,) forward and left that leave least of ``leans`` (N, 2, 3)."""
    weight = STATION_M / (_SWAY_RAD**2 * _SWAY_M)
    recorded = leans[..., 0]
    by_mount = leans[..., 1:]
    normal = weight * np.einsum("nim,nik->mk", by_mount, by_mount) + np.diag(1.0 / np.square(_MOUNT_RAD))
    return np.asarray(np.linalg.solve(normal, -weight * np.einsum("nim,ni->m", by_mount, recorded)))


def _with_mount(lean: FloatArray, yaw: FloatArray, measured: BoolArray) -> FloatArray:
    """Slopes (P, 2, 3) by map x and y: recorded, and the change by a unit of mount forward and left."""
    directions = (np.tile(unit, (len(yaw), 1)) for unit in np.diag(measured.astype(np.float64)))
    return np.stack([_turned(lean, yaw), *(-_turned(direction, yaw) for direction in directions)], axis=2)


def roll_pitch(lean: FloatArray) -> FloatArray:
    """Roll and pitch (P, 2) of a floor with these slopes forward and left (P, 2)."""
    pitch = -np.arctan(lean[:, 0])
    return np.column_stack([np.arctan(lean[:, 1] * np.cos(pitch)), pitch])


def _turned(vectors: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """Vectors (P, 2), each turned by its angle (P,)."""
    c = np.cos(angle_rad)
    s = np.sin(angle_rad)
    x, y = vectors.T
    return np.column_stack([c * x - s * y, s * x + c * y])


@dataclass(frozen=True)
class Stations:
    """Places along a route, each the mean of the successive poses within a metre."""

    first: np.ndarray  # (N + 1,) indices of the stations' first poses, and the number of poses
    points_map: FloatArray  # (N, 2)
    path_m: FloatArray  # (N,) the way

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
        reach_slice = slice(int(low), max(int(high), k + 1))
        weight = np.exp(-0.5 * ((self.path_m[reach_slice] - self.path_m[k]) / width_m) ** 2)
        return reach_slice, weight


def along_route(points_map: FloatArray) -> Stations:
    """The stations of poses at ``points_map`` (P, 2)."""
    first = [0]
    x0, y0 = points_map[0].tolist()
    for p, (x, y) in enumerate(points_map.tolist()):
        if (x - x0) ** 2 + (y - y0) ** 2 >= STATION_M**2:
            first.append(p)
            x0 = x
            y0 = y
    starts = np.array([*first, len(points_map)])
    centres = _means(points_map, starts)
    return Stations(starts, centres, length_along(centres))


def local_lines(stations: Stations, values: FloatArray, width_m: float) -> FloatArray:
    """``values`` (N, C) smoothed by the line fitted around each station."""
    smooth = np.empty_like(values)
    for k, here in enumerate(stations.path_m):
        window, weight = stations.around(k, width_m)
        weight = weight / weight.sum()
        offset = stations.path_m[window] - here
        centred = offset - weight @ offset
        spread = weight @ centred**2 + (_END_RIDGE * width_m) ** 2
        mean = weight @ values[window]
        smooth[k] = mean - (weight @ offset) * ((weight * centred) @ values[window]) / spread
    return smooth


def local_planes(
    stations: Stations, height: FloatArray, slope: FloatArray, width_m: float, trust_m2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Heights (N, C) and slopes (N, 2, C) of the planes around the stations that fit C sets of both there.

    ``slope`` (N, 2, C) is known apart from the heights; ``trust_m2`` (N,) is the mean squared leverage, m^2,
    at which heights say as much as these slopes.
    """
    fitted = np.empty_like(height)
    inclined = np.empty_like(slope)
    for k in range(len(height)):
        window, weight = stations.around(k, width_m)
        weight = weight / weight.sum()
        offset = stations.points_map[window] - stations.points_map[k]
        mean = weight @ offset
        lever = (offset - mean) * weight[:, None]
        normal = lever.T @ offset + trust_m2[k] * np.eye(2)
        known_slope = np.tensordot(weight, slope[window], axes=1)
        inclined[k] = np.linalg.solve(normal, lever.T @ height[window] + trust_m2[k] * known_slope)
        fitted[k] = weight @ height[window] - mean @ inclined[k]
    return fitted, inclined


def _means(values: FloatArray, first: np.ndarray) -> FloatArray:
    count = np.diff(first).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(np.add.reduceat(values, first[:-1], axis=0) / count)


@dataclass(frozen=True)
class Unevenness:
    """The ground's worst deviation from the plane beneath the vehicle, at a distance."""

    value_m: float
    distance_m: float
    at_map: FloatArray  # (2,) the vehicle
    station_m: float  # along the route


def unevenness(road: Road, reach_m: float) -> Unevenness:
    """The worst deviation of the ground, over distance, between half of ``reach_m`` and all of it."""
    station_m = length_along(road.points_map)
    # Unit vectors to the left of the path, zero where it is a point.
    ahead = np.gradient(road.points_map, axis=0) if len(station_m) > 1 else np.zeros((1, 2))
    left = turned_left(ahead)
    left /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    worst = Unevenness(0.0, reach_m, road.points_map[0], 0.0)
    for k, here_m in enumerate(station_m):
        low, high = np.searchsorted(station_m, [here_m - reach_m, here_m + reach_m])
        window = slice(int(low), int(high))
        offset = road.points_map[window] - road.points_map[k]
        distance_m = np.linalg.norm(offset, axis=1)
        far = distance_m >= 0.5 * reach_m
        if not far.any():
            continue
        change = road.slope[window] - road.slope[k]
        along_m = road.height_m[window] - road.height_m[k] - offset @ road.slope[k]
        across_m = _HALF_WIDTH_M * np.einsum("ni,ni->n", change, left[window])
        deviation_m = np.where(far, np.abs(along_m) + np.abs(across_m), 0.0)
        j = int(np.argmax(deviation_m / np.maximum(distance_m, 0.5 * reach_m)))
        if deviation_m[j] * worst.distance_m > worst.value_m * distance_m[j]:
            worst = Unevenness(float(deviation_m[j]), float(distance_m[j]), road.points_map[k], float(here_m))
    return worst
