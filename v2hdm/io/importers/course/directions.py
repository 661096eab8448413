"""Where a vehicle drives forward and where backward, and what its heading was there, to begin with.

Between two stops a vehicle keeps its direction. Where it leaves a stop against the way that it came, it has
changed it; where it leaves sideways, nothing tells, and that is asked.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.planar import wrapped
from v2hdm.io.importers.course.recording import LONGEST_S, Course
from v2hdm.records import FloatArray, IntArray

_CHORD_SIGMAS = 8.0  # length of the shortest chord with a course, in sigmas of a position: 10 deg
_LEAST_CHORD_M = 0.25  # length of the shortest chord in any case, m; chosen
_SLOWEST_M_S = 0.15  # speed below which the vehicle stands, m/s: a walk is ten times as fast; chosen
_SAME_RAD = float(np.radians(60))  # largest turn across a stop in one direction: chosen
_OPPOSITE_RAD = float(np.radians(120))  # smallest turn across a stop where the direction changes: chosen
_LEAST_DRIVEN_M = 5.0  # length of a drive whose course is a heading to a degree, m; chosen


class Directions(NamedTuple):
    """The heading (P,), rad, unwrapped, and 1 or -1 (P,) for forward or backward, both to begin with."""

    heading_rad: FloatArray
    forward: FloatArray

    @property
    def turned(self) -> Directions:
        """The same drive with the vehicle the other way round."""
        return Directions(self.heading_rad + np.pi, -self.forward)


class _Stretch(NamedTuple):
    """Epochs from one stop to the next."""

    first: int
    last: int


def directions_of(course: Course, where: str) -> Directions:
    """The directions of a drive that begins forward; DriveError where it nowhere moves or nothing tells."""
    chords = _chords(course, where)
    moving = np.flatnonzero(np.isfinite(chords))
    stretches = _stretches(course, moving)
    heading_rad = np.full(len(course.stamp_s), np.nan)
    forward = np.ones(len(course.stamp_s))
    sign = 1.0
    before: int | None = None
    for stretch in stretches:
        rows = moving[(moving >= stretch.first) & (moving <= stretch.last)]
        of_stretch = np.unwrap(chords[rows])
        if before is not None:
            expected = heading_rad[before] + _gyro_turn(course, before, stretch.first)
            sign = _sign_after(course, float(of_stretch[0]), expected, sign, (before, stretch.first), where)
            shift = of_stretch[0] + (np.pi if sign < 0 else 0.0)
            of_stretch = of_stretch + (expected + wrapped(np.array([shift - expected]))[0] - of_stretch[0])
        heading_rad[rows] = of_stretch
        forward[stretch.first :] = sign
        before = int(rows[-1])
    everywhere = np.arange(len(heading_rad))
    is_known = np.isfinite(heading_rad)
    filled = np.interp(everywhere, everywhere[is_known], heading_rad[is_known])
    return Directions(filled, forward)


def _chords(course: Course, where: str) -> FloatArray:
    """The direction (P,) of the chord around each position, rad; nan where the vehicle stands."""
    points = course.antenna_map
    count = len(points)
    chord_m = max(_LEAST_CHORD_M, _CHORD_SIGMAS * float(np.median(course.sigma_m)))
    direction = np.full(count, np.nan)
    dark = _darkness(course)
    for middle in range(count):
        # The chord grows to both sides until it is longer than the noise, but not beyond a standstill.
        for reach in range(1, count):
            first = max(middle - reach, 0)
            last = min(middle + reach, count - 1)
            if dark[first] != dark[last]:
                break
            chord = points[last] - points[first]
            length_m = float(np.hypot(*chord))
            lasts_s = float(course.stamp_s[last] - course.stamp_s[first])
            if length_m >= chord_m:
                if length_m >= _SLOWEST_M_S * lasts_s:
                    direction[middle] = np.arctan2(chord[1], chord[0])
                break
            if lasts_s > chord_m / _SLOWEST_M_S:
                break
    moved_m = float(np.linalg.norm(np.ptp(points, axis=0)))
    if moved_m < _LEAST_DRIVEN_M or np.isfinite(direction).sum() < 3:
        raise DriveError(
            f"{where}: the antenna moves {moved_m:.2g} m in all, and a vehicle that stands has no course: "
            "record a drive, or a heading"
        )
    return direction


def _stretches(course: Course, moving: IntArray) -> list[_Stretch]:
    """The stretches between stops, or gaps: where the ``moving`` epochs lack some, or positions lack."""
    dark = _darkness(course)
    breaks = np.flatnonzero((np.diff(moving) > 1) | (np.diff(dark[moving]) > 0))
    begins = np.concatenate([[0], breaks + 1])
    ends = np.concatenate([breaks, [len(moving) - 1]])
    return [_Stretch(int(moving[begin]), int(moving[end])) for begin, end in zip(begins, ends, strict=True)]


def _darkness(course: Course) -> IntArray:
    """The number of gaps (P,) before each position."""
    return np.concatenate([[0], np.cumsum(course.interval_s > LONGEST_S)])


def _gyro_turn(course: Course, first: int, last: int) -> float:
    """The turn from one epoch to another by the gyro, rad; 0 where it does not tell: a standing one."""
    turn_rad = float(course.turn_rad[first:last].sum())
    return turn_rad if np.isfinite(turn_rad) else 0.0


def _sign_after(
    course: Course, leaves_rad: float, expected_rad: float, sign: float, stop: tuple[int, int], where: str
) -> float:
    """Whether the vehicle leaves a stop, between two epochs, forward (1) or backward (-1)."""
    came_rad = expected_rad + (np.pi if sign < 0 else 0.0)
    turn_rad = float(np.abs(wrapped(np.array([leaves_rad - came_rad]))[0]))
    if turn_rad < _SAME_RAD:
        return sign
    if turn_rad > _OPPOSITE_RAD:
        return -sign
    raise DriveError(
        f"{where}: between {course.stamp_s[stop[0]]:.2f} and {course.stamp_s[stop[1]]:.2f} s the course "
        f"turns by {np.degrees(turn_rad):.0f} deg where the vehicle stands or positions lack, forward or "
        "backward: add a gyro (gyro_file), or map both parts as two drives"
    )
