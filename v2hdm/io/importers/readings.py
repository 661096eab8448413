"""Readings of a pose file or topic, before frames, antenna and noise; and those of CSV files.

The columns of tables say by their names what they hold and in which unit; ``columns`` in ``drive.yaml``
translates these names.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError, shown
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.importers.course.recording import Turning
from v2hdm.io.rows import read_rows
from v2hdm.io.trajectory import NO_NUMBER, UNITS, checked_rotations, in_order, parse_number
from v2hdm.records import BoolArray, FloatArray, Trajectory
from v2hdm.store.files import check_keys, take_mapping, take_text

_log = logging.getLogger(__name__)

RTK_FIXED = 4
"""The quality of NMEA's GGA of a position by RTK with fixed ambiguities."""

SIGMA_OF_QUALITY_M: Mapping[int, float] = {
    0: np.inf,  # no fix
    1: 3.0,  # single
    2: 1.0,  # differential
    3: 3.0,  # PPS
    RTK_FIXED: 0.02,
    5: 0.5,  # RTK, float
    6: np.inf,  # dead reckoning
    7: np.inf,  # typed in
    8: np.inf,  # simulated
    9: 1.0,  # satellite-based augmentation, as some receivers number it
}
"""Standard deviation of a position, a coordinate, m, by the quality of NMEA's GGA (0183, 4.11)."""


@dataclass(frozen=True)
class Attitudes:
    """Attitudes over time."""

    stamp_s: FloatArray  # (A,) rising strictly
    rotation: FloatArray  # (A, 3, 3) from the sensor to east, north, up of the place, or the map
    sigma_rad: FloatArray  # (A,) of the heading, nan if not stated
    tilt_sigma_rad: FloatArray | None = None  # (A,) of roll and pitch, nan if not stated
    later_s: FloatArray | None = (
        None  # (A,) the times that they have instead, where the source leaves it open
    )

    def at(self, rows: BoolArray) -> Attitudes:
        """The attitudes of some ``rows`` (A,)."""
        more = {
            key: None if (values := getattr(self, key)) is None else values[rows]
            for key in ("tilt_sigma_rad", "later_s")
        }
        return Attitudes(self.stamp_s[rows], self.rotation[rows], self.sigma_rad[rows], **more)


@dataclass(frozen=True)
class TurnRates:
    """Turn rates of a gyro over time."""

    stamp_s: FloatArray  # (G,) rising strictly
    rate_rad_s: FloatArray  # (G, 3) about the sensor's axes

    def about_up(self, vehicle_from_sensor: FloatArray) -> Turning:
        """The vehicle's yaw rates, by the turn (3, 3) of the sensor on it."""
        unknown = np.full(len(self.stamp_s), np.nan)
        return Turning(self.stamp_s, self.rate_rad_s @ vehicle_from_sensor[2], unknown)


@dataclass(frozen=True)
class Readings:
    """Positions over time, and attitudes, if any, perhaps at other times."""

    stamp_s: FloatArray  # (P,) rising strictly
    # (P, 3) x, y, z in m, or latitude, longitude (deg), ellipsoidal height (m) where ``geodetic``
    points: FloatArray
    geodetic: bool
    sigma_m: FloatArray  # (P,) of a horizontal coordinate, nan where not stated, infinite without a fix
    attitudes: Attitudes | None
    point: str = ""  # the point that positions refer to, seldom the vehicle's origin: an antenna's
    is_fixed: BoolArray | None = None  # (P,) whether RTK had fixed its ambiguities, None where not stated
    turning: Turning | None = None  # of a gyro's file beside the receiver
    rates: TurnRates | None = None  # of a gyro in the bag


def readings_of_poses(poses: Trajectory) -> Readings:
    """Poses in the map, whose sigmas nobody has stated, as readings."""
    unknown = np.full(len(poses.stamp_s), np.nan)
    attitudes = Attitudes(poses.stamp_s, poses.map_from_vehicle[:, :3, :3], unknown)
    return Readings(poses.stamp_s, poses.map_from_vehicle[:, :3, 3], False, unknown, attitudes)


def headings_only(attitudes: Attitudes | None) -> Readings:
    """Readings without a position."""
    none = np.zeros((0, 3))
    return Readings(none[:, 0], none, True, none[:, 0], attitudes)


