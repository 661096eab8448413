"""Readings of a pose file or topic, before frames, antenna and noise; from CSV files and NMEA 0183 logs.

The columns of tables say by their names what they hold and in which unit; ``columns`` in ``drive.yaml``
translates these names.

In a receiver's log, GGA gives positions and their quality, GST their standard deviations, RMC or ZDA the
date, HDT, THS or PASHR the heading; HDT and THS, which have no time, belong to the sentence before them. A
course over ground is no heading.
"""

from __future__ import annotations

import csv
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import DriveError, one_line
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.trajectory import UNITS, checked_rotations, in_order, parse_number
from v2hdm.records import FloatArray, Trajectory
from v2hdm.safe.texts import read_bytes, shown
from v2hdm.store.files import check_keys, read_text, take_mapping, take_text

SIGMA_OF_QUALITY_M: Mapping[int, float] = {
    0: np.inf,  # no fix
    1: 3.0,  # single
    2: 1.0,  # differential
    3: 3.0,  # PPS
    4: 0.02,  # RTK, fixed
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


@dataclass(frozen=True)
class Readings:
    """Positions over time, and attitudes, if any, perhaps at other times."""

    stamp_s: FloatArray  # (P,) rising strictly
    # (P, 3) x, y, z in m, or latitude, longitude (deg), ellipsoidal height (m) where ``geodetic``
    points: FloatArray
    geodetic: bool
    sigma_m: FloatArray  # (P,) of a horizontal coordinate, nan where not stated, infinite without a fix
    attitudes: Attitudes | None
    antenna: bool = field(default=False)  # which seldom sits at the vehicle's origin


def readings_of_poses(poses: Trajectory) -> Readings:
    """Poses in the map, whose sigmas nobody has stated, as readings."""
    unknown = np.full(len(poses.stamp_s), np.nan)
    attitudes = Attitudes(poses.stamp_s, poses.map_from_vehicle[:, :3, :3], unknown)
    return Readings(poses.stamp_s, poses.map_from_vehicle[:, :3, 3], False, unknown, attitudes)


_STAMPS: Mapping[str, float] = {f"stamp_{unit}": scale for unit, scale in UNITS.items()}
_MAP = ("x_m", "y_m", "z_m")
_GEODETIC = ("latitude_deg", "longitude_deg", "altitude_m")
_QUATERNION = ("qx", "qy", "qz", "qw")
_ANGLES = (
    "heading_deg", "yaw_deg", "yaw_rad", "roll_deg", "roll_rad", "pitch_deg", "pitch_rad", "pitch_up_deg",
)  # fmt: skip
_SURENESS = ("quality", "sigma_m", "heading_sigma_deg")
NAMES = (*_STAMPS, "utc", *_MAP, *_GEODETIC, *_QUATERNION, *_ANGLES, *_SURENESS)
"""Columns that are understood. ``heading_deg`` counts clockwise from north, ``yaw_...`` counter-clockwise
from x or east; roll is positive with the left side up, ``pitch_...`` with the nose down, ``pitch_up_deg``
up."""


def read_table(path: Path, entry: dict[str, Any], root: Path, where: str) -> Readings:
    """Read the CSV file at ``path``, separated by commas, semicolons, tabs or blanks."""
    names = take_mapping(entry.get("columns", {}), f"{where}, columns", DriveError)
    check_keys(names, (), NAMES, f"{where}, columns", DriveError)
    texts = {ours: take_text(name, f"{where}, columns, {ours}", DriveError) for ours, name in names.items()}
    columns = _columns(path, texts)
    stamp_s = _stamps(columns, path)
    rows = in_order(stamp_s, str(path), "pose")
    columns = {name: values[rows] for name, values in columns.items()}
    geodetic = _GEODETIC[0] in columns
    coordinates = _GEODETIC if geodetic else _MAP
    if geodetic == (_MAP[0] in columns):
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
    return Readings(stamp_s[rows], points, geodetic, sigma_m, attitudes, antenna=geodetic)


def _columns(path: Path, names: Mapping[str, str]) -> dict[str, FloatArray]:
    """The columns of our ``NAMES`` that the file has, each (N,)."""
    header, rows = read_rows(path, ",;\t", "pose")
    for ours, theirs in names.items():
        if header.count(theirs) != 1:
            problem = f"has no column '{theirs}' for {ours}, or two"
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


class Table(NamedTuple):
    """A CSV file: the names in its first line, and the cells of each further line with its number."""

    header: list[str]
    rows: list[tuple[int, list[str]]]


def read_rows(path: Path, separators: str, thing: str) -> Table:
    """The names and the cells of a CSV file, each row as long as the line of names.

    The first of ``separators`` in the line of names separates cells, else blanks do; ``#`` begins a comment.
    """
    text = read_text(path, DriveError)
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    lines = [*lines[:1], *(line for line in lines[1:] if not line[1].lstrip().startswith("#"))]
    if len(lines) < 2:
        raise DriveError(f"{path}: has no {thing}; expected a line of column names and one line per {thing}")
    title = lines[0][1].lstrip("\ufeff# ")
    separator = next((mark for mark in separators if mark in title), None)

    def split(line: str) -> list[str]:
        if separator is None:
            cells = line.split()
        else:
            cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
        return [one_line(cell) for cell in cells]

    try:
        header = split(title)
        rows = [(number, split(line)) for number, line in lines[1:]]
    except csv.Error as failure:
        raise DriveError(f"{path}: is not a table ({failure}); fix its quotes or its longest cell") from None
    for number, cells in rows:
        if len(cells) != len(header):
            problem = f"{len(cells)} cells under {len(header)} columns"
            raise DriveError(f"{path}: line {number}: {problem}; fix that line")
    return Table(header, rows)


def _parse(name: str, cell: str, where: str) -> float:
    try:
        if name == "utc":
            moment = datetime.fromisoformat(cell)
            return moment.replace(tzinfo=moment.tzinfo or UTC).timestamp()
        if name in _SURENESS:
            return parse_sigma(cell)
    except ValueError:
        kind = "a time such as 2024-05-17T08:30:00.25Z" if name == "utc" else "a number, 0 or more"
        raise DriveError(f"{where}: '{cell}' is not {kind}; fix that line") from None
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
            raise DriveError(f"{path}: has no column '{name}'; give the file's name for it under columns")


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


_log = logging.getLogger(__name__)

_DAY_S = 86400.0  # seconds of a day


def read_nmea(path: Path, entry: dict[str, Any], root: Path, where: str) -> Readings:
    """Read the log at ``path``; damaged sentences are left out and counted, and refused if they prevail."""
    lines = read_bytes(path, DriveError).decode("ascii", errors="replace").splitlines()
    first = None
    if "date" in entry:
        day = take_text(entry["date"], f"{where}, date", DriveError)
        try:
            first = date.fromisoformat(day)
        except ValueError:
            raise DriveError(f"{where}, date: expected a day such as 2024-05-17, got {shown(day)}") from None
    return nmea_readings(lines, str(path), first)


def nmea_readings(lines: Iterable[str], where: str, first_day: date | None = None) -> Readings:
    """Readings of sentences in the order of the log, from ``first_day`` on where none has a date."""
    log = _Log(where)
    total = bad = 0
    for line in lines:
        start = line.find("$")
        if start < 0:
            continue
        total += 1
        try:
            log.take(_fields(line[start:]))
        except (ValueError, IndexError):
            bad += 1
    if bad:
        _log.warning("%s: left out %d of %d damaged sentences", where, bad, total)
    if 2 * bad > total:
        raise DriveError(f"{where}: {bad} of {total} NMEA sentences are damaged; record the log again")
    return log.readings(first_day)


class _Log:
    """Sentences so far; times are seconds of the day until the date is known."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._day = 0
        self._above_sea = False
        self._time_s: float | None = None
        self._first_date: date | None = None
        self._fixes: dict[float, tuple[float, ...]] = {}
        self._attitudes: dict[float, tuple[float, ...]] = {}
        self._sigma_m: dict[float, float] = {}

    def take(self, fields: list[str]) -> None:
        """One sentence, its fields without ``$`` and checksum."""
        kind = fields[0] if fields[0] == "PASHR" else fields[0][-3:]
        if kind == "GGA":
            stamp = self._time(fields[1])
            if int(fields[6] or 0) == 0 or not fields[2]:
                return
            self._above_sea |= not fields[11]
            height_m = float(fields[9]) + float(fields[11] or 0.0)
            place = (_angle(fields[2], fields[3]), _angle(fields[4], fields[5]), height_m)
            self._fixes[stamp] = (*place, SIGMA_OF_QUALITY_M.get(int(fields[6]), np.inf))
        elif kind == "RMC":
            self._time(fields[1])
            if fields[9]:
                self._dated(datetime.strptime(fields[9], "%d%m%y").replace(tzinfo=UTC).date())
        elif kind == "ZDA":
            self._time(fields[1])
            self._dated(date(int(fields[4]), int(fields[3]), int(fields[2])))
        elif kind == "GST":
            stamp = self._time(fields[1])
            sigma_m = np.hypot(parse_sigma(fields[6]), parse_sigma(fields[7])) / np.sqrt(2)
            self._sigma_m[stamp] = float(sigma_m)
        # The modes of THS: autonomous, estimated, manual, simulated, and V for invalid.
        elif kind == "HDT" or (kind == "THS" and fields[2] != "V"):
            if fields[1] and self._time_s is not None:
                self._attitudes[self._time_s] = (float(fields[1]), 0.0, 0.0, np.nan)
        elif kind == "PASHR" and fields[2] and fields[3] == "T":
            # Roll to starboard is left side up, as ours; pitch counts bow up, ours nose down.
            sigma_deg = parse_sigma(fields[9])
            values = (float(fields[2]), float(fields[4] or 0), -float(fields[5] or 0), sigma_deg)
            self._attitudes[self._time(fields[1])] = values

    def readings(self, first_day: date | None) -> Readings:
        """All of it on one clock, seconds since 1970 UTC."""
        if not self._fixes:
            raise DriveError(f"{self._where}: no GGA sentence with a position; log GGA and HDT, THS or PASHR")
        day = self._first_date or first_day
        if day is None:
            advice = "add date, the day of the first sentence"
            raise DriveError(f"{self._where}: no RMC or ZDA sentence states the date: {advice}")
        if self._above_sea:
            _log.warning(
                "%s: its heights count from the sea, and GGA does not say where that is; add geoid_m if the "
                "map is to have heights above the ellipsoid", self._where,
            )  # fmt: skip
        begin_s = datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()
        stamp_s, fixes = _table(self._fixes, begin_s, self._where)
        sigma_m = np.array([self._sigma_m.get(stamp, np.nan) for stamp in self._fixes])
        sigma_m = sigma_m[in_order(np.array(list(self._fixes)), self._where, "fix")]
        # The receiver's own figure counts as far as there is a fix at all.
        sigma_m = np.where(np.isfinite(sigma_m) & np.isfinite(fixes[:, 3]), sigma_m, fixes[:, 3])
        attitudes = None
        if self._attitudes:
            attitude_s, angles = _table(self._attitudes, begin_s, self._where)
            heading, roll, pitch, sigma = np.radians(angles).T
            rotation = rotation_from_euler(roll, pitch, np.pi / 2 - heading)
            attitudes = Attitudes(attitude_s, rotation, sigma)
        return Readings(stamp_s, fixes[:, :3], True, sigma_m, attitudes, antenna=True)

    def _time(self, text: str) -> float:
        """``hhmmss.sss`` in s since the first day's midnight; past midnight a new day begins."""
        of_day = 3600.0 * int(text[:2]) + 60.0 * int(text[2:4]) + float(text[4:])
        stamp = of_day + self._day * _DAY_S
        if self._time_s is not None and stamp < self._time_s - _DAY_S / 2:
            self._day += 1
            stamp += _DAY_S
        self._time_s = stamp
        return stamp

    def _dated(self, today: date) -> None:
        if self._first_date is None:
            self._first_date = date.fromordinal(today.toordinal() - self._day)


def _table(rows: dict[float, tuple[float, ...]], begin_s: float, where: str) -> tuple[FloatArray, FloatArray]:
    stamp_s = np.array(list(rows))
    order = in_order(stamp_s, where, "sentence")
    return begin_s + stamp_s[order], np.array(list(rows.values()))[order]


def _fields(sentence: str) -> list[str]:
    """The fields of a sentence; ValueError where its checksum is wrong."""
    body, star, check = sentence[1:].strip().partition("*")
    if star and f"{reduce(xor, map(ord, body), 0):02X}" != check[:2].upper():
        raise ValueError(check)
    return body.split(",")


def _angle(text: str, side: str) -> float:
    """Degrees of ``dddmm.mmmm`` and N, S, E or W."""
    point = text.index(".") if "." in text else len(text)
    minutes = float(text[point - 2 :])
    degrees = float(text[: point - 2] or 0) + minutes / 60
    if side not in ("N", "S", "E", "W"):
        raise ValueError(side)
    return -degrees if side in ("S", "W") else degrees
