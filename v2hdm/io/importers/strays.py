"""Single positions and attitudes that no vehicle can have between their neighbours.

A stray is a reading, or two or three in a row, without which the others go on as a vehicle does. A step that
stays is none: then neither side can be left out, and the checks of the poses tell of it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from v2hdm.geometry.rigid import interpolate, make_transform
from v2hdm.records import SIGMA_OF_MAD, BoolArray, FloatArray, IntArray, Trajectory

_log = logging.getLogger(__name__)

_HARDEST_MPS2 = 9.0  # no tyre turns or brakes a road vehicle harder
_HARDEST_RADPS2 = 1.5  # from straight on to a full turn, 0.75 rad/s, in half a second; chosen
_EXTREME = 6.0  # sigmas that are never reached by chance
_LEAST_M = 0.02  # scatter of a position that counts as none: RTK's
_LEAST_RAD = float(np.radians(0.25))  # scatter of a heading that counts as none: half a digit of coarse ones
_LONGEST = 3  # readings in a row that are strays; more are a step
_CLEARLY = 3.0  # times that strays are farther off than what is left; beside a step both are off alike
_FEW = 0.02  # share of readings up to which clusters of strays are singled out; more are scatter
_BESIDE = 3  # readings beside a cluster of strays that have to fit without it

_Off = Callable[[IntArray, IntArray, IntArray], FloatArray]


def without_strays(stamp_s: FloatArray, points: FloatArray, where: str) -> BoolArray:
    """Flags (N,) of the positions (N, 3), m, at rising times (N,) that are no strays; those are counted."""

    def off_m(before: IntArray, middle: IntArray, after: IntArray) -> FloatArray:
        part = ((stamp_s[middle] - stamp_s[before]) / (stamp_s[after] - stamp_s[before]))[:, None]
        expected = points[before] + part * (points[after] - points[before])
        return np.asarray(np.linalg.norm(points[middle] - expected, axis=1))

    return _plausible(
        stamp_s, off_m, 0.5 * _HARDEST_MPS2, _LEAST_M, f"{where}: left out %d of %d positions that jump"
    )


def without_stray_turns(stamp_s: FloatArray, rotation: FloatArray, where: str) -> BoolArray:
    """Flags (N,) of the rotations (N, 3, 3) at rising times (N,) that are no strays; those are counted."""

    def off_rad(before: IntArray, middle: IntArray, after: IntArray) -> FloatArray:
        part = (stamp_s[middle] - stamp_s[before]) / (stamp_s[after] - stamp_s[before])
        # Each at a time of its own: pairs one after the other.
        times = np.arange(2.0 * len(part))
        pairs = np.stack([rotation[before], rotation[after]], axis=1).reshape(-1, 3, 3)
        turns = Trajectory(times, make_transform(pairs, np.zeros(3)))
        expected = interpolate(turns, times[::2] + np.clip(part, 0, 1), 1.5)[0][:, :3, :3]
        cosine = (np.einsum("nij,nij->n", rotation[middle], expected) - 1) / 2
        return np.asarray(np.arccos(np.clip(cosine, -1, 1)))

    said = f"{where}: left out %d of %d headings that jump"
    return _plausible(stamp_s, off_rad, 0.5 * _HARDEST_RADPS2, _LEAST_RAD, said)


def _plausible(stamp_s: FloatArray, off: _Off, hardest: float, least: float, said: str) -> BoolArray:
    count = len(stamp_s)
    is_plausible = np.ones(count, dtype=bool)
    if count < 2 * _BESIDE:
        return is_plausible
    inner = np.arange(1, count - 1)
    off_of_all = off(inner - 1, inner, inner + 1)
    usual = _EXTREME * max(SIGMA_OF_MAD * float(np.median(off_of_all)), least)

    def fits(others: IntArray, strays: range) -> bool:
        """Whether the others lie between their neighbours, and far better than the strays do."""
        longest_s = np.maximum(np.diff(stamp_s[others])[:-1], np.diff(stamp_s[others])[1:])
        off_of_others = off(others[:-2], others[1:-1], others[2:])
        if not (off_of_others <= usual + hardest * longest_s**2).all():
            return False
        before = strays[0] - 1
        after = strays[-1] + 1
        if before < 0 or after >= count:
            return True
        middle = np.array(strays)
        stray_off = off(np.full(len(middle), before), middle, np.full(len(middle), after))
        return bool(stray_off.min() > _CLEARLY * off_of_others.max())

    longest_s = np.maximum(np.diff(stamp_s)[:-1], np.diff(stamp_s)[1:])
    wrong = inner[off_of_all > usual + hardest * longest_s**2]
    clusters = np.split(wrong, np.flatnonzero(np.diff(wrong) > 2) + 1) if len(wrong) else []
    if len(clusters) > max(3, _FEW * count):
        return is_plausible
    for cluster in clusters:
        if (strays := _strays(int(cluster[0]), int(cluster[-1]), count, fits)) is not None:
            is_plausible[strays] = False
    if not is_plausible.all():
        _log.warning(f"{said} away from those around them", int((~is_plausible).sum()), count)
    return is_plausible


def _strays(first: int, last: int, count: int, fits: Callable[[IntArray, range], bool]) -> range | None:
    """The shortest run among rows ``first`` to ``last``, and the next ones, without which the others fit."""
    rows = np.arange(max(first - _BESIDE, 0), min(last + _BESIDE + 1, count))
    for length in range(1, _LONGEST + 1):
        for begin in range(max(first - 1, 0), min(last + 2, count - length + 1)):
            others = rows[(rows < begin) | (rows >= begin + length)]
            strays = range(begin, begin + length)
            if len(others) >= _BESIDE and fits(others, strays):
                return strays
    return None
