"""Readings of positions and attitudes to poses of the vehicle in the map.

Antenna and vehicle: ``vehicle = position - rotation @ lever_arm``. True and grid north: the attitude at a
place is relative to that place's east and north; the map's axes are those at its origin, and both differences
are taken exactly, over the earth's centre.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.geodetic import (
    convergence_rad,
    datum_of,
    enu_axes,
    enu_from_geodetic,
    geodetic_from_grid,
    has_height_datum,
    is_geographic,
)
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.geometry.trajectory import interpolate
from v2hdm.io.drive.trajectory import check_geodetic
from v2hdm.io.importers.poses.readings import Readings
from v2hdm.io.importers.poses.settings import PoseSettings
from v2hdm.io.importers.stamp_units import why_no_pose
from v2hdm.records import BoolArray, FloatArray, GeodeticOrigin, Trajectory

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Recorded:
    """Poses as a drive has them.

    Attributes:
        trajectory: ``map_from_vehicle``.
        noise: those fields of :class:`PoseNoise` that the source states.
        origin: the map's place on the earth; None where the poses are the map's own.
    """

    trajectory: Trajectory
    noise: Mapping[str, float]
    origin: GeodeticOrigin | None


def assemble(
    readings: Readings, settings: PoseSettings, origin: GeodeticOrigin | None, max_gap_s: float, where: str
) -> Recorded:
    """The vehicle's poses in the map.

    Args:
        readings: what the source states.
        settings: how to understand it.
        origin: the map's origin as the drive gives it; without one the first position is the origin of a
            source that has a place on the earth.
        max_gap_s: attitudes further apart are not interpolated across.
        where: the source, for errors.

    Raises:
        DriveError: positions without a heading, of an antenna whose place is not said, of no sufficient fix,
            or of a system that cannot be used.
    """
    if readings.antenna and settings.lever_arm_m is None:
        raise DriveError(
            f"{where}: holds an antenna's positions: add lever_arm_m: [x, y, z], where the antenna sits in "
            "the vehicle frame (m forward, left, up); [0, 0, 0] only if it is above the rear axle, on the "
            "ground"
        )
    if readings.attitudes is None:
        raise DriveError(
            f"{where}: holds positions without a heading, and the course over ground is none where a vehicle "
            "turns, stands or reverses; add a heading (HDT, THS, PASHR, an Imu or dual-antenna topic, a "
            "column)"
        )
    kept = _sure_enough(readings, settings.max_sigma_m, where)
    readings = replace(
        readings, stamp_s=readings.stamp_s[kept], points=readings.points[kept], sigma_m=readings.sigma_m[kept]
    )
    rotation, known = _rotation_at(readings, max_gap_s, where)
    points, sigma_m = readings.points[known], readings.sigma_m[known]
    rotation = rotation @ settings.vehicle_from_sensor.T
    stamp_s = readings.stamp_s[known] + settings.offset_s
    if readings.geodetic or settings.crs is not None:
        if readings.geodetic:
            check_geodetic(points, where)
        geodetic, north_rad = _on_earth(points, readings.geodetic, settings, where)
        datum = "WGS84" if settings.crs is None else datum_of(settings.crs, where, DriveError)
        origin = _origin(origin, geodetic[0], datum, settings, where)
        zeros = np.zeros(len(points))
        here = np.array([[origin.latitude_deg, origin.longitude_deg, origin.altitude_m]])
        # A grid whose north lies clockwise of true north turns all that is measured from it clockwise.
        rotation = rotation_from_euler(zeros, zeros, -north_rad) @ rotation
        rotation = enu_axes(here)[0].T @ enu_axes(geodetic) @ rotation
        points = enu_from_geodetic(origin, geodetic)
    elif settings.heading is not None or settings.geoid_m is not None:
        key = "heading" if settings.heading is not None else "geoid_m"
        raise DriveError(
            f"{where}, {key}: only for coordinates with a place on the earth; add crs or drop it"
        )
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = points
    if settings.lever_arm_m is not None:
        poses[:, :3, 3] -= rotation @ settings.lever_arm_m
    noise = _noise(sigma_m, readings)
    return Recorded(Trajectory(stamp_s, poses), noise, origin)


def _sure_enough(readings: Readings, max_sigma_m: float, where: str) -> BoolArray:
    unsure = readings.sigma_m > max_sigma_m
    if unsure.all():
        stated = readings.sigma_m[np.isfinite(readings.sigma_m)]
        best = f"the best is {stated.min():.2g} m" if len(stated) else "none is a fix"
        raise DriveError(
            f"{where}: no position is sure to {max_sigma_m:g} m ({best}); record with an RTK fix, or set "
            "max_sigma_m higher and expect a map as unsure"
        )
    if unsure.any():
        _log.warning(
            "%s: left out %d of %d positions, stated to be less sure than %g m (no RTK fix; max_sigma_m)",
            where, int(unsure.sum()), len(unsure), max_sigma_m,
        )  # fmt: skip
    return np.asarray(~unsure)


def _rotation_at(readings: Readings, max_gap_s: float, where: str) -> tuple[FloatArray, BoolArray]:
    """Rotations (K, 3, 3) at the times of those positions that have one, and the flags (P,) of these."""
    attitudes = readings.attitudes
    assert attitudes is not None
    poses = np.tile(np.eye(4), (len(attitudes.stamp_s), 1, 1))
    poses[:, :3, :3] = attitudes.rotation
    if np.array_equal(attitudes.stamp_s, readings.stamp_s):
        return attitudes.rotation, np.ones(len(readings.stamp_s), dtype=bool)
    found, known = interpolate(Trajectory(attitudes.stamp_s, poses), readings.stamp_s, max_gap_s)
    if not known.any():
        raise DriveError(
            f"{where}: no position ({readings.stamp_s[0]:.3f} to {readings.stamp_s[-1]:.3f} s) has a heading "
            f"({attitudes.stamp_s[0]:.3f} to {attitudes.stamp_s[-1]:.3f} s) within {max_gap_s:g} s "
            "(drive.max_gap_s): "
            f"{why_no_pose(readings.stamp_s, attitudes.stamp_s, max_gap_s, 'positions', 'headings')}"
        )
    if not known.all():
        _log.warning(
            "%s: left out %d of %d positions: no heading at their time",
            where,
            int((~known).sum()),
            len(known),
        )
    return found[known, :3, :3], known


def _on_earth(
    points: FloatArray, geodetic: bool, settings: PoseSettings, where: str
) -> tuple[FloatArray, FloatArray]:
    """Latitude, longitude and height above the ellipsoid (P, 3), and the north that counts (P,), rad."""
    crs = settings.crs
    if crs is not None and has_height_datum(crs, where, DriveError) and settings.geoid_m is None:
        raise DriveError(
            f"{where}: heights of {crs} count from the sea: add geoid_m, the geoid's height above the "
            "ellipsoid"
        )
    raised = points + np.array([0.0, 0.0, settings.geoid_m or 0.0])
    if geodetic:
        if crs is not None and not is_geographic(crs, where, DriveError):
            raise DriveError(f"{where}: holds latitudes and longitudes, but crs {crs} is projected; mend crs")
        if settings.heading == "grid":
            raise DriveError(
                f"{where}: heading 'grid' of latitudes and longitudes, which have no grid; mend it"
            )
        return raised, np.zeros(len(points))
    assert crs is not None
    if settings.heading is None:
        raise DriveError(
            f"{where}: true and grid north differ in {crs}: add heading: true (gyrocompass, dual antenna) or "
            "heading: grid (yaw of the projected coordinates)"
        )
    north_rad = np.zeros(len(points))
    if settings.heading == "grid":
        north_rad = convergence_rad(crs, raised, where, DriveError)
    return geodetic_from_grid(crs, raised, where, DriveError), north_rad


def _origin(
    given: GeodeticOrigin | None, first: FloatArray, datum: str, settings: PoseSettings, where: str
) -> GeodeticOrigin:
    if given is None:
        return GeodeticOrigin(float(first[0]), float(first[1]), float(first[2]), datum, settings.epoch)
    # Without crs the source does not say its datum: that of a correction service is the origin's.
    if settings.crs is not None and given.datum.replace(" ", "") != datum.replace(" ", ""):
        raise DriveError(
            f"{where}: the poses are in {datum}, the origin in {given.datum}, which differ by decimetres; "
            f"give the origin in {datum} (datum: {datum})"
        )
    return given if given.epoch is not None else replace(given, epoch=settings.epoch)


def _noise(sigma_m: FloatArray, readings: Readings) -> dict[str, float]:
    """Root mean squares of what is stated of the positions that are left, and of headings."""
    assert readings.attitudes is not None
    noise = {"position_m": sigma_m, "heading_rad": readings.attitudes.sigma_rad}
    return {
        key: float(np.sqrt(np.mean(np.square(stated))))
        for key, values in noise.items()
        if len(stated := values[np.isfinite(values) & (values > 0)])
    }
