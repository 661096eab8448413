"""How well a marking's place is known beside its neighbours, free of the drift and mounting that they share.

A vehicle that localises in the map, or a crane that measures from marking to marking, has this error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.records import FloatArray, IntArray, Marking
from v2hdm.site.candidates import UNSEEN_M2

JointCovariance = Callable[[IntArray], FloatArray]
"""Covariances (P, 2 n, 2 n), m^2, of the stacked corners of P groups (P, n) of corners."""

_NEIGHBOUR_M = 10.0  # distance at which markings are compared, m: a vehicle's length, for manoeuvres
FARTHEST_M = 15.0
"""Largest distance to another marking, m, for a relative standard deviation."""

_NEIGHBOURS = 4  # largest number of neighbours: with n, their own errors add 1 / 2 n to the sigma, an eighth


def with_relative_sigma(
    markings: Sequence[Marking], corner_index: IntArray, joint: JointCovariance
) -> tuple[Marking, ...]:
    """The markings (M,), each with the standard deviation of its place, given those of its neighbours.

    It is never larger than the marking's own, however badly the neighbours are known. ``corner_index`` (M, 4)
    numbers the corners in the solution, -1 for unseen ones; ``joint`` is the solution's. A marking's own
    covariance counts besides: of its paint, of ends that may be hidden, of a shape that its class prescribes.
    """
    rows = np.flatnonzero((corner_index >= 0).any(axis=1))
    if not len(rows):
        return tuple(markings)
    chosen = [markings[m] for m in rows.tolist()]
    stated_m2 = np.array([marking.covariance_m2 for marking in chosen])
    others = neighbours(np.array([marking.corners_map.mean(axis=0) for marking in chosen]))
    improved = list(markings)
    for count in range(1, _NEIGHBOURS + 1):
        # The marking itself comes last.
        groups = np.array(
            [
                [*nearest[:count], k]
                for k, nearest in enumerate(others)
                if min(len(nearest), _NEIGHBOURS) == count
            ],
            dtype=np.int64,
        )
        if not len(groups):
            continue
        formal_m2 = _of_solution(corner_index[rows][groups], joint)
        left_m2 = _left_open(_of_centres(_as_stated(formal_m2, stated_m2[groups])))
        for k, sigma_m in zip(groups[:, -1].tolist(), np.sqrt(left_m2).tolist(), strict=True):
            improved[rows[k]] = replace(chosen[k], relative_sigma_m=sigma_m)
    return tuple(improved)


def neighbours(centres_map: FloatArray) -> Sequence[IntArray]:
    """The others within reach of each point (N, 2), m, the one whose distance is nearest to 10 m first."""
    out = []
    for k, in_reach in enumerate(cKDTree(centres_map).query_ball_point(centres_map, FARTHEST_M)):
        others = np.array([other for other in in_reach if other != k], dtype=np.int64)
        distance_m = np.linalg.norm(centres_map[others] - centres_map[k], axis=1)
        out.append(others[np.argsort(np.abs(distance_m - _NEIGHBOUR_M), kind="stable")])
    return out


def _of_solution(corners: IntArray, joint: JointCovariance) -> FloatArray:
    """The covariances (P, n, 8, n, 8) of the solution for n markings with ``corners`` (P, n, 4) each."""
    groups, markings, _ = corners.shape
    solved_corners = np.where(corners >= 0, corners, corners.max(axis=2, keepdims=True))
    joint_m2 = joint(solved_corners.reshape(groups, -1))
    unseen = np.repeat(corners.reshape(groups, -1) < 0, 2, axis=1)
    unknown_m2 = UNSEEN_M2 * np.eye(unseen.shape[1])
    joint_m2 = np.where(unseen[:, :, None] | unseen[:, None, :], unknown_m2, joint_m2)
    return np.asarray(joint_m2.reshape(groups, markings, 8, markings, 8))


def _as_stated(formal_m2: FloatArray, stated_m2: FloatArray) -> FloatArray:
    """Joint covariances as ``formal_m2`` (P, n, 8, n, 8), each marking's own as ``stated_m2`` (P, n, 8, 8).

    What was learned of a marking besides the solution, such as its shape, corrects its corners by what the
    solution knows of them, as in a Kalman filter; what is stated beyond the solution's is its own error.
    """
    number = np.arange(formal_m2.shape[1])
    root = np.linalg.cholesky(np.moveaxis(formal_m2[:, number, :, number, :], 0, 1))
    whitened = np.linalg.solve(root, np.swapaxes(np.linalg.solve(root, stated_m2), -1, -2))
    share, axes = np.linalg.eigh((whitened + np.swapaxes(whitened, -1, -2)) / 2)
    explained = (axes * np.clip(share, 0.0, 1.0)[..., None, :]) @ np.swapaxes(axes, -1, -2)
    gain = root @ explained @ np.linalg.inv(root)
    joint_m2 = np.einsum("piab,pibjc,pjdc->piajd", gain, formal_m2, gain, optimize=True)
    joint_m2[:, number, :, number, :] = np.moveaxis(stated_m2, 1, 0)
    return np.asarray(joint_m2)


def _of_centres(corners_m2: FloatArray) -> FloatArray:
    """The covariances (P, 2 n, 2 n) of the centres of n markings with those (P, n, 8, n, 8) of corners."""
    count = corners_m2.shape[1]
    by_corner = (-1, count, 4, 2, count, 4, 2)
    return np.asarray(corners_m2.reshape(by_corner).mean(axis=(2, 5)).reshape(-1, 2 * count, 2 * count))


def _left_open(joint_m2: FloatArray) -> FloatArray:
    """The variance (P,) of a coordinate of the last of n points, given the others; joint (P, 2 n, 2 n)."""
    # The last block of the triangular root is the root of that conditional covariance.
    last = np.linalg.cholesky(joint_m2)[:, -2:, -2:]
    return np.asarray(np.square(last).sum(axis=(1, 2)) / 2)
