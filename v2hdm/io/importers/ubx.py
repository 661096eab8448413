"""u-blox receivers' messages: as pyubx2 prints them, as JSON lines, or raw, which pyubx2 reads.

NAV-HPPOSLLH or NAV-PVT give positions, NAV-ATT, NAV-RELPOSNED of a moving base or NAV-PVT headings, NAV-PVT
the date. pyubx2 prints a message's time of the GPS week as the time of the day in UTC.
"""

from __future__ import annotations

import io
import logging
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import DriveError, need
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.importers.gps_time import SINCE_1970_S, WEEK_S, utc_of_week
from v2hdm.io.importers.nmea import take_date
from v2hdm.io.importers.readings import Attitudes, Readings, headings_only
from v2hdm.io.trajectory import in_order
from v2hdm.records import FloatArray
from v2hdm.safe.texts import parse_json, read_bytes

_log = logging.getLogger(__name__)

_DAY_S = 86400.0  # seconds of a day
_MESSAGES = ("NAV-PVT", "NAV-HPPOSLLH", "NAV-ATT", "NAV-RELPOSNED")
_PRINTED = re.compile(r"<UBX\((NAV-[A-Z]+), (.*?)\)>")
_FIELD = re.compile(r"(\w+)=([^,]*)")
_SYNC = b"\xb5\x62"
_FIXES = (3, 4)  # fixType: in three dimensions, and with dead reckoning beside it
_FIXED = 2  # carrSoln: ambiguities fixed
_UNSURE_DEG = 90.0  # accHeading of a heading that is not known yet is larger

Message = Mapping[str, Any]


def read_ubx(
    path: Path, entry: dict[str, Any], root: Path, where: str, near_s: float | None = None
) -> Readings:
    """Read the log at ``path``; messages that are damaged are left out and counted."""
    data = read_bytes(path, DriveError)
    messages: dict[str, list[Message]] = defaultdict(list)
    damaged = 0
    for message in _raw(data, path) if _SYNC in data else _texts(data, str(path)):
        try:
            identity = message["identity"]
            key_s = _key_s(message["iTOW"])
            numbers = {key: number for key in message if (number := _number(message[key])) is not None}
            messages[identity].append(numbers | {"key_s": key_s})
        except (KeyError, ValueError, TypeError, OverflowError):
            damaged += 1
    if damaged:
        _log.warning("%s: left out %d damaged messages", path, damaged)
    if not messages:
        raise DriveError(f"{path}: holds no {', '.join(_MESSAGES)}; log NAV-PVT and NAV-ATT or NAV-RELPOSNED")
    period_s = WEEK_S if _SYNC in data else _DAY_S
    day = take_date(entry["date"], f"{where}, date") if "date" in entry else None
    noon_s = None if day is None else datetime(day.year, day.month, day.day, 12, tzinfo=UTC).timestamp()
    clock = _clock(messages["NAV-PVT"], period_s, noon_s if noon_s is not None else near_s, str(path))
    positions = _rows(messages, _POSITIONS, clock)
    attitudes = _rows(messages, _ATTITUDES, clock)
    turned = None
    if len(attitudes):
        rows = in_order(attitudes[:, 0], str(path), "heading")
        stamp_s, *angles, sigma, tilt_sigma = attitudes[rows].T
        roll, pitch, heading = np.radians(angles)
        rotation = rotation_from_euler(roll, -pitch, np.pi / 2 - heading)
        turned = Attitudes(stamp_s, rotation, np.radians(sigma), np.radians(tilt_sigma))
    if not len(positions):
        return headings_only(turned)
    table = positions[in_order(positions[:, 0], str(path), "position")]
    solved = table[:, 5]
    is_fixed = None if np.isnan(solved).all() else solved == _FIXED
    return Readings(table[:, 0], table[:, 1:4], True, table[:, 4], turned, "an antenna's", is_fixed)


def _texts(data: bytes, where: str) -> Iterator[dict[str, Any]]:
    """Messages that pyubx2 printed, and those of JSON lines; one that cannot be read has no fields."""
    for line in data.decode("utf-8", errors="replace").splitlines():
        text = line.strip().rstrip(",")
        if text.startswith("{"):
            try:
                content = parse_json(text, where, DriveError)
            except DriveError:
                yield {}
                continue
            if isinstance(content, dict) and content.get("identity") in _MESSAGES:
                payload = content.get("payload")
                yield ({"identity": content["identity"]} | payload) if isinstance(payload, dict) else {}
            continue
        for identity, fields in _PRINTED.findall(line):
            if identity in _MESSAGES:
                yield {"identity": identity} | dict(_FIELD.findall(fields))


def _raw(data: bytes, path: Path) -> Iterator[dict[str, Any]]:
    pyubx2 = need("pyubx2", "ubx", f"{path}: a raw log of u-blox", DriveError)
    reader = pyubx2.UBXReader(io.BytesIO(data), protfilter=pyubx2.UBX_PROTOCOL, quitonerror=pyubx2.ERR_IGNORE)
    while True:
        try:
            raw, parsed = reader.read()
        except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError):
            yield {}
            continue
        if raw is None:
            return
        identity = getattr(parsed, "identity", "")
        if identity in _MESSAGES:
            yield {"identity": identity} | {
                key: value for key, value in vars(parsed).items() if not key.startswith("_")
            }


