"""How a design lies in a map: a rigid motion of the whole, and which marking is which shape.

A design may lie off as a whole, for it was drawn on another datum or staked out from a wrong point. Rows of
like dashes fit each other at every shift by a dash; so each shift that many pairs of shapes of one class name
is tried, and the one counts under which the most shapes lie on their markings.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from v2hdm.geometry.planar import align
from v2hdm.records import FloatArray, IntArray

_FARTHEST_M = 30.0  # largest shift of a whole design, m, that is looked for; chosen
_BIN_M = 0.5  # width of the cells in which shifts are counted, m
_NEAR_M = 0.5  # distance, m, of a shape from its marking up to which it speaks for a motion of the whole
_TRIED = 12  # number of shifts to try: those that most pairs suggest
_ROUNDS = 8  # of pairing and fitting, from each shift
_FEWEST = 3  # pairs that a motion of the whole is fitted to
_SHIFT_SIGMA_M = 10.0  # prior standard deviation of a shift, m: of two that fit alike the smaller one counts
_MOST_VOTING = 400  # shapes that vote, spread over the design: the pairs grow with their square

REACH_M = 1.0
"""Distance, m, from a shape of a design, its corners', up to which a marking may be that shape, moved."""


class Motion(NamedTuple):
    """A rigid motion: points turn by ``turn_rad`` about ``about_map`` (2,), then move by ``shift_m`` (2,)."""

    turn_rad: float
    shift_m: FloatArray
    about_map: FloatArray

    def apply(self, points: FloatArray) -> FloatArray:
        """Points (..., 2) after the motion."""
        cos = np.cos(self.turn_rad)
        sin = np.sin(self.turn_rad)
        rotation = np.array([[cos, -sin], [sin, cos]])
        return np.asarray((points - self.about_map) @ rotation.T + self.about_map + self.shift_m)


class Pairs(NamedTuple):
    """P pairs: of a shape of the design, a marking, and the turn of its corners onto the shape's."""

    shape: IntArray
    marking: IntArray
    turn: IntArray  # corner c of the shape is corner (c + turn) mod 4 of the marking


def register(
    design: FloatArray, kinds: list[str | None], built: FloatArray, built_kinds: list[str]
) -> Motion:
    """The motion that takes the corners of a design (N, 4, 2) nearest to the built ones (M, 4, 2)."""
    centres = design.mean(axis=1)
    built_centres = built.mean(axis=1)
    about = centres.mean(axis=0)
    still = Motion(0.0, np.zeros(2), about)
    best = still
    best_score = -np.inf
    for shift in (np.zeros(2), *_named_shifts(centres, kinds, built_centres, built_kinds)):
        motion = still._replace(shift_m=shift)
        for _ in range(_ROUNDS):
            pairs = _near_pairs(motion.apply(centres), kinds, built_centres, built_kinds)
            if len(pairs.shape) < _FEWEST:
                break
            motion = _fitted(centres[pairs.shape], built_centres[pairs.marking], about)
        off_m = _near_pairs(motion.apply(centres), kinds, built_centres, built_kinds).off_m
        unlikely = float(motion.shift_m @ motion.shift_m) / (2 * _SHIFT_SIGMA_M**2)
        score = float(np.sum(1 - (off_m / _NEAR_M) ** 2)) - unlikely
        if score > best_score:
            best = motion
            best_score = score
    return best


def _named_shifts(
    centres: FloatArray, kinds: list[str | None], built: FloatArray, built_kinds: list[str]
) -> list[FloatArray]:
    """The shifts that the most pairs of a class name."""
    chosen = np.unique(np.linspace(0, len(centres) - 1, min(len(centres), _MOST_VOTING)).astype(int))
    tree = cKDTree(built)
    offsets = []
    for k, neighbours in zip(chosen, tree.query_ball_point(centres[chosen], _FARTHEST_M), strict=True):
        alike = [j for j in neighbours if kinds[k] in (None, built_kinds[j])]
        offsets.append(built[alike] - centres[k])
    every = np.concatenate([*offsets, np.zeros((0, 2))])
    cells, votes = np.unique(np.round(every / _BIN_M).astype(np.int64), axis=0, return_counts=True)
    most = np.argsort(-votes, kind="stable")[:_TRIED]
    return [_BIN_M * cell for cell in cells[most]]


