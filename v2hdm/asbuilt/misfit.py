"""Differences between a map and its design, split: common to all, common to neighbours, and a marking's own.

A difference is the sum of a rigid motion of the whole design, the map's error that neighbouring markings
share (a Gaussian process, :mod:`v2hdm.site.living.map_errors`), the marking's own error, and what it is
painted off. Most paint lies as near to its design as a crew works; what lies farther off takes no part in
what is shared, which it would else pull to itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, chdtri

from v2hdm.asbuilt.registration import Motion
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.site.living.map_errors import Errors

_PAINTED_M = 0.01  # start of the standard deviation, m, of a coordinate of the paint about its design
_LEAST_PAINTED_M = 0.002  # least of it, m: of a design that was surveyed from the paint
_MOST_PAINTED_M = 0.02  # largest of it, m: paint that lies worse is off
_APART = chdtri(2, 1e-3)  # squared distance of centres, in sigmas, from which on paint takes no part
_ROUNDS = 10  # of finding what takes no part, which settles within five
_SIGNIFICANT = 1e-3  # probability, if there were no motion of the whole, of one that is said to be
_FEWEST = 8  # markings that can tell a motion of the whole
_AT_ONCE = 400  # markings of one joint distribution: its cost grows with their cube


@dataclass(frozen=True)
class Misfit:
    """How a design lies in a map, and what P markings share with their neighbours."""

    motion: Motion  # of the whole design onto the paint
    covariance: FloatArray  # (3, 3) of its shift, m, and turn, rad
    probability: float  # of so large a motion, if there were none
    painted_m: float  # standard deviation of a coordinate of the paint about its design
    common_m: FloatArray  # (P, 2) from each shape's place to where a rightly painted marking would be mapped
    common_m2: FloatArray  # (P, 2, 2) covariance of that

    @property
    def is_significant(self) -> bool:
        """Whether the design lies off as a whole, which no marking is to blame for."""
        return self.probability < _SIGNIFICANT


def find_misfit(built: FloatArray, design: FloatArray, errors: Errors, start: Motion) -> Misfit:
    """The misfit of P markings with centres ``built`` (P, 2) and places in the design (P, 2), m.

    ``start`` is the motion of the design that paired them.
    """
    off_m = built - start.apply(design)
    motions = _motions(start.apply(design) - start.apply(start.about_map))
    is_alike, painted_m = _alike(off_m, errors, motions)
    chosen = _spread_out(np.flatnonzero(is_alike))
    joint = _Joint(errors, chosen, chosen, painted_m, motions)
    step = joint.motion(off_m[chosen])
    turn_rad = start.turn_rad + float(step[2])
    whole = Motion(turn_rad, np.asarray(start.shift_m + step[:2]), start.about_map)
    estimate = np.append(whole.shift_m, turn_rad)
    squared = float(estimate @ np.linalg.solve(joint.spread, estimate))
    probability = float(chdtrc(3, squared)) if len(chosen) >= _FEWEST else 1.0
    if probability >= _SIGNIFICANT:
        off_m = built - design
        motions = motions[:, :, :0]
        is_alike, painted_m = _alike(off_m, errors, motions)
    apart_m, spread = _apart(off_m, errors, motions, is_alike, painted_m)
    return Misfit(whole, joint.spread, probability, painted_m, off_m - apart_m, spread)


def _motions(arms: FloatArray) -> FloatArray:
    """Derivatives (P, 2, 3) of places at ``arms`` (P, 2) from the middle by a shift and a turn."""
    turning = np.stack([-arms[:, 1], arms[:, 0]], axis=1)
    shifting = np.broadcast_to(np.eye(2), (len(arms), 2, 2))
    return np.concatenate([shifting, turning[:, :, None]], axis=2)


def _own_m2(errors: Errors) -> FloatArray:
    """Covariances (P, 2, 2) of centres by the markings' own errors."""
    return np.asarray(np.einsum("piaib->pab", errors.own_m2.reshape(-1, 4, 2, 4, 2)) / 16)


def _spread_out(index: IntArray) -> IntArray:
    """At most as many of an index as are taken at once, spread over it."""
    count = min(len(index), _AT_ONCE)
    return index[np.unique(np.linspace(0, len(index) - 1, count).astype(int))] if count else index


def _alike(off_m: FloatArray, errors: Errors, motions: FloatArray) -> tuple[BoolArray, float]:
    """Which differences (P,) take part in what is shared, and how far paint lies about its design, m."""
    own_m2 = _own_m2(errors)
    is_alike = np.ones(len(off_m), dtype=np.bool_)
    painted_m = _PAINTED_M
    for _ in range(_ROUNDS):
        apart_m, spread = _apart(off_m, errors, motions, is_alike, painted_m)
        known_m2 = spread + own_m2
        inverse = np.linalg.inv(known_m2 + painted_m**2 * np.eye(2))
        squared = np.einsum("pi,pij,pj->p", apart_m, inverse, apart_m)
        fits = squared < _APART
        if fits.sum() < len(fits) / 2:  # most is painted rightly, or nothing can be said of the rest
            fits = squared <= np.median(squared)
        left_m2 = float(np.mean(apart_m[fits] ** 2 - np.diagonal(known_m2, axis1=1, axis2=2)[fits]))
        painted_m = float(np.sqrt(np.clip(left_m2, _LEAST_PAINTED_M**2, _MOST_PAINTED_M**2)))
        if (fits == is_alike).all():
            break
        is_alike = fits
    return is_alike, painted_m


