"""Poses in a receiver's NMEA 0183 log.

GGA gives positions and their quality, GST their standard deviations, RMC or ZDA the date, HDT, THS or PASHR
the heading; HDT and THS, which have no time, belong to the sentence before them. A course over ground is no
heading.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from datetime import UTC, date, datetime
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.importers.tables import SIGMA_OF_QUALITY_M, Attitudes, Readings, parse_sigma
from v2hdm.io.safe.texts import read_bytes, shown
from v2hdm.io.trajectory import in_order
from v2hdm.records import FloatArray
from v2hdm.store.files import take_text

KEYS = ("date",)

_log = logging.getLogger(__name__)

_DAY_S = 86400.0


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
        raise DriveError(f"{where}: {bad} of {total} NMEA sentences are damaged; record the log anew")
    return log.readings(first_day)


class _Log:
    """Sentences so far; times are seconds of the day until the date is known."""

    def __init__(self, where: str) -> None:
        self._where, self._day, self._above_sea = where, 0, False
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
            self._sigma_m[stamp] = float(
                np.hypot(parse_sigma(fields[6]), parse_sigma(fields[7])) / np.sqrt(2)
            )
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
            raise DriveError(f"{self._where}: no RMC or ZDA sentence tells the date: {advice}")
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
