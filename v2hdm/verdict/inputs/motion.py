"""How the vehicle moved, as its recorded poses say: chords of the path, course, speed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from v2hdm.records import BoolArray, Drive, FloatArray, IntArray, Trajectory

CHORD_M = 2.0
"""Length of the chords whose direction is the course: RTK noise of 2 cm turns one by less than a degree."""

SLOWEST_MPS = 0.5
"""A vehicle that takes longer for a chord counts as standing: its path is then mostly noise."""

_MOST_STARTS = 4000
"""Chords per drive: enough for medians to a hundredth of a degree, and a tenth of a second of work."""


@dataclass(frozen=True)
class Chords:
    """Stretches of :data:`CHORD_M` that the vehicle moved: indices (N,) of their first and last pose."""

    first: IntArray
    last: IntArray

    def __len__(self) -> int:
        """The number of chords."""
        return len(self.first)


@dataclass(frozen=True)
class Motion:
    """A trajectory as the checks see it: ``stamp_s`` (P,), ``position`` (P, 3), ``rotation`` (P, 3, 3)."""

    stamp_s: FloatArray
    position: FloatArray
    rotation: FloatArray

    @classmethod
    def of(cls, drive: Drive) -> Motion:
        """The poses of a drive as they were recorded; those of its images where nothing else is kept."""
        poses = drive.recorded or drive.trajectory or _of_images(drive)
        return cls(poses.stamp_s, poses.map_from_vehicle[:, :3, 3], poses.map_from_vehicle[:, :3, :3])

    @cached_property
    def chords(self) -> Chords:
        """The chords of the stretches on which the vehicle moves."""
        stride = -(-len(self.stamp_s) // _MOST_STARTS)
        pairs = [
            (start, end)
            for start in range(0, len(self.stamp_s), stride)
            if (end := self._reached(start)) is not None
        ]
        first, last = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
        return Chords(first, last)

    @cached_property
    def interval_s(self) -> FloatArray:
        """Time (P - 1,) from each pose to the next."""
        return np.diff(self.stamp_s)

    @cached_property
    def step_m(self) -> FloatArray:
        """Distance (P - 1,) in the plane from each pose to the next."""
        return np.asarray(np.linalg.norm(np.diff(self.position[:, :2], axis=0), axis=1))

    @cached_property
    def moving(self) -> BoolArray:
        """Which steps (P - 1,) from pose to pose lie on a chord."""
        covered = np.zeros(len(self.stamp_s))
        np.add.at(covered, self.chords.first, 1)
        np.add.at(covered, self.chords.last, -1)
        return np.asarray(np.cumsum(covered)[:-1] > 0)

    @cached_property
    def speed_mps(self) -> FloatArray:
        """Speed (N,) on each chord."""
        length = np.linalg.norm(
            self.position[self.chords.last, :2] - self.position[self.chords.first, :2], axis=1
        )
        return np.asarray(length / (self.stamp_s[self.chords.last] - self.stamp_s[self.chords.first]))

    @cached_property
    def turn_rad(self) -> FloatArray:
        """By how much (N,) the recorded heading turns on each chord."""
        first, last = self.rotation[self.chords.first, :2, 0], self.rotation[self.chords.last, :2, 0]
        return angle_between(first, last)

    def _reached(self, start: int) -> int | None:
        """The first pose a chord away from ``start``, if the vehicle gets there at a moving speed."""
        end = np.searchsorted(self.stamp_s, self.stamp_s[start] + CHORD_M / SLOWEST_MPS, side="right")
        offset = self.position[start + 1 : end, :2] - self.position[start, :2]
        reached = np.flatnonzero((offset**2).sum(axis=1) >= CHORD_M**2)
        return start + 1 + int(reached[0]) if len(reached) else None


def angle_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """Angles (N,), rad within +-pi, from plane vectors (N, 2) to others, counter-clockwise."""
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return np.asarray(np.arctan2(cross, (first * second).sum(axis=1)))


def _of_images(drive: Drive) -> Trajectory:
    stamp_s, rows = np.unique([image.stamp_s for image in drive.images], return_index=True)
    return Trajectory(stamp_s, np.array([drive.images[row].map_from_vehicle for row in rows]))