class _Near(NamedTuple):
    """Pairs of shapes and markings that are each other's nearest, and their distances."""

    shape: IntArray
    marking: IntArray
    off_m: FloatArray


def _near_pairs(
    centres: FloatArray, kinds: list[str | None], built: FloatArray, built_kinds: list[str]
) -> _Near:
    off_m, nearest = cKDTree(built).query(centres, distance_upper_bound=_NEAR_M)
    _, back = cKDTree(centres).query(built, distance_upper_bound=_NEAR_M)
    shapes = [
        k
        for k, j in enumerate(nearest.tolist())
        if j < len(built) and back[j] == k and kinds[k] in (None, built_kinds[j])
    ]
    index = np.array(shapes, dtype=np.int64)
    return _Near(index, nearest[index].astype(np.int64), off_m[index])


def _fitted(centres: FloatArray, built: FloatArray, about: FloatArray) -> Motion:
    """The least-squares motion of centres (P, 2) onto built ones, without a scale."""
    mean = centres.mean(axis=0)
    built_mean = built.mean(axis=0)
    arms = centres - mean
    built_arms = built - built_mean
    crossed = np.sum(arms[:, 0] * built_arms[:, 1] - arms[:, 1] * built_arms[:, 0])
    turn_rad = float(np.arctan2(crossed, np.sum(arms * built_arms)))
    turned = Motion(turn_rad, np.zeros(2), about).apply(mean)
    return Motion(turn_rad, built_mean - turned, about)


def paired(design: FloatArray, kinds: list[str | None], built: FloatArray, built_kinds: list[str]) -> Pairs:
    """The pairs of shapes (N, 4, 2) and markings (M, 4, 2) of one class with the least squared distances."""
    centres = design.mean(axis=1)
    neighbours = cKDTree(built.mean(axis=1)).query_ball_point(centres, REACH_M)
    couples = [
        (k, j)
        for k, candidates in enumerate(neighbours)
        for j in sorted(candidates)
        if kinds[k] in (None, built_kinds[j])
    ]
    if not couples:
        nothing = np.zeros(0, dtype=np.int64)
        return Pairs(nothing, nothing, nothing)
    shape, marking = np.array(couples, dtype=np.int64).T
    every_corner = np.ones((len(shape), 4), dtype=np.bool_)
    aligned = align(design[shape], every_corner, built[marking], every_corner)
    turned = np.take_along_axis(built[marking], ((np.arange(4) + aligned.shift[:, None]) % 4)[..., None], 1)
    squared = np.sum((turned - design[shape]) ** 2, axis=(1, 2)) / 4
    return _cheapest(shape, marking, aligned.shift, squared, len(design), len(built))


def _cheapest(
    shape: IntArray, marking: IntArray, turn: IntArray, squared: FloatArray, shapes: int, markings: int
) -> Pairs:
    """The couples, with squared distances, m^2, that make the most pairs at the least cost."""
    graph = coo_array((np.ones(len(shape)), (shape, shapes + marking)), shape=(shapes + markings,) * 2)
    _, group = connected_components(graph, directed=False)
    chosen = []
    order = np.argsort(group[shape], kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(group[shape][order])) + 1):
        own_shapes, of_shape = np.unique(shape[rows], return_inverse=True)
        own_markings, of_marking = np.unique(marking[rows], return_inverse=True)
        cost = np.full((len(own_shapes), len(own_markings)), _NO_COUPLE)
        cost[of_shape, of_marking] = squared[rows]
        number = np.full(cost.shape, -1)
        number[of_shape, of_marking] = rows
        picked = number[linear_sum_assignment(cost)]
        chosen.extend(picked[picked >= 0].tolist())
    index = np.array(sorted(chosen), dtype=np.int64)
    return Pairs(shape[index], marking[index], turn[index])


_NO_COUPLE = 1e6  # cost, m^2, of what is no couple: beyond any of them