_STAMPS: Mapping[str, float] = {f"stamp_{unit}": scale for unit, scale in UNITS.items()}
_MAP = ("x_m", "y_m", "z_m")
_GEODETIC = ("latitude_deg", "longitude_deg", "altitude_m")
_QUATERNION = ("qx", "qy", "qz", "qw")
_ANGLES = (
    "heading_deg", "yaw_deg", "yaw_rad", "roll_deg", "roll_rad", "pitch_deg", "pitch_rad", "pitch_up_deg",
)  # fmt: skip
_SURENESS = ("quality", "sigma_m", "heading_sigma_deg")
_RATES = ("yaw_rate_rad_s", "yaw_rate_deg_s", "speed_m_s")
NAMES = (*_STAMPS, "utc", *_MAP, *_GEODETIC, *_QUATERNION, *_ANGLES, *_SURENESS, *_RATES)
"""Columns that are understood. ``heading_deg`` counts clockwise from north, ``yaw_...`` counter-clockwise
from x or east; roll is positive with the left side up, ``pitch_...`` with the nose down, ``pitch_up_deg``
up. ``yaw_rate_...`` is positive to the left, ``speed_m_s`` forward."""


def read_table(
    path: Path, entry: dict[str, Any], root: Path, where: str, near_s: float | None = None
) -> Readings:
    """Read the CSV file at ``path``, separated by commas, semicolons, tabs or blanks."""
    names = take_mapping(entry.get("columns", {}), f"{where}, columns", DriveError)
    check_keys(names, (), NAMES, f"{where}, columns", DriveError)
    texts = {ours: take_text(name, f"{where}, columns, {ours}", DriveError) for ours, name in names.items()}
    columns = _columns(path, texts)
    stamp_s = _stamps(columns, path)
    if not (is_timed := np.isfinite(stamp_s)).any():
        raise DriveError(f"{path}: no line has a time; record it again, or give another column")
    if not is_timed.all():
        lost = int((~is_timed).sum())
        _log.warning("%s: left out %d of %d lines without a time", path, lost, len(stamp_s))
        columns = {name: values[is_timed] for name, values in columns.items()}
        stamp_s = stamp_s[is_timed]
    rows = in_order(stamp_s, str(path), "pose")
    columns = {name: values[rows] for name, values in columns.items()}
    geodetic = _GEODETIC[0] in columns
    coordinates = _GEODETIC if geodetic else _MAP
    rotation = _rotation(columns, path)
    heading_sigma = np.radians(columns.get("heading_sigma_deg", np.full(len(rows), np.nan)))
    attitudes = None if rotation is None else Attitudes(stamp_s[rows], rotation, heading_sigma)
    if geodetic == (_MAP[0] in columns):
        if attitudes is not None and not geodetic:
            return headings_only(attitudes)
        either = f"{', '.join(_MAP)} or {', '.join(_GEODETIC)}"
        raise DriveError(f"{path}: needs positions, as columns {either}, but not both")
    _check_there(columns, coordinates[:2], path)
    count = len(rows)
    points = np.column_stack([columns.get(name, np.zeros(count)) for name in coordinates])
    sigma_m = columns.get("sigma_m", np.full(count, np.nan))
    if "quality" in columns:
        stated = np.array([SIGMA_OF_QUALITY_M.get(value, np.inf) for value in columns["quality"]])
        sigma_m = np.where(np.isfinite(sigma_m) & np.isfinite(stated), sigma_m, stated)
    heading_sigma = np.radians(columns.get("heading_sigma_deg", np.full(count, np.nan)))
    rotation = _rotation(columns, path)
    attitudes = None if rotation is None else Attitudes(stamp_s[rows], rotation, heading_sigma)
    point = "an antenna's" if geodetic else ""
    is_fixed = columns["quality"] == RTK_FIXED if "quality" in columns else None
    return Readings(stamp_s[rows], points, geodetic, sigma_m, attitudes, point, is_fixed)


def read_turning(path: Path, entry: Mapping[str, Any], where: str) -> Turning:
    """Read yaw rates, speeds of the wheels, or both, from the CSV file at ``path``."""
    names = take_mapping(entry.get("columns", {}), f"{where}, columns", DriveError)
    check_keys(names, (), NAMES, f"{where}, columns", DriveError)
    texts = {ours: take_text(name, f"{where}, columns, {ours}", DriveError) for ours, name in names.items()}
    columns = _columns(path, texts)
    named = [name for name in _RATES if name in columns]
    if not named or {"yaw_rate_rad_s", "yaw_rate_deg_s"} <= set(named):
        raise DriveError(
            f"{path}: needs a column yaw_rate_rad_s or yaw_rate_deg_s (to the left positive), or speed_m_s; "
            f"has {', '.join(named) or 'none'}; see columns"
        )
    stamp_s = _stamps(columns, path)
    is_timed = np.isfinite(stamp_s)
    stamp_s = stamp_s[is_timed]
    if len(stamp_s) < 2:
        raise DriveError(f"{path}: holds {len(stamp_s)} lines with a time; record the gyro during the drive")
    rows = in_order(stamp_s, str(path), "reading")
    unknown = np.full(len(is_timed), np.nan)
    degrees = np.radians(columns.get("yaw_rate_deg_s", unknown))
    yaw_rate = columns.get("yaw_rate_rad_s", degrees)[is_timed][rows]
    speed = columns.get("speed_m_s", unknown)[is_timed][rows]
    return Turning(stamp_s[rows], yaw_rate, speed)


