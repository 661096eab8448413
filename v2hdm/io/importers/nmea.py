"""Receivers' logs of NMEA 0183 sentences: positions, headings and their sigmas on one clock.

GGA, GNS, GGK or KSXT give positions, GST their standard deviations, RMC, ZDA and others the date, HDT, THS,
HDG, PASHR, PSAT, AVR, VHD or KSXT headings. A course over ground is no heading. HDT, THS and HDG have no
time: :mod:`v2hdm.io.importers.epochs` finds it from the sentences around them.
"""

from __future__ import annotations

import logging
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.geodetic import metres_between
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.importers.epochs import Untimed, time_headings
from v2hdm.io.importers.gps_time import SINCE_1970_S
from v2hdm.io.importers.readings import (
    RTK_FIXED,
    SIGMA_OF_QUALITY_M,
    Attitudes,
    Readings,
    parse_sigma,
)
from v2hdm.io.trajectory import in_order
from v2hdm.records import FloatArray
from v2hdm.safe.texts import read_bytes, shown
from v2hdm.store.files import take_text

_log = logging.getLogger(__name__)

_DAY_S = 86400.0  # seconds of a day
_BELATED_S = 60.0  # a sentence from before midnight may come that long after one from behind it
_APART_M = 0.05  # antennas of two receivers are farther apart; RTK noise and rounding are less
_SWITCHES = 0.05  # share of positions before which one receiver changes its talker, as satellites come
_COMPASS_DEG = 2.0  # standard deviation of a magnetic compass with its variation; chosen

_OF_TRIMBLE: Mapping[int, int] = {0: 0, 1: 1, 2: 5, 3: 4, 4: 2, 5: 9, 6: 5, 7: 4, 8: 5}
"""The quality of GGA for that of Trimble's GGK, AVR and VHD (manual of the BD9xx receivers)."""

_OF_UNICORE: Mapping[int, int] = {0: 0, 1: 1, 2: 5, 3: 4}
"""The quality of GGA for that of Unicore's KSXT (its manual of sentences)."""

_FIXED = 3  # quality of a heading by fixed ambiguities: Trimble's and Unicore's number
_MODES: Mapping[str, int] = {"N": 0, "A": 1, "D": 2, "P": 3, "R": 4, "F": 5, "E": 6, "M": 7, "S": 8}
"""The quality of GGA for a mode of GNS, one letter per constellation (NMEA 0183, 4.11)."""

_SENTENCE = re.compile(r"\$([A-Z]{2}[A-Z0-9]{2,8},[^$]*)")
_UNIX = re.compile(r"(?<![\d.:-])(1\d{9}(?:\.\d+)?)(?![\d])")
_CLOCK = re.compile(r"(?<!\d)(\d\d):(\d\d):(\d\d(?:[.,]\d+)?)")


def read_nmea(
    path: Path, entry: dict[str, Any], root: Path, where: str, near_s: float | None = None
) -> Readings:
    """Read the log at ``path``; damaged sentences are left out and counted, and refused if they prevail.

    Where neither the log nor ``entry`` states a day, it is the one by which the log lies about ``near_s``, a
    time of the drive.
    """
    data = read_bytes(path, DriveError)
    # PowerShell's > writes UTF-16.
    form = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "ascii"
    lines = data.decode(form, errors="replace").splitlines()
    first = take_date(entry["date"], f"{where}, date") if "date" in entry else None
    talker = take_text(entry["talker"], f"{where}, talker", DriveError) if "talker" in entry else None
    return nmea_readings(lines, str(path), first, talker, dated(near_s))


def dated(near_s: float | None) -> float | None:
    """A time of the drive if it counts from 1970, so that it has a day; else None."""
    return near_s if near_s is not None and near_s > SINCE_1970_S else None


def take_date(content: object, where: str) -> date:
    """The day that ``content`` states; DriveError where it states none."""
    day = take_text(content, where, DriveError)
    try:
        return date.fromisoformat(day)
    except ValueError:
        raise DriveError(f"{where}: expected a day such as 2024-05-17, got {shown(day)}") from None


