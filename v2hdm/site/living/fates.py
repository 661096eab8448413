"""The most likely assignment of a new map's markings to an old one's, and their fates.

An old marking was found again, in place or repainted elsewhere, or is gone, out of every image's view, or was
missed. A new marking without an old one is new paint, or was missed before. The rates are learned from the
pair of maps (expectation maximisation with a Dirichlet prior); one assignment maximises the joint likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching
from scipy.spatial import cKDTree
from scipy.special import logsumexp

from v2hdm.geometry.planar import SHIFTS, align
from v2hdm.records import FloatArray, IntArray, Marking
from v2hdm.site.living.map_errors import SHIFT, Errors, Shift
from v2hdm.site.shapes import rigid_motions

_MOVED_SIGMA_M = 0.5  # sigma of a coordinate, m, of a repainted marking about its old place: a new line
_TURNED_SIGMA_RAD = 0.2  # sigma of the rotation of a repainted marking, rad
_REACH_M = 4 * _MOVED_SIGMA_M  # largest distance of one marking in both maps, m

_OTHER_SHAPE_M = 0.1
"""Standard deviation, m, of corners between two markings of a class: two shapes, or two lengths."""

_MISREAD_M = 0.3  # standard deviation, m, of an end or corner that one drive took from another edge
_MISREAD_SHARE = 0.05  # fraction of markings with an end or corner that one of two drives misread

_PRIOR_COUNT = np.array([47.0, 1.0, 2.0])
"""Dirichlet prior: of fifty markings, the numbers that stay, are repainted elsewhere, are gone."""

_PRIOR_NEW = (1.0, 50.0)  # Gamma prior: one new marking per fifty old ones
_PASSES = 4  # rounds of shift, odds and assignment; the assignment settles within three

STAYED, MOVED = range(2)  # columns of the likelihoods of a pair


@dataclass(frozen=True)
class Watched:
    """Log-likelihoods (N,) of the images of unmapped places, with and without a marking there."""

    painted: FloatArray
    bare: FloatArray

    @classmethod
    def never(cls, count: int) -> Watched:
        """For places in no image."""
        return cls(np.zeros(count), np.zeros(count))


@dataclass(frozen=True)
class Pair:
    """An old and a new marking that are one; corner c is (c + ``turn``) mod 4; probability of ``moved``."""

    old: int
    new: int
    turn: int
    moved: float


@dataclass(frozen=True)
class Decision:
    """The fates of the markings."""

    pairs: tuple[Pair, ...]  # found again
    gone: dict[int, float]  # probability, by old marking not found again
    fresh: dict[int, float]  # probability of new paint, by new marking without partner
    shift: Shift  # relative shift of the maps


@dataclass(frozen=True)
class _Candidates:
    """P pairs of markings that may be one: indices, the new one's turn, and differences of corners."""

    old: IntArray
    new: IntArray
    turn: IntArray
    off: FloatArray  # (P, 8) m
    noise: FloatArray  # (P, 8, 8) m^2, of both markings
    basis: FloatArray  # (P, 8, 8) rows: two of translation, one of rotation, five deformations
    arm_m: FloatArray  # (P,) scale of the rotation

    def __len__(self) -> int:
        return len(self.old)


@dataclass(frozen=True)
class _Rates:
    """Log probabilities of an old marking's fates, and log densities per m^2 of new and of older paint."""

    stayed: float
    moved: float
    gone: float
    remains: float
    new_per_m2: float
    older_per_m2: float


