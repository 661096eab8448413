"""Poses as people have them: one registry of formats, and poses of the vehicle in the map made of each.

Antenna and vehicle: ``vehicle = position - rotation @ lever_arm``. True and grid north: the attitude at a
place is relative to that place's east and north; the map's axes are those at its origin, and both differences
are taken exactly, over the earth's centre.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry import geodetic as earth
from v2hdm.geometry.datums import is_named, is_same_datum
from v2hdm.geometry.planar import angle_between
from v2hdm.geometry.rigid import interpolate, make_transform, rotation_from_euler
from v2hdm.io.description import (
    NmeaPoses,
    PoseKeys,
    SbetPoses,
    TablePoses,
    TopicPoses,
    UbxPoses,
    keys_in,
)
from v2hdm.io.importers import readings as logs
from v2hdm.io.importers.course.headings import STARTS, course_headings
from v2hdm.io.importers.course.recording import Turning, course_of
from v2hdm.io.importers.nmea import read_nmea
from v2hdm.io.importers.readings import Attitudes, Readings
from v2hdm.io.importers.rtklib import read_pos
from v2hdm.io.importers.sbet import read_sbet
from v2hdm.io.importers.slip import driven
from v2hdm.io.importers.strays import without_stray_turns, without_strays
from v2hdm.io.importers.ubx import read_ubx
from v2hdm.io.trajectory import check_geodetic, read_tum, span, why_no_pose
from v2hdm.records import BoolArray, FloatArray, GeodeticOrigin, Reception, Trajectory
from v2hdm.store.files import check_keys, take_array, take_choice, take_mapping, take_number, take_text

_log = logging.getLogger(__name__)

COURSE = "course"  # a heading that was not recorded: the smoothed course over ground replaces it
HEADINGS = ("true", "grid", COURSE)
_USUAL_SIGMA_M = 0.02  # of a position that states none: RTK, fixed, as in records.PoseNoise
_SAME_HEADING_DEG = 0.2  # headings closer than this are one: the noise of two antennas a metre apart
COMMON_KEYS = keys_in(PoseKeys).optional
TOPIC_KEYS = keys_in(TopicPoses, PoseKeys).optional


@dataclass(frozen=True)
class PoseSettings:
    """The keys of ``poses`` in ``drive.yaml`` that every format has; None is not stated."""

    vehicle_from_sensor: FloatArray  # (3, 3), turn of the attitude's sensor on the vehicle
    crs: str | None = None  # of the coordinates, such as EPSG:25832; None for the map's own, or WGS84
    heading: str | None = None  # north that headings count from, one of HEADINGS
    lever_arm_m: FloatArray | None = None  # (3,), the point that positions refer to, in the vehicle frame
    max_sigma_m: float = 0.1  # less sure positions are left out: RTK fixed is 0.02, float about 0.5
    geoid_m: float | None = None  # height of the geoid above the ellipsoid, for heights above the sea
    epoch: float | None = None  # of the coordinates, in years
    offset_s: float = 0.0  # added to the recorded times
    starts: str | None = None  # direction of the beginning, one of STARTS, for COURSE


class Fixes(NamedTuple):
    """All positions of a source, used or not."""

    stamp_s: FloatArray  # (P,)
    is_fixed: BoolArray | None  # (P,) whether RTK had fixed its ambiguities, None where not stated

    def between(self, first_s: float, last_s: float, geoid_m: float | None) -> Reception:
        """The reception from ``first_s`` to ``last_s``, both included."""
        is_within = (self.stamp_s >= first_s) & (self.stamp_s <= last_s)
        fixed = None if self.is_fixed is None else int((self.is_fixed & is_within).sum())
        return Reception(int(is_within.sum()), fixed, geoid_m)


@dataclass(frozen=True)
class Recorded:
    """Poses ``map_from_vehicle`` as a drive has them."""

    trajectory: Trajectory
    noise: Mapping[str, float]  # the fields of :class:`PoseNoise` that the source states
    origin: GeodeticOrigin | None  # None where the poses are the map's own
    fixes: Fixes | None = None
    geoid_m: float | None = None  # height of the geoid above the ellipsoid, as stated and added
    headed_by_course: bool = False  # whether no heading was recorded


_Reader = Callable[[Path, dict[str, Any], Path, str, float | None], Readings]

POSE_FORMATS: Mapping[str, tuple[_Reader, tuple[str, ...]]] = {
    "tum": (lambda path, entry, root, where, near_s: logs.readings_of_poses(read_tum(path)), ()),
    "csv": (logs.read_table, keys_in(TablePoses, PoseKeys).optional),
    "nmea": (read_nmea, keys_in(NmeaPoses, PoseKeys).optional),
    "sbet": (read_sbet, keys_in(SbetPoses, PoseKeys).optional),
    "pos": (read_pos, ()),
    "ubx": (read_ubx, keys_in(UbxPoses, PoseKeys).optional),
}
"""Formats of files by the key that names the file: the reader, and keys of its own; bags have ``topic``."""


def read_poses(
    content: object,
    root: Path,
    origin: GeodeticOrigin | None,
    max_gap_s: float,
    where: str,
    read_topic: Callable[[], Readings] | None,
    near_s: float | None = None,
) -> Recorded:
    """The poses of ``poses`` in ``drive.yaml``: a TUM file's name, or a mapping with a format or a topic.

    File names are relative to ``root``, ``origin`` is the map's place on the earth as the drive states it,
    and ``read_topic`` reads the named topic of the drive's bag. ``near_s`` is a time of the drive, from its
    images, by which seconds of a day or a week find theirs.
    """
    if isinstance(content, str):
        content = {"tum": content}
    entry = take_mapping(content, where, DriveError)
    named = [key for key in (*POSE_FORMATS, "topic") if key in entry]
    if len(named) != 1:
        raise DriveError(
            f"{where}: name one source, a pose file by its format ({', '.join(POSE_FORMATS)}) or a topic "
            f"of the bag; got {', '.join(named) or 'none'}"
        )
    (kind,) = named
    keys = TOPIC_KEYS if kind == "topic" else POSE_FORMATS[kind][1]
    check_keys(entry, (kind,), (*keys, *COMMON_KEYS), where, DriveError)
    settings = _take_settings(entry, where)
    name = take_text(entry[kind], f"{where}, {kind}", DriveError)
    if read_topic is not None:
        readings = read_topic()
        source = f"{where}, topic {name}"
    else:
        readings = POSE_FORMATS[kind][0](root / name, entry, root, where, near_s)
        source = str(root / name)
    if entry.get("heading_file") is not None:
        attitudes = _headings(entry["heading_file"], root, f"{where}, heading_file", near_s)
        readings = replace(readings, attitudes=attitudes)
    if entry.get("gyro_file") is not None:
        turning = _turning(entry["gyro_file"], root, f"{where}, gyro_file")
        readings = replace(readings, turning=turning)
    return assemble(readings, settings, origin, max_gap_s, source)


def _turning(content: object, root: Path, where: str) -> Turning:
    """The readings of a gyro's file."""
    entry = {"csv": content} if isinstance(content, str) else take_mapping(content, where, DriveError)
    check_keys(entry, ("csv",), ("columns", "offset_s"), where, DriveError)
    turning = logs.read_turning(root / take_text(entry["csv"], f"{where}, csv", DriveError), entry, where)
    offset_s = take_number(entry.get("offset_s", 0.0), f"{where}, offset_s", DriveError)
    return replace(turning, stamp_s=turning.stamp_s + offset_s)


