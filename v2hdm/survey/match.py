"""Match surveyed points with the corners of a map.

The map may lie off by more than its paint is wide: a dash is 12 cm wide, and a receiver drifts by as much, so
that the nearest corner may be the wrong one. But neighbouring corners have like errors, so that one match
predicts the others (mean and covariance of a normal distribution, given part of it). The match of one point
that the others agree with most is found first, and then always the surest one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from v2hdm.records import FloatArray, IntArray


def match(
    points_map: FloatArray, corners_map: FloatArray, reach_m: float, covariance_m2: FloatArray
) -> IntArray:
    """The corner (N,) of ``corners_map`` (M, 2) that each surveyed point (N, 2) is of, m, -1 for none.

    A point is of a corner within ``reach_m`` if there is one, however badly it fits, and no corner has two
    points. ``covariance_m2`` (2N, 2N) is of corner minus point, stacked x0, y0, x1, ...
    """
    from scipy.spatial import KDTree  # of the map extra, as its callers are

    count = len(points_map)
    in_reach = KDTree(corners_map).query_ball_point(points_map, reach_m)
    most = max([len(corners) for corners in in_reach], default=0)
    corner = np.full((count, most), -1, dtype=np.int64)
    for k, corners in enumerate(in_reach):
        corner[k, : len(corners)] = sorted(corners)
    off_m = corners_map[corner] - points_map[:, None]
    out = np.full(count, -1, dtype=np.int64)
    # Survey and poses may be of two datums: then all points are off alike, within reach at two sigmas.
    datum = (reach_m / 2) ** 2 * np.kron(np.ones((count, count)), np.eye(2))
    mean = np.zeros((count, 2))
    covariance = covariance_m2 + datum
    # A corner that is not the point's lies anywhere within reach of it.
    chance = 2 * float(np.log(np.pi * reach_m**2))
    choice = _first(corner, off_m, covariance, chance)
    while choice is not None:
        k = choice.point
        out[k] = corner[k, choice.rank]
        if choice.fits:
            of_point = slice(2 * k, 2 * k + 2)
            gain = np.linalg.solve(covariance[of_point, of_point], covariance[of_point]).T
            mean = mean + (gain @ (off_m[k, choice.rank] - mean[k])).reshape(-1, 2)
            covariance = covariance - gain @ covariance[of_point]
        corner[k] = -1
        corner[corner == out[k]] = -1
        choice = _surest(corner, off_m - mean[:, None], covariance, chance)
    return out


class _Choice(NamedTuple):
    """A surveyed point and its corner."""

    point: int
    rank: int  # which of the point's corners
    fits: bool  # whether it is likelier than chance


def _first(corner: IntArray, off_m: FloatArray, covariance: FloatArray, chance: float) -> _Choice | None:
    """The choice under which all points together are likeliest, each of its best corner or of none."""
    blocks = _own_blocks(covariance)
    alone = _unlikely(corner, off_m, blocks)
    best: tuple[float, _Choice] | None = None
    for k, rank in np.argwhere(corner >= 0).tolist():
        rows = slice(2 * k, 2 * k + 2)
        gain = np.linalg.solve(covariance[rows, rows], covariance[rows]).T.reshape(-1, 2, 2)
        mean = gain @ off_m[k, rank]
        left = blocks - gain @ covariance[rows].reshape(2, -1, 2).transpose(1, 0, 2)
        others = np.arange(len(corner)) != k
        free = np.where(corner == corner[k, rank], -1, corner)[others]
        unlikely = _unlikely(free, (off_m - mean[:, None])[others], left[others])
        total = float(alone[k, rank] + np.minimum(unlikely.min(axis=1), chance).sum())
        if best is None or total < best[0]:
            best = total, _Choice(k, rank, total < chance * len(corner))
    return None if best is None else best[1]


def _surest(corner: IntArray, off_m: FloatArray, covariance: FloatArray, chance: float) -> _Choice | None:
    """The choice that beats the point's other corners, and chance, by most."""
    waiting = np.flatnonzero((corner >= 0).any(axis=1))
    if not len(waiting):
        return None
    unlikely = _unlikely(corner[waiting], off_m[waiting], _own_blocks(covariance)[waiting])
    ranked = np.column_stack([np.sort(unlikely, axis=1), np.full(len(waiting), np.inf)])
    lead = np.minimum(ranked[:, 1], chance) - ranked[:, 0]
    row = int(np.argmax(lead))
    rank = int(np.argmin(unlikely[row]))
    return _Choice(int(waiting[row]), rank, bool(ranked[row, 0] < chance))


def _own_blocks(covariance: FloatArray) -> FloatArray:
    """The covariance (N, 2, 2) of each point."""
    count = len(covariance) // 2
    return covariance.reshape(count, 2, count, 2)[np.arange(count), :, np.arange(count)]


def _unlikely(corner: IntArray, off_m: FloatArray, covariance_m2: FloatArray) -> FloatArray:
    """Minus twice the log density (N, K) of offsets (N, K, 2), normally distributed; inf for no corner."""
    squared = np.einsum("nki,nij,nkj->nk", off_m, np.linalg.inv(covariance_m2), off_m)
    density = squared + np.log((2 * np.pi) ** 2 * np.linalg.det(covariance_m2))[:, None]
    return np.where(corner >= 0, density, np.inf)
