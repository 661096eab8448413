"""Times and numbers in the names of images, and times in lists: read exactly, or not at all.

A text that has two readings, such as ``12.5`` (12.5 s, or 12 s and 5 ns), is a time only if its neighbours
decide between them. Names without a time give an order only if all readings of their numbers agree on it.
"""

from __future__ import annotations

import re
from calendar import timegm
from collections import defaultdict
from collections.abc import Sequence
from datetime import timedelta
from decimal import Decimal
from itertools import pairwise
from time import strptime
from typing import NamedTuple

import numpy as np

from v2hdm.errors import DriveError, shown
from v2hdm.records import FloatArray

_POWERS = {"s": 0, "ms": 3, "us": 6, "ns": 9}  # of ten, which divide a time in this unit into s
_UNIT_OF_DIGITS = {13: "ms", 16: "us", 19: "ns"}  # whole times since 1970 have as many, from 2001 to 2286
_FRACTIONS = (3, 6, 9)  # digits of a fraction that programs write: ms, us, ns
_FULL_SHARE = 0.75  # of numbers without zeros before them have the most digits: nine tenths, if even
_QUICKEST_S = 0.002  # least median time from image to image, chosen: quicker "fractions" count images
_MOST_CAMERAS = 12  # of a vehicle in one folder, chosen: more series than that are no cameras
_ZONE = re.compile(r"utc(?:([+-])([01][0-9]):([0-5][0-9]))?")
ZONES = "utc, or utc+01:00 where the camera's clock is one hour ahead"
_ADVICE = "add stamps, a file with one time in s per line"

_DATE = re.compile(
    r"(?<![0-9])(?P<year>(?:19|20)[0-9]{2})(?P<a>[-_.]?)(?P<month>[0-9]{2})(?P=a)(?P<day>[0-9]{2})"
    r"(?:[Tt]|[-_. ]{1,3}| at )?"
    r"(?P<hour>[0-9]{2})(?P<b>[-_.:h]?)(?P<minute>[0-9]{2})(?:(?P=b)|(?<=h[0-9]{2})m)(?P<second>[0-9]{2})s?"
    r"(?:(?P<point>[-_.,]?)(?P<fraction>[0-9]{1,9}))?(?P<zone>[Zz]|[+-][0-9]{2}[-_:.]?[0-9]{2})?(?![0-9])"
)
_DATE_KEYS = ("year", "month", "day", "hour", "minute", "second")
_SPLIT = re.compile(
    r"(?<![0-9.])(?P<whole>[0-9]{10})(?P<point>[._,-])(?P<fraction>[0-9]{1,9})(?![0-9]|\.[0-9])"
)
_WHOLE = re.compile(r"(?<![0-9.])(?:[0-9]{19}|[0-9]{16}|[0-9]{13})(?![0-9]|\.[0-9])")
_PLAIN = re.compile(r"(?P<whole>-?[0-9]+)(?:\.(?P<fraction>[0-9]+))?")
_SECONDS = re.compile(r"[12][0-9]{9}")  # since 1970, from 2001 to 2065
_SPLIT_NS = re.compile(r"(?P<whole>[0-9]+)_(?P<fraction>[0-9]{9})")
_DIGITS = re.compile(r"([0-9]+)")
_TIME_OF_DAY = re.compile(r"[012][0-9][0-5][0-9][0-5][0-9]")


def is_unit(text: str) -> bool:
    """Whether ``text`` is a unit of times that are names: s, ms, us, ns, utc or utc+hh:mm."""
    return text in _POWERS or bool(_ZONE.fullmatch(text))


def times_of_names(stems: Sequence[str], unit: str | None, where: str) -> FloatArray:
    """The times (N,) in s that names without suffix state, in their ``unit``; None: as their digits tell.

    Raises DriveError, which begins with ``where``, if they state none, or may state another one.
    """
    for reading in (_dates, _numbers):
        stamps = reading(stems, unit, where)
        if stamps is not None:
            return np.array(stamps, dtype=np.float64)
    raise DriveError(f"{where} are not named by their times; {_ADVICE}")


def number_order(stems: Sequence[str], where: str) -> list[int]:
    """The places (N,) of names in the order of the times or else the numbers in them.

    Raises DriveError, which begins with ``where``, if the names leave another order possible.
    """
    for unit in (None, "utc"):
        try:
            stamp_s = times_of_names(stems, unit, where)
        except DriveError:
            continue
        if len(np.unique(stamp_s)) == len(stems):
            return sorted(range(len(stems)), key=stamp_s.tolist().__getitem__)
    return _order_of_numbers(stems, where)