def _headings(content: object, root: Path, where: str, near_s: float | None) -> Attitudes:
    """The attitudes of a second file."""
    entry = {"tum": content} if isinstance(content, str) else take_mapping(content, where, DriveError)
    named = [kind for kind in POSE_FORMATS if kind in entry]
    if len(named) != 1:
        raise DriveError(f"{where}: name one file by its format: {', '.join(POSE_FORMATS)}")
    (kind,) = named
    read, keys = POSE_FORMATS[kind]
    check_keys(entry, (kind,), (*keys, "offset_s"), where, DriveError)
    name = take_text(entry[kind], f"{where}, {kind}", DriveError)
    attitudes = read(root / name, entry, root, where, near_s).attitudes
    if attitudes is None:
        raise DriveError(f"{where}: {root / name}: holds no headings; name a file that does")
    offset_s = take_number(entry.get("offset_s", 0.0), f"{where}, offset_s", DriveError)
    later_s = None if attitudes.later_s is None else attitudes.later_s + offset_s
    return replace(attitudes, stamp_s=attitudes.stamp_s + offset_s, later_s=later_s)


def _take_settings(entry: Mapping[str, Any], where: str) -> PoseSettings:
    fields: dict[str, Any] = {}
    for key in filter(entry.__contains__, ("max_sigma_m", "geoid_m", "epoch", "offset_s")):
        fields[key] = take_number(entry[key], f"{where}, {key}", DriveError)
    for key in filter(entry.__contains__, ("lever_arm_m", "mounting_rpy_deg")):
        fields[key] = take_array(entry[key], (3,), f"{where}, {key}", DriveError)
    if entry.get("heading") is not None:
        fields["heading"] = take_choice(entry["heading"], HEADINGS, f"{where}, heading", DriveError)
    if entry.get("starts") is not None:
        fields["starts"] = take_choice(entry["starts"], STARTS, f"{where}, starts", DriveError)
    for key in ("starts", "gyro_file", "gyro_topic"):
        if entry.get(key) is not None and fields.get("heading") != COURSE:
            raise DriveError(f"{where}, {key}: only with heading: {COURSE}; add that or drop it")
    if fields.get("max_sigma_m", 1.0) <= 0:
        raise DriveError(f"{where}, max_sigma_m: give a positive number of metres")
    crs = entry.get("crs")
    if isinstance(crs, int) and not isinstance(crs, bool):
        crs = f"EPSG:{crs}"
    if crs is not None:
        fields["crs"] = take_text(crs, f"{where}, crs", DriveError)
    roll, pitch, yaw = np.radians(fields.pop("mounting_rpy_deg", np.zeros(3)))[:, None]
    return PoseSettings(rotation_from_euler(roll, pitch, yaw)[0], **fields)


