"""The vehicle's own motion: an odometry of speeds and yaw rates, and what may be wrong with it."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from v2hdm.records import FloatArray

_KEPT_S = 5.0  # time for which samples are kept: longer than any image is late
_LARGEST_SPEED_M_S = 60.0  # largest speed, m/s, of a road vehicle
_LARGEST_YAW_RATE_RAD_S = 3.0  # largest yaw rate, rad/s: full lock at a crawl is under 1
_GAP_S = 0.3  # time without a sample, s, from which the last one says little
ACCELERATION_M_S2 = 1.5
"""Standard deviation, m/s^2, of an acceleration that no sample has told: a yard truck brakes with 2 to 3."""
TURN_ACCELERATION_RAD_S2 = 0.3
"""The same of the yaw rate's, rad/s^2: full lock within two seconds."""
# A slope of the samples is that of the motion where it exceeds so many sigmas of their noise: a noise taken
# for motion would say that the odometry is on time, whatever it is. One in 16,000 slopes of noise alone does.
_SURE_SLOPE = 4.0
_SLOPE_REACHES_S = (
    0.1,
    0.3,
)  # times, s, on either side over which a slope is fitted: a short one if it is sure
_LEAST_SAMPLES = 4  # samples from which a slope, and what it may be wrong by, is known
_NOISE_SAMPLES = 64  # samples by whose deviations from their neighbours the noise is known
_MEDIAN_SQUARE = 0.455  # median of the square of a standard normal
_CLOCK_BACK_S = 1.0  # a stamp that lies farther back than this, s, comes from a clock that was set


class Motion(NamedTuple):
    """One sample of an odometry: of the vehicle's origin, forward and to the left positive."""

    stamp_s: float
    speed_m_s: float
    yaw_rate_rad_s: float


@dataclass(frozen=True)
class MotionNoise:
    """Errors of an odometry: standard deviations, from data sheets of wheels and MEMS gyros.

    Attributes:
        scale: of the logarithm of true over stated speed.
        bias_rad_s: of the yaw rate at rest.
        speed_m_sqrt_s: of the way after a second, that is m per root of a second.
        yaw_rad_sqrt_s: of the heading after a second.
        slip_m_sqrt_s: of the way sideways after a second.
        bias_walk_rad_s: of the change of the bias after a second.
        late_s: of how much later than the images it is stamped: buses and exposures take 10 to 100 ms.
        late_walk_s: of the change of that after a second: of 20 parts in a million, as clocks drift.
    """

    scale: float = 0.02
    bias_rad_s: float = 0.003
    speed_m_sqrt_s: float = 0.02
    yaw_rad_sqrt_s: float = 5e-4
    slip_m_sqrt_s: float = 0.01
    bias_walk_rad_s: float = 1e-5
    late_s: float = 0.05
    late_walk_s: float = 2e-5


class Piece(NamedTuple):
    """A time over which the motion is taken for constant."""

    length_s: float
    speed_m_s: float
    yaw_rate_rad_s: float
    speed_sigma_m_s: float  # beside the noise of samples: of a gap
    yaw_rate_sigma_rad_s: float
    faster_m_s: float = 0.0  # the speed at its end less that at its beginning, 0 where that may be noise
    turning_more_rad_s: float = 0.0  # the same of the yaw rate


