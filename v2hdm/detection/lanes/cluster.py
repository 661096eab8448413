"""Which crossings and pieces of paint are one line.

Crossings are linked from row to row into chains, near ones first: near the vehicle lines are far apart, so
that each is known by the time they run together. Chains and pieces of paint are then joined as long as they
are more likely one line than two, the likeliest pair first (Bayesian hierarchical clustering). A far dash
joins a near one by the curve that both suggest and by the road that they lie along. Lines painted along a
road are parallel: of u = a + b v + c / v (:mod:`v2hdm.detection.lanes.curve`) they share a, their vanishing
point, and c; only b, the place beside the camera, is each one's own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from v2hdm.detection.lanes.curve import Evidence, Horizon, Line, LinePoints, Prior
from v2hdm.records import FloatArray, IntArray

_MIN_CHAIN = 3
_CHAIN_ODDS = 0.0
"""Chains are made of crossings more likely than not."""

_MAX_GAP_PX = 40.0
_SLOPE_POINTS = 6
"""Over how many of its last points a chain's direction is taken."""

_MAX_SLOPE = 4.5
_GATE_PX = 12.0

_FREE_SIGMAS = (0.5, 8.0, 0.008)
"""Lines of any kind: direction about the camera's, rad, place beside it, m, and curvature, 1/m."""

_PARALLEL_SIGMAS = (0.012, 0.0, 0.001)
"""By how much lines of one road differ in direction, rad, and curvature, 1/m.

An error of half a degree in the camera's pitch turns lines 2 m to the side of a low camera by as much.
"""

_SHARE = 0.85
"""So many lines keep to the road; kerbs and strokes of letters need not."""

_FREE_KEPT = np.diag([0.04, 0.04, 1.0])
_ALONG_KEPT = np.array([[1.0, 0.0, 1.0], [0.0, 0.04, 0.0], [1.0, 0.0, 1.0]])
"""Where lines tend to be says what is one line, not where that one is: so much of the prior is kept there."""

_CANDIDATES = 4
"""So many of the groups known best are tried as the road's direction."""

_SHARED = [0, 2]
_SHARED_BLOCK = np.ix_(_SHARED, _SHARED)


@dataclass
class _Chain:
    """A line so far: rows and columns, px, and indices of its crossings, from near to far."""

    v_px: list[float]
    u_px: list[float]
    index: list[int]
    slope: float | None = None
    """Columns per row over the last points; None as long as there is one only."""

    def add(self, v_px: float, u_px: float, index: int) -> None:
        self.v_px.append(v_px)
        self.u_px.append(u_px)
        self.index.append(index)
        first = max(-len(self.v_px), -_SLOPE_POINTS)
        self.slope = (u_px - self.u_px[first]) / (self.v_px[first] - v_px)

    def expected(self, v_px: float) -> tuple[float, float]:
        """Where the line should cross a row farther on, px, and how far off it may be."""
        ahead = self.v_px[-1] - v_px
        if self.slope is None:
            return self.u_px[-1], _MAX_SLOPE * ahead
        young = 1.5 if len(self.v_px) < _SLOPE_POINTS else 1.0
        return self.u_px[-1] + self.slope * ahead, _GATE_PX * young * (1 + 0.04 * (ahead - 8))


def find_chains(points: LinePoints) -> list[IntArray]:
    """Likely crossings, in order from near to far, linked from row to row."""
    likely = np.flatnonzero(points.odds > _CHAIN_ODDS)
    u_px, v_px = points.points_px[likely].T
    if not len(likely):
        return []
    begins = np.flatnonzero(np.diff(v_px, prepend=np.nan)).tolist()  # nan differs from any row
    columns, indices, row_px = u_px.tolist(), likely.tolist(), v_px[begins].tolist()
    open_chains: list[_Chain] = []
    done: list[_Chain] = []
    for begin, end, row in zip(begins, [*begins[1:], len(likely)], row_px, strict=True):
        done += [chain for chain in open_chains if chain.v_px[-1] - row > _MAX_GAP_PX]
        open_chains = [chain for chain in open_chains if chain.v_px[-1] - row <= _MAX_GAP_PX]
        open_chains += _extend(open_chains, row, columns[begin:end], indices[begin:end])
    return [np.array(chain.index) for chain in done + open_chains if len(chain.index) >= _MIN_CHAIN]


def _extend(chains: list[_Chain], row_px: float, columns: list[float], indices: list[int]) -> list[_Chain]:
    """Give each crossing of a row to the chain that it suits best; what is left over starts chains."""
    pairs = []
    for c, chain in enumerate(chains):
        expected, gate = chain.expected(row_px)
        pairs += [
            (off / gate, c, p) for p, u_px in enumerate(columns) if (off := abs(u_px - expected)) <= gate
        ]
    taken: set[int] = set()
    extended: set[int] = set()
    for _, c, p in sorted(pairs):
        if c not in extended and p not in taken:
            chains[c].add(row_px, columns[p], indices[p])
            extended.add(c)
            taken.add(p)
    return [_Chain([row_px], [columns[p]], [indices[p]]) for p in range(len(columns)) if p not in taken]