def assemble(
    readings: Readings, settings: PoseSettings, origin: GeodeticOrigin | None, max_gap_s: float, where: str
) -> Recorded:
    """The vehicle's poses in the map, from the ``readings`` of the source ``where``.

    Without an ``origin`` it is the first position. Raises DriveError for positions without a heading, of an
    antenna whose place is not stated, without a sufficient fix, or of an unsuitable system.
    """
    if not len(readings.stamp_s):
        only = "headings only; name it as heading_file" if readings.attitudes is not None else "none"
        raise DriveError(f"{where}: needs positions, and holds {only}")
    if readings.point and settings.lever_arm_m is None:
        raise DriveError(
            f"{where}: holds {readings.point} positions: add lever_arm_m: [x, y, z], its place in the "
            "vehicle frame (m forward, left, up); [0, 0, 0] only if it is above the rear axle"
        )
    fixes = Fixes(readings.stamp_s + settings.offset_s, readings.is_fixed)
    if settings.heading == COURSE:
        recorded = _of_course(readings, settings, origin, where)
        return replace(recorded, fixes=fixes, geoid_m=settings.geoid_m)
    if readings.attitudes is None:
        raise DriveError(
            f"{where}: holds positions without a heading, and the course over ground is not a heading when a "
            "vehicle turns, stands or reverses; add a heading (HDT, THS, PASHR, a column, an Imu topic, or "
            f"heading_file, a second file), or for one antenna heading: {COURSE}, with lever_arm_m and best "
            "a gyro (gyro_file)"
        )
    recorded = _of_either_time(_usable(readings, settings, where), settings, origin, max_gap_s, where)
    return replace(recorded, fixes=fixes, geoid_m=settings.geoid_m)


