"""Hypotheses about the shape of a class's candidates, and how likely each makes their solved corners.

A hypothesis lays a shape on a candidate. Painted corners scatter about it with covariance N; solved corners
scatter about painted ones with P from the adjustment and with O, for edges that all images misplace alike.
All are indifferent to rigid motions. In the other five directions the deviation r of the solved corners from
the laid shape has the marginal likelihood N(r; 0, P + O + N), which penalises freedom.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from itertools import product

import numpy as np
from scipy.special import logsumexp
from scipy.stats import norm

from v2hdm.records import BoolArray, FloatArray
from v2hdm.site.candidates import Candidates
from v2hdm.site.series import Series, in_series
from v2hdm.site.shapes import SHAPE_SIGMA_M, Laid, PaintError, Shape, lay, learn_paint_error, parallelograms


class Kind(IntEnum):
    """Kinds of hypotheses, with the covariances N and O; those before :attr:`PART_OF_SYMBOL` are markings."""

    OF_CLASS = 0  # N as the class's markings, or as long as the spacing of its line shows
    OTHER_LENGTH = 1  # N of any length, for paint rolled by the metre
    WRONG_END = 2  # N as one of these, O an end worn away or running into other paint, cut at any angle
    PIECE = 3  # N as the class, O two adjacent sides hidden
    OWN_SHAPE = 4  # N of any size
    PART_OF_SYMBOL = 5  # N somewhat like the class, or of any size
    CLUTTER = 6  # the same, and O for each corner


_SIZE_SIGMA_M = 1.0  # sigma of a side, m, of a marking of its own size: covers any paint on a road
_LENGTH_SIGMA_M = 0.3  # prior sigma of the length of paint rolled by the metre, m: a tenth of it

_REPEATED_COUNT = 3.0
"""Concentration of the Dirichlet process of lengths: paint of another length repeats a known one."""

_MISPLACED_M = 0.3  # sigma, m, of a worn end, or of any corner of clutter (17 worn ends: .08 to .74 m)
_WORN_SHARE = 0.5  # the same relative to the length: any part may be worn away

_SLANT_OF_END = 0.5
_SLANT_OF_PIECE = 0.1
"""Sigma, relative to the width, of a corner of a dash's end cut at any angle, and of a piece."""

_RUN_ON_M = 1.0  # sigma, m, of an end that merges with other paint: about the length of letters

_LIKE_CLASS = 0.7
_LIKE_SHARE = 0.2
"""Fraction of other paint and clutter that is shaped like the class it was taken for, at any length, and the
sigma of its corners relative to the width: detections of a class resemble it, and are fitted as such."""

_SOUND_SPREAD = (0.0, 0.4)
_WORN_SPREAD = (1.5, 0.7)
"""Mean and standard deviation of the logarithm of an end's scatter relative to its class: images agree on a
sound end, a worn one ends elsewhere in each (229 sound and 10 worn ends of a rendered port)."""

_UNCLEAR_SHARE = 0.05
_CLEAR_SHARE = 0.1
"""Fraction of sound ends that scatter like worn ones, being distant, and of worn ones that all images show
alike (5 of 229 and 1 of 11 ends there)."""

_FIRST = np.array([-0.5, 0.5, 0.5, -0.5])
_SECOND = np.array([-0.5, -0.5, 0.5, 0.5])
"""Corner k of a parallelogram with sides u and v lies at its centre plus first[k] u + second[k] v."""

_OWN_SIZE = _SIZE_SIGMA_M**2 * np.kron(np.outer(_FIRST, _FIRST) + np.outer(_SECOND, _SECOND), np.eye(2))

_NOTHING = np.zeros((8, 8))  # covariance of no misplacement

_Ends = Sequence[tuple[FloatArray, FloatArray]]
"""Motions (N, 8) of corners for a side moving inwards by 1 m, and their limits (N, 1), m."""


