"""Solutions of RTKLIB (``.pos``): positions with their sigmas, or baselines of two antennas of a vehicle.

Its line of names says what the columns are: GPST, UTC or JST, by calendar or week and seconds; latitude,
longitude in degrees or degrees, minutes, seconds; x, y, z from the earth's centre; or east, north, up from
the base. ``sdne`` and its like are the square root of a covariance with that one's sign.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.geodetic import enu_axes, geodetic_from_ecef, geodetic_from_enu
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.importers.gps_time import GPS_EPOCH_S, WEEK_S, utc_of_gps
from v2hdm.io.importers.nmea import dated, nmea_readings
from v2hdm.io.importers.readings import SIGMA_OF_QUALITY_M, Attitudes, Readings, headings_only
from v2hdm.io.trajectory import in_order
from v2hdm.records import FloatArray, GeodeticOrigin
from v2hdm.safe.texts import shown
from v2hdm.store.files import read_text

_log = logging.getLogger(__name__)

_JST_S = 9 * 3600.0  # Japan's time is ahead of UTC by this
_PPP_M = 0.1  # sigma of precise point positioning where none is stated; chosen
# RTKLIB's numbers of the quality, as NMEA's GGA numbers them.
_QUALITIES: Mapping[int, int] = {0: 0, 1: 4, 2: 5, 3: 9, 4: 2, 5: 1}
_RTK_FIXED = 1  # RTKLIB's number of the quality of a position with fixed ambiguities
_PPP = 6  # RTKLIB's number of the quality of a precise point position

_DMS = ("latitude(d'\")", "longitude(d'\")")
_ON_EARTH = ("latitude(deg)", "longitude(deg)", "height(m)")
_FROM_CENTRE = ("x-ecef(m)", "y-ecef(m)", "z-ecef(m)")
_BASELINE = ("e-baseline(m)", "n-baseline(m)", "u-baseline(m)")
_OF_CENTRE: Mapping[str, tuple[int, int]] = {
    "sdx(m)": (0, 0),
    "sdy(m)": (1, 1),
    "sdz(m)": (2, 2),
    "sdxy(m)": (0, 1),
    "sdyz(m)": (1, 2),
    "sdzx(m)": (2, 0),
}
"""Places in the covariance of x, y and z."""

_SCALES = ("GPST", "UTC", "JST")
_SIGMAS = "sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio"
_DEFAULT = ("GPST", *_ON_EARTH, "Q", "ns", *_SIGMAS.split())
"""Columns that RTKLIB assumes in a file without a line of names."""


class _Header(NamedTuple):
    """The facts that the comments of a solution state."""

    names: tuple[str, ...]  # of the time scale, and of the columns behind the time's two
    separator: str
    above_sea: bool
    base: GeodeticOrigin | None
    is_moving: bool  # whether the base moves with the vehicle


def read_pos(
    path: Path, entry: dict[str, Any], root: Path, where: str, near_s: float | None = None
) -> Readings:
    """Read the solution at ``path``; rows that are damaged are left out and counted."""
    lines = [line.lstrip("\ufeff").strip() for line in read_text(path, DriveError).splitlines()]
    rows = [line for line in lines if line and not line.startswith(("%", "#", "+", "-"))]
    if not rows:
        raise DriveError(f"{path}: holds no solution; check the log of RTKLIB")
    if rows[0].startswith("$"):
        return nmea_readings(rows, str(path), near_s=dated(near_s))
    header = _header([line for line in lines if line.startswith("%")], str(path))
    table = _table(rows, header, str(path))
    columns = dict(zip(_value_names(header.names), table.T[1:], strict=True))
    stamp_s = _utc(table[:, 0], header.names[0])
    order = in_order(stamp_s, str(path), "solution")
    columns = {name: values[order] for name, values in columns.items()}
    stamp_s = stamp_s[order]
    if header.is_moving and _BASELINE[0] in columns:
        return headings_only(_heading(stamp_s, columns))
    if header.above_sea:
        _log.warning(
            "%s: its heights count from the sea (geodetic); add geoid_m if the map is to have heights above "
            "the ellipsoid", path,
        )  # fmt: skip
    geodetic = _BASELINE[0] not in columns or header.base is not None
    is_fixed = columns["Q"] == _RTK_FIXED if "Q" in columns else None
    points = _points(columns, header)
    sigma_m = _sigma_m(columns)
    return Readings(stamp_s, points, geodetic, sigma_m, None, "an antenna's", is_fixed)


def _header(comments: Sequence[str], where: str) -> _Header:
    firsts = (_DMS[0], _ON_EARTH[0], _FROM_CENTRE[0], _BASELINE[0])
    titles = [line for line in comments if any(name in line for name in firsts)]
    text = "\n".join(comments)
    base = re.search(r"^%\s*ref pos\s*:\s*(.*)$", text, re.MULTILINE)
    moving = re.search(r"^%\s*pos mode\s*:\s*moving", text, re.MULTILINE | re.IGNORECASE)
    above_sea = re.search(r"lat/lon/height=\w+/geodetic", text) is not None
    separator = " "
    names: tuple[str, ...] = _DEFAULT
    if titles:
        title = titles[-1].lstrip("% ")
        first_title = next(name for name in firsts if name in title)
        letter_behind = title[title.index(first_title) + len(first_title) :][:1]
        separator = letter_behind if letter_behind in ",;:|\t" and letter_behind else " "
        names = tuple(title.replace(separator, " ").split())
        if names[0] not in _SCALES:
            scales = ", ".join(_SCALES)
            raise DriveError(f"{where}: its times are {shown(names[0])}, not one of {scales}; export them so")
        values = _value_names(names)
        if tuple(values[:3]) not in (_ON_EARTH, _FROM_CENTRE, _BASELINE):
            columns = ", ".join(map(shown, values[:3]))
            raise DriveError(
                f"{where}: its first columns are {columns}, no position of RTKLIB; export it again"
            )
    else:
        _log.warning(
            "%s: has no line of names: taken, as RTKLIB does, for GPST, latitude, longitude, height", where
        )
    return _Header(names, separator, above_sea, _base(base[1]) if base else None, moving is not None)


def _base(text: str) -> GeodeticOrigin | None:
    """The base's place: latitude, longitude, height, in degrees or parts of them, or x, y, z."""
    try:
        numbers = [float(part) for part in re.split(r"[\s,;]+", text.strip())]
    except ValueError:
        return None
    if len(numbers) == 7:
        numbers = [_of_parts(numbers[:3]), _of_parts(numbers[3:6]), numbers[6]]
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        return None
    if np.linalg.norm(numbers) > 1e5:  # from the earth's centre
        numbers = geodetic_from_ecef(np.array([numbers]))[0].tolist()
    if abs(numbers[0]) > 90 or abs(numbers[1]) > 360:
        return None
    latitude_deg, longitude_deg, height_m = numbers
    return GeodeticOrigin(latitude_deg, longitude_deg, height_m)


