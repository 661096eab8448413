"""Which corner of a map a surveyed point is of, where the whole map may lie off by more than its paint is wide.

A dash is 12 cm wide, and a receiver drifts by as much: the nearest corner may be the wrong one. But the errors of
neighbouring corners are alike. So the surest point is matched first; what its corner is off tells where the
others will be (the mean and covariance of a normal distribution, given part of it), and the next surest follows.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from v2hdm.records import FloatArray, IntArray


def match(
    points_map: FloatArray, corners_map: FloatArray, reach_m: float, covariance_m2: FloatArray
) -> IntArray:
    """The corner (N,) of ``corners_map`` (M, 2) that each surveyed point (N, 2) is of, -1 for none.

    A point is of a corner within ``reach_m`` if there is one, however badly it fits, and no corner has two
    points.

    Args:
        points_map: m.
        corners_map: m.
        reach_m: how far a corner may lie from its point.
        covariance_m2: (2N, 2N) of corner minus point, stacked x0, y0, x1, ...
    """
    near = KDTree(corners_map).query_ball_point(points_map, reach_m)
    most = max([len(one) for one in near], default=0)
    corner = np.full((len(points_map), most), -1, dtype=np.int64)
    for k, one in enumerate(near):
        corner[k, : len(one)] = sorted(one)
    off_m = corners_map[corner] - points_map[:, None]
    out = np.full(len(points_map), -1, dtype=np.int64)
    mean, covariance = np.zeros((len(points_map), 2)), covariance_m2.copy()
    # A corner that is not the point's lies anywhere within reach of it.
    chance = 2 * np.log(np.pi * reach_m**2)
    while len(waiting := np.flatnonzero((out < 0) & (corner >= 0).any(axis=1))):
        rows = 2 * waiting[:, None] + np.arange(2)
        own = covariance[rows[:, :, None], rows[:, None, :]]
        unlikely = _unlikely(off_m[waiting] - mean[waiting, None], own)
        unlikely[corner[waiting] < 0] = np.inf
        first = unlikely.min(axis=1)
        rival = np.minimum(np.partition(unlikely, 1, axis=1)[:, 1], chance) if most > 1 else chance
        surest = int(np.argmax(rival - first))
        k, choice = int(waiting[surest]), int(np.argmin(unlikely[surest]))
        out[k] = corner[k, choice]
        if first[surest] < chance:
            mean, covariance = _given(mean, covariance, k, off_m[k, choice])
        corner[corner == out[k]] = -1
    return out


def _unlikely(off_m: FloatArray, covariance_m2: FloatArray) -> FloatArray:
    """Minus twice the log density (N, K) of offsets (N, K, 2) of N normal distributions."""
    inverse = np.linalg.inv(covariance_m2)
    squared = np.einsum("nki,nij,nkj->nk", off_m, inverse, off_m)
    return np.asarray(squared + np.log((2 * np.pi) ** 2 * np.linalg.det(covariance_m2))[:, None])


def _given(
    mean: FloatArray, covariance: FloatArray, k: int, off_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Means (N, 2) and joint covariance (2N, 2N) once point ``k`` is known to be ``off_m`` (2,) off."""
    own = slice(2 * k, 2 * k + 2)
    gain = np.linalg.solve(covariance[own, own], covariance[own]).T
    moved = mean + (gain @ (off_m - mean[k])).reshape(-1, 2)
    return moved, covariance - gain @ covariance[own]