def seconds_of(texts: Sequence[str], decimal_s: FloatArray, where: str) -> FloatArray:
    """The times (N,) in s of a list's ``texts``, which are ``decimal_s`` (N,) as decimal numbers.

    Some programs write seconds, a point and nanoseconds without the zeros before these. Raises DriveError
    where that is as likely.
    """
    matches = [_PLAIN.fullmatch(text) for text in texts]
    parts = [(match["whole"], match["fraction"]) for match in matches if match and match["fraction"]]
    if len(parts) < len(texts):
        return decimal_s
    kind = _kind_of([fraction for _, fraction in parts])
    if not kind.digits:
        return decimal_s
    counted_s = np.array([float(f"{whole}.{fraction:0>{kind.digits}}") for whole, fraction in parts])
    if (np.diff(counted_s) < 0).any():
        return decimal_s
    if (np.diff(decimal_s) < 0).any() or (kind.digits == _POWERS["ns"] and not kind.may_be_decimal):
        return counted_s
    if kind.digits < _POWERS["ns"]:
        return decimal_s
    raise DriveError(
        f"{where}: '{texts[0]}' may be decimal, or seconds and nanoseconds without the zeros before them; "
        "write nine digits after the point"
    )


class _Kind(NamedTuple):
    """The kinds of numbers that the digits behind points may be."""

    may_be_decimal: bool
    digits: int  # of whole ms, us or ns written without the zeros before them; 0 where they are none


def _kind_of(fractions: Sequence[str]) -> _Kind:
    widths = [len(fraction) for fraction in fractions]
    most = max(widths)
    if min(widths) == most:
        return _Kind(True, 0)
    # Programs that drop zeros drop those at the end of a decimal number, and before a whole one.
    may_be_decimal = not any(len(fraction) > 1 and fraction.endswith("0") for fraction in fractions)
    has_zeros_before = any(len(fraction) > 1 and fraction.startswith("0") for fraction in fractions)
    is_full = widths.count(most) >= _FULL_SHARE * len(widths)
    return _Kind(may_be_decimal, most if most in _FRACTIONS and is_full and not has_zeros_before else 0)


def _matches(stems: Sequence[str], pattern: re.Pattern[str]) -> list[re.Match[str]] | None:
    """The only match in each name; None where a name has none, or more than a counter changes around it."""
    matches = []
    for stem in stems:
        in_stem = [*pattern.finditer(stem)]
        if len(in_stem) != 1:
            return None
        matches.append(in_stem[0])
    around = [
        _DIGITS.split(match.string[: match.start()]) + _DIGITS.split(match.string[match.end() :])
        for match in matches
    ]
    if len({len(parts) for parts in around}) > 1:
        return None
    for column in zip(*around, strict=True):
        if len(set(column)) > 1 and not (all(map(str.isdigit, column)) and len(set(column)) == len(column)):
            return None
    return matches


def _dates(stems: Sequence[str], unit: str | None, where: str) -> list[float] | None:
    """Times of dates with times of day."""
    matches = _matches(stems, _DATE)
    if matches is None:
        return None
    try:
        whole_s = [
            timegm(strptime("".join(match[key] for key in _DATE_KEYS), "%Y%m%d%H%M%S")) for match in matches
        ]
    except ValueError:
        return None
    fractions = [match["fraction"] or "" for match in matches]
    widths = {len(fraction) for fraction in fractions}
    if widths == {0, 6}:  # Python leaves the fraction out where it is zero
        fractions = [fraction or "000000" for fraction in fractions]
        widths = {6}
    if 0 in widths:
        raise DriveError(
            f"{where} state whole seconds, which leaves their times up to a second off; {_ADVICE}"
        )
    _check_fractions(whole_s, fractions, {match["point"] for match in matches}, where)
    shift_s = _shifts([match["zone"] for match in matches], unit, where)
    return [
        float(f"{seconds - shift}.{fraction}")
        for seconds, shift, fraction in zip(whole_s, shift_s, fractions, strict=True)
    ]