def _of_parts(parts: Sequence[float]) -> float:
    """Degrees of degrees, minutes and seconds, the sign before the degrees."""
    if len(parts) != 3:
        raise ValueError(parts)
    size = abs(parts[0]) + parts[1] / 60 + parts[2] / 3600
    return -size if np.signbit(parts[0]) else size


def _value_names(names: Sequence[str]) -> list[str]:
    """The names of numbers behind the time."""
    return [_ON_EARTH[_DMS.index(name)] if name in _DMS else name for name in names[1:]]


def _table(rows: Sequence[str], header: _Header, where: str) -> FloatArray:
    """Times, by the file's scale, and the values of all columns; nan where a row is short."""
    table: list[list[float]] = []
    for row in rows:
        try:
            table.append(_numbers(row, header))
        except (ValueError, OverflowError):
            continue
    if lost := len(rows) - len(table):
        _log.warning("%s: left out %d of %d damaged lines", where, lost, len(rows))
    if 2 * lost > len(rows):
        raise DriveError(f"{where}: {lost} of {len(rows)} lines are not as its names say; export it again")
    return np.array(table)


def _numbers(row: str, header: _Header) -> list[float]:
    cells = row.replace(header.separator, " ").split()
    values = [_time(cells[0], cells[1] if len(cells) > 1 else "")]
    place = 2
    for name in header.names[1:]:
        if name in _DMS:
            values.append(_of_parts([float(cell) for cell in cells[place : place + 3]]))
            place += 3
        else:
            values.append(float(cells[place]) if place < len(cells) else np.nan)
            place += 1
    # Time, three coordinates and the quality have to be there; sigmas and ratio may lack.
    if not np.isfinite(values[:4]).all() or max(map(abs, values[1:4])) > 1e8:
        raise ValueError(row)
    return values