@dataclass
class MotionLog:
    """The last seconds of an odometry, in order; what does not belong is left out and counted."""

    stamps_s: list[float] = field(default_factory=list)
    samples: list[Motion] = field(default_factory=list)
    refused: int = 0
    late: int = 0
    _noise: FloatArray = field(default_factory=lambda: np.zeros(2))  # variances of speeds and of yaw rates
    _noise_at: tuple[int, float] | None = None  # number and time of the samples that these belong to

    def add(self, sample: Motion) -> str | None:
        """Take a sample; a sentence where the clock was set back, so that nothing before it counts."""
        if not (
            np.isfinite(sample).all()
            and abs(sample.speed_m_s) <= _LARGEST_SPEED_M_S
            and abs(sample.yaw_rate_rad_s) <= _LARGEST_YAW_RATE_RAD_S
        ):
            self.refused += 1
            return None
        problem = None
        if self.stamps_s and sample.stamp_s <= self.stamps_s[-1]:
            back_s = self.stamps_s[-1] - sample.stamp_s
            if back_s <= _CLOCK_BACK_S:
                self._insert(sample)
                return None
            problem = f"the odometry's clock went back by {back_s:.1f} s"
            self.stamps_s.clear()
            self.samples.clear()
        self.stamps_s.append(sample.stamp_s)
        self.samples.append(sample)
        old = bisect_left(self.stamps_s, sample.stamp_s - _KEPT_S) - 1
        if old > 0:
            del self.stamps_s[:old], self.samples[:old]
        return problem

    def _insert(self, sample: Motion) -> None:
        """Put a late sample in its place; one with a stamp that is there already is left out."""
        place = bisect_left(self.stamps_s, sample.stamp_s)
        self.late += 1
        if self.stamps_s[place] != sample.stamp_s:
            self.stamps_s.insert(place, sample.stamp_s)
            self.samples.insert(place, sample)

    @property
    def newest_s(self) -> float | None:
        """The stamp of the newest sample."""
        return self.stamps_s[-1] if self.stamps_s else None

    def pieces(self, begin_s: float, end_s: float) -> list[Piece]:
        """The motion from one time to a later one; before and after all samples the nearest one holds."""
        first = bisect_right(self.stamps_s, begin_s)
        last = bisect_left(self.stamps_s, end_s)
        times = [begin_s, *self.stamps_s[first:last], end_s]
        out = []
        for start_s, stop_s in pairwise(times):
            if stop_s > start_s:
                out.append(self._piece(start_s, stop_s))
        return out

    def _piece(self, start_s: float, stop_s: float) -> Piece:
        length_s = stop_s - start_s
        if not self.samples:
            return Piece(length_s, 0.0, 0.0, 5.0, 0.3)  # a yard's usual speeds and turns
        after = bisect_left(self.stamps_s, stop_s)
        before = max(bisect_right(self.stamps_s, start_s) - 1, 0)
        nearest_s = self.stamps_s[before]
        if after < len(self.samples) and self.stamps_s[after] > nearest_s:
            share = (0.5 * (start_s + stop_s) - nearest_s) / (self.stamps_s[after] - nearest_s)
            share = min(max(share, 0.0), 1.0)
            earlier = self.samples[before]
            later_sample = self.samples[after]
            speed = earlier.speed_m_s + share * (later_sample.speed_m_s - earlier.speed_m_s)
            turn = earlier.yaw_rate_rad_s + share * (later_sample.yaw_rate_rad_s - earlier.yaw_rate_rad_s)
            gap_s = self.stamps_s[after] - nearest_s
        else:
            speed, turn = self.samples[before][1:]
            gap_s = max(stop_s - nearest_s, nearest_s - start_s)
        faster, turning_more = (length_s * self._slopes(0.5 * (start_s + stop_s))).tolist()
        unknown_s = max(gap_s - _GAP_S, 0.0)
        return Piece(
            length_s,
            speed,
            turn,
            ACCELERATION_M_S2 * unknown_s,
            TURN_ACCELERATION_RAD_S2 * unknown_s,
            faster,
            turning_more,
        )

    def _slopes(self, middle_s: float) -> FloatArray:
        """How fast speed and yaw rate (2,) change about a time; 0 where that may be noise."""
        slopes = np.zeros(2)
        for reach_s in _SLOPE_REACHES_S:
            first = bisect_left(self.stamps_s, middle_s - reach_s)
            last = bisect_right(self.stamps_s, middle_s + reach_s)
            if last - first < _LEAST_SAMPLES:
                continue
            table = np.array(self.samples[first:last])
            from_mean = table - table.mean(axis=0)
            squared_s2 = float(from_mean[:, 0] @ from_mean[:, 0])
            if squared_s2 <= 0.0:
                continue
            fitted = from_mean[:, 0] @ from_mean[:, 1:] / squared_s2
            # Of a short time only where that surely differs: what noise lets pass is mostly too steep.
            is_sure = (fitted - slopes) ** 2 * squared_s2 > _SURE_SLOPE**2 * self._noise_squared()
            slopes = np.where(is_sure, fitted, slopes)
        return slopes

    def _noise_squared(self) -> FloatArray:
        """The variances (2,) of the noise of the last speeds and yaw rates, by how far each is off others.

        What a motion bends between two samples, and what numbers are rounded by, is in it.
        """
        newest = (len(self.samples), self.stamps_s[-1])
        if self._noise_at != newest:
            table = np.array(self.samples[-_NOISE_SAMPLES:])
            stamps_s = table[:, 0]
            share = (stamps_s[1:-1] - stamps_s[:-2]) / (stamps_s[2:] - stamps_s[:-2])
            between = table[:-2, 1:] + share[:, None] * (table[2:, 1:] - table[:-2, 1:])
            off = table[1:-1, 1:] - between
            count = 1.0 + share**2 + (1.0 - share) ** 2
            self._noise = np.median(off**2 / count[:, None], axis=0) / _MEDIAN_SQUARE
            self._noise_at = newest
        return self._noise


def moved(pieces: list[Piece]) -> FloatArray:
    """The pose (3,) of x, y and heading after pieces of motion, from the one before."""
    x, y, heading = 0.0, 0.0, 0.0
    for piece in pieces:
        middle = heading + 0.5 * piece.yaw_rate_rad_s * piece.length_s
        x += piece.speed_m_s * piece.length_s * np.cos(middle)
        y += piece.speed_m_s * piece.length_s * np.sin(middle)
        heading += piece.yaw_rate_rad_s * piece.length_s
    return np.array([x, y, heading])
