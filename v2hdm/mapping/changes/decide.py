"""Which marking of a new map is which of an old one: the likeliest of all that may have happened to them.

Of a marking of the old map, the new drive may have seen it where it was, seen it elsewhere because it was painted
anew there, or not seen it, because it is gone, because no image showed its place, or because it was missed. A
marking of the new map that is none of the old one is new paint, or was missed before. Each has a likelihood; how
often each happens is learned from the pair of maps (expectation maximisation with a Dirichlet prior), and one
assignment makes all of it as likely as can be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import logsumexp

from v2hdm.geometry.quadrilateral import SHIFTS, align
from v2hdm.mapping.changes.field import SHIFT, Errors, Shift
from v2hdm.records import FloatArray, IntArray, Marking

MOVED_SIGMA_M = 0.5
"""Sigma of how far a marking is painted from where it was, m a coordinate: a new line of the same bay."""

TURNED_SIGMA_RAD = 0.2
"""Sigma of how far it is turned then, rad."""

_REACH_M = 4 * MOVED_SIGMA_M
"""Markings farther apart are never one, m."""

_OTHER_SHAPE_M = 0.1
"""Sigma by which corners of two markings of one class differ, m: two shapes, or two lengths of one line."""

_MISREAD_M = 0.3
"""Sigma of an end or corner that one of two drives has taken from another edge, m, as in the site model."""

_MISREAD_SHARE = 0.05
"""Share of markings of which one of two drives has misread an end or a corner."""

_PRIOR_COUNT = np.array([47.0, 1.0, 2.0])
"""Dirichlet prior: of fifty markings about so many stay, are painted elsewhere, are gone."""

_PRIOR_NEW = (1.0, 50.0)
"""Gamma prior: one new marking where there were fifty."""

_PASSES = 4
"""Rounds of shift, odds and assignment; the assignment settles within three."""

STAYED, MOVED = range(2)


@dataclass(frozen=True)
class Watched:
    """How often places of N markings were looked at, in log likelihoods (N,).

    ``there`` is that of what the images show if the marking is there, and yet is not in the map of the drive;
    ``bare`` if it is not there.
    """

    there: FloatArray
    bare: FloatArray

    @classmethod
    def never(cls, count: int) -> Watched:
        """Of places that no image shows."""
        return cls(np.zeros(count), np.zeros(count))


@dataclass(frozen=True)
class Pair:
    """An old and a new marking that are one: corner c of the old one is corner (c + ``turn``) mod 4 of the new.

    ``moved`` is the probability that it was painted elsewhere.
    """

    old: int
    new: int
    turn: int
    moved: float


@dataclass(frozen=True)
class Decision:
    """What became of the markings.

    ``pairs`` were seen again; ``gone`` are the probabilities by old marking that was not, ``fresh`` those by
    new marking that has no partner, that it is new paint. ``shift`` is how the maps lie to each other.
    """

    pairs: tuple[Pair, ...]
    gone: dict[int, float]
    fresh: dict[int, float]
    shift: Shift


@dataclass(frozen=True)
class _Candidates:
    """P pairs of markings that may be one: their numbers, the new one's turn, and how its corners are off.

    ``off`` (P, 8), m; ``noise`` (P, 8, 8), m^2, is that of both; ``basis`` (P, 8, 8) has rows for two shifts, the
    turn and five deformations; ``arm_m`` (P,) is what a turn is multiplied by in it.
    """

    old: IntArray
    new: IntArray
    turn: IntArray
    off: FloatArray
    noise: FloatArray
    basis: FloatArray
    arm_m: FloatArray

    def __len__(self) -> int:
        return len(self.old)


@dataclass(frozen=True)
class _Rates:
    """Log probabilities of an old marking's fate, and log density of new ones per m^2."""

    stayed: float
    moved: float
    gone: float
    kept: float
    new_per_m2: float


def decide(
    old: Sequence[Marking],
    new: Sequence[Marking],
    of_old: Errors,
    of_new: Errors,
    watched_now: Watched,
    watched_before: Watched,
) -> Decision:
    """Tell what became of the ``old`` markings, and what the ``new`` ones are.

    Args:
        old: of the earlier map.
        new: of the new drive's own map.
        of_old: errors of the former.
        of_new: errors of the latter.
        watched_now: how often the new drive looked at the old markings that it has not mapped.
        watched_before: how often the earlier drive looked at the places of the new ones.
    """
    candidates = _candidates(old, new, of_old, of_new)
    shift = _shift(of_old, of_new, candidates, np.zeros(0, dtype=np.int64))
    rates = _rates(_PRIOR_COUNT, _PRIOR_NEW, len(new))
    chosen, moved = np.zeros(0, dtype=np.int64), np.zeros(0)
    gone, fresh = np.zeros(len(old)), np.zeros(len(new))
    for _ in range(_PASSES):
        likelihood = _likelihoods(candidates, shift, chosen, rates)
        unseen = np.logaddexp(rates.gone + watched_now.bare, rates.kept + watched_now.there)
        gone = np.exp(rates.gone + watched_now.bare - unseen)
        density = rates.new_per_m2 + np.logaddexp(watched_before.bare, _missed(rates) + watched_before.there)
        fresh = np.exp(rates.new_per_m2 + watched_before.bare - density)
        both = logsumexp(likelihood, axis=1)
        score = both - unseen[candidates.old] - _alone(candidates, density[candidates.new])
        chosen = _assign(candidates, score)
        moved = np.exp(likelihood[:, MOVED] - both)
        stayed = chosen[moved[chosen] < 0.5]
        shift = _shift(of_old, of_new, candidates, stayed)
        alone_old = np.setdiff1d(np.arange(len(old)), candidates.old[chosen])
        alone_new = np.setdiff1d(np.arange(len(new)), candidates.new[chosen])
        counts = [(1 - moved[chosen]).sum(), moved[chosen].sum(), gone[alone_old].sum()]
        rates = _rates(
            _PRIOR_COUNT + counts,
            (_PRIOR_NEW[0] + fresh[alone_new].sum(), _PRIOR_NEW[1] + len(old)),
            len(new),
        )
    numbers = zip(candidates.old[chosen], candidates.new[chosen], candidates.turn[chosen], strict=True)
    return Decision(
        pairs=tuple(
            Pair(int(a), int(b), int(turn), float(probability))
            for (a, b, turn), probability in zip(numbers, moved[chosen], strict=True)
        ),
        gone={int(k): float(gone[k]) for k in alone_old},
        fresh={int(k): float(fresh[k]) for k in alone_new},
        shift=shift,
    )
