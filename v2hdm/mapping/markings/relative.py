"""How sure a marking is beside its neighbours, whatever drift or survey moves all of them alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.records import FloatArray, IntArray, Marking

JointCovariance = Callable[[IntArray], FloatArray]
"""Covariances (P, 8, 8), m^2, of the stacked corners of pairs of diagonals (P, 4): two corners of either."""

NEIGHBOUR_M = 10.0
"""How far apart markings are compared, m: about a vehicle's length, over which it manoeuvres."""

_FARTHEST_M = 15.0
"""A marking without another one within so many metres has no relative standard deviation."""

_CENTRES = np.kron(np.array([[0.5, 0.5, -0.5, -0.5]]), np.eye(2))


def with_relative_sigma(
    markings: Sequence[Marking], corner_index: IntArray, joint: JointCovariance
) -> tuple[Marking, ...]:
    """The markings with what each contributes to the error of the distance to one about 10 m away.

    To the errors of the adjustment comes what the marking's own covariance has beyond it: an error of its
    paint, which it shares with no other.

    Args:
        markings: (M,) of the map.
        corner_index: (M, 4) the number of their corners in the solution, -1 where a corner was not seen.
        joint: of corners of the solution.
    """
    seen = np.flatnonzero((corner_index >= 0).sum(axis=1) >= 3)
    if not len(seen):
        return tuple(markings)
    chosen = [markings[m] for m in seen.tolist()]
    diagonal = _diagonals(corner_index[seen])
    first, second = neighbours(np.array([marking.corners_map.mean(axis=0) for marking in chosen]))
    if not len(first):
        return tuple(markings)
    covariance = joint(np.concatenate([diagonal[first], diagonal[second]], axis=1))
    apart = _CENTRES @ covariance @ _CENTRES.T
    formal = _CENTRES[:, :4] @ covariance[:, :4, :4] @ _CENTRES[:, :4].T
    stated = np.array([_centre_variance_m2(chosen[k]) for k in first])
    own = np.maximum(stated - np.trace(formal, axis1=1, axis2=2) / 2, 0.0)
    # The difference of two centres has the errors of both.
    sigma_m = np.sqrt(np.trace(apart, axis1=1, axis2=2) / 4 + own)
    out = list(markings)
    for marking, sigma in zip(seen[first].tolist(), sigma_m.tolist(), strict=True):
        out[marking] = replace(markings[marking], relative_sigma_m=sigma)
    return tuple(out)


def _centre_variance_m2(marking: Marking) -> float:
    """Variance of a coordinate of the mean of its corners."""
    assert marking.covariance_m2 is not None
    return float(np.einsum("iaja->", marking.covariance_m2.reshape(4, 2, 4, 2)) / 32)


def neighbours(centres_map: FloatArray) -> tuple[IntArray, IntArray]:
    """Pairs of points (N, 2): each that has others near, with the one whose distance is nearest to 10 m."""
    first, second = [], []
    tree = cKDTree(centres_map)
    for own, near in enumerate(tree.query_ball_point(centres_map, _FARTHEST_M)):
        others = np.array([other for other in near if other != own], dtype=np.int64)
        if len(others):
            distance_m = np.linalg.norm(centres_map[others] - centres_map[own], axis=1)
            first.append(own)
            second.append(int(others[np.argmin(np.abs(distance_m - NEIGHBOUR_M))]))
    return np.array(first, dtype=np.int64), np.array(second, dtype=np.int64)


def _diagonals(corner_index: IntArray) -> IntArray:
    """Of markings (M, 4) of which three corners are known, two (M, 2) that are opposite each other."""
    even = np.asarray((corner_index[:, [0, 2]] >= 0).all(axis=1, keepdims=True))
    return np.where(even, corner_index[:, [0, 2]], corner_index[:, [1, 3]])