@dataclass(frozen=True)
class Road:
    """A road: the priors of lines ``along`` it and of ``free`` ones."""

    along: Prior
    free: Prior

    @cached_property
    def _both(self) -> Prior:
        return Prior.several([self.along, self.free])

    def judge(self, evidence: Evidence) -> tuple[FloatArray, FloatArray]:
        """Log probability (N,) of each group as one line, and how much likelier (N,) it is along the road.

        The first is up to a constant per point, the second a log ratio that leaves out how common each is.
        """
        along, free = evidence.log_evidence(self._both)
        return np.logaddexp(along + np.log(_SHARE), free + np.log1p(-_SHARE)), along - free

    def drawn_by(self, log_ratio: float) -> Prior:
        """What helps to draw a line of such a log ratio of :meth:`judge`."""
        keeps = log_ratio + np.log(_SHARE) > np.log1p(-_SHARE)
        prior, kept = (self.along, _ALONG_KEPT) if keeps else (self.free, _FREE_KEPT)
        return Prior(prior.mean, prior.information * kept)


def find_road(evidence: Evidence, horizon: Horizon) -> Road:
    """The road that N groups of points, each roughly a line, agree on best."""
    free = Prior(np.zeros(3), np.diag(horizon.parameters(*_FREE_SIGMAS) ** -2.0))
    covariance = np.linalg.inv(evidence.information + free.information)
    mean = np.einsum("nij,nj->ni", covariance, evidence.moment)[:, _SHARED]
    spread = np.diag(horizon.parameters(*_PARALLEL_SIGMAS)[_SHARED] ** 2)
    # By how much the road may differ from what each line says.
    doubt = covariance[:, [[0], [2]], _SHARED] + spread
    certain = np.argsort((np.diagonal(doubt, axis1=1, axis2=2) / np.diag(spread)).sum(axis=1))[:_CANDIDATES]
    candidates = [_along(mean[k], doubt[k], free) for k in certain]
    *along, alone = evidence.log_evidence(Prior.several([*candidates, free]))
    best = max((ratio - alone for ratio in along), key=_agreement)
    # The mean of what all say of the road, each as far as it keeps to it.
    weight = 1 / (1 + (1 - _SHARE) / _SHARE * np.exp(-np.clip(best, -50, 50)))
    each = np.linalg.inv(doubt) * weight[:, None, None]
    shared = np.linalg.inv(each.sum(axis=0) + free.information[_SHARED_BLOCK])
    return Road(_along(shared @ np.einsum("nij,nj->i", each, mean), shared + spread, free), free)


def _agreement(gain: FloatArray) -> float:
    """Log probability of lines of such log ratios, some of which keep to the road."""
    return float(np.logaddexp(np.log(_SHARE) + gain, np.log1p(-_SHARE)).sum())


def _along(shared: FloatArray, covariance: FloatArray, free: Prior) -> Prior:
    """Lines of known a and c (2,), with their covariance (2, 2), anywhere beside the camera."""
    information = free.information.copy()
    information[_SHARED_BLOCK] = np.linalg.inv(covariance)
    return Prior(np.array([shared[0], 0.0, shared[1]]), information)


def find_lines(
    points: LinePoints, groups: list[IntArray], horizon: Horizon, paint_step_m: float
) -> list[Line]:
    """The lines through ``groups`` of points."""
    if not groups:
        return []
    evidence = points.evidence(horizon, groups, points.slopes(groups))
    road = find_road(evidence, horizon)
    groups = _join(evidence, groups, road)
    evidence = points.evidence(horizon, groups, points.slopes(groups))
    along = road.judge(evidence)[1].tolist()
    priors = [road.drawn_by(log_ratio) for log_ratio in along]
    curves = evidence.curves(priors, horizon.centre_px)
    paint_m = [paint_step_m * float(points.is_paint[group].sum()) for group in groups]
    return [Line(*parts) for parts in zip(curves, groups, paint_m, along, strict=True)]


def _join(evidence: Evidence, groups: list[IntArray], road: Road) -> list[IntArray]:
    groups = list(groups)
    alone = road.judge(evidence)[0]
    count = len(groups)
    first, second = np.triu_indices(count, 1)
    gain = np.full((count, count), -np.inf)
    gain[first, second] = road.judge(evidence[first] + evidence[second])[0] - (alone[first] + alone[second])
    left = np.ones(count, dtype=np.bool_)
    while left.sum() > 1:
        a, b = divmod(int(np.argmax(gain)), count)
        if not gain[a, b] > 0:
            break
        groups[a] = np.concatenate([groups[a], groups[b]])
        for total in (evidence.information, evidence.moment, evidence.square):
            total[a] += total[b]
            total[b] = 0
        left[b] = False
        gain[b], gain[:, b] = -np.inf, -np.inf
        # With that of b, which is nought now, comes what the two are together.
        together = road.judge(evidence[np.full(count, a)] + evidence)[0]
        alone[a] = together[b]
        left[a] = False
        others = np.flatnonzero(left)
        left[a] = True
        low, high = np.minimum(others, a), np.maximum(others, a)
        gain[low, high] = together[others] - alone[a] - alone[others]
    return [groups[k] for k in np.flatnonzero(left)]