def _shifts(zones: Sequence[str | None], unit: str | None, where: str) -> list[int]:
    """The differences of the clocks of dates from UTC, s, positive where they are ahead."""
    if all(zones) and unit is None:
        return [_shift_of(re.sub("[^-+0-9]|(?<=.)-", "", zone or "")) for zone in zones]
    stated = _ZONE.fullmatch(unit or "")
    if any(zones) or stated is None:
        problem = "state their zone, some or all; drop unit, or name all alike" if any(zones) else (
            f"state dates without a zone; add unit: {ZONES}"
        )  # fmt: skip
        raise DriveError(f"{where} {problem}")
    sign, hours, minutes = stated.groups()
    return [_shift_of(f"{sign}{hours}{minutes}" if sign else "")] * len(zones)


def _shift_of(zone: str) -> int:
    """Seconds of ``+hhmm``; 0 for UTC."""
    if not zone:
        return 0
    ahead = timedelta(hours=int(zone[1:3]), minutes=int(zone[3:5]))
    return int(ahead.total_seconds()) * (-1 if zone[0] == "-" else 1)


def _numbers(stems: Sequence[str], unit: str | None, where: str) -> list[float] | None:
    """Times that are numbers: alone in their unit, or since 1970 beside other words."""
    plain = [_PLAIN.fullmatch(stem) for stem in stems]
    if unit in _POWERS and unit != "s" and all(plain):
        return [float(Decimal(stem).scaleb(-_POWERS[unit])) for stem in stems]
    split = _matches(stems, _SPLIT)
    if split is not None and unit in (None, "s"):
        points = {match["point"] for match in split}
        return _split_times([(match["whole"], match["fraction"]) for match in split], points, where)
    if all(plain):
        return _plain_times(stems, [match for match in plain if match], unit, where)
    split = [match for stem in stems if (match := _SPLIT_NS.fullmatch(stem))]
    if len(split) == len(stems) and unit in (None, "s"):
        return _split_times([(match["whole"], match["fraction"]) for match in split], {"_"}, where)
    return _since_1970(stems, unit, where)


def _since_1970(stems: Sequence[str], unit: str | None, where: str) -> list[float] | None:
    """Whole times since 1970, whose number of digits tells their unit."""
    matches = _matches(stems, _WHOLE)
    widths = {len(match[0]) for match in matches or []}
    if matches is None or len(widths) != 1:
        return None
    told = _UNIT_OF_DIGITS[widths.pop()]
    if unit not in (None, told):
        raise DriveError(
            f"{where} state times since 1970 in {told}, as {shown(stems[0])} does, not in {unit}"
        )
    return [float(Decimal(match[0]).scaleb(-_POWERS[told])) for match in matches]


def _plain_times(
    stems: Sequence[str], matches: Sequence[re.Match[str]], unit: str | None, where: str
) -> list[float] | None:
    """Numbers alone, as seconds."""
    decimals = [match["fraction"] for match in matches]
    if unit is None and not any(decimals):
        stamps = _since_1970(stems, unit, where)
        if stamps is not None:
            return stamps
        whole_s = np.sort([float(stem) for stem in stems])
        is_pulse = len({*np.diff(whole_s).tolist()}) == 1  # as a receiver triggers a camera
        if all(_SECONDS.fullmatch(stem) for stem in stems) and is_pulse:
            return [float(stem) for stem in stems]
        raise DriveError(
            f"{where} are named by whole numbers, such as {shown(stems[0])}, which may count them; "
            f"{_ADVICE}, or unit: s, ms, us or ns if they are times"
        )
    if not all(decimals):
        return [float(stem) for stem in stems] if unit == "s" else None
    stamps = _split_times([(match["whole"], match["fraction"]) for match in matches], {"."}, where)
    is_time_of_day = all(_TIME_OF_DAY.fullmatch(match["whole"]) for match in matches)
    if is_time_of_day and max(stamps) - min(stamps) > 60:  # of seconds alone some would end in 60 to 99
        raise DriveError(f"{where} state times of day, such as {shown(stems[0])}, but no date; {_ADVICE}")
    return stamps


def _split_times(parts: Sequence[tuple[str, str]], points: set[str], where: str) -> list[float]:
    """Times of whole seconds with the digits after a point."""
    fractions = [fraction for _, fraction in parts]
    kind = _kind_of(fractions)
    digits = kind.digits
    if len({*map(len, fractions)}) == 1:
        _check_fractions([int(whole) for whole, _ in parts], fractions, points, where)
    elif kind.may_be_decimal == bool(digits) or (not digits and max(map(len, fractions)) < _FRACTIONS[0]):
        shortest = min(parts, key=lambda part: len(part[1]))
        raise DriveError(
            f"{where} may be decimal, or hold a number without the zeros before it, such as "
            f"'{'.'.join(shortest)}'; {_ADVICE}"
        )
    return [float(f"{whole}.{fraction:0>{digits}}") for whole, fraction in parts]