def _apart(
    off_m: FloatArray, errors: Errors, motions: FloatArray, is_alike: BoolArray, painted_m: float
) -> tuple[FloatArray, FloatArray]:
    """Differences (P, 2), less the values that others near it foretell, and the covariances."""
    apart_m = np.empty_like(off_m)
    spread = np.empty((len(off_m), 2, 2))
    for rows in _neighbourhoods(errors.centres_map, np.arange(len(off_m))):
        part = rows[is_alike[rows]]
        joint = _Joint(errors, rows, part, painted_m, motions)
        apart_m[rows], spread[rows] = joint.apart(off_m)
    return apart_m, spread


def _neighbourhoods(centres_map: FloatArray, rows: IntArray) -> list[IntArray]:
    """Rows split across their longer side until they can be taken at once."""
    if len(rows) <= _AT_ONCE:
        return [rows]
    centres = centres_map[rows]
    axis = int(np.argmax(np.ptp(centres, axis=0)))
    order = rows[np.argsort(centres[:, axis], kind="stable")]
    middle = len(order) // 2
    return [*_neighbourhoods(centres_map, order[:middle]), *_neighbourhoods(centres_map, order[middle:])]


class _Joint:
    """The joint normal distribution of differences at ``rows`` (R,), given those of a ``part`` of them.

    The trend of ``motions`` (P, 2, T) has a flat prior: universal kriging (Cressie, Statistics for Spatial
    Data, section 3.4).
    """

    def __init__(
        self, errors: Errors, rows: IntArray, part: IntArray, painted_m: float, motions: FloatArray
    ) -> None:
        self._rows = rows
        self._part = part
        self._alone_m2 = _own_m2(errors) + painted_m**2 * np.eye(2)
        self._errors = errors
        shared = np.kron(errors.between(part, part), np.eye(2))
        for k, marking in enumerate(part):
            shared[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += self._alone_m2[marking]
        self._inverse = np.asarray(np.linalg.inv(shared), dtype=np.float64)
        self._motions = motions
        self._trend = motions[part].reshape(2 * len(part), -1)
        self._weighed = self._inverse @ self._trend
        self.spread = np.asarray(
            np.linalg.inv(self._trend.T @ self._weighed), np.float64
        )  # (T, T) of the trend
        self._projected = self._inverse - self._weighed @ self.spread @ self._weighed.T

    def motion(self, off_m: FloatArray) -> FloatArray:
        """The generalised least-squares trend (T,) of the part's differences (N, 2)."""
        return np.asarray(self.spread @ (self._weighed.T @ off_m.ravel()))

    def apart(self, off_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Differences (R, 2), less the values that the others foretell, and their covariances (R, 2, 2)."""
        errors = self._errors
        rows = self._rows
        of_part = off_m[self._part]
        weights = self._projected @ of_part.ravel()
        across = np.asarray(np.kron(errors.between(rows, self._part), np.eye(2)), dtype=np.float64)
        trend = self._motions[rows].reshape(2 * len(rows), -1)
        foretold = trend @ self.motion(of_part) + across @ weights
        of_known = _carried(across, self._inverse)
        unexplained = np.asarray(trend - across @ self._weighed)
        of_trend = _carried(unexplained, self.spread)
        prior = errors.shared_m2[rows][:, None, None] * np.eye(2)
        beyond_m = off_m[rows] - foretold.reshape(-1, 2)
        spread = _positive(prior - of_known + of_trend)
        number = {marking: k for k, marking in enumerate(rows.tolist())}
        for k, marking in enumerate(self._part.tolist()):  # from all others: leave one out
            block = slice(2 * k, 2 * k + 2)
            total_m2 = np.linalg.inv(self._projected[block, block])
            beyond_m[number[marking]] = total_m2 @ weights[block]
            spread[number[marking]] = _positive(total_m2 - self._alone_m2[marking])
        return beyond_m, spread


def _carried(rows: FloatArray, covariance: FloatArray) -> FloatArray:
    """The covariances (R, 2, 2) of stacked ``rows`` (2R, N) of factors of N numbers with that covariance."""
    stacked = rows.reshape(len(rows) // 2, 2, -1)
    return np.asarray(np.einsum("pix,xy,pjy->pij", stacked, covariance, stacked, optimize=True))


def _positive(covariance: FloatArray) -> FloatArray:
    """The nearest covariances (..., 2, 2) that no rounding has made negative."""
    values, vectors = np.linalg.eigh((covariance + np.swapaxes(covariance, -1, -2)) / 2)
    values = np.maximum(values, 0.0)
    return np.asarray((vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2))
