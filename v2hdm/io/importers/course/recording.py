"""The recording of a drive by a receiver with one antenna, and by a gyro beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.records import FloatArray

LONGEST_S = 1.0
"""Longest time between two positions over which the path is one arc; chosen."""

_ROLLS_M_S = 0.1  # speed backward that is no noise of a standing wheel, m/s; chosen
_DARK_S = 0.3  # longest time between two readings of a gyro or of wheels over which they are taken for linear


@dataclass(frozen=True)
class Turning:
    """Readings of a gyro, of the wheels' speed, or both; nan where there is none."""

    stamp_s: FloatArray  # (G,) rising strictly
    yaw_rate_rad_s: FloatArray  # (G,) to the left
    speed_m_s: FloatArray  # (G,) forward; of unsigned wheels the amount

    @property
    def has_gyro(self) -> bool:
        """Whether any reading is a gyro's."""
        return bool(np.isfinite(self.yaw_rate_rad_s).any())

    @property
    def has_speed(self) -> bool:
        """Whether any reading is the wheels'."""
        return bool(np.isfinite(self.speed_m_s).any())


@dataclass(frozen=True)
class Course:
    """Positions of an antenna in the plane, and the turn and the speed between them.

    ``turn_rad`` and ``speed_m_s`` are nan where nothing was recorded.
    """

    stamp_s: FloatArray  # (P,) rising strictly
    antenna_map: FloatArray  # (P, 2) m
    sigma_m: FloatArray  # (P,) of a coordinate
    lever_arm_m: FloatArray  # (2,) the antenna ahead and to the left of the rear axle
    turn_rad: FloatArray  # (P - 1,) to the left by the gyro, with its bias
    speed_m_s: FloatArray  # (P - 1,) by the wheels

    @property
    def interval_s(self) -> FloatArray:
        """Time (P - 1,) from each position to the next."""
        return np.asarray(np.diff(self.stamp_s))

    @property
    def has_gyro(self) -> bool:
        """Whether a gyro recorded any turn."""
        return bool(np.isfinite(self.turn_rad).any())

    @property
    def speed_is_signed(self) -> bool:
        """Whether the wheels count backward, and so tell the direction."""
        return bool((self.speed_m_s < -_ROLLS_M_S).any())


def course_of(
    stamp_s: FloatArray,
    antenna_map: FloatArray,
    sigma_m: FloatArray,
    lever_arm_m: FloatArray,
    turning: Turning | None,
    where: str,
) -> Course:
    """Antenna positions (P, 2) with the gyro and the wheels brought to their times.

    Raises DriveError for a gyro that was recorded at another time.
    """
    nothing = np.full(len(stamp_s) - 1, np.nan)
    turn_rad = nothing
    speed_m_s = nothing
    if turning is not None and turning.has_gyro:
        turn_rad = _integral(turning.stamp_s, turning.yaw_rate_rad_s, stamp_s)
        if not np.isfinite(turn_rad).any():
            raise DriveError(
                f"{where}: the gyro's times ({turning.stamp_s[0]:.2f} to {turning.stamp_s[-1]:.2f} s) are "
                f"not those of the positions ({stamp_s[0]:.2f} to {stamp_s[-1]:.2f} s); put both on one clock"
            )
    if turning is not None and turning.has_speed:
        speed_m_s = _integral(turning.stamp_s, turning.speed_m_s, stamp_s) / np.diff(stamp_s)
    return Course(stamp_s, antenna_map, sigma_m, lever_arm_m, turn_rad, speed_m_s)


def _integral(stamp_s: FloatArray, rates: FloatArray, at_s: FloatArray) -> FloatArray:
    """Integrals (P - 1,) of rates (G,) from each time of ``at_s`` (P,) to the next; nan where they lack."""
    is_number = np.isfinite(rates)
    known_s = stamp_s[is_number]
    rates = rates[is_number]
    steps = np.diff(known_s)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (rates[:-1] + rates[1:]) * steps)])
    after = np.clip(np.searchsorted(known_s, at_s, side="left"), 1, len(known_s) - 1)
    before = after - 1
    since_s = at_s - known_s[before]
    slope = (rates[after] - rates[before]) / steps[before]
    reached = total[before] + since_s * (rates[before] + 0.5 * slope * since_s)
    dark = np.concatenate([[0], np.cumsum(steps > _DARK_S)])
    # A position beyond the last reading, or in a gap, has no turn up to it.
    is_inside = (at_s >= known_s[0]) & (at_s <= known_s[-1])
    is_lit = dark[after] == dark[before]
    reached = np.where(is_inside & is_lit, reached, np.nan)
    crosses = dark[after[1:]] != dark[after[:-1]]
    return np.asarray(np.where(crosses, np.nan, np.diff(reached)))