def _check_fractions(whole_s: Sequence[int], fractions: Sequence[str], points: set[str], where: str) -> None:
    """Refuse digits after the seconds that may count images: ``_1``, ``_2``, or ``_000``, ``_001``, ..."""
    if points <= {".", ","} and len({*map(len, fractions)}) == 1:
        return
    (width, *others) = {*map(len, fractions)}
    stamps = sorted(
        whole + int(text) / 10 ** len(text) for whole, text in zip(whole_s, fractions, strict=True)
    )
    if others or width not in _FRACTIONS or _counts(whole_s, fractions) or (
        len(stamps) > 2 and np.median(np.diff(stamps)) < _QUICKEST_S
    ):  # fmt: skip
        raise DriveError(
            f"{where} have digits after the seconds, such as '{fractions[-1]}', which may count images; "
            f"{_ADVICE}"
        )


def _counts(whole_s: Sequence[int], fractions: Sequence[str]) -> bool:
    """Whether the numbers after the seconds go on one by one in all seconds, or begin again in each."""
    by_second: dict[int, list[int]] = defaultdict(list)
    for second, fraction in zip(whole_s, fractions, strict=True):
        by_second[second].append(int(fraction))
    last = -1
    for second in sorted(by_second):
        numbers = sorted(by_second[second])
        if numbers[0] not in (0, 1, last + 1) or numbers[-1] - numbers[0] != len(numbers) - 1:
            return False
        last = numbers[-1]
    return len(whole_s) > 1


def _order_of_numbers(stems: Sequence[str], where: str) -> list[int]:
    """The places of names by the numbers in them, the first one before the later ones."""
    parts = [_DIGITS.split(stem.casefold()) for stem in stems]
    texts = [tuple(row[::2]) for row in parts]
    advice = "give a list, one line 'timestamp filename' per image"
    for stem, text in zip(stems, texts, strict=True):
        if text != texts[0]:
            raise DriveError(
                f"{where} have no certain order: {shown(stems[0])} and {shown(stem)} differ in more than "
                f"numbers; put each camera into a folder of its own, or {advice}"
            )
    columns = [*zip(*(row[1::2] for row in parts), strict=True)]
    keys = [tuple(map(int, row[1::2])) for row in parts]
    order = sorted(range(len(stems)), key=keys.__getitem__)
    for before, after in pairwise(order):
        if keys[before] == keys[after]:
            pair = f"{shown(stems[before])} and {shown(stems[after])}"
            raise DriveError(f"{where} have no certain order: {pair} have the same numbers; {advice}")
    unsure = _unsure(columns, texts[0] if texts else (), keys, order)
    if unsure and _matches(stems, _DATE) is None:
        raise DriveError(f"{where} have no certain order: {unsure}; {advice}")
    return order


def _unsure(
    columns: Sequence[Sequence[str]], texts: Sequence[str], keys: Sequence[tuple[int, ...]], order: list[int]
) -> str:
    """Why the order of numbers need not be that of the images; empty where it must."""
    for place in range(1, len(columns)):
        if texts[place] in (".", ",") and len({*map(len, columns[place])}) > 1:
            decimal_keys = [
                (*key[:place], float(f"0.{digits}"), *key[place + 1 :])
                for key, digits in zip(keys, columns[place], strict=True)
            ]
            if sorted(range(len(keys)), key=decimal_keys.__getitem__) != order:
                return "digits after a point may be decimals, or a number"
    changing = [place for place, column in enumerate(columns) if len(set(column)) > 1]
    if not changing:
        return ""
    last = columns[changing[-1]]
    numbers = {*map(int, last)}
    nines = 10 ** len(last[0]) - 1
    is_padded = len({*map(len, last)}) == 1
    if is_padded and nines in numbers and not numbers.isdisjoint({0, 1}) and len(numbers) < nines:
        return f"after {nines} their numbers may begin again"
    series: dict[tuple[int, ...], set[int]] = defaultdict(set)
    for key in keys:
        series[tuple(key[place] for place in changing[1:])].add(key[changing[0]])
    cameras = {key[changing[0]] for key in keys}
    shared = sum(len(values) > 1 for values in series.values())
    inner = len(series)
    if len(changing) > 1 and 2 * shared > len(series) and min(len(cameras), inner) <= _MOST_CAMERAS:
        return "the same numbers come again beside another one, as of two cameras or recordings in one folder"
    return ""