def _of_either_time(
    readings: Readings, settings: PoseSettings, origin: GeodeticOrigin | None, max_gap_s: float, where: str
) -> Recorded:
    """The poses by the times of the headings, or by the later ones where these fit the driving better."""
    attitudes = readings.attitudes
    assert attitudes is not None
    recorded = _recorded(readings, settings, origin, max_gap_s, where)
    if attitudes.later_s is None:
        return recorded
    later = replace(attitudes, stamp_s=attitudes.later_s, later_s=None)
    recorded_later = _recorded(replace(readings, attitudes=later), settings, origin, max_gap_s, where)
    choice = driven(recorded.trajectory, recorded_later.trajectory)
    if not choice.is_sure:
        _warn_of_time(recorded.trajectory, recorded_later.trajectory, attitudes, choice.is_second, where)
    return recorded_later if choice.is_second else recorded


def _warn_of_time(
    first: Trajectory, second: Trajectory, attitudes: Attitudes, is_second: bool, where: str
) -> None:
    """Say that the time of headings is open, where that matters."""
    assert attitudes.later_s is not None
    _, rows_of_first, rows_of_second = np.intersect1d(first.stamp_s, second.stamp_s, return_indices=True)
    forward = first.map_from_vehicle[rows_of_first, :2, 0]
    off_deg = np.degrees(np.abs(angle_between(forward, second.map_from_vehicle[rows_of_second, :2, 0])))
    worst_deg = float(off_deg.max(initial=0.0))
    if worst_deg < _SAME_HEADING_DEG:
        return
    off_s = float(np.median(attitudes.later_s - attitudes.stamp_s))
    _log.warning(
        "%s: its headings have no time, and may be %.3g s %s than taken, which is up to %.1f deg: log them "
        "between two sentences of their epoch (GGA, HDT, RMC), or with times (PASHR)",
        where, off_s, "earlier" if is_second else "later", worst_deg,
    )  # fmt: skip


def _usable(readings: Readings, settings: PoseSettings, where: str) -> Readings:
    """The readings without those that are no numbers, not sure enough, or strays."""
    attitudes = readings.attitudes
    assert attitudes is not None
    fixed = _fixed(readings, settings, where)
    turned = _finite(attitudes.rotation.reshape(-1, 9), np.zeros(len(attitudes.stamp_s)), where, "headings")
    attitudes = attitudes.at(turned)
    attitudes = attitudes.at(without_stray_turns(attitudes.stamp_s, attitudes.rotation, where))
    return replace(fixed, attitudes=attitudes)


def _fixed(readings: Readings, settings: PoseSettings, where: str) -> Readings:
    """The readings of positions that are numbers, sure enough and no strays."""
    fixed = _without(readings, _finite(readings.points, readings.sigma_m, where, "positions"))
    fixed = _without(fixed, _sure_enough(fixed, settings.max_sigma_m, where))
    return _without(fixed, without_strays(fixed.stamp_s, _metres(fixed, settings, where), where))


