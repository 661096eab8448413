"""How the true poses differ from the recorded ones: suspension, RTK and heading errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.geometry.rigid import heading_rad, rotation_from_euler
from v2hdm.geometry.trajectory import interpolate
from v2hdm.records import FloatArray, PoseNoise, Trajectory
from v2hdm.simulate.port.config import DisturbanceConfig, RouteConfig
from v2hdm.simulate.port.route import Route

_LEAD_S = 0.35


@dataclass(frozen=True)
class DrivenPoses:
    """The drive in time: images at ``stamp_s`` (I,), where the vehicle truly was and what was recorded."""

    stamp_s: FloatArray
    map_from_vehicle: FloatArray
    recorded: Trajectory


def correlated_noise(
    at: FloatArray, sigma: float, correlation: float, rng: np.random.Generator, columns: int = 1
) -> FloatArray:
    """A stationary Gauss-Markov process (N, columns) at rising places ``at`` (N,), exactly discretised."""
    out = rng.standard_normal((len(at), columns))
    keep = np.exp(-np.diff(at) / correlation)
    for k in range(1, len(at)):
        out[k] = keep[k - 1] * out[k - 1] + np.sqrt(1 - keep[k - 1] ** 2) * out[k]
    return np.asarray(sigma * out)


def drive_along(
    route: Route, config: RouteConfig, disturbance: DisturbanceConfig, rng: np.random.Generator
) -> DrivenPoses:
    """Drive a route: image times, true poses with suspension jitter, recorded poses with receiver errors.

    The receiver measures position and heading; roll, pitch and height are recorded as zero. Its times
    are not those of the images.
    """
    lead_m = route.speed_mps * _LEAD_S
    stations = np.arange(lead_m, route.length_m - lead_m, config.image_spacing_m)
    times = _times_at(route, np.append(stations, route.length_m))
    stamp_s = np.round(times[:-1], 6)
    recorded_s = np.arange(0.0, times[-1], 1.0 / config.pose_rate_hz)
    stamp_s = stamp_s[stamp_s < recorded_s[-1]]
    return DrivenPoses(
        stamp_s, _true_poses(route, stamp_s, disturbance, rng), _recorded(route, recorded_s, disturbance, rng)
    )


def _times_at(route: Route, station_m: FloatArray) -> FloatArray:
    """Times (K,) at which the vehicle passes rising stations (K,)."""
    grid = np.arange(0.0, station_m[-1] / route.speed_mps * 1.5 + 10.0, 0.05)
    return np.interp(station_m, route.station_at(grid), grid)


def _true_poses(
    route: Route, stamp_s: FloatArray, config: DisturbanceConfig, rng: np.random.Generator
) -> FloatArray:
    station = route.station_at(stamp_s)
    sigma = np.deg2rad(config.roll_pitch_deg) / np.sqrt(2.0)
    jitter = correlated_noise(stamp_s, sigma, config.jitter_correlation_s, rng, 2)
    jitter += rng.normal(0.0, sigma, (len(stamp_s), 2))
    heave = correlated_noise(stamp_s, config.heave_m, config.jitter_correlation_s, rng)
    return _poses(route.points_at(station), heave[:, 0], jitter[:, 0], jitter[:, 1], route.yaw_at(station))


def _recorded(
    route: Route, stamp_s: FloatArray, config: DisturbanceConfig, rng: np.random.Generator
) -> Trajectory:
    station = route.station_at(stamp_s)
    points = route.points_at(station)
    points = points + correlated_noise(station, config.rtk_correlated_m, config.rtk_correlation_m, rng, 2)
    points += rng.normal(0.0, config.rtk_white_m, points.shape)
    sigma = np.deg2rad(config.heading_deg) / np.sqrt(2.0)
    yaw = route.yaw_at(station) + rng.normal(0.0, sigma, len(stamp_s))
    yaw += correlated_noise(stamp_s, sigma, config.heading_correlation_s, rng)[:, 0]
    zero = np.zeros(len(stamp_s))
    return Trajectory(stamp_s=stamp_s, map_from_vehicle=_poses(points, zero, zero, zero, yaw))


def _poses(
    points: FloatArray, height: FloatArray, roll: FloatArray, pitch: FloatArray, yaw: FloatArray
) -> FloatArray:
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3] = rotation_from_euler(roll, pitch, yaw)
    poses[:, :2, 3] = points
    poses[:, 2, 3] = height
    return poses


def pose_noise(config: DisturbanceConfig, speed_mps: float) -> PoseNoise:
    """What the receiver's data sheet would state, and a test drive of the suspension at ``speed_mps``."""
    heading_rad = float(np.deg2rad(config.heading_deg))
    roll_pitch_rad = float(np.deg2rad(config.roll_pitch_deg))
    return PoseNoise(
        position_m=float(np.hypot(config.rtk_white_m, config.rtk_correlated_m)),
        heading_rad=heading_rad,
        roll_pitch_rad=roll_pitch_rad,
        position_drift_m=config.rtk_correlated_m,
        position_drift_over_m=config.rtk_correlation_m,
        heading_drift_rad=heading_rad / float(np.sqrt(2.0)),
        heading_drift_over_m=config.heading_correlation_s * speed_mps,
        roll_pitch_drift_rad=roll_pitch_rad / float(np.sqrt(2.0)),
        roll_pitch_drift_over_m=config.jitter_correlation_s * speed_mps,
    )


def measured_disturbances(config: DisturbanceConfig, driven: DrivenPoses) -> dict[str, float]:
    """The configured standard deviations, per axis, and under ``actual_`` their values at the images."""
    recorded, _ = interpolate(driven.recorded, driven.stamp_s, np.inf)
    true = driven.map_from_vehicle
    yaw = [heading_rad(pose) for pose in (recorded, true)]
    tilt = np.stack([true[:, 2, 0], true[:, 2, 1]])
    error = recorded[:, :2, 3] - true[:, :2, 3]
    turned = np.angle(np.exp(1j * (yaw[0] - yaw[1])))

    def rms(values: FloatArray) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return {
        "roll_pitch_deg": config.roll_pitch_deg,
        "heave_m": config.heave_m,
        "rtk_position_m": float(np.hypot(config.rtk_white_m, config.rtk_correlated_m)),
        "heading_deg": config.heading_deg,
        "actual_roll_pitch_deg": float(np.rad2deg(rms(tilt))),
        "actual_heave_m": rms(true[:, 2, 3]),
        "actual_rtk_position_m": rms(error),
        "actual_heading_deg": float(np.rad2deg(rms(turned))),
    }
