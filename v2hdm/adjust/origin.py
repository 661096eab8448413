"""An origin near the drive: in UTM coordinates a solver would lose seven digits to the distance of theirs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from v2hdm.adjust.problem import Problem
from v2hdm.records import FloatArray

_NEAR_M = 10_000.0
"""Coordinates of this size are known to a picometre, and moving them would cost memory for nothing."""


def nearby_origin(problem: Problem) -> FloatArray:
    """A point (2,) of the map by the recorded poses: its origin, or their middle where that is far from it.

    It is in whole metres, so that shifts are exact.
    """
    position = problem.map_from_vehicle[:, :2, 3]
    middle = np.round((position.min(0) + position.max(0)) / 2)
    return np.asarray(middle if np.abs(middle).max() > _NEAR_M else np.zeros(2))


def shifted(problem: Problem, by_m: FloatArray) -> Problem:
    """``problem`` on a map whose points all are moved by ``by_m`` (2,)."""
    if not by_m.any():
        return problem
    poses = problem.map_from_vehicle.copy()
    poses[:, :2, 3] += by_m
    start, control = problem.corners_start, problem.control
    return replace(
        problem,
        map_from_vehicle=poses,
        corners_start=None if start is None else start + by_m,
        control=None if control is None else replace(control, points_map=control.points_map + by_m),
    )