def decide(
    old: Sequence[Marking],
    new: Sequence[Marking],
    of_old: Errors,
    of_new: Errors,
    watched_now: Watched,
    watched_before: Watched,
) -> Decision:
    """Decide the fates of the ``old`` markings of an earlier map and of a drive's ``new`` ones.

    ``watched_now`` are the new drive's looks at unmapped old markings, ``watched_before`` the earlier drive's
    at the places of new ones.
    """
    candidates = _candidates(old, new, of_old, of_new)
    shift = _shift(of_old, of_new, candidates, np.zeros(0, dtype=np.int64))
    rates = _rates(_PRIOR_COUNT, _PRIOR_NEW)
    chosen = np.zeros(0, dtype=np.int64)
    moved = np.zeros(0)
    gone = np.zeros(len(old))
    fresh = np.zeros(len(new))
    for _ in range(_PASSES):
        likelihood = _likelihoods(candidates, shift, chosen, rates)
        unseen = np.logaddexp(rates.gone + watched_now.bare, rates.remains + watched_now.painted)
        gone = np.exp(rates.gone + watched_now.bare - unseen)
        painted = rates.new_per_m2 + watched_before.bare
        density = np.logaddexp(painted, rates.older_per_m2 + watched_before.painted)
        fresh = np.exp(painted - density)
        of_pair = logsumexp(likelihood, axis=1)
        score = of_pair - unseen[candidates.old] - _alone(candidates, density[candidates.new])
        chosen = _assign(candidates, score)
        moved = np.exp(likelihood[:, MOVED] - of_pair)
        stayed = chosen[moved[chosen] < 0.5]
        shift = _shift(of_old, of_new, candidates, stayed)
        alone_old = np.setdiff1d(np.arange(len(old)), candidates.old[chosen])
        alone_new = np.setdiff1d(np.arange(len(new)), candidates.new[chosen])
        counts = [(1 - moved[chosen]).sum(), moved[chosen].sum(), gone[alone_old].sum()]
        rates = _rates(
            _PRIOR_COUNT + counts, (_PRIOR_NEW[0] + fresh[alone_new].sum(), _PRIOR_NEW[1] + len(chosen))
        )
    pairs = [
        Pair(
            old=int(candidates.old[p]),
            new=int(candidates.new[p]),
            turn=int(candidates.turn[p]),
            moved=float(moved[p]),
        )
        for p in chosen.tolist()
    ]
    return Decision(
        pairs=tuple(pairs),
        gone={k: float(gone[k]) for k in alone_old.tolist()},
        fresh={k: float(fresh[k]) for k in alone_new.tolist()},
        shift=shift,
    )


def _rates(counts: FloatArray, new: tuple[float, float]) -> _Rates:
    """Rates from the ``counts`` of the fates, and ``new`` markings per number of old ones."""
    stayed, moved, gone = np.log(counts / counts.sum())
    # About one older marking lies within reach of an old one: its density over that area.
    older = -float(np.log(np.pi * _REACH_M**2))
    return _Rates(
        stayed=stayed,
        moved=moved,
        gone=gone,
        remains=float(np.log1p(-np.exp(gone))),
        new_per_m2=older + np.log(new[0] / new[1]),
        older_per_m2=older,
    )


def _candidates(
    old: Sequence[Marking], new: Sequence[Marking], of_old: Errors, of_new: Errors
) -> _Candidates:
    """The pairs of one class within reach."""
    in_reach: list[list[int]] = [[] for _ in old]
    if len(old) and len(new):
        in_reach = cKDTree(of_new.centres_map).query_ball_point(of_old.centres_map, _REACH_M).tolist()
    pairs = [
        (a, b) for a, others in enumerate(in_reach) for b in sorted(others) if old[a].kind == new[b].kind
    ]
    first, second = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    before = np.array([old[a].corners_map for a in first]).reshape(-1, 4, 2)
    after = np.array([new[b].corners_map for b in second]).reshape(-1, 4, 2)
    whole = np.ones(before.shape[:2], dtype=bool)
    turn = align(before, whole, after, whole).shift
    turned = np.take_along_axis(after, SHIFTS[turn][..., None], axis=1)
    order = (2 * SHIFTS[turn][..., None] + np.arange(2)).reshape(-1, 8)
    rows = np.arange(len(second))[:, None, None]
    noise = of_old.own_m2[first] + of_new.own_m2[second][rows, order[:, :, None], order[:, None, :]]
    motions = rigid_motions(before)
    basis = np.swapaxes(np.linalg.qr(motions, mode="complete")[0], 1, 2)
    off = (turned - before).reshape(-1, 8)
    return _Candidates(
        old=first,
        new=second,
        turn=turn,
        off=off,
        noise=noise,
        basis=basis,
        arm_m=np.linalg.norm(motions[..., 2], axis=1),
    )


