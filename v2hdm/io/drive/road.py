"""The road under a drive, and the drive's poses with that road laid flat into z = 0.

The mapper's ground is the plane z = 0. A road has grade, cross-fall, ramps and a height above the sea; none
of it concerns the markings' plan. The vehicle's attitude relative to the road before it does: one degree of
pitch moves a ground point at 15 m by 2.4 m for a camera 1.65 m up.

The recorded up-axis, smoothed over a few metres, gives the road's slope. The heights tell where it does not:
integrated along the path, that slope must give them. What it lacks, a sensor that is not level or a vehicle
that squats as it speeds up, is the vehicle's and not the road's. Only this difference is smoothed over a
longer way, so that a short ramp, of which both know, is not blurred.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from v2hdm.geometry.rigid import heading_rad, rotation_from_euler
from v2hdm.io.drive.stations import STATION_M, Stations, along_route, local_lines, local_planes
from v2hdm.io.drive.unevenness import Unevenness, unevenness
from v2hdm.records import BoolArray, FloatArray, Road, Trajectory

__all__ = ["Laid", "Unevenness", "lay_flat", "tell", "unevenness"]

_log = logging.getLogger(__name__)

_ROAD_M = 5.0
"""Standard deviation of the Gaussian along the path under which the recorded up-axis is the road's, m. What
is shorter is the suspension, whose waves at 1.5 Hz are 3 to 10 m long at 5 to 15 m/s."""

_HEIGHTS_M = 10.0
"""Standard deviation of the Gaussian along the path under which heights are held against the up-axis, m:
short enough for a vehicle's squat at a start or stop, long enough for heights of 2 cm to tell 1 mrad."""

_SWAY_RAD = 0.003
"""Slow sway of a vehicle relative to the road, by acceleration and in bends: 0.17 deg, as on KITTI drives."""

_SWAY_M = 10.0
"""Way over which that sway lasts, m: a few seconds of driving."""

_HEIGHT_SIGMAS = 1.5
"""Heights from GNSS are half again as uncertain as positions: no satellite is below the antenna."""

_HEIGHT_M = 5.0
"""Way over which an error of the height is of one piece, m."""

_CROSS_FALL = 0.02
"""Slope of a road that drains: what is expected of ground of which only heights along a line are known."""

_MOUNT_RAD = (0.1, 0.02)
"""How far off level on its vehicle a sensor may be, in pitch and roll. Heights tell the pitch whatever is
expected. Only turns tell roll from the road's cross-fall: 1 deg, which is no more than cross-falls are."""

_TOLD_RAD = float(np.radians(0.3))
"""A sensor that is further off level than this is told of."""

_STEEPEST = 0.35
"""Slope that no road has. Up-axes that lean further, in the median, are no ground vehicle's."""

_ROUNDING = 1e-9
"""Slope below which a rotation that was made of the heading alone is level."""


@dataclass(frozen=True)
class Laid:
    """Poses with the road laid flat.

    Attributes:
        trajectory: z = 0, x, y and heading as recorded, roll and pitch relative to the road.
        road: the recorded ground; None where it was recorded as the plane z = 0.
        mount_rad: (2,) roll (positive: left side up) and pitch (positive: nose down) of the sensor on the
            vehicle, which ``trajectory`` no longer has.
    """

    trajectory: Trajectory
    road: Road | None
    mount_rad: FloatArray


def lay_flat(recorded: Trajectory, position_sigma_m: float) -> Laid:
    """Lay the road under ``recorded`` poses flat into z = 0.

    Roll, or pitch, that is zero throughout was not measured: the vehicle is taken to follow the road.

    Args:
        recorded: ``map_from_vehicle`` at the receiver's rate.
        position_sigma_m: standard deviation of a recorded position.
    """
    poses = recorded.map_from_vehicle
    slope = _slope_of_up_axis(poses)
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
    height_sigma_m = _HEIGHT_SIGMAS * position_sigma_m
    if not measured.all():
        ground = stations.at_poses(_slope_of_heights(stations, height_m, height_sigma_m))
        lean[:, ~measured] = _turned(ground, -yaw)[:, ~measured]
    leans = stations.mean(_with_mount(lean, yaw, measured))
    fit = _fit(stations, height_m, leans, height_sigma_m)
    relative = lean - _turned(stations.at_poses(fit.slope), -yaw) - fit.mount
    relative[:, ~measured] = 0.0
    flat = poses.copy()
    flat[:, 2, 3] = 0.0
    roll, pitch = _roll_pitch(relative).T
    flat[:, :3, :3] = rotation_from_euler(roll, pitch, yaw)
    road = Road(stations.points_map, fit.height_m, fit.slope)
    return Laid(Trajectory(recorded.stamp_s, flat), road, _roll_pitch(fit.mount[None])[0])


def tell(laid: Laid, where: Path) -> None:
    """Say in the log how the road lies that was laid flat, and how a sensor sits that is not level."""
    if laid.road is None:
        return
    percent = 100.0 * np.linalg.norm(laid.road.slope, axis=1)
    _log.info(
        "%s: the road is laid flat; recorded were heights of %.2f to %.2f m and slopes of %.1f %% (median) "
        "to %.1f %%",
        where, laid.road.height_m.min(), laid.road.height_m.max(), np.median(percent), percent.max(),
    )  # fmt: skip
    if np.abs(laid.mount_rad).max() > _TOLD_RAD:
        _log.info(
            "%s: on average the recorded attitude is off the road's by %.2f deg of roll (left side up), "
            "%.2f deg of pitch (nose down); this is taken off",
            where, *np.degrees(laid.mount_rad),
        )  # fmt: skip