def _of_course(
    readings: Readings, settings: PoseSettings, origin: GeodeticOrigin | None, where: str
) -> Recorded:
    """The level vehicle's poses in the map, headed as its antenna's course and the gyro tell."""
    if settings.lever_arm_m is None:
        raise DriveError(
            f"{where}: heading: {COURSE} needs lever_arm_m: [x, y, z], the antenna's place from the ground "
            "under the rear axle, which does not slip (m forward, left, up)"
        )
    if readings.attitudes is not None:
        _log.info("%s: its headings are not used: heading: %s", where, COURSE)
    turning = readings.turning
    if readings.rates is not None:
        if turning is not None:
            raise DriveError(f"{where}: has gyro_topic and gyro_file; drop one")
        turning = readings.rates.about_up(settings.vehicle_from_sensor)
    readings = _fixed(readings, settings, where)
    if len(readings.stamp_s) < 3:
        raise DriveError(f"{where}: {len(readings.stamp_s)} positions have no course; record a drive")
    placed = _in_map(readings, settings, origin, where)
    sigma_m = np.where(readings.sigma_m > 0, readings.sigma_m, _USUAL_SIGMA_M)
    course = course_of(
        readings.stamp_s, placed.points_map[:, :2], sigma_m, settings.lever_arm_m[:2], turning, where
    )
    headings = course_headings(course, settings.starts, where)
    zeros = np.zeros(len(readings.stamp_s))
    rotation = rotation_from_euler(zeros, zeros, headings.heading_rad)
    lever_arm_m = np.array([headings.lever_ahead_m, *settings.lever_arm_m[1:]])
    poses = make_transform(rotation, placed.points_map - rotation @ lever_arm_m)
    noise = _root_mean_squares({"position_m": readings.sigma_m}) | headings.noise
    trajectory = Trajectory(readings.stamp_s + settings.offset_s, poses)
    return Recorded(trajectory, noise, placed.origin, headed_by_course=True)


def _without(readings: Readings, is_usable: BoolArray) -> Readings:
    """The readings whose positions are ``kept`` (P,)."""
    rows = {key: getattr(readings, key)[is_usable] for key in ("stamp_s", "points", "sigma_m")}
    return replace(readings, **rows, is_fixed=None)  # counted before anything was left out


def _finite(values: FloatArray, sigma_m: FloatArray, where: str, things: str) -> BoolArray:
    """Flags (N,) of the rows of ``values`` (N, V) that are numbers; the others are counted."""
    is_number = np.asarray(np.isfinite(values).all(axis=1))
    lost = ~is_number & ~np.isinf(sigma_m)  # a position without a fix is counted as such
    if not is_number.any():
        raise DriveError(f"{where}: none of its {len(is_number)} {things} is a number; record it again")
    if lost.any():
        _log.warning(
            "%s: left out %d of %d %s that are not numbers", where, int(lost.sum()), len(lost), things
        )
    return is_number


def _metres(readings: Readings, settings: PoseSettings, where: str) -> FloatArray:
    """The positions (P, 3) in m, in any frame."""
    if not readings.geodetic:
        return readings.points * _units_m(settings, where)
    middle = np.median(readings.points, axis=0)
    # Strays off the earth stay far away.
    limited = np.clip(readings.points, [-90.0, -540.0, -1e7], [90.0, 540.0, 1e7])
    return earth.enu_from_geodetic(
        GeodeticOrigin(*np.clip(middle, [-90, -180, -1e7], [90, 180, 1e7])), limited
    )


def _recorded(
    readings: Readings, settings: PoseSettings, origin: GeodeticOrigin | None, max_gap_s: float, where: str
) -> Recorded:
    """The vehicle's poses in the map, of sure readings with headings."""
    attitudes = readings.attitudes
    assert attitudes is not None
    rotation, has_heading = _rotation_at(readings, max_gap_s, where)
    rotation = rotation @ settings.vehicle_from_sensor.T
    headed = _without(readings, has_heading)
    placed = _in_map(headed, settings, origin, where)
    rotation = placed.map_from_north @ rotation
    points = placed.points_map
    if settings.lever_arm_m is not None:
        points = points - rotation @ settings.lever_arm_m
    noise = _noise(headed.sigma_m, attitudes)
    stamp_s = headed.stamp_s + settings.offset_s
    return Recorded(Trajectory(stamp_s, make_transform(rotation, points)), noise, placed.origin)


class _Placed(NamedTuple):
    """Positions in the map, and what turns attitudes of each place into the map's axes."""

    points_map: FloatArray  # (P, 3) m
    map_from_north: FloatArray  # (P, 3, 3) from x east of the north that counts, y along it
    origin: GeodeticOrigin | None


