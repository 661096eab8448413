"""How a vehicle moved at each of its poses: slopes of smooth curves through the poses around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from v2hdm.geometry.rigid import inverse, log
from v2hdm.records import FloatArray, IntArray

_REACH_S = 1.0
"""Time, s, on both sides of a pose within which others tell the motion there: chosen. A vehicle's yaw rate
changes within about two seconds, and a receiver's white noise averages out over a dozen poses."""

_CUBIC = 3  # degree of the curve: its slope follows a yaw rate that changes evenly, and its change as well
_LEAST_FOR_CUBIC = 6  # number of poses from which a cubic is fitted to them; to fewer, a straight line
_NO_TIME_S = 1e-6  # time, s, far below any between two poses
_LEAST_UNIT_S = 0.01  # least unit of time, s, of a fit


class _Sums(NamedTuple):
    """Sums over the poses about each of F, with time in the units ``unit_s`` (F,)."""

    powers: FloatArray  # (F, 7) of the powers of time, from the 0th
    moments: FloatArray  # (F, 4, 6) of the first four powers of time, times the motion from the pose
    unit_s: FloatArray


def vehicle_twists(
    map_from_vehicle: FloatArray, stamp_s: FloatArray, session: IntArray | None = None
) -> FloatArray:
    """Vehicle twists (F, 6) in its own frame, m/s, rad/s, at poses (F, 4, 4) of times (F,).

    Each is the slope of a cubic that is fitted by least squares to the poses of its ``session`` (F,), rising,
    within a second, as far before as behind; a single pose stands still. A pose's own error has hardly a part
    in such a slope. It has in the difference of its two neighbours, if these were interpolated between the
    same recorded poses: a camera that fires just after another would seem to have a late clock.
    """
    if session is None:
        session = np.zeros(len(stamp_s), dtype=np.int64)
    sums = _sums(map_from_vehicle, stamp_s, session)
    slopes = np.zeros((len(stamp_s), 6))
    count, first_power, second_power = sums.powers[:, :3].T[..., None]
    straight = np.flatnonzero(count > 1)
    covariance = count * sums.moments[:, 1] - first_power * sums.moments[:, 0]
    variance = count * second_power - first_power**2
    slopes[straight] = covariance[straight] / variance[straight]
    curved = np.flatnonzero(count >= _LEAST_FOR_CUBIC)
    degree = np.arange(_CUBIC + 1)
    normal_matrix = sums.powers[curved][:, degree[:, None] + degree]
    slopes[curved] = np.linalg.solve(normal_matrix, sums.moments[curved])[:, 1]
    return slopes / sums.unit_s[:, None]


def _sums(map_from_vehicle: FloatArray, stamp_s: FloatArray, session: IntArray) -> _Sums:
    """Add up the poses about each, outwards from it, until none is within its reach."""
    first = np.searchsorted(session, session)
    last = np.searchsorted(session, session, side="right") - 1
    to_end_s = np.minimum(stamp_s - stamp_s[first], stamp_s[last] - stamp_s)
    reach_s = np.minimum(to_end_s, _REACH_S) + _NO_TIME_S
    unit_s = np.maximum(reach_s, _LEAST_UNIT_S)
    number = np.arange(len(stamp_s))
    vehicle_from_map = inverse(map_from_vehicle)
    powers = np.zeros((len(number), 2 * _CUBIC + 1))
    powers[:, 0] = 1.0  # the pose itself, at time 0 and without motion
    moments = np.zeros((len(number), _CUBIC + 1, 6))
    distance = 0
    added = True
    while added:
        distance += 1
        added = False
        for other in (number - distance, number + distance):
            exists = (first <= other) & (other <= last)
            elapsed_s = stamp_s[np.clip(other, first, last)] - stamp_s
            # A neighbour counts however far it is: at a session's ends, and where images are seconds apart.
            within = np.flatnonzero(exists & ((np.abs(elapsed_s) <= reach_s) | (distance == 1)))
            if not len(within):
                continue
            added = True
            motion = log(vehicle_from_map[within] @ map_from_vehicle[other[within]])
            time_powers = (elapsed_s[within] / unit_s[within])[:, None] ** np.arange(2 * _CUBIC + 1)
            powers[within] += time_powers
            moments[within] += time_powers[:, : _CUBIC + 1, None] * motion[:, None]
    return _Sums(powers, moments, unit_s)