@dataclass(frozen=True)
class Hypothesis:
    """One hypothesis on N candidates."""

    kind: Kind
    log_prior: float
    candidates: Candidates
    directions: FloatArray  # (N, 5, 8) in which deviations are tested
    residual: FloatArray  # (N, 5) from the laid shape
    scatter: FloatArray  # (..., 8, 8) covariance of painted corners, N
    misplaced: FloatArray  # (..., 8, 8) covariance common to all images, O
    paint: PaintError
    one_way: FloatArray | None  # (N, 8, K) one-sided directions, if any: paint wears inwards
    beside: FloatArray | float  # (N,) log-likelihood of other data

    @cached_property
    def formal(self) -> FloatArray:
        """Covariance (N, 5, 5) of the residual from the solved corners alone."""
        return _within(self.directions, self.candidates.covariance_m2)

    @cached_property
    def fit(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Covariance of the residual, its inverse times the residual, and squared Mahalanobis distance."""
        innovation = self.formal + _within(self.directions, self.scatter + self.misplaced)
        innovation = innovation + self.paint.sigma_m**2 * np.eye(5)
        solved = np.linalg.solve(innovation, self.residual[..., None])[..., 0]
        return innovation, np.asarray(solved), np.asarray(np.sum(self.residual * solved, axis=1))

    @property
    def log_likelihood(self) -> FloatArray:
        """Marginal log-likelihood (N,) of the residual."""
        innovation, solved, squared = self.fit
        both_ways = -0.5 * (squared + np.linalg.slogdet(innovation)[1] + 5 * np.log(2 * np.pi))
        both_ways = both_ways + self.beside
        if self.one_way is None:
            return np.asarray(both_ways)
        moved = self.directions @ self.one_way
        mean = np.sum(moved * solved[..., None], axis=1)
        held = np.sum(moved * np.linalg.solve(innovation, moved), axis=1)
        # Two directions are treated as independent: correlation changes the quadrant's probability little.
        inside = norm.logcdf(mean / np.sqrt(np.maximum(1 - held, 1e-9))) + np.log(2)
        return np.asarray(both_ways + inside.sum(axis=1))

    def corners(self, paint: PaintError) -> Candidates:
        """Corners under the hypothesis (a Kalman update), with the errors of ``paint`` that images share.

        A candidate's deviation from a shape of its class narrows their variance down.
        """
        paint_m2 = np.full(len(self.residual), paint.sigma_m**2)
        if self.kind == Kind.OF_CLASS:
            pairs = zip(self.residual, self.formal, strict=True)
            paint_m2 = np.array([paint.variance_m2(*pair) for pair in pairs])
        covariance = self.candidates.covariance_m2 + self.misplaced + paint_m2[:, None, None] * np.eye(8)
        noise = _within(self.directions, self.scatter)
        seen = self.directions @ covariance
        innovation = seen @ np.swapaxes(self.directions, 1, 2) + noise
        gain = np.swapaxes(np.linalg.solve(innovation, seen), 1, 2)
        # Joseph's form, a sum of squares, keeps small variances positive.
        left = np.eye(8) - gain @ self.directions
        after = left @ covariance @ np.swapaxes(left, 1, 2) + gain @ noise @ np.swapaxes(gain, 1, 2)
        corners = self.candidates.corners_map - (gain @ self.residual[..., None]).reshape(-1, 4, 2)
        return Candidates(corners, (after + np.swapaxes(after, 1, 2)) / 2)


def _within(directions: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(directions @ covariance @ np.swapaxes(directions, 1, 2))


@dataclass
class Hypotheses:
    """All ``found`` hypotheses on N ``candidates`` of a class.

    From the previous pass are their corners as ``believed``, the ``probability`` (N, K) and frequency
    ``share`` (K,) of each kind, and the errors of ``paint``. ``vague`` (N, 4) are log-likelihood ratios of a
    worn or hidden corner, from views that disagree on it; ``series`` is the evidence of lines of dashes.
    """

    candidates: Candidates
    believed: Candidates
    probability: FloatArray
    share: FloatArray
    paint: PaintError
    vague: FloatArray
    found: list[Hypothesis] = field(default_factory=list)
    series: Series | None = None

    @property
    def weight(self) -> FloatArray:
        """Probability (N,) of a marking."""
        return np.asarray(self.probability[:, : Kind.PART_OF_SYMBOL].sum(axis=1))

    def add(
        self,
        kind: Kind,
        part: float,
        laid: Laid,
        scatter: FloatArray,
        misplaced: FloatArray = _NOTHING,
        one_way: FloatArray | None = None,
        beside: FloatArray | float = 0.0,
    ) -> None:
        """Add one with a ``part`` of its kind's frequency; see :class:`Hypothesis` for the rest."""
        off = (self.candidates.corners_map - laid.corners_map).reshape(-1, 8, 1)
        residual = (laid.directions @ off)[..., 0]
        errors = scatter, misplaced, self.paint, one_way, beside
        prior = float(np.log(part * self.share[kind]))
        self.found.append(Hypothesis(kind, prior, self.candidates, laid.directions, residual, *errors))

    def add_all(self, shapes: Sequence[Shape]) -> None:
        """Add those on the class's ``shapes``, and those on a parallelogram of any size."""
        candidates, ragged = self.candidates, np.zeros(len(self.candidates))
        for shape in shapes:
            ragged = self._add_shape(shape, shape.share / sum(one.share for one in shapes))
        centre = candidates.corners_map.mean(axis=1)
        turns = np.tile(np.eye(2), (len(centre), 1, 1))
        shifts = np.zeros(len(centre), dtype=np.int64)
        own = Laid(parallelograms(candidates.corners_map) + centre[:, None], turns, centre, shifts)
        own = lay(shapes[0].corners, SHAPE_SIGMA_M, candidates)[0] if shapes else own
        any_size = SHAPE_SIGMA_M**2 * np.eye(8) + _OWN_SIZE
        self.add(Kind.OWN_SHAPE, 1.0, own, any_size)
        self._add_unlike(1 - _LIKE_CLASS if shapes else 1.0, own, any_size, ragged)

    def _add_shape(self, shape: Shape, part: float) -> FloatArray:
        """Add those on one shape, a ``part`` of the class; log-likelihood (N,) of equally ragged clutter."""
        laid, otherwise = lay(shape.corners, shape.sigma_m, self.candidates)
        scatter: FloatArray = shape.sigma_m**2 * np.eye(8)
        sides_m = np.linalg.norm(np.roll(shape.corners, -1, axis=0) - shape.corners, axis=1)
        alike = scatter + (_LIKE_SHARE * sides_m.min()) ** 2 * np.eye(8)
        ends = _inwards(laid.corners_map, shape.is_elongated)
        worn = np.zeros((len(ends), len(self.candidates)))
        self.add(Kind.OF_CLASS, part / 2, otherwise, scatter)
        if shape.is_elongated:
            worn = _worn_evidence(self.candidates, [end for end, _ in ends], self.weight)
            at_end = np.stack([end.reshape(-1, 4, 2).any(axis=2) for end, _ in ends])
            worn = worn + np.sum(at_end * self.vague, axis=2) / 2
            shorter = (ends[0][0] + ends[1][0]) / 2
            alike = alike + (_WORN_SHARE * sides_m.max()) ** 2 * _outer(shorter)
            self._add_lengths(part, laid, shape.sigma_m, shorter, ends, worn)
        else:
            self.add(Kind.OF_CLASS, part / 2, laid, scatter)
            self._add_wrong_ends(part, laid, [(1.0, scatter)], ends, worn, [0.0])
            self._add_pieces(part, laid, scatter, ends)
        # An end of clutter is ragged with probability one half.
        ragged = np.asarray(np.sum(np.logaddexp(worn, 0.0) - np.log(2), axis=0))
        self._add_unlike(part * _LIKE_CLASS, laid, alike, ragged)
        return ragged

    def _add_lengths(
        self, part: float, laid: Laid, sigma_m: float, shorter: FloatArray, ends: _Ends, worn: FloatArray
    ) -> None:
        """Add those on a shape rolled by the metre, which ``shorter`` (N, 8) shortens by 1 m."""
        scatter: FloatArray = sigma_m**2 * np.eye(8)
        spread_m, again = self._other_lengths(laid, shorter, sigma_m)
        any_length = scatter + spread_m**2 * _outer(shorter)
        self.add(Kind.OTHER_LENGTH, part, laid, any_length, beside=again)
        other = self.share[Kind.OTHER_LENGTH] / (self.share[Kind.OF_CLASS] + self.share[Kind.OTHER_LENGTH])
        ways = [(part, laid, scatter)]
        series = in_series(self.candidates, self.believed, laid, shorter, sigma_m, self.weight)
        if series is not None:
            self.series = self.series or series
            stretched = laid.corners_map - (series.longer_m[:, None] * shorter).reshape(-1, 4, 2)
            about = scatter + series.longer_sigma_m[:, None, None] ** 2 * _outer(shorter)
            ways = [
                (part * (1 - series.longer_often), laid, scatter),
                (part * series.longer_often, replace(laid, corners_map=stretched), about),
            ]
        for each, one, about in ways:
            self.add(Kind.OF_CLASS, each / 2, one, about)
            lengths = (1 - other, about), (other, any_length)
            self._add_wrong_ends(each, one, lengths, ends, worn, [0.0, _SLANT_OF_END])

    def _other_lengths(self, laid: Laid, shorter: FloatArray, sigma_m: float) -> tuple[float, FloatArray]:
        """Sigma, m, of other lengths, and the log-likelihood ratio (N,) of a repeated to a new one."""
        weight = self.probability[:, Kind.OTHER_LENGTH]
        off_m = np.sum((laid.corners_map - self.candidates.corners_map).reshape(-1, 8) * shorter, axis=1)
        own_m2 = self.candidates.along(shorter, shorter)
        squared = _REPEATED_COUNT * _LENGTH_SIGMA_M**2 + weight @ np.maximum(off_m**2 - own_m2, 0.0)
        spread_m = float(np.sqrt(squared / (_REPEATED_COUNT + weight.sum())))
        alone = norm.pdf(off_m, 0.0, np.sqrt(own_m2 + spread_m**2))
        apart = np.sqrt(own_m2 + own_m2[:, None] + 2 * sigma_m**2)
        alike = weight * (1 - np.eye(len(weight))) * norm.pdf(off_m, off_m[:, None], apart)
        drawn = (_REPEATED_COUNT * alone + alike.sum(axis=1)) / (_REPEATED_COUNT + weight.sum() - weight)
        return spread_m, np.asarray(np.log(np.maximum(drawn, 1e-300) / np.maximum(alone, 1e-300)))

    def _add_wrong_ends(
        self,
        part: float,
        laid: Laid,
        lengths: Sequence[tuple[float, FloatArray]],
        ends: _Ends,
        worn: FloatArray,
        slants: Sequence[float],
    ) -> None:
        """Add those of one end worn, or merged with other paint, of any of the ``lengths`` and ``slants``."""
        for (end, extent_m), ragged in zip(ends, worn, strict=True):
            ways: tuple[tuple[FloatArray, FloatArray | float], ...] = (
                (_MISPLACED_M * end, ragged),
                (_WORN_SHARE * extent_m * end, ragged),
                (-_RUN_ON_M * end, 0.0),
            )
            for (way, beside), (likely, scatter), slant in product(ways, lengths, slants):
                each = part * likely / len(ends) / len(ways) / len(slants)
                misplaced = _outer(way) + _cut(laid.corners_map, end, slant)
                self.add(Kind.WRONG_END, each, laid, scatter, misplaced, way[..., None], beside)

    def _add_pieces(self, part: float, laid: Laid, scatter: FloatArray, ends: _Ends) -> None:
        """Add those of two adjacent sides hidden, as another vehicle may leave a piece in view."""
        for (one, reach_m), (other, across_m) in product(ends[:2], ends[2:]):
            both = np.asarray(_WORN_SHARE * np.stack([reach_m * one, across_m * other], axis=2))
            cut = _cut(laid.corners_map, one + other, _SLANT_OF_PIECE)
            self.add(Kind.PIECE, part / 4, laid, scatter, both @ np.swapaxes(both, 1, 2) + cut, both)

    def _add_unlike(self, part: float, laid: Laid, scatter: FloatArray, ragged: FloatArray) -> None:
        """Add those of other paint and of clutter."""
        self.add(Kind.PART_OF_SYMBOL, part, laid, scatter, beside=ragged)
        self.add(Kind.CLUTTER, part, laid, scatter + _MISPLACED_M**2 * np.eye(8), beside=ragged)

    def paint_error(self, probability: FloatArray, whole: BoolArray) -> PaintError:
        """Paint error from the deviations of ``whole`` candidates (N,), each ``found`` with (H, N)."""
        members = [
            (one.residual[k], one.formal[k])
            for one, probable in zip(self.found, probability > 0.5, strict=True)
            if one.kind == Kind.OF_CLASS
            for k in np.flatnonzero(whole & probable)
        ]
        return learn_paint_error([residual for residual, _ in members], [formal for _, formal in members])

    def mixture(self, joint: FloatArray, paint: PaintError) -> Candidates:
        """Mean and covariance of the corners over the markings among :attr:`found`, of ``joint`` (H, N)."""
        markings = [k for k, one in enumerate(self.found) if one.kind < Kind.PART_OF_SYMBOL]
        weight = np.exp(joint[markings] - logsumexp(joint[markings], axis=0))[..., None, None]
        each = [self.found[k].corners(paint) for k in markings]
        mean = np.asarray(sum(w * one.corners_map for w, one in zip(weight, each, strict=True)))
        off = [(one.corners_map - mean).reshape(-1, 8) for one in each]
        spread = [one.covariance_m2 + _outer(away) for one, away in zip(each, off, strict=True)]
        return Candidates(mean, np.sum(weight * spread, axis=0))


def _inwards(corners: FloatArray, elongated: bool) -> _Ends:
    """Both ends of an elongated shape at ``corners`` (N, 4, 2), else all sides, opposite ones in pairs."""
    ways = []
    for along, side in ((corners[:, 1] - corners[:, 0], _FIRST), (corners[:, 2] - corners[:, 1], _SECOND)):
        extent_m = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        both = [-np.sign(sign) * (side * sign > 0)[:, None] * (along / extent_m)[:, None] for sign in (-1, 1)]
        ways.append([(one.reshape(-1, 8), extent_m) for one in both])
    if not elongated:
        return [*ways[0], *ways[1]]
    first = ways[0][0][1] > ways[1][0][1]
    return [(np.where(first, a[0], b[0]), np.where(first, a[1], b[1])) for a, b in zip(*ways, strict=True)]


def _worn_evidence(candidates: Candidates, ends: Sequence[FloatArray], weight: FloatArray) -> FloatArray:
    """Log-likelihood ratios (2, N) of a worn against a sound end, from the images' disagreement on it.

    ``ends`` (N, 8) move two corners by 1 m inwards; disagreement common to both is excluded.
    """
    whole = candidates.known.all(axis=1)
    variance = [candidates.along(end / 2, (end + ends[k ^ 1]) / 2) for k, end in enumerate(ends)]
    sigma = 0.5 * np.log(np.maximum(variance, 0.0) + SHAPE_SIGMA_M**2)
    off = sigma - np.median(sigma[:, weight * whole > 0.5])
    worn = norm.pdf(off, *_WORN_SPREAD)
    sound = norm.pdf(off, *_SOUND_SPREAD)
    odds = worn + _CLEAR_SHARE * (sound - worn)
    odds /= sound + _UNCLEAR_SHARE * (worn - sound)
    return np.asarray(np.where(whole, np.log(odds), 0.0))


def _cut(corners: FloatArray, end: FloatArray, slant: float) -> FloatArray:
    """Covariance (N, 8, 8), m^2, of the corners of an ``end`` cut at a ``slant``, relative to the width."""
    breadth_m = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).min(axis=1)
    each = (end.reshape(-1, 4, 1, 2) * np.eye(4)[:, :, None]).reshape(-1, 4, 8)
    return np.asarray((slant * breadth_m)[:, None, None] ** 2 * (np.swapaxes(each, 1, 2) @ each))


def _outer(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors[:, :, None] * vectors[:, None, :])