def _time(day: str, clock: str) -> float:
    """Seconds since 1970 by the file's own scale, of a day and a time, or a week and its seconds."""
    if "/" not in day:
        week = int(day)
        of_week_s = float(clock)
        if not (0 < week < 10000 and 0 <= of_week_s <= WEEK_S):
            raise ValueError(day)
        return GPS_EPOCH_S + week * WEEK_S + of_week_s
    year, month, of_month = map(int, day.split("/"))
    hours, minutes, seconds = clock.split(":")
    midnight_s = datetime(year, month, of_month, tzinfo=UTC).timestamp()
    return midnight_s + 3600 * int(hours) + 60 * int(minutes) + float(seconds)


def _utc(stamp_s: FloatArray, scale: str) -> FloatArray:
    if scale == "GPST":
        return utc_of_gps(stamp_s)
    return stamp_s - (_JST_S if scale == "JST" else 0.0)


def _points(columns: Mapping[str, FloatArray], header: _Header) -> FloatArray:
    """Latitudes, longitudes and heights (N, 3), or metres from a base whose place is not stated."""
    if _FROM_CENTRE[0] in columns:
        return geodetic_from_ecef(np.column_stack([columns[name] for name in _FROM_CENTRE]))
    if _BASELINE[0] in columns:
        baseline = np.column_stack([columns[name] for name in _BASELINE])
        return baseline if header.base is None else geodetic_from_enu(header.base, baseline)
    points = np.column_stack([columns[name] for name in _ON_EARTH])
    points[:, 1] = (points[:, 1] + 180) % 360 - 180
    return points


def _sigma_m(columns: Mapping[str, FloatArray]) -> FloatArray:
    """Sigmas (N,) of a horizontal coordinate, as stated, else by the quality."""
    quality = columns.get("Q", np.full(len(next(iter(columns.values()))), np.nan))
    of_quality = np.array([_of_quality(value) for value in quality.tolist()])
    if {"sde(m)", "sdn(m)"} <= set(columns):
        stated = np.hypot(columns["sde(m)"], columns["sdn(m)"]) / np.sqrt(2)
    elif set(_OF_CENTRE) <= set(columns):
        places = geodetic_from_ecef(np.column_stack([columns[name] for name in _FROM_CENTRE]))
        covariance = np.empty((len(places), 3, 3))
        for name, (row, column) in _OF_CENTRE.items():
            covariance[:, row, column] = covariance[:, column, row] = (
                np.sign(columns[name]) * columns[name] ** 2
            )
        axes = enu_axes(places)
        variances = np.einsum("nki,nkl,nli->ni", axes, covariance, axes)[:, :2]
        stated = np.sqrt(np.maximum(variances.mean(axis=1), 0.0))
    else:
        stated = np.full(len(quality), np.nan)
    # A fix that states 0 states nothing.
    return np.where((stated > 0) & np.isfinite(stated) & np.isfinite(of_quality), stated, of_quality)


def _of_quality(quality: float) -> float:
    if quality == _PPP:
        return _PPP_M
    return SIGMA_OF_QUALITY_M.get(_QUALITIES.get(int(quality), 0), np.inf) if np.isfinite(quality) else np.nan


def _heading(stamp_s: FloatArray, columns: Mapping[str, FloatArray]) -> Attitudes | None:
    """Headings of the baseline of two antennas on the vehicle, where its ambiguities are fixed."""
    fixed = columns.get("Q", np.zeros(len(stamp_s))) == 1
    if not fixed.any():
        return None
    east, north, _ = (columns[name][fixed] for name in _BASELINE)
    zeros = np.zeros(len(east))
    sigma_m = _sigma_m({name: values[fixed] for name, values in columns.items()})
    rotation = rotation_from_euler(zeros, zeros, np.arctan2(north, east))
    return Attitudes(stamp_s[fixed], rotation, sigma_m / np.maximum(np.hypot(east, north), 1e-3))