def _in_map(readings: Readings, settings: PoseSettings, origin: GeodeticOrigin | None, where: str) -> _Placed:
    """The positions of ``readings`` in the map."""
    points = readings.points
    if readings.geodetic or settings.crs is not None:
        if readings.geodetic:
            check_geodetic(points, where)
        geodetic, north_rad = _on_earth(points, readings.geodetic, settings, where)
        datum = "WGS84" if settings.crs is None else earth.datum_of(settings.crs, where, DriveError)
        origin = _origin(origin, geodetic[0], datum, settings, where)
        zeros = np.zeros(len(points))
        # A grid whose north lies clockwise of true north turns all that is measured from it clockwise.
        grid = rotation_from_euler(zeros, zeros, -north_rad)
        axes = earth.enu_axes(earth.position_of(origin))[0].T @ earth.enu_axes(geodetic)
        return _Placed(earth.enu_from_geodetic(origin, geodetic), axes @ grid, origin)
    for key in ("heading", "geoid_m"):
        value = getattr(settings, key)
        if value is not None and value != COURSE:
            only = "only for coordinates on the earth; add crs or drop it"
            raise DriveError(f"{where}, {key}: {only}")
    return _Placed(points, np.broadcast_to(np.eye(3), (len(points), 3, 3)), origin)


def _noise(sigma_m: FloatArray, attitudes: Attitudes) -> dict[str, float]:
    """Root mean squares of the sigmas that are stated."""
    tilt_sigma_rad = np.array([]) if attitudes.tilt_sigma_rad is None else attitudes.tilt_sigma_rad
    return _root_mean_squares(
        {
            "position_m": sigma_m,
            "heading_rad": attitudes.sigma_rad,
            "roll_pitch_rad": tilt_sigma_rad,
        }
    )


def _root_mean_squares(values_of: Mapping[str, FloatArray]) -> dict[str, float]:
    """Root mean squares of values that are stated."""
    return {
        key: float(np.sqrt(np.mean(np.square(stated))))
        for key, values in values_of.items()
        if len(stated := values[np.isfinite(values) & (values > 0)])
    }


def _sure_enough(readings: Readings, max_sigma_m: float, where: str) -> BoolArray:
    # Among positions that state how sure they are, one that does not is no fix.
    states = np.isfinite(readings.sigma_m).any()
    unsure = ~(readings.sigma_m <= max_sigma_m) if states else readings.sigma_m > max_sigma_m
    if unsure.all():
        stated = readings.sigma_m[np.isfinite(readings.sigma_m)]
        best = f"the best is {stated.min():.2g} m" if len(stated) else "none has a fix"
        raise DriveError(
            f"{where}: no position is known to {max_sigma_m:g} m ({best}); record with an RTK fix, or raise "
            "max_sigma_m and expect a map as uncertain"
        )
    if unsure.any():
        _log.warning(
            "%s: left out %d of %d positions, whose sigma is not below %g m (no RTK fix; max_sigma_m)",
            where, int(unsure.sum()), len(unsure), max_sigma_m,
        )  # fmt: skip
    return np.asarray(~unsure)


def _rotation_at(readings: Readings, max_gap_s: float, where: str) -> tuple[FloatArray, BoolArray]:
    """Rotations (K, 3, 3) at the times of those positions that have one, and their flags (P,)."""
    attitudes = readings.attitudes
    assert attitudes is not None
    if np.array_equal(attitudes.stamp_s, readings.stamp_s):
        return attitudes.rotation, np.ones(len(readings.stamp_s), dtype=bool)
    turns = Trajectory(attitudes.stamp_s, make_transform(attitudes.rotation, np.zeros(3)))
    poses, has_heading = interpolate(turns, readings.stamp_s, max_gap_s)
    if not has_heading.any():
        raise DriveError(
            f"{where}: no position ({span(readings.stamp_s)}) has a heading "
            f"({span(attitudes.stamp_s)}) within {max_gap_s:g} s "
            "(drive.max_gap_s): "
            f"{why_no_pose(readings.stamp_s, attitudes.stamp_s, max_gap_s, 'positions', 'headings')}"
        )
    if not has_heading.all():
        lacking = int((~has_heading).sum())
        _log.warning(
            "%s: left out %d of %d positions: no heading at their time", where, lacking, len(has_heading)
        )
    return poses[has_heading, :3, :3], has_heading