def _shift(of_old: Errors, of_new: Errors, candidates: _Candidates, stayed: IntArray) -> Shift:
    """Relative shift of the maps from the candidates ``stayed``."""
    information = np.linalg.inv(candidates.noise[stayed])
    common = SHIFT.T @ information @ SHIFT
    pulled = SHIFT.T @ information @ candidates.off[stayed][..., None]
    spread = np.linalg.inv(common)
    return Shift(
        of_old=of_old,
        of_new=of_new,
        old=candidates.old[stayed],
        new=candidates.new[stayed],
        off_map=(spread @ pulled)[..., 0],
        noise_m2=np.asarray(spread, dtype=np.float64),
    )


def _likelihoods(candidates: _Candidates, shift: Shift, chosen: IntArray, rates: _Rates) -> FloatArray:
    """Log-likelihood (P, 2) of each candidate pair having stayed or moved, prior included."""
    of_pair = {(int(a), int(b)): k for k, (a, b) in enumerate(zip(shift.old, shift.new, strict=True))}
    log_likelihood = np.empty((len(candidates), 2))
    for p in range(len(candidates)):
        old = int(candidates.old[p])
        new = int(candidates.new[p])
        pair = of_pair.get((old, new))
        mean, spread = shift.at(old, new) if pair is None else shift.without_itself(pair)
        off = candidates.basis[p] @ (candidates.off[p] - SHIFT @ mean)
        noise = candidates.basis[p] @ (candidates.noise[p] + SHIFT @ spread @ SHIFT.T) @ candidates.basis[p].T
        # In this basis a shift counts twice its length, a rotation its arm.
        free = np.zeros(8)
        free[:2] = (2 * _MOVED_SIGMA_M) ** 2
        free[2] = (candidates.arm_m[p] * _TURNED_SIGMA_RAD) ** 2
        log_likelihood[p, STAYED] = rates.stayed + _read(off, noise)
        log_likelihood[p, MOVED] = rates.moved + _read(off, noise + np.diag(free))
    return log_likelihood


def _read(off: FloatArray, noise: FloatArray) -> float:
    """Log-likelihood of a deviation (8,) with a possible misread end or corner."""
    plain = np.log1p(-_MISREAD_SHARE) + _normal(off, noise)
    misread = noise + np.diag(np.repeat([0.0, _MISREAD_M**2], [3, 5]))
    return float(np.logaddexp(plain, np.log(_MISREAD_SHARE) + _normal(off, misread)))


def _normal(off: FloatArray, covariance: FloatArray) -> float:
    """Log density of a deviation (K,) under its covariance (K, K)."""
    root = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(root, off)
    return float(-0.5 * (whitened @ whitened + len(off) * np.log(2 * np.pi)) - np.log(np.diag(root)).sum())


def _alone(candidates: _Candidates, density: FloatArray) -> FloatArray:
    """Log density (P,) of each pair's new marking, in its basis, as an unrelated marking."""
    off = (candidates.basis @ candidates.off[..., None])[..., 0]
    noise = candidates.basis @ candidates.noise @ np.swapaxes(candidates.basis, 1, 2)
    noise = noise[:, 3:, 3:] + _OTHER_SHAPE_M**2 * np.eye(5)
    shape = [_normal(deformation, formal) for deformation, formal in zip(off[:, 3:], noise, strict=True)]
    return np.asarray(density - np.log(4) - np.log(np.pi * candidates.arm_m) + np.array(shape))


def _assign(candidates: _Candidates, score: FloatArray) -> IntArray:
    """Candidates with the largest total score; each marking is in at most one."""
    better = np.flatnonzero(score > 0)
    if not len(better):
        return better
    old, row = np.unique(candidates.old[better], return_inverse=True)
    new, column = np.unique(candidates.new[better], return_inverse=True)
    # A dummy column per old marking lets it stay unassigned.
    alone = np.arange(len(old))
    most = 1.0 + score[better].max()
    cost = np.append(most - score[better], np.full(len(old), most))
    places = np.append(row, alone), np.append(column, len(new) + alone)
    graph = coo_array((cost, places), shape=(len(old), len(new) + len(old))).tocsr()
    _, partner = min_weight_full_bipartite_matching(graph)
    return np.asarray(better[partner[row] == column], dtype=np.int64)
