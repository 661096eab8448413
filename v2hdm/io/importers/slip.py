"""The choice of the poses that a vehicle can have driven, as its rear axle does not slip sideways."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import angle_between, wrapped
from v2hdm.records import FloatArray, Trajectory

_CHORD_S = 0.5  # time of the chords whose direction is the course; chosen
_LONGEST_S = 2.0  # chords over a longer gap say nothing
_SHORTEST_M = 1.0  # RTK noise of 2 cm turns a chord of this length by 1.6 deg
_LEVER_M = 0.15  # standard deviation of a stated lever arm, along the vehicle; chosen
_LEAST_RAD = float(np.radians(0.2))  # scatter of course and heading that is always there
_SURE = 9.0  # twice the log of a likelihood ratio of 90 to 1
_LEAST_CHORDS = 10  # fewer say nothing; chosen


class Choice(NamedTuple):
    """The likelier of two trajectories of a vehicle."""

    is_second: bool
    is_sure: bool


class _Chords(NamedTuple):
    """Chords of a path."""

    off_rad: FloatArray  # (N,) from the heading midway to the chord
    curvature: FloatArray  # (N,) turn over length, rad per m
    overlap: float  # chords that share a stretch


def driven(first: Trajectory, second: Trajectory) -> Choice:
    """Whether the origin of ``second`` rather than of ``first`` goes where its vehicle points."""
    chords_of_first = _chords(first)
    chords_of_second = _chords(second)
    if chords_of_first is None or chords_of_second is None:
        return Choice(False, False)
    # Both without the lever arm's prior: the scatter that is there anyway.
    scatter = min(
        _cost(chords, 1.0, np.inf) / len(chords.off_rad) for chords in (chords_of_first, chords_of_second)
    )
    variance = max(scatter, _LEAST_RAD**2)
    gain = _cost(chords_of_first, variance, _LEVER_M) - _cost(chords_of_second, variance, _LEVER_M)
    return Choice(gain > 0, abs(gain) > _SURE)


def _cost(chords: _Chords, variance: float, lever_m: float) -> float:
    """Squared misfit of chords to the heading, in sigmas, after a constant and the lever arm's error."""
    weight = 1 / np.sqrt(variance * (chords.overlap if np.isfinite(lever_m) else 1.0))
    columns = weight * np.column_stack([np.ones(len(chords.off_rad)), chords.curvature])
    columns = np.vstack([columns, [[0.0, 1 / lever_m]]])
    target = np.append(weight * chords.off_rad, 0.0)
    solved = np.linalg.lstsq(columns, target, rcond=None)[0]
    return float(((target - columns @ solved) ** 2).sum())


def _chords(trajectory: Trajectory) -> _Chords | None:
    """The chords where the vehicle drives; None where it hardly does."""
    stamp_s = trajectory.stamp_s
    if len(stamp_s) < _LEAST_CHORDS:
        return None
    stride = max(1, round(_CHORD_S / max(float(np.median(np.diff(stamp_s))), 1e-3)))
    points = trajectory.map_from_vehicle[:, :2, 3]
    forward = trajectory.map_from_vehicle[:, :2, 0]
    chord = points[stride:] - points[:-stride]
    length_m = np.linalg.norm(chord, axis=1)
    is_driven = (length_m > _SHORTEST_M) & (stamp_s[stride:] - stamp_s[:-stride] < _LONGEST_S)
    if is_driven.sum() < _LEAST_CHORDS:
        return None
    begin = forward[:-stride][is_driven]
    end = forward[stride:][is_driven]
    off_rad = angle_between(begin + end, chord[is_driven])
    off_rad = np.where(np.abs(off_rad) > np.pi / 2, wrapped(off_rad + np.pi), off_rad)  # in reverse
    return _Chords(off_rad, angle_between(begin, end) / length_m[is_driven], float(stride))