def _on_earth(
    points: FloatArray, geodetic: bool, settings: PoseSettings, where: str
) -> tuple[FloatArray, FloatArray]:
    """Latitude, longitude and height above the ellipsoid (P, 3), and the north that counts (P,), rad."""
    crs = settings.crs
    if crs is not None and earth.has_height_datum(crs, where, DriveError) and settings.geoid_m is None:
        advice = "add geoid_m, the geoid's height above the ellipsoid"
        raise DriveError(f"{where}: heights of {crs} are above sea level: {advice}")
    raised = points.copy()
    raised[:, 2] = (1.0 if geodetic else _units_m(settings, where)[2]) * points[:, 2] + (
        settings.geoid_m or 0.0
    )
    if geodetic:
        if crs is not None and not earth.is_geographic(crs, where, DriveError):
            raise DriveError(f"{where}: holds latitudes and longitudes, but crs {crs} is projected; fix crs")
        if settings.heading == "grid":
            raise DriveError(f"{where}: heading 'grid' for latitudes, longitudes, which have no grid; fix it")
        return raised, np.zeros(len(points))
    assert crs is not None
    if settings.heading is None:
        raise DriveError(
            f"{where}: true and grid north differ in {crs}: add heading: true (gyrocompass, dual antenna) or "
            "heading: grid (yaw of the projected coordinates)"
        )
    north_rad = np.zeros(len(points))
    if settings.heading == "grid":
        north_rad = earth.convergence_rad(crs, raised, where, DriveError)
    units = earth.units_of(crs, where, DriveError)
    if units.horizontal_m != 1.0:
        _log.info("%s: x, y and z are read in the unit of %s, %s", where, crs, units.name)
    on_earth = earth.geodetic_from_grid(crs, raised, where, DriveError)
    if not earth.is_in_use(crs, on_earth, where, DriveError):
        latitude_deg, longitude_deg, _ = on_earth[0]
        raise DriveError(
            f"{where}: its positions would be at latitude {latitude_deg:.2f}, longitude {longitude_deg:.2f}, "
            f"where {crs} is not used; check it, and that x is the easting and y the northing"
        )
    return on_earth, north_rad


def _units_m(settings: PoseSettings, where: str) -> FloatArray:
    """Lengths (3,), m, of the units of x, y and z in the system of the coordinates."""
    if settings.crs is None:
        return np.ones(3)
    units = earth.units_of(settings.crs, where, DriveError)
    return np.array([units.horizontal_m, units.horizontal_m, units.vertical_m])


def _origin(
    stated: GeodeticOrigin | None, first: FloatArray, datum: str, settings: PoseSettings, where: str
) -> GeodeticOrigin:
    if stated is None:
        if not is_named(datum):
            raise DriveError(f"{where}: crs {settings.crs} names no datum; give its code, such as EPSG:25832")
        return GeodeticOrigin(float(first[0]), float(first[1]), float(first[2]), datum, settings.epoch)
    # Without crs the source does not say its datum: that of a correction service is the origin's.
    if settings.crs is not None and is_named(datum) and not is_same_datum(stated.datum, datum):
        raise DriveError(
            f"{where}: the poses are in {datum}, the origin in {stated.datum}, which differ by decimetres; "
            f"give the origin in {datum} (datum: {datum})"
        )
    return stated if stated.epoch is not None else replace(stated, epoch=settings.epoch)
