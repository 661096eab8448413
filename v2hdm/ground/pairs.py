"""Which images of a camera are compared with each other."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from v2hdm.records import FloatArray, IntArray

_ARM_M = 10.0
"""A turn by one radian moves the ground in view by about this."""


def spread_pairs(path_m: FloatArray, count: int, shortest_m: float, longest_m: float) -> IntArray:
    """Pairs (P, 2) of images, spread evenly along the path, no image used twice where that is possible.

    Args:
        path_m: (I,) distance driven at each image, not falling.
        count: how many pairs are wanted.
        shortest_m: distance between the images of a pair, at least.
        longest_m: and at most.
    """
    chosen: list[tuple[int, int]] = []
    used: set[int] = set()
    last = len(path_m) - 1
    for start_m in np.linspace(path_m[0], max(path_m[-1] - longest_m, path_m[0]), count):
        nearest = int(np.searchsorted(path_m, start_m))
        pair = _pair_from(path_m, min(nearest, last), shortest_m, longest_m, used)
        if pair is not None:
            chosen.append(pair)
            used.update(pair)
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)


def _pair_from(
    path_m: FloatArray, start: int, shortest_m: float, longest_m: float, used: set[int]
) -> tuple[int, int] | None:
    first = next((k for k in range(start, len(path_m)) if k not in used), None)
    if first is None:
        return None
    away = path_m - path_m[first]
    fitting = np.flatnonzero((away >= shortest_m) & (away <= longest_m))
    if not len(fitting):
        return None
    middle = (shortest_m + longest_m) / 2
    free = [k for k in fitting if k not in used] or list(fitting)
    second = min(free, key=lambda k: abs(float(away[k]) - middle))
    return first, int(second)


def changing_pairs(
    path_m: FloatArray, velocity: FloatArray, count: int, shortest_m: float, longest_m: float
) -> IntArray:
    """Pairs (P, 2) of images between which the motion changes most, so that a clock shows.

    Args:
        path_m: (I,) distance driven at each image.
        velocity: (I, 3) smoothed velocity there; see :class:`v2hdm.ground.motion.Motion`.
        count: how many pairs are wanted.
        shortest_m: distance between the images of a pair, at least.
        longest_m: and at most.
    """

    def worth(first: int, second: int) -> float:
        change = velocity[second] - velocity[first]
        return float(np.hypot(np.hypot(change[0], change[1]), _ARM_M * change[2]))

    return _best_pairs(path_m, worth, count, shortest_m, longest_m)


def turning_pairs(
    path_m: FloatArray, yaw_rad: FloatArray, count: int, shortest_m: float, longest_m: float
) -> IntArray:
    """Pairs (P, 2) of images between which the vehicle turns most, so that a mirrored path shows.

    Args:
        path_m: (I,) distance driven at each image.
        yaw_rad: (I,) heading there, without jumps.
        count: how many pairs are wanted.
        shortest_m: distance between the images of a pair, at least.
        longest_m: and at most.
    """

    def worth(first: int, second: int) -> float:
        return abs(float(yaw_rad[second] - yaw_rad[first]))

    return _best_pairs(path_m, worth, count, shortest_m, longest_m)


def _best_pairs(
    path_m: FloatArray, worth: Callable[[int, int], float], count: int, shortest_m: float, longest_m: float
) -> IntArray:
    """The pairs of most worth, no image used twice."""
    found: list[tuple[float, int, int]] = []
    for first in range(len(path_m)):
        away = path_m - path_m[first]
        for second in np.flatnonzero((away >= shortest_m) & (away <= longest_m)).tolist():
            found.append((worth(first, second), first, second))
    found.sort(reverse=True)
    used: set[int] = set()
    chosen: list[tuple[int, int]] = []
    for _, first, second in found:
        if first not in used and second not in used and len(chosen) < count:
            chosen.append((first, second))
            used.update((first, second))
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)
