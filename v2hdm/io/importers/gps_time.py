"""GPS time: seconds of a week without leap seconds, and UTC, which has them."""

from __future__ import annotations

from datetime import UTC, date, datetime

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.records import FloatArray

WEEK_S = 604800.0  # length of a week of GPS time, which has no leap seconds, s
GPS_EPOCH_S = 315964800.0  # midnight of 6 January 1980, s since 1970 (IS-GPS-200)
SINCE_1970_S = 6e8  # times of images that are later count from 1970; earlier ones from anything

# Days, UTC, from which GPS time is ahead of UTC by one second more (IERS Bulletin C).
_LEAP_DAYS = (
    "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01",
    "1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01",
    "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01",
)  # fmt: skip
_LEAPS_S = np.array([datetime.fromisoformat(f"{day}T00:00:00+00:00").timestamp() for day in _LEAP_DAYS])


def leap_seconds(unix_s: float) -> int:
    """Seconds that GPS time is ahead of UTC at a Unix time (18 since 2017)."""
    return int(np.searchsorted(_LEAPS_S, unix_s, side="right"))


def utc_of_gps(calendar_s: FloatArray) -> FloatArray:
    """UTC (N,), s since 1970, of what a calendar of GPS time would call so."""
    return calendar_s - leap_seconds(float(np.median(calendar_s)))


def unwrapped(of_week_s: FloatArray) -> FloatArray:
    """Seconds of the week (N,) that go on past its end."""
    falls = np.diff(of_week_s, prepend=of_week_s[:1]) < -WEEK_S / 2
    return of_week_s + WEEK_S * np.cumsum(falls)


def utc_of_week(
    of_week_s: FloatArray, day: date | None, near_s: float | None, is_utc: bool, where: str
) -> FloatArray:
    """UTC (N,), s since 1970, of seconds of the week, next to noon of ``day`` or else to ``near_s``.

    ``is_utc`` says that they have leap seconds. Images whose times are no dates count as they do.
    """
    going_on_s = unwrapped(of_week_s)
    if day is not None:
        about_s = datetime(day.year, day.month, day.day, 12, tzinfo=UTC).timestamp()
    elif near_s is None:
        raise DriveError(f"{where}: its times are seconds of the week: add date, a day of the recording")
    elif near_s < SINCE_1970_S:
        return going_on_s
    else:
        about_s = near_s
    middle_s = float(np.median(going_on_s))
    week = round((about_s - GPS_EPOCH_S - middle_s) / WEEK_S)
    calendar_s = GPS_EPOCH_S + week * WEEK_S + going_on_s
    return calendar_s if is_utc else utc_of_gps(calendar_s)
