"""Poses of a vehicle, their noise, their reception, and the road below."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from v2hdm.records.arrays import FloatArray


@dataclass(frozen=True)
class GeodeticOrigin:
    """The map frame's origin on the earth: degrees, metres above the ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    datum: str = "WGS84"
    epoch: float | None = None


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations of the recorded poses, as in the receiver's data sheet.

    ``..._drift_...`` is the slow part of each, as in RTK: a first-order Gauss-Markov process with the
    correlation length ``..._drift_over_m``. The rest, in quadrature, is white noise. ``clock_s`` is of the
    time by which the images of all cameras are late on the poses' clock, ``clock_drift_s`` of the change of
    that time from the first image of a drive to its last. ``heading_slip`` is of the slip in headings that
    are an antenna's course: rad for each m/s2 to the side; 0 for headings that were measured.
    """

    position_m: float = 0.02
    heading_rad: float = 0.001
    roll_pitch_rad: float = 0.003
    position_drift_m: float = 0.0
    position_drift_over_m: float = 30.0
    heading_drift_rad: float = 0.0
    heading_drift_over_m: float = 5.0
    roll_pitch_drift_rad: float = 0.0
    roll_pitch_drift_over_m: float = 5.0
    clock_s: float = 0.0
    clock_drift_s: float = 0.0
    heading_slip: float = 0.0

    @classmethod
    def from_stated(cls, **stated: float) -> PoseNoise:
        """The noise of a drive that states only some of it; the rest takes the mean square over drives.

        An unstated drift takes half the variance: without one, errors that repeat from image to image would
        be averaged out, and the map state too small an uncertainty. Unstated clocks are those that nothing
        synchronises; a clock that is stated drifts by no more than it is off.
        """
        noise = cls(**stated)
        unstated = {total: _UNSTATED * getattr(noise, total) for total in DRIFTS if total not in stated}
        noise = replace(noise, **unstated)
        drifts = {
            drift: math.sqrt(_USUAL_DRIFT_SHARE) * getattr(noise, total)
            for total, drift in DRIFTS.items()
            if drift not in stated
        }
        clocks = {
            "clock_s": _UNSTATED_CLOCK_S,
            "clock_drift_s": stated.get("clock_s", _UNSTATED_CLOCK_DRIFT_S),
        }
        return replace(noise, **drifts, **{key: clocks[key] for key in clocks if key not in stated})


def unstated_clock_drift_s(stamp_s: Sequence[FloatArray]) -> float:
    """Standard deviation, s, of the drift of clocks that nobody states, by the stamps (N,) of each camera.

    Even stamps may have been counted at a camera's nominal rate. Uneven ones were read from a clock, which a
    computer never lets drift by as much.
    """
    return max((_drift_of(stamps) for stamps in stamp_s if len(stamps)), default=_UNSTATED_CLOCK_DRIFT_S)


def _drift_of(stamp_s: FloatArray) -> float:
    """The same of one camera; stamps without at least two intervals tell nothing."""
    intervals_s = np.diff(stamp_s)
    if len(intervals_s) < 2:
        return _UNSTATED_CLOCK_DRIFT_S
    # Images that a recorder dropped leave whole multiples.
    usual_s = float(np.median(intervals_s))
    uneven_s = np.abs(intervals_s - usual_s * np.round(intervals_s / max(usual_s, 1e-9)))
    if np.quantile(uneven_s, 1 - _UNEVEN_SHARE) <= _UNEVEN_S:
        return _UNSTATED_CLOCK_DRIFT_S
    return min(_MOST_SLEWED * float(stamp_s[-1] - stamp_s[0]), _UNSTATED_CLOCK_DRIFT_S)


def largest_noise(noises: Sequence[PoseNoise]) -> PoseNoise:
    """The largest of each standard deviation, and of each distance over which a drift fades."""
    names = [field.name for field in fields(PoseNoise)]
    return PoseNoise(**{name: max(getattr(noise, name) for noise in noises) for name in names})


DRIFTS: Mapping[str, str] = {
    "position_m": "position_drift_m",
    "heading_rad": "heading_drift_rad",
    "roll_pitch_rad": "roll_pitch_drift_rad",
}
"""The drift that belongs to each standard deviation of :class:`PoseNoise`."""

_UNSTATED = math.sqrt((3.0**2 - 3.0**-2) / (2 * math.log(3.0**2)))
"""Root mean square, relative to the usual value, of a sigma whose logarithm is uniform from a third of it to
three times: the range of receivers and vehicles."""

_USUAL_DRIFT_SHARE = 0.5
"""Fraction of an unstated variance that drifts: half of RTK's errors are multipath and atmosphere, which last
for tens of metres."""

_UNSTATED_CLOCK_S = 0.03
"""Standard deviation, s, of the time by which images are late where nothing synchronises cameras with the
receiver: exposure, read-out and transfer take 20 to 60 ms, and computers stamp images when these arrive."""

_UNSTATED_CLOCK_DRIFT_S = 0.05
"""Standard deviation, s, of its change over a drive where nothing synchronises them: that of stamps counted
at the nominal rate of a camera, which is off by a few thousandths, over ten to twenty seconds."""

_MOST_SLEWED = 5e-4
"""Largest relative error of a computer's clock while it is led to the right time (RFC 5905, MAXFREQ); a
quartz that nothing leads is off by a tenth of it."""

_UNEVEN_S = 0.002  # departure of an interval, s, from multiples of the usual one that no rounding to ms makes
_UNEVEN_SHARE = 0.1  # least share of such intervals among those of stamps that were read from a clock


@dataclass(frozen=True)
class Trajectory:
    """Vehicle poses over time: ``stamp_s`` (P,), strictly rising, and ``map_from_vehicle`` (P, 4, 4)."""

    stamp_s: FloatArray
    map_from_vehicle: FloatArray


@dataclass(frozen=True)
class Reception:
    """The quality of a drive's recorded positions, as their source states it, while images were taken."""

    positions: int
    rtk_fixed: int | None  # of these, with fixed ambiguities; None where the source states no quality
    geoid_m: float | None = None  # stated height of the geoid above the ellipsoid, added to all heights


@dataclass(frozen=True)
class Road:
    """The recorded ground along the route; the drive's poses are reduced to the plane z = 0."""

    points_map: FloatArray  # (P, 2) m in driving order
    height_m: FloatArray  # (P,)
    slope: FloatArray  # (P, 2) by x and y
