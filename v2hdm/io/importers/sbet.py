"""Smoothed best estimates of trajectory (Applanix POSPac): SBET, and the accuracies of its RMS file.

Both are records of doubles without a header: 17 in an SBET, 10 in an ``smrmsg``. Angles of the SBET are
radians in north-east-down, those of the other minutes of arc. The heading is the platform's less the wander
angle.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.importers.gps_time import unwrapped, utc_of_week
from v2hdm.io.importers.nmea import take_date
from v2hdm.io.importers.readings import Attitudes, Readings
from v2hdm.io.trajectory import in_order
from v2hdm.records import BoolArray, FloatArray
from v2hdm.safe.texts import read_bytes
from v2hdm.store.files import take_choice, take_text

_log = logging.getLogger(__name__)

_FIELDS = 17  # time, latitude, longitude, altitude, 3 velocities, roll, pitch, heading, wander, 6 of the IMU
_RMS_FIELDS = 10  # time, north, east, down, 3 velocities, roll, pitch, heading
_MOST = 0.9  # share of records that have to make sense
_HIGHEST_M = 1e5  # no vehicle is higher, or deeper
_LONGEST_S = 1.3e6  # two weeks: later times are no seconds of the week
_MINUTE_RAD = float(np.radians(1 / 60))  # a minute of arc, the unit of the attitude's RMS, rad
CLOCKS = ("gps", "utc")


def read_sbet(
    path: Path, entry: dict[str, Any], root: Path, where: str, near_s: float | None = None
) -> Readings:
    """Read the SBET at ``path`` and, if ``entry`` names one, its RMS file under ``root``.

    The week is that of ``date``, or else that of ``near_s``. Records that make no sense are left out and
    counted. Raises DriveError for a file that is none.
    """
    day = take_date(entry["date"], f"{where}, date") if "date" in entry else None
    clock = take_choice(entry.get("clock", CLOCKS[0]), CLOCKS, f"{where}, clock", DriveError)
    table = _sound(path, _FIELDS, "SBET")
    going_on_s = unwrapped(table[:, 0])
    rows = in_order(going_on_s, str(path), "record")
    table = table[rows]
    going_on_s = going_on_s[rows]
    stamp_s = utc_of_week(going_on_s, day, near_s, clock == "utc", where)
    roll, pitch, platform_rad, wander_rad = table[:, 7:11].T
    rotation = rotation_from_euler(roll, -pitch, np.pi / 2 - (platform_rad - wander_rad))
    points = np.column_stack([np.degrees(table[:, 1:3]), table[:, 3]])
    points[:, 1] = (points[:, 1] + 180) % 360 - 180
    sigma_m, tilt_sigma_rad, heading_sigma_rad = np.full((3, len(table)), np.nan)
    if "rms" in entry:
        rms = root / take_text(entry["rms"], f"{where}, rms", DriveError)
        sigma_m, tilt_sigma_rad, heading_sigma_rad = _sigmas(rms, going_on_s)
    attitudes = Attitudes(stamp_s, rotation, heading_sigma_rad, tilt_sigma_rad)
    return Readings(stamp_s, points, True, sigma_m, attitudes, point="the IMU's, or its reference point's,")


def _sigmas(path: Path, stamp_s: FloatArray) -> FloatArray:
    """Sigmas (3, N) at seconds of the week: of a coordinate, m, of roll and pitch, of the heading, rad."""
    table = _sound(path, _RMS_FIELDS, "RMS file")
    going_on_s = unwrapped(table[:, 0])
    rows = in_order(going_on_s, str(path), "record")
    table = table[rows]
    values = [
        np.hypot(table[:, 1], table[:, 2]) / np.sqrt(2),
        _MINUTE_RAD * np.hypot(table[:, 7], table[:, 8]) / np.sqrt(2),
        _MINUTE_RAD * table[:, 9],
    ]
    inside = (stamp_s >= going_on_s[rows][0]) & (stamp_s <= going_on_s[rows][-1])
    if not inside.any():
        raise DriveError(f"{path}: none of its times is one of the SBET's; give the RMS file of this one")
    sigmas = [np.interp(stamp_s, going_on_s[rows], value, left=np.nan, right=np.nan) for value in values]
    return np.array(sigmas)


def _sound(path: Path, fields: int, kind: str) -> FloatArray:
    """The records (N, ``fields``) that make sense, of either order of bytes."""
    data = read_bytes(path, DriveError)
    size = 8 * fields
    count = len(data) // size
    if not count:
        raise DriveError(f"{path}: {len(data)} bytes are no {kind}, which has {size} bytes a record")
    if cut := len(data) % size:
        _log.warning("%s: its last record is cut: left out %d bytes of %d", path, cut, len(data))
    check = _is_sbet if fields == _FIELDS else _is_rms
    for order in ("<", ">"):
        table = np.frombuffer(data, f"{order}f8", count * fields).reshape(count, fields).astype(np.float64)
        with np.errstate(invalid="ignore"):
            sound = np.isfinite(table).all(axis=1) & check(table)
        if sound.mean() >= _MOST:
            if not sound.all():
                _log.warning("%s: left out %d of %d damaged records", path, int((~sound).sum()), count)
            return table[sound]
    degrees = ""
    first = np.frombuffer(data, "<f8", fields)
    if fields == _FIELDS and np.pi / 2 < abs(first[1]) <= 90 and abs(first[2]) <= 360:
        degrees = "; its angles look like degrees: export it in radians"
    raise DriveError(
        f"{path}: is no {kind} of {fields} doubles a record{degrees or '; check which file it is'}"
    )


def _is_sbet(table: FloatArray) -> BoolArray:
    time_s, latitude, longitude, height_m = np.abs(table[:, :4]).T
    turned = (np.abs(table[:, 7:9]) <= np.pi).all(axis=1) & (np.abs(table[:, 9:11]) <= 4 * np.pi).all(axis=1)
    on_earth = (latitude <= np.pi / 2) & (longitude <= 2 * np.pi) & (height_m <= _HIGHEST_M)
    in_week = (table[:, 0] >= 0) & (time_s <= _LONGEST_S)
    return np.asarray(in_week & on_earth & turned)


def _is_rms(table: FloatArray) -> BoolArray:
    in_week = (table[:, 0] >= 0) & (table[:, 0] <= _LONGEST_S)
    return np.asarray(in_week & (table[:, 1:] >= 0).all(axis=1) & (table[:, 1:] < 1e4).all(axis=1))
