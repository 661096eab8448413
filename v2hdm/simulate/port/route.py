"""The vehicle's route, its true and recorded poses over time, and the relief of the ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.errors import ConfigError
from v2hdm.geometry.rigid import heading_rad, interpolate, make_transform, rotation_from_euler
from v2hdm.io.drive.road import HEIGHT_SIGMAS, roll_pitch
from v2hdm.records import FloatArray, PoseNoise, Trajectory
from v2hdm.simulate.port.config import DisturbanceConfig, ReliefConfig, RouteConfig
from v2hdm.simulate.render.relief import Relief

_STEP_M = 0.05  # distance between the stations at which a route is integrated
_TRANSITION_M = 4.0  # length over which the curvature changes from one piece of a route to the next
_SPEED_SWING = 0.12  # amplitude of the speed about its mean, as a fraction of it
_SPEED_PERIOD_S = 23.0  # period of the speed's swing


class Place(NamedTuple):
    """A point on the ground and a heading."""

    point_map: tuple[float, float]  # m
    yaw_rad: float


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

    def pose_at(self, station_m: float, offset_m: float = 0.0) -> Place:
        """Point and heading at one station, ``offset_m`` to the left of the path."""
        at = np.array([station_m])
        x, y = self.points_at(at, offset_m)[0].tolist()
        return Place((x, y), float(self.yaw_at(at)[0]))

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
    """Integrate a route's pieces from the origin, heading along x; between them curvature ramps over 4 m."""
    steps = [(max(round(length / _STEP_M), 1), np.deg2rad(turn) / length) for length, turn in config.pieces]
    curvature = np.concatenate([np.full(count, bend) for count, bend in steps])
    window = int(_TRANSITION_M / _STEP_M)
    padded = np.pad(curvature, (window // 2, window - 1 - window // 2), mode="edge")
    curvature = np.convolve(padded, np.full(window, 1.0 / window), mode="valid")
    yaw = np.concatenate([[0.0], np.cumsum(curvature * _STEP_M)])
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    moves = _STEP_M * np.column_stack([np.cos(middle), np.sin(middle)])
    points = np.vstack([[0.0, 0.0], np.cumsum(moves, axis=0)])
    return Route(
        station_m=np.linspace(0.0, len(curvature) * _STEP_M, len(yaw)),
        points_map=points,
        yaw_rad=yaw,
        curvature=np.append(curvature, curvature[-1]),
        speed_mps=config.speed_mps,
    )


_LEAD_S = 0.35  # time from the start of the drive to the first image, and from the last image to its end


@dataclass(frozen=True)
class DrivenPoses:
    """The drive over time: images at ``stamp_s`` (I,), the vehicle's true poses, and the recorded ones.

    ``above_plane`` (I, 4, 4) are the true poses without the ground's heights and slopes.
    """

    stamp_s: FloatArray
    map_from_vehicle: FloatArray
    recorded: Trajectory
    above_plane: FloatArray


def correlated_noise(
    at: FloatArray, sigma: float, correlation: float, rng: np.random.Generator, columns: int = 1
) -> FloatArray:
    """A stationary Gauss-Markov process (N, columns) at rising places ``at`` (N,), exactly discretised."""
    out = rng.standard_normal((len(at), columns))
    keep = np.exp(-np.diff(at) / correlation)
    for k in range(1, len(at)):
        out[k] = keep[k - 1] * out[k - 1] + np.sqrt(1 - keep[k - 1] ** 2) * out[k]
    return np.asarray(sigma * out)


Stands = Callable[[FloatArray, FloatArray], FloatArray]
"""Height, roll and pitch (N, 3) that the ground gives a vehicle at points (N, 2) with headings (N,)."""


def drive_along(
    route: Route,
    config: RouteConfig,
    disturbance: DisturbanceConfig,
    rng: np.random.Generator,
    stands: Stands | None = None,
) -> DrivenPoses:
    """Drive a route: image times, true poses with suspension jitter, recorded poses with receiver errors.

    On a plane the receiver measures position and heading; roll, pitch and height are recorded as zero. Where
    the vehicle ``stands`` otherwise, height, roll and pitch are recorded, too, without the suspension's. Its
    times are not those of the images.
    """
    lead_m = route.speed_mps * _LEAD_S
    stations = np.arange(lead_m, route.length_m - lead_m, config.image_spacing_m)
    grid = np.arange(0.0, route.length_m / route.speed_mps * 1.5 + 10.0, 0.05)
    times = np.interp(np.append(stations, route.length_m), route.station_at(grid), grid)
    stamp_s = np.round(times[:-1], 6)
    recorded_s = np.arange(0.0, times[-1], 1.0 / config.pose_rate_hz)
    stamp_s = stamp_s[stamp_s < recorded_s[-1]]

    station = route.station_at(stamp_s)
    sigma = np.deg2rad(disturbance.roll_pitch_deg) / np.sqrt(2.0)
    jitter = correlated_noise(stamp_s, sigma, disturbance.jitter_correlation_s, rng, 2)
    jitter += rng.normal(0.0, sigma, (len(stamp_s), 2))
    heave = correlated_noise(stamp_s, disturbance.heave_m, disturbance.jitter_correlation_s, rng)
    at = route.points_at(station)
    yaw = route.yaw_at(station)
    true = above_plane = _poses(at, heave[:, 0], jitter, yaw)
    if stands is not None:
        ground = stands(at, yaw)
        true = _poses(at, ground[:, 0] + heave[:, 0], ground[:, 1:] + jitter, yaw)

    station = route.station_at(recorded_s)
    points = route.points_at(station)
    points += correlated_noise(station, disturbance.rtk_correlated_m, disturbance.rtk_correlation_m, rng, 2)
    points += rng.normal(0.0, disturbance.rtk_white_m, points.shape)
    sigma = np.deg2rad(disturbance.heading_deg) / np.sqrt(2.0)
    yaw = route.yaw_at(station) + rng.normal(0.0, sigma, len(recorded_s))
    yaw += correlated_noise(recorded_s, sigma, disturbance.heading_correlation_s, rng)[:, 0]
    ground = np.zeros((len(recorded_s), 3))
    if stands is not None:
        ground = stands(route.points_at(station), route.yaw_at(station))
        drift = disturbance.rtk_correlated_m
        over_m = disturbance.rtk_correlation_m
        errors = correlated_noise(station, drift, over_m, rng)[:, 0]
        errors += rng.normal(0.0, disturbance.rtk_white_m, len(errors))
        ground[:, 0] += HEIGHT_SIGMAS * errors
    recorded = Trajectory(recorded_s, _poses(points, ground[:, 0], ground[:, 1:], yaw))
    return DrivenPoses(stamp_s, true, recorded, above_plane)


def _poses(points: FloatArray, height: FloatArray, tilt: FloatArray, yaw: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) of points (N, 2), heights (N,), rolls and pitches (N, 2), and headings (N,)."""
    rotation = rotation_from_euler(tilt[:, 0], tilt[:, 1], yaw)
    return make_transform(rotation, np.column_stack([points, height]))


def pose_noise(config: DisturbanceConfig, speed_mps: float) -> PoseNoise:
    """The noise in the receiver's data sheet, and of a test drive of the suspension at ``speed_mps``."""
    heading, roll_pitch = (
        float(np.deg2rad(sigma_deg)) for sigma_deg in (config.heading_deg, config.roll_pitch_deg)
    )
    return PoseNoise(
        position_m=float(np.hypot(config.rtk_white_m, config.rtk_correlated_m)),
        heading_rad=heading,
        roll_pitch_rad=roll_pitch,
        position_drift_m=config.rtk_correlated_m,
        position_drift_over_m=config.rtk_correlation_m,
        heading_drift_rad=heading / float(np.sqrt(2.0)),
        heading_drift_over_m=config.heading_correlation_s * speed_mps,
        roll_pitch_drift_rad=roll_pitch / float(np.sqrt(2.0)),
        roll_pitch_drift_over_m=config.jitter_correlation_s * speed_mps,
    )


def measured_disturbances(config: DisturbanceConfig, driven: DrivenPoses) -> dict[str, float]:
    """The configured standard deviations, per axis, and under ``actual_`` their values at the images."""
    recorded, _ = interpolate(driven.recorded, driven.stamp_s, np.inf)
    true = driven.above_plane
    tilt = np.stack([true[:, 2, 0], true[:, 2, 1]])
    turned = np.angle(np.exp(1j * (heading_rad(recorded) - heading_rad(true))))

    def rms(values: FloatArray) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return {
        "roll_pitch_deg": config.roll_pitch_deg,
        "heave_m": config.heave_m,
        "rtk_position_m": float(np.hypot(config.rtk_white_m, config.rtk_correlated_m)),
        "heading_deg": config.heading_deg,
        "actual_roll_pitch_deg": float(np.rad2deg(rms(tilt))),
        "actual_heave_m": rms(true[:, 2, 3]),
        "actual_rtk_position_m": rms(recorded[:, :2, 3] - true[:, :2, 3]),
        "actual_heading_deg": float(np.rad2deg(rms(turned))),
    }


_GRID_M = 0.25  # distance between the knots of a relief
_BORDER_M = 60.0  # width of the relief beyond the route's extent
_REACH_M = 20.0  # distance from the route up to which its crown, bank, gullies and kerb shape the ground
_CROWN_M = 10.0  # distance from the route up to which the crown falls
_BANK_M = 8.0  # distance from the route up to which the bank keeps its full slope
_EASE_M = 12.0  # length over which a ramp begins, and ends
_GULLY_M = 0.4  # standard deviation of a gully's bell-shaped section
_KERB_M = 0.3  # width over which a kerb rises
_WHEELS_M = np.array([[2.8, 0.8], [2.8, -0.8], [0.0, 0.8], [0.0, -0.8]])
"""Wheels (4, 2), m, ahead of the vehicle's origin under the rear axle and to its left, front wheels first."""


def build_relief(config: ReliefConfig, route: Route) -> Relief | None:
    """The heights around a route, None if a plane z = 0; ConfigError if the ramp does not fit on it."""
    if not any((config.grade, config.crown, config.ramp, config.bank, config.gully_m, config.kerb_m)):
        return None
    if config.ramp_at_m + config.ramp_length_m > route.length_m:
        end_m = config.ramp_at_m + config.ramp_length_m
        problem = f"the ramp ends {end_m:g} m along a route of {route.length_m:.0f} m"
        raise ConfigError(f"simulate.relief: {problem}; set a lower ramp_at_m or ramp_length_m")
    low = route.points_map.min(axis=0) - _BORDER_M
    high = route.points_map.max(axis=0) + _BORDER_M
    columns, rows = (np.arange(a, b, _GRID_M) for a, b in zip(low, high, strict=True))
    points = np.stack(np.meshgrid(columns, rows), axis=-1)
    heights = config.grade * points[..., 0] + _ramp(config, route, points)
    heights += _beside(config, route, points.reshape(-1, 2)).reshape(heights.shape)
    return Relief(knots=heights, origin_map=(float(low[0]), float(low[1])), step_m=_GRID_M)


def _on_ramp(config: ReliefConfig, station_m: FloatArray) -> FloatArray:
    """Fraction (...) of the ramp's slope at stations: 0 to 1, eased at both ends."""
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
    at = np.minimum(at, len(route.yaw_rad) - 1)
    away = np.minimum(away, _REACH_M)
    off = points - route.points_map[at]
    yaw = route.yaw_rad[at]
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
    cos = np.cos(yaw_rad)
    sin = np.sin(yaw_rad)
    turn = np.stack([np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)], axis=1)
    wheels = relief.height_m(points_map[:, None] + _WHEELS_M @ turn)
    middle = _WHEELS_M.mean(axis=0)
    slope = wheels @ (_WHEELS_M - middle) / ((_WHEELS_M - middle) ** 2).sum(axis=0)
    return np.column_stack([wheels.mean(axis=1) - slope @ middle, roll_pitch(slope)])