def nmea_readings(
    lines: Iterable[str],
    where: str,
    first_day: date | None = None,
    talker: str | None = None,
    near_s: float | None = None,
) -> Readings:
    """Readings of sentences in the order of the log, from ``first_day`` on where none has a date.

    Without either they lie about ``near_s``, s since 1970. ``talker``, two letters, chooses the receiver of
    several.
    """
    log = _Log(where)
    sentences = list(_sentences(lines))
    summed = {sentence.address for sentence in sentences if sentence.has_sum}
    bad = 0
    for sentence in sentences:
        try:
            if not sentence.sound or (not sentence.has_sum and sentence.address in summed):
                raise ValueError(sentence.address)
            log.take(sentence)
        except (ValueError, IndexError, OverflowError):
            bad += 1
    if bad:
        _log.warning("%s: left out %d of %d damaged sentences", where, bad, len(sentences))
    if 2 * bad > len(sentences):
        raise DriveError(
            f"{where}: {bad} of {len(sentences)} NMEA sentences are damaged; record the log again"
        )
    return log.readings(first_day, talker, near_s)


class _Sentence(NamedTuple):
    """One sentence of a log."""

    fields: list[str]  # without $ and checksum
    sound: bool  # whether its checksum is that of its letters, or there is none
    has_sum: bool
    received_s: float | None  # when the logger got it, s of a clock of its own; None where it does not say

    @property
    def address(self) -> str:
        """Talker and type, such as GNGGA."""
        return self.fields[0]


def _sentences(lines: Iterable[str]) -> Iterator[_Sentence]:
    """All sentences of the ``lines``; one that was cut may have the next one behind it."""
    for line in lines:
        before, dollar, _ = line.partition("$")
        if not dollar:
            continue
        received_s = _received(before) if before else None
        for body in _SENTENCE.findall(line):
            letters, star, check = body.rstrip().partition("*")
            if not star:
                yield _Sentence(letters.split(","), True, False, received_s)
                continue
            expected = f"{reduce(xor, map(ord, letters), 0):02X}"
            # Unicore and ComNav end their own sentences with a CRC of 32 bits.
            sound = len(check) == 8 or expected == check[:2].upper()
            yield _Sentence(letters.split(","), sound, True, received_s)


def _received(before: str) -> float | None:
    """The time, s, in what a logger put before a sentence: of Unix, or of the day; None without."""
    if unix := _UNIX.search(before):
        return float(unix[1])
    if not (clock := _CLOCK.search(before)):
        return None
    return 3600.0 * int(clock[1]) + 60.0 * int(clock[2]) + float(clock[3].replace(",", "."))


class _Attitude(NamedTuple):
    """A heading from true north, and roll and pitch as receivers count them, deg; their sigmas, deg."""

    heading: float
    roll: float = 0.0  # left side up
    pitch: float = 0.0  # bow up
    sigma: float = np.nan
    tilt_sigma: float = np.nan