def _columns(path: Path, names: Mapping[str, str]) -> dict[str, FloatArray]:
    """The columns of our ``NAMES`` that the file has, each (N,)."""
    header, rows = read_rows(path, ",;\t", "pose")
    for ours, theirs in names.items():
        if header.count(theirs) != 1:
            problem = f"has no column {shown(theirs)} for {ours}, or two"
            raise DriveError(f"{path}: {problem}; it has: {', '.join(header)}")
    place_of = {ours: header.index(theirs) for ours, theirs in names.items()}
    for place, name in enumerate(header):
        if name in NAMES and place not in place_of.values() and name not in place_of:
            place_of[name] = place
    table: dict[str, list[float]] = {name: [] for name in place_of}
    for number, cells in rows:
        for name, place in place_of.items():
            table[name].append(_parse(name, cells[place], f"{path}: line {number}: {header[place]}"))
    return {name: np.array(values, dtype=np.float64) for name, values in table.items()}


def _parse(name: str, cell: str, where: str) -> float:
    if name not in _SURENESS and cell.lower().lstrip("+-") in NO_NUMBER:
        return np.nan
    try:
        if name == "utc":
            moment = datetime.fromisoformat(cell)
            return moment.replace(tzinfo=moment.tzinfo or UTC).timestamp()
        if name in _SURENESS:
            return parse_sigma(cell)
    except ValueError:
        kind = "a time such as 2024-05-17T08:30:00.25Z" if name == "utc" else "a number, 0 or more"
        raise DriveError(f"{where}: {shown(cell)} is not {kind}; fix that line") from None
    return parse_number(cell, where)


def parse_sigma(cell: str) -> float:
    """A standard deviation, nan where there is none; raises ValueError where it is no number from 0 up."""
    if (sigma := float(cell or "nan")) < 0:
        raise ValueError
    return sigma


def _stamps(columns: Mapping[str, FloatArray], path: Path) -> FloatArray:
    named = [name for name in (*_STAMPS, "utc") if name in columns]
    if len(named) != 1:
        accepted = ", ".join(_STAMPS)
        has = ", ".join(named) or "none"
        raise DriveError(f"{path}: needs one time column, {accepted} or utc, has {has}; see columns")
    return columns[named[0]] / _STAMPS.get(named[0], 1.0)


def _check_there(columns: Mapping[str, FloatArray], names: Sequence[str], path: Path) -> None:
    for name in names:
        if name not in columns:
            raise DriveError(
                f"{path}: has no column {shown(name)}; give the file's name for it under columns"
            )


def _rotation(columns: Mapping[str, FloatArray], path: Path) -> FloatArray | None:
    angles = [name for name in _ANGLES if name in columns]
    yaws = [name for name in angles if name.startswith(("heading", "yaw"))]
    if "qw" in columns:
        _check_there(columns, _QUATERNION, path)
        if angles:
            raise DriveError(f"{path}: has a quaternion and {angles[0]}: choose one under columns")
        quaternion = np.column_stack([columns[name] for name in _QUATERNION])
        return checked_rotations(quaternion, lambda k: f"{path}: pose {k + 1}")
    if not yaws:
        return None
    for kind in (("heading_deg", "yaw_deg", "yaw_rad"), ("roll_deg", "roll_rad"),
                 ("pitch_deg", "pitch_rad", "pitch_up_deg")):  # fmt: skip
        twice = [name for name in kind if name in columns]
        if len(twice) > 1:
            raise DriveError(f"{path}: has {twice[0]} and {twice[1]}: choose one under columns")
    zeros = np.zeros(len(columns[yaws[0]]))

    def radians(kind: str) -> FloatArray:
        degrees = columns.get(f"{kind}_deg", zeros)
        return columns[f"{kind}_rad"] if f"{kind}_rad" in columns else np.radians(degrees)

    yaw = np.pi / 2 - radians("heading") if "heading_deg" in columns else radians("yaw")
    pitch = -radians("pitch_up") if "pitch_up_deg" in columns else radians("pitch")
    return rotation_from_euler(radians("roll"), pitch, yaw)