def _number(content: Any) -> float | None:
    """A field's number; None where it holds none."""
    try:
        value = float(content)
    except (TypeError, ValueError, OverflowError):
        return None
    return value if np.isfinite(value) else None


def _key_s(of_week: Any) -> float:
    """Seconds of the GPS week of a raw message, or of the day, UTC, of a printed one."""
    if not isinstance(of_week, str) or ":" not in of_week:
        key_s = float(of_week) / 1e3
    else:
        hours, minutes, seconds = of_week.split(":")
        key_s = 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds)
    if not 0 <= key_s <= WEEK_S:
        raise ValueError(of_week)
    return key_s


def _clock(
    solutions: list[Message], period_s: float, near_s: float | None, where: str
) -> Callable[[float], float]:
    """From a message's own seconds to UTC, s since 1970."""
    dated = [
        (solution["key_s"], stamp_s) for solution in solutions if (stamp_s := _dated(solution)) is not None
    ]
    if dated:
        keys, stamps = np.array(sorted(dated, key=lambda pair: pair[1])).T
        # Whole seconds: midnights, or beginnings of weeks less the leap seconds.
        bases = np.unique(np.round(stamps - keys))

        def of_dates(key_s: float) -> float:
            times = key_s + bases
            after = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1) if len(stamps) > 1 else 0
            apart_s = np.minimum(np.abs(stamps[after] - times), np.abs(stamps[after - 1] - times))
            return float(times[np.argmin(apart_s)])

        return of_dates
    if near_s is None or near_s < SINCE_1970_S:
        raise DriveError(f"{where}: no NAV-PVT states the date: add date, a day of the recording")
    if period_s == WEEK_S:
        return lambda key_s: float(utc_of_week(np.array([key_s]), None, near_s, False, where)[0])
    return lambda key_s: key_s + _DAY_S * round((near_s - key_s) / _DAY_S)


def _dated(solution: Message) -> float | None:
    """The UTC that a NAV-PVT states, s since 1970."""
    if not (solution.get("validDate", 1) and solution.get("validTime", 1)):
        return None
    try:
        parts = [int(solution[key]) for key in ("year", "month", "day", "hour", "min", "second")]
        leap = parts[5] == 60
        parts[5] -= leap
        stamp_s = datetime(*parts, tzinfo=UTC).timestamp()  # type: ignore[misc, arg-type]
    except (KeyError, ValueError, OverflowError):
        return None
    return stamp_s + leap + float(solution.get("nano", 0.0)) / 1e9


class _Maker(NamedTuple):
    """The row of a message, made with the NAV-PVT of its time, if any; None if the message is empty."""

    identity: str
    row: Callable[[Message, Message], tuple[float, ...] | None]


def _rows(
    messages: Mapping[str, list[Message]], makers: tuple[_Maker, ...], clock: Callable[[float], float]
) -> FloatArray:
    """Rows (N, V) of a time and values, of the first of ``makers`` that gives any."""
    solutions = {solution["key_s"]: solution for solution in messages["NAV-PVT"]}
    for maker in makers:
        rows = []
        for message in messages[maker.identity]:
            try:
                values = maker.row(message, solutions.get(message["key_s"], {}))
            except (KeyError, TypeError):  # a field that is not there, or is a text
                continue
            if values is not None and np.isfinite(values[:3]).all():
                rows.append((clock(message["key_s"]), *values))
        if rows:
            return np.array(rows)
    return np.zeros((0, 0))


def _position(message: Message, solution: Message) -> tuple[float, ...] | None:
    """Latitude, longitude, deg, height, m, the sigma of a coordinate, m, and the state of its ambiguities."""
    has_fix = solution.get("fixType", 3) in _FIXES and solution.get("gnssFixOk", 1)
    sigma_m = message["hAcc"] / 1e3 if has_fix else np.inf
    if message.get("invalidLlh", 0) or abs(message["lat"]) > 90 or abs(message["lon"]) > 180:
        return None
    solved = solution.get("carrSoln", np.nan)
    return message["lat"], message["lon"], message["height"] / 1e3, sigma_m, solved


def _attitude(message: Message, solution: Message) -> tuple[float, ...] | None:
    """Roll, pitch, heading, deg, and the sigmas of the heading and of both others, deg."""
    if not 0 < message["accHeading"] < _UNSURE_DEG:
        return None
    tilt_sigma = float(np.hypot(message["accRoll"], message["accPitch"]) / np.sqrt(2))
    return message["roll"], message["pitch"], message["heading"], message["accHeading"], tilt_sigma


def _baseline(message: Message, solution: Message) -> tuple[float, ...] | None:
    valid = message["relPosHeadingValid"] and message["relPosValid"] and message["isMoving"]
    if not valid or message["carrSoln"] != _FIXED:
        return None
    return 0.0, 0.0, message["relPosHeading"], message["accHeading"], np.nan


def _vehicle(message: Message, solution: Message) -> tuple[float, ...] | None:
    if not message["headVehValid"]:
        return None
    return 0.0, 0.0, message["headVeh"], message["headAcc"], np.nan


_POSITIONS = (_Maker("NAV-HPPOSLLH", _position), _Maker("NAV-PVT", _position))
_ATTITUDES = (_Maker("NAV-ATT", _attitude), _Maker("NAV-RELPOSNED", _baseline), _Maker("NAV-PVT", _vehicle))