class _Fix(NamedTuple):
    """A position, its height nan where it has none, or counts from the sea where ``geoid_m`` is nan."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    geoid_m: float
    quality: int


@dataclass
class _Source:
    """Positions of one talker by their times, and how far those of equal times lay apart, m."""

    fixes: dict[float, _Fix] = field(default_factory=dict)
    sigma_m: dict[float, float] = field(default_factory=dict)
    apart_m: list[float] = field(default_factory=list)

    def put(self, stamp: float, fix: _Fix) -> None:
        other = self.fixes.setdefault(stamp, fix)
        if other is not fix and (apart_m := _apart(other, fix)) > _APART_M:
            self.apart_m.append(apart_m)

    @property
    def is_rtk(self) -> bool:
        return any(fix.quality in (4, 5) for fix in self.fixes.values())


class _Log:
    """Sentences so far; times are seconds of the day until the date is known."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._time_s: float | None = None
        self._first_dates: Counter[date] = Counter()
        self._positions: dict[str, dict[str, _Source]] = defaultdict(lambda: defaultdict(_Source))
        self._timed: dict[str, dict[float, _Attitude]] = defaultdict(dict)
        self._untimed: dict[str, list[Untimed]] = defaultdict(list)
        self._epochs: list[Untimed] = []
        self._magnetic = 0
        self._count = 0
        self._takers: Mapping[str, Callable[[_Sentence], None]] = {
            "GGA": self._gga, "GNS": self._gns, "RMC": self._rmc, "ZDA": self._zda, "GST": self._gst,
            "HDT": self._hdt, "THS": self._ths, "HDG": self._hdg, "PASHR": self._pashr, "KSXT": self._ksxt,
            "PTNL": self._ptnl, "PSAT": self._psat,
        }  # fmt: skip

    def take(self, sentence: _Sentence) -> None:
        """One sentence; ValueError or IndexError where it is damaged."""
        address = sentence.address
        self._count += 1
        taker = self._takers.get(address if address in self._takers else address[-3:])
        if taker is not None:
            taker(sentence)

    def _gga(self, sentence: _Sentence) -> None:
        self._position(sentence, int(sentence.fields[6] or 0), 11)

    def _gns(self, sentence: _Sentence) -> None:
        quality = max((_MODES[mode] for mode in sentence.fields[6]), default=0, key=_sureness)
        self._position(sentence, quality, 10)

    def _position(self, sentence: _Sentence, quality: int, geoid: int) -> None:
        """Take the position of a GGA or GNS, whose field ``geoid`` is the geoid's height."""
        fields = sentence.fields
        stamp = self._time(fields[1], sentence)
        if quality and fields[2]:
            source = self._positions[sentence.address[-3:]][sentence.address[:2]]
            source.put(stamp, _above(fields[2:6], fields[9], fields[geoid], quality))

    def _rmc(self, sentence: _Sentence) -> None:
        fields = sentence.fields
        self._time(fields[1], sentence)
        if fields[9]:
            # Without a fix the receiver has no date yet.
            self._dated(datetime.strptime(fields[9], "%d%m%y").date(), 1 if fields[2] == "V" else 1000)

    def _zda(self, sentence: _Sentence) -> None:
        fields = sentence.fields
        self._time(fields[1], sentence)
        if fields[4]:
            self._dated(date(int(fields[4]), int(fields[3]), int(fields[2])), 100)

    def _gst(self, sentence: _Sentence) -> None:
        stamp = self._time(sentence.fields[1], sentence)
        sigma_m = float(
            np.hypot(parse_sigma(sentence.fields[6]), parse_sigma(sentence.fields[7])) / np.sqrt(2)
        )
        for kind in ("GGA", "GNS"):
            self._positions[kind][sentence.address[:2]].sigma_m[stamp] = sigma_m or np.nan

    def _hdt(self, sentence: _Sentence) -> None:
        if sentence.fields[1]:
            self._heading(sentence, _Attitude(_angle(sentence.fields[1])))

    def _ths(self, sentence: _Sentence) -> None:
        # Its modes: autonomous, estimated, manual, simulated, and V for invalid.
        if sentence.fields[1] and sentence.fields[2] not in ("V", "M", "S"):
            self._heading(sentence, _Attitude(_angle(sentence.fields[1])))

    def _hdg(self, sentence: _Sentence) -> None:
        _, heading, deviation, _, variation = sentence.fields[:5]
        if not heading:
            return
        if not variation:
            self._magnetic += 1
            return
        east = {"E": 1.0, "W": -1.0, "": 0.0}
        true = (
            _angle(heading)
            + east[sentence.fields[3]] * _number(deviation or "0")
            + east[sentence.fields[5]] * _number(variation)
        )
        self._heading(sentence, _Attitude(true, sigma=_COMPASS_DEG))

    def _pashr(self, sentence: _Sentence) -> None:
        fields = sentence.fields
        if len(fields) < 4 or not fields[2] or fields[3] != "T":
            return
        stamp = self._time(fields[1], sentence)
        tilt_sigma = float(np.hypot(parse_sigma(fields[7]), parse_sigma(fields[8])) / np.sqrt(2))
        roll = _angle(fields[4] or "0")
        pitch = _angle(fields[5] or "0")
        attitude = _Attitude(_angle(fields[2]), roll, pitch, parse_sigma(fields[9]), tilt_sigma)
        self._timed[sentence.address][stamp] = attitude

    def _psat(self, sentence: _Sentence) -> None:
        if sentence.fields[1] != "HPR":
            return
        time, heading, pitch, roll = sentence.fields[2:6]
        stamp = self._time(time, sentence)
        if heading:  # Hemisphere's manual counts roll and pitch as PASHR does
            self._timed["PSAT,HPR"][stamp] = _tilted(heading, roll, pitch)

    def _ksxt(self, sentence: _Sentence) -> None:
        fields = sentence.fields
        stamp = self._time(fields[1][8:], sentence)
        self._dated(datetime.strptime(fields[1][:8], "%Y%m%d").date(), 100)
        quality = _OF_UNICORE.get(int(fields[10] or 0), 0)
        if quality and fields[3]:
            place = _on_earth(_number(fields[3]), _number(fields[2]))
            fix = _Fix(*place, _number(fields[4] or "nan", True), np.nan, quality)
            self._positions["KSXT"][sentence.address].put(stamp, fix)
        if fields[5] and int(fields[11] or 0) == _FIXED:
            self._timed[sentence.address][stamp] = _tilted(fields[5], fields[9], fields[6])

    def _ptnl(self, sentence: _Sentence) -> None:
        kind, *fields = sentence.fields[1:]
        if kind == "GGK":
            stamp = self._time(fields[0], sentence)
            self._dated(datetime.strptime(fields[1], "%m%d%y").date(), 100)
            quality = _OF_TRIMBLE.get(int(fields[6] or 0), 0)
            if quality and fields[2]:
                height_m = _number(fields[9].lstrip("EHTGA") or "nan", True)
                geoid_m = 0.0 if fields[9].startswith("EHT") else np.nan
                fix = _Fix(*_place(fields[2:6]), height_m, geoid_m, quality)
                self._positions["GGK"]["PTNL"].put(stamp, fix)
        elif kind == "AVR":
            stamp = self._time(fields[0], sentence)
            if fields[1] and int(fields[8] or 0) == _FIXED:
                self._timed["PTNL,AVR"][stamp] = _tilted(fields[1], fields[5], fields[3])
        elif kind == "VHD":
            stamp = self._time(fields[0], sentence)
            self._dated(datetime.strptime(fields[1], "%m%d%y").date(), 100)
            if fields[2] and int(fields[8] or 0) == _FIXED:
                self._timed["PTNL,VHD"][stamp] = _Attitude(_angle(fields[2]))

    def _heading(self, sentence: _Sentence, attitude: _Attitude) -> None:
        """One without a time, at its place among those that have one."""
        self._untimed[sentence.address].append(
            Untimed(self._count, self._time_s, sentence.received_s, (attitude.heading, attitude.sigma))
        )

    def _time(self, text: str, sentence: _Sentence) -> float:
        """``hhmmss.sss`` in s since the first day's midnight; past midnight a new day begins."""
        if not (text[:6].isdigit() and int(text[:2]) < 24 and int(text[2:4]) < 60 and int(text[4:6]) < 61):
            raise ValueError(text)
        stamp = 3600.0 * int(text[:2]) + 60.0 * int(text[2:4]) + _number(text[4:])
        if self._time_s is not None:
            stamp += _DAY_S * (self._time_s // _DAY_S)
            if stamp < self._time_s - _DAY_S / 2:
                stamp += _DAY_S
            elif stamp > self._time_s + _DAY_S - _BELATED_S:
                stamp -= _DAY_S
        self._time_s = stamp
        self._epochs.append(Untimed(self._count, stamp, sentence.received_s, ()))
        return stamp

    def _dated(self, today: date, weight: int) -> None:
        assert self._time_s is not None
        first = today.toordinal() - int(self._time_s // _DAY_S)
        if first > 0:
            self._first_dates[date.fromordinal(first)] += weight

    def readings(self, first_day: date | None, talker: str | None, near_s: float | None) -> Readings:
        """All of it on one clock, seconds since 1970 UTC."""
        if not any(source.fixes for sources in self._positions.values() for source in sources.values()):
            raise DriveError(f"{self._where}: no GGA sentence with a position; log GGA and HDT, THS or PASHR")
        begin_s = self._begin(first_day, near_s)
        chosen = self._receiver(talker)
        stamps = np.array(list(chosen.source.fixes))
        rows = in_order(stamps, self._where, "fix")
        fixes = np.array(list(chosen.source.fixes.values()), dtype=np.float64)[rows]
        stated = np.array([chosen.source.sigma_m.get(stamp, np.nan) for stamp in chosen.source.fixes])[rows]
        of_quality = np.array([SIGMA_OF_QUALITY_M.get(int(quality), np.inf) for quality in fixes[:, 4]])
        # The receiver's own figure counts as far as there is a fix at all.
        sigma_m = np.where(np.isfinite(stated) & np.isfinite(of_quality), stated, of_quality)
        points = np.column_stack([fixes[:, :2], self._heights(fixes[:, 2], fixes[:, 3])])
        has_height = np.isfinite(points[:, 2])
        attitudes = self._attitudes(chosen.others, begin_s)
        is_fixed = fixes[:, 4] == RTK_FIXED
        return Readings(
            (begin_s + stamps[rows])[has_height], points[has_height], True, sigma_m[has_height], attitudes,
            point="an antenna's", is_fixed=is_fixed[has_height],
        )  # fmt: skip

    def _begin(self, first_day: date | None, near_s: float | None) -> float:
        """The first day's midnight, s since 1970."""
        dates = self._first_dates.most_common(1)
        day = dates[0][0] if dates else first_day
        if day is None and near_s is not None:
            # A log from before midnight may belong to images from behind it, or the other way round.
            middle_s = float(
                np.median([epoch.stamp_s for epoch in self._epochs if epoch.stamp_s is not None])
            )
            return _DAY_S * round((near_s - middle_s) / _DAY_S)
        if day is None:
            advice = "add date, the day of the first sentence"
            raise DriveError(f"{self._where}: no RMC or ZDA sentence states the date: {advice}")
        return datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()

    def _heights(self, height_m: FloatArray, geoid_m: FloatArray) -> FloatArray:
        """Heights (N,) above the ellipsoid as far as the log states the geoid's."""
        if np.isnan(height_m).all():
            _log.warning("%s: its positions have no heights; taken as 0 m", self._where)
            return np.zeros(len(height_m))
        if not np.isnan(geoid_m).any():
            return height_m
        if np.isnan(geoid_m).all():
            _log.warning(
                "%s: its heights count from the sea, and GGA does not say where that is; add geoid_m if the "
                "map is to have heights above the ellipsoid", self._where,
            )  # fmt: skip
            return height_m
        return np.where(np.isnan(geoid_m), height_m + float(np.nanmedian(geoid_m)), height_m)

    def _receiver(self, talker: str | None) -> _Receiver:
        """Positions of one receiver, and the talkers of others."""
        kind, sources = next(
            (kind, {name: source for name, source in self._positions[kind].items() if source.fixes})
            for kind in ("GGA", "GNS", "GGK", "KSXT")
            if any(source.fixes for source in self._positions[kind].values())
        )
        if talker is not None:
            if talker not in sources:
                raise DriveError(
                    f"{self._where}: no positions of talker {shown(talker)}; it has: {', '.join(sources)}"
                )
            return _Receiver(self._alone(sources[talker], kind), set(sources) - {talker})
        by_count = sorted(sources, key=lambda name: -len(sources[name].fixes))
        first = sources[by_count[0]]
        for name in by_count[1:]:
            apart_m = _apart_at_once(first, sources[name])
            if apart_m is None:  # one receiver that changes its talker, or states all positions twice
                for stamp, fix in sources[name].fixes.items():
                    first.fixes.setdefault(stamp, fix)
                first.fixes = dict(sorted(first.fixes.items()))
                first.sigma_m = sources[name].sigma_m | first.sigma_m
                continue
            rtk = [name for name in by_count if sources[name].is_rtk]
            if len(rtk) != 1:
                raise DriveError(
                    f"{self._where}: holds positions of two receivers, {by_count[0]} and {name}, "
                    f"{apart_m:.2g} m apart: add talker: {by_count[0]} or {name}, whose antenna "
                    "lever_arm_m is of"
                )
            others = set(sources) - set(rtk)
            _log.warning(
                "%s: two receivers, %s and %s, %.2g m apart: taking %s, which alone has RTK fixes",
                self._where, by_count[0], name, apart_m, rtk[0],
            )  # fmt: skip
            return _Receiver(self._alone(sources[rtk[0]], kind), others)
        return _Receiver(self._alone(first, kind), set())

    def _alone(self, source: _Source, kind: str) -> _Source:
        """The source, if its positions come from one receiver."""
        if len(source.apart_m) > _SWITCHES * len(source.fixes):
            raise DriveError(
                f"{self._where}: two {kind} positions at one time, {np.median(source.apart_m):.2g} m apart: "
                "two receivers in one log, which call themselves alike; log each into a file of its own"
            )
        return source

    def _attitudes(self, others: set[str], begin_s: float) -> Attitudes | None:
        """Headings of one source, rather of one that states their times, and not of an other receiver."""
        counts = {name: len(rows) for name, rows in (*self._timed.items(), *self._untimed.items()) if rows}
        if not counts:
            if self._magnetic:
                _log.warning("%s: its HDG headings are magnetic and have no variation: not used", self._where)
            return None
        count_of_source = {name: count for name, count in counts.items() if name[:2] not in others} or counts
        most = max(count_of_source.values())
        frequent = [name for name in count_of_source if 2 * count_of_source[name] >= most]
        compass = [name for name in frequent if name.endswith("HDG")]
        frequent = sorted(set(frequent) - set(compass)) or compass
        chosen = max(frequent, key=lambda name: (name in self._timed, count_of_source[name]))
        if len(counts) > 1:
            _log.info("%s: headings of %s, of %s", self._where, chosen, ", ".join(counts))
        if chosen in self._timed:
            stamps = np.array(list(self._timed[chosen]))
            rows = in_order(stamps, self._where, "heading")
            table = np.array(list(self._timed[chosen].values()))[rows]
            return _attitudes_of(begin_s + stamps[rows], table)
        timed = time_headings(self._untimed[chosen], self._epochs, f"{self._where}: {chosen}")
        if timed is None:
            return None
        zeros = np.zeros(len(timed.stamp_s))
        table = np.column_stack([timed.values[:, 0], zeros, zeros, timed.values[:, 1], zeros + np.nan])
        attitudes = _attitudes_of(begin_s + timed.stamp_s, table)
        if timed.later_s is None:
            return attitudes
        return Attitudes(
            attitudes.stamp_s, attitudes.rotation, attitudes.sigma_rad, later_s=begin_s + timed.later_s
        )


class _Receiver(NamedTuple):
    """The positions of one receiver, and the talkers of the others in the log."""

    source: _Source
    others: set[str]


def _attitudes_of(stamp_s: FloatArray, table: FloatArray) -> Attitudes:
    heading, roll, pitch, sigma, tilt_sigma = np.radians(table).T
    # Roll to starboard is left side up, as ours; pitch counts bow up, ours nose down.
    rotation = rotation_from_euler(roll, -pitch, np.pi / 2 - heading)
    return Attitudes(stamp_s, rotation, sigma, tilt_sigma)


def _sureness(quality: int) -> float:
    return -SIGMA_OF_QUALITY_M.get(quality, np.inf)


def _tilted(heading: str, roll: str, pitch: str) -> _Attitude:
    """An attitude of two antennas; roll and pitch count only together."""
    if roll and pitch:
        return _Attitude(_angle(heading), _angle(roll), _angle(pitch))
    return _Attitude(_angle(heading))


def _number(text: str, may_lack: bool = False) -> float:
    """The number in a field; ValueError where it is not finite, unless it ``may_lack``."""
    value = float(text)
    if not np.isfinite(value) and not (may_lack and text == "nan"):
        raise ValueError(text)
    return value


def _angle(text: str) -> float:
    """An angle in degrees; ValueError where it is beyond a full turn."""
    if abs(degrees := _number(text)) > 360:
        raise ValueError(text)
    return degrees


def _place(fields: list[str]) -> tuple[float, float]:
    """Latitude and longitude, deg, of ``ddmm.mmmm``, N or S, ``dddmm.mmmm``, E or W."""
    return _on_earth(_degrees(fields[0], fields[1], "NS"), _degrees(fields[2], fields[3], "EW"))


def _on_earth(latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    if abs(latitude_deg) > 90 or abs(longitude_deg) > 180:
        raise ValueError(latitude_deg)
    return latitude_deg, longitude_deg


def _above(place: list[str], above_sea: str, geoid: str, quality: int) -> _Fix:
    """A position with its height above the ellipsoid, where both parts of it are stated."""
    geoid_m = _number(geoid or "nan", True)
    height_m = _number(above_sea or "nan", True) + (0.0 if np.isnan(geoid_m) else geoid_m)
    return _Fix(*_place(place), height_m, geoid_m, quality)


def _degrees(text: str, side: str, sides: str) -> float:
    point = text.index(".") if "." in text else len(text)
    minutes = _number(text[point - 2 :])
    degrees = _number(text[: point - 2] or "0") + minutes / 60
    if side not in tuple(sides) or not 0 <= minutes < 60:
        raise ValueError(side)
    return -degrees if side == sides[1] else degrees


def _apart(fix: _Fix, other: _Fix) -> float:
    """Distance of two positions on the ground, m."""
    return float(metres_between(np.array([fix[:2]]), np.array([other[:2]]))[0])


def _apart_at_once(source: _Source, other: _Source) -> float | None:
    """The distance of two receivers, m; None if both sources are the same receiver."""
    shared_stamps = sorted(set(source.fixes) & set(other.fixes))
    if shared_stamps:
        pairs = np.array([(*source.fixes[stamp][:2], *other.fixes[stamp][:2]) for stamp in shared_stamps])
        apart_m = float(np.median(metres_between(pairs[:, :2], pairs[:, 2:])))
        return apart_m if apart_m > _APART_M else None
    owner = [stamp in source.fixes for stamp in sorted({*source.fixes, *other.fixes})]
    switches = int(np.count_nonzero(np.diff(owner)))
    if switches <= max(1, _SWITCHES * len(owner)):
        return None
    stamps, places = _line(source)
    stamps_of_other, places_of_other = _line(other)
    at = np.column_stack([np.interp(stamps_of_other, stamps, axis) for axis in places.T])
    apart_m = float(np.median(metres_between(places_of_other, at)))
    return apart_m if apart_m > _APART_M else None


def _line(source: _Source) -> tuple[FloatArray, FloatArray]:
    stamps = sorted(source.fixes)
    return np.array(stamps), np.array([source.fixes[stamp][:2] for stamp in stamps])