@dataclass(frozen=True)
class _Fit:
    """The ground at N stations and the sensor on the vehicle.

    ``height_m`` (N,), ``slope`` (N, 2) by map x and y, ``mount`` (2,) slope of the sensor forward and left.
    """

    height_m: FloatArray
    slope: FloatArray
    mount: FloatArray


def _fit(stations: Stations, height_m: FloatArray, leans: FloatArray, height_sigma_m: float) -> _Fit:
    """The ground that heights and up-axes agree upon, and how the sensor sits on the vehicle.

    Everything is linear in the mount, so its effect is carried along in columns of its own.

    Args:
        stations: the N places.
        height_m: (N,) recorded there.
        leans: (N, 2, 3) of :func:`_with_mount`.
        height_sigma_m: standard deviation of a height.
    """
    road = local_lines(stations, leans.reshape(len(leans), 6), _ROAD_M).reshape(leans.shape)
    drawn = _integrated(stations, road)
    missing = np.column_stack([height_m, np.zeros((len(height_m), 2))]) - drawn
    variance = np.full(len(height_m), height_sigma_m**2)
    for _ in range(2):
        offset, correction = local_planes(stations, missing, leans - road, _HEIGHTS_M, _trust_m2(variance))
        mount = _mount(leans - road - correction)
        with_mount = np.append(1.0, mount)
        # Heights that leave the profile of the up-axes, as where a receiver loses its fix, weigh less.
        misfit = local_lines(stations, ((missing - offset) @ with_mount)[:, None] ** 2, _HEIGHTS_M)[:, 0]
        variance = np.maximum(variance, misfit)
    return _Fit((offset + drawn) @ with_mount, (road + correction) @ with_mount, mount)


def _trust_m2(height_variance: FloatArray) -> FloatArray:
    """Mean squared leverage (N,) at which heights say as much of a slope as the up-axis does."""
    return np.asarray(height_variance * _HEIGHT_M / (_SWAY_RAD**2 * _SWAY_M))


def _mount(leans: FloatArray) -> FloatArray:
    """The sensor's slopes (2,) forward and left that leave least of ``leans`` (N, 2, 3)."""
    weight = STATION_M / (_SWAY_RAD**2 * _SWAY_M)
    normal = weight * np.einsum("nim,nik->mk", leans[..., 1:], leans[..., 1:]) + np.diag(
        1.0 / np.square(_MOUNT_RAD)
    )
    return np.asarray(
        np.linalg.solve(normal, -weight * np.einsum("nim,ni->m", leans[..., 1:], leans[..., 0]))
    )


def _integrated(stations: Stations, slope: FloatArray) -> FloatArray:
    """Heights (N, C) along the route over a ground of these slopes (N, 2, C), from zero at its start."""
    steps = np.diff(stations.points_map, axis=0)
    rise = np.einsum("ni,nic->nc", steps, 0.5 * (slope[1:] + slope[:-1]))
    return np.vstack([np.zeros((1, slope.shape[2])), np.cumsum(rise, axis=0)])


def _slope_of_up_axis(poses: FloatArray) -> FloatArray:
    """Slope (P, 2) by map x and y of the vehicle's floor; huge where its z axis does not point up."""
    up = poses[:, :3, 2]
    return np.asarray(-up[:, :2] / np.maximum(up[:, 2:], 1e-3))


def _slope_of_heights(stations: Stations, height_m: FloatArray, height_sigma_m: float) -> FloatArray:
    """Slope (N, 2) of the ground by its heights alone, which hardly say anything across a straight road."""
    pieces = np.sqrt(2.0 * np.pi) * _HEIGHTS_M / _HEIGHT_M
    trust_m2 = np.full(len(height_m), (height_sigma_m / _CROSS_FALL) ** 2 / pieces)
    level = np.zeros((len(height_m), 2, 1))
    return local_planes(stations, height_m[:, None], level, _HEIGHTS_M, trust_m2)[1][..., 0]


def _with_mount(lean: FloatArray, yaw: FloatArray, measured: BoolArray) -> FloatArray:
    """Slopes (P, 2, 3) by map x and y: recorded, and what a unit of mount forward and left takes off them.

    ``lean`` (P, 2) is the recorded floor's, forward and left; only what was ``measured`` (2,) has a mount.
    """
    directions = (np.tile(unit, (len(yaw), 1)) for unit in np.diag(measured.astype(np.float64)))
    return np.stack([_turned(lean, yaw), *(-_turned(direction, yaw) for direction in directions)], axis=2)


def _roll_pitch(lean: FloatArray) -> FloatArray:
    """Roll and pitch (P, 2) of a floor with these slopes forward and left (P, 2)."""
    pitch = -np.arctan(lean[:, 0])
    return np.column_stack([np.arctan(lean[:, 1] * np.cos(pitch)), pitch])


def _turned(vectors: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """Vectors (P, 2), each turned by its angle (P,)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y = vectors.T
    return np.column_stack([c * x - s * y, s * x + c * y])
