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
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr, logsumexp, ndtr

from v2hdm.association.groups import SHAPE_TOLERANCE
from v2hdm.densities import normal_density
from v2hdm.geometry.planar import diameters
from v2hdm.records import BoolArray, FloatArray
from v2hdm.site.candidates import Candidates
from v2hdm.site.lengths import Lost, lost_of
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

_MISPLACED_M = 0.3  # sigma, m, of a worn end, or of any corner of clutter (17 worn ends: 0.08 to 0.74 m)
_WORN_SHARE = 0.5  # sigma of a worn end relative to the marking's length: any part may be worn away

_SLANT_OF_END = 0.5  # sigma, relative to the width, of a corner of a dash's end that is cut at any angle
_SLANT_OF_PIECE = 0.1  # sigma, relative to the width, of a corner of a marking's piece that is in view

_ALONE_ASPECT = 2.0  # least length over width of a marking that may have lost an end without others telling
_ANYWHERE_M = 100.0  # sigma, m, of an end that says nothing of where the paint ended: beyond any paint

_RUN_ON_M = 1.0  # sigma, m, of an end that merges with other paint: about the length of letters

# Detections of a class resemble it, and are fitted as such.
_LIKE_CLASS = 0.7  # fraction of other paint and clutter that is shaped like its class, at any length
_LIKE_SHARE = 0.2  # sigma of the corners of such paint, relative to the width of the class

# Images agree on a sound end; a worn one ends elsewhere in each.
_SOUND_SPREAD = (0.0, 0.4)  # mean and sigma of the log of a sound end's scatter (229 ends of a rendered port)
_WORN_SPREAD = (1.5, 0.7)  # mean and sigma of the log of a worn end's scatter (10 ends of that port)

_UNCLEAR_SHARE = 0.05  # fraction of sound ends that scatter like worn ones, being distant (5 of 229 there)
_CLEAR_SHARE = 0.1  # fraction of worn ends that all images show alike (1 of 11 there)

# Corner k of a parallelogram with sides u and v lies at its centre plus first[k] u + second[k] v.
_FIRST = np.array([-0.5, 0.5, 0.5, -0.5])  # offsets of the four corners along u, in lengths of u
_SECOND = np.array([-0.5, -0.5, 0.5, 0.5])  # offsets of the four corners along v, in lengths of v

# Covariance (8, 8), m^2, of the corners of a parallelogram whose sides have any length and direction.
_OWN_SIZE = _SIZE_SIGMA_M**2 * np.kron(np.outer(_FIRST, _FIRST) + np.outer(_SECOND, _SECOND), np.eye(2))

_FROM_CENTRE = np.eye(8) - np.kron(np.full((4, 4), 0.25), np.eye(2))
"""Matrix (8, 8) that makes of stacked corners what they are from their centre."""

_NOTHING = np.zeros((8, 8))  # covariance of no misplacement


class _End(NamedTuple):
    """An end or a side of a shape on N candidates, which may lie farther inwards than its class's."""

    inwards: FloatArray  # (N, 8) motions of the corners as the side moves inwards by 1 m
    limit_m: FloatArray  # (N, 1) largest such motion, m: the extent of the shape


class Fit(NamedTuple):
    """The deviations of N candidates from a laid shape, beside what is expected of them."""

    innovation: FloatArray  # (N, 5, 5) covariance of the residual
    solved: FloatArray  # (N, 5) inverse of the covariance times the residual
    squared: FloatArray  # (N,) squared Mahalanobis distance


class Mixture(NamedTuple):
    """N candidates over all hypotheses that they are markings."""

    candidates: Candidates  # mean and covariance of the corners
    deformed: FloatArray  # (N,) probability of another shape than that of the mean corners


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
    def fit(self) -> Fit:
        """The residual under its covariance from all errors."""
        innovation = self.formal + _within(self.directions, self.scatter + self.misplaced)
        innovation = innovation + self.paint.sigma_m**2 * np.eye(5)
        solved = np.linalg.solve(innovation, self.residual[..., None])[..., 0]
        return Fit(innovation, np.asarray(solved), np.asarray(np.sum(self.residual * solved, axis=1)))

    @property
    def log_likelihood(self) -> FloatArray:
        """Marginal log-likelihood (N,) of the residual."""
        innovation, solved, squared = self.fit
        both_ways = -0.5 * (squared + np.linalg.slogdet(innovation)[1] + 5 * np.log(2 * np.pi))
        both_ways = both_ways + self.beside
        if self.one_way is None:
            return np.asarray(both_ways)
        one_sided = self.directions @ self.one_way
        mean = np.sum(one_sided * solved[..., None], axis=1)
        explained = np.sum(one_sided * np.linalg.solve(innovation, one_sided), axis=1)
        # Two directions are treated as independent: correlation changes the quadrant's probability little.
        inside = log_ndtr(mean / np.sqrt(np.maximum(1 - explained, 1e-9))) + np.log(2)
        return np.asarray(both_ways + inside.sum(axis=1))

    def corners(self, paint: PaintError) -> Candidates:
        """Corners under the hypothesis (a Kalman update), with the errors of ``paint`` that images share.

        A candidate's deviation from a shape of its class narrows their variance down.
        """
        paint_m2 = np.full(len(self.residual), paint.sigma_m**2)
        if self.kind == Kind.OF_CLASS:
            deviations = zip(self.residual, self.formal, strict=True)
            paint_m2 = np.array([paint.variance_m2(residual, formal) for residual, formal in deviations])
        covariance = self.candidates.covariance_m2 + self.misplaced + paint_m2[:, None, None] * np.eye(8)
        noise = _within(self.directions, self.scatter)
        gained = self.directions @ covariance
        innovation = gained @ np.swapaxes(self.directions, 1, 2) + noise
        gain = np.swapaxes(np.linalg.solve(innovation, gained), 1, 2)
        # Joseph's form, a sum of squares, keeps small variances positive.
        left = np.eye(8) - gain @ self.directions
        posterior_m2 = left @ covariance @ np.swapaxes(left, 1, 2) + gain @ noise @ np.swapaxes(gain, 1, 2)
        corners = self.candidates.corners_map - (gain @ self.residual[..., None]).reshape(-1, 4, 2)
        return Candidates(corners, (posterior_m2 + np.swapaxes(posterior_m2, 1, 2)) / 2)


def _within(directions: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance (N, 5, 5) of deviations in ``directions`` (N, 5, 8), of the corners' (..., 8, 8)."""
    return np.asarray(directions @ covariance @ np.swapaxes(directions, 1, 2))


@dataclass
class Hypotheses:
    """All hypotheses (``members``) on N ``candidates`` of a class.

    From the previous pass are their corners as ``believed``, the ``probability`` (N, K) and frequency
    ``share`` (K,) of each kind, and the errors of ``paint``. ``vague`` (N, 4) are log-likelihood ratios of a
    worn or hidden corner, from views that disagree on it, ``standing_odds`` (N, 4) of something that stands
    beyond a side; ``series`` is the evidence of lines of dashes. ``standard_m`` are the lengths to which such
    markings are painted; empty where none is known.
    """

    candidates: Candidates
    believed: Candidates
    probability: FloatArray
    share: FloatArray
    paint: PaintError
    vague: FloatArray
    standing_odds: FloatArray
    standard_m: tuple[float, ...] = ()
    members: list[Hypothesis] = field(default_factory=list)
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
        hypothesis = Hypothesis(
            kind=kind,
            log_prior=float(np.log(part * self.share[kind])),
            candidates=self.candidates,
            directions=laid.directions,
            residual=residual,
            scatter=scatter,
            misplaced=misplaced,
            paint=self.paint,
            one_way=one_way,
            beside=beside,
        )
        self.members.append(hypothesis)

    def add_all(self, shapes: Sequence[Shape]) -> None:
        """Add those on the class's ``shapes``, and those on a parallelogram of any size."""
        candidates = self.candidates
        ragged = np.zeros(len(candidates))
        total_share = sum(shape.share for shape in shapes)
        for shape in shapes:
            ragged = self._add_shape(shape, shape.share / total_share)
        centre = candidates.corners_map.mean(axis=1)
        turns = np.tile(np.eye(2), (len(centre), 1, 1))
        shifts = np.zeros(len(centre), dtype=np.int64)
        own_shape = Laid(parallelograms(candidates.corners_map) + centre[:, None], turns, centre, shifts)
        own_shape = lay(shapes[0].corners, SHAPE_SIGMA_M, candidates)[0] if shapes else own_shape
        any_size = SHAPE_SIGMA_M**2 * np.eye(8) + _OWN_SIZE
        self.add(Kind.OWN_SHAPE, 1.0, own_shape, any_size)
        if self.standard_m and not shapes:
            self._add_worn_alone(own_shape, self.members[-1])
        self._add_unlike(1 - _LIKE_CLASS if shapes else 1.0, own_shape, any_size, ragged)

    def _add_shape(self, shape: Shape, part: float) -> FloatArray:
        """Add those on one shape, a ``part`` of the class; log-likelihood (N,) of equally ragged clutter."""
        laid, other_way_round = lay(shape.corners, shape.sigma_m, self.candidates)
        scatter: FloatArray = shape.sigma_m**2 * np.eye(8)
        sides_m = np.linalg.norm(np.roll(shape.corners, -1, axis=0) - shape.corners, axis=1)
        alike = scatter + (_LIKE_SHARE * sides_m.min()) ** 2 * np.eye(8)
        ends = _inwards(laid.corners_map, shape.is_elongated)
        worn = np.zeros((len(ends), len(self.candidates)))
        self.add(Kind.OF_CLASS, part / 2, other_way_round, scatter)
        if shape.is_elongated:
            worn = _worn_evidence(self.candidates, [end.inwards for end in ends], self.weight)
            worn = worn + self._of_views(ends)
            shorter = (ends[0].inwards + ends[1].inwards) / 2
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

    def _of_views(self, ends: Sequence[_End]) -> FloatArray:
        """Log-likelihood ratios (E, N) of worn or hidden ``ends``, by views and by what stands beyond."""
        at_end = np.stack([end.inwards.reshape(-1, 4, 2).any(axis=2) for end in ends])
        is_end = at_end & np.roll(at_end, -1, axis=2)
        by_views = np.sum(at_end * self.vague, axis=2) / 2
        return np.asarray(by_views + np.sum(is_end * self.standing_odds, axis=2))

    def _add_worn_alone(self, laid: Laid, whole: Hypothesis) -> None:
        """Add those of one end lost by a long marking, where the class has no shape that would tell.

        ``laid`` is its own shape, ``whole`` the hypothesis that this is all of it. Of both, the lengths that
        are painted say which is likelier (:mod:`v2hdm.site.lengths`); its own deviations say nothing.
        """
        ends = _inwards(laid.corners_map, elongated=True)
        length_m = ends[0].limit_m[:, 0]
        breadth_m = np.linalg.norm(np.roll(laid.corners_map, -1, axis=1) - laid.corners_map, axis=2).min(1)
        is_long = self.candidates.known.all(axis=1) & (length_m >= _ALONE_ASPECT * breadth_m)
        longer = (ends[0].inwards + ends[1].inwards) / 2
        sigma_m = np.where(is_long, np.sqrt(self.candidates.along(longer, longer)), np.inf)
        lost: Lost = lost_of(self.standard_m, length_m, sigma_m)
        # Without a shape of the class, a marking of its own shape is what one of the class's would be.
        sound = self.share[[Kind.OF_CLASS, Kind.OTHER_LENGTH, Kind.OWN_SHAPE]].sum()
        part = self.share[Kind.OWN_SHAPE] / sound / len(ends)
        for end, by_views in zip(ends, self._of_views(ends), strict=True):
            gone = (lost.mean_m[:, None] * end.inwards).reshape(-1, 4, 2)
            scatter = SHAPE_SIGMA_M**2 * np.eye(8) + lost.variance_m2[:, None, None] * _outer(end.inwards)
            anywhere = _outer(_ANYWHERE_M * end.inwards)
            longer_shape = replace(laid, corners_map=laid.corners_map - gone)
            self.add(Kind.WRONG_END, part, longer_shape, scatter, anywhere)
            worn = self.members[-1]
            odds = np.where(is_long, lost.log_odds + by_views, -np.inf)
            beside = whole.log_likelihood - worn.log_likelihood + odds
            self.members[-1] = replace(worn, beside=beside)

    def _add_lengths(
        self,
        part: float,
        laid: Laid,
        sigma_m: float,
        shorter: FloatArray,
        ends: Sequence[_End],
        worn: FloatArray,
    ) -> None:
        """Add those on a shape rolled by the metre, which ``shorter`` (N, 8) shortens by 1 m."""
        scatter: FloatArray = sigma_m**2 * np.eye(8)
        spread_m, repeated = self._other_lengths(laid, shorter, sigma_m)
        any_length = scatter + spread_m[:, None, None] ** 2 * _outer(shorter)
        self.add(Kind.OTHER_LENGTH, part, laid, any_length, beside=repeated)
        of_other_length = self.share[Kind.OTHER_LENGTH] / (
            self.share[Kind.OF_CLASS] + self.share[Kind.OTHER_LENGTH]
        )
        lengths_of_class = [(part, laid, scatter)]
        series = in_series(self.candidates, self.believed, laid, shorter, sigma_m, self.weight)
        if series is not None:
            self.series = self.series or series
            stretched = laid.corners_map - (series.longer_m[:, None] * shorter).reshape(-1, 4, 2)
            scatter_at_length = scatter + series.longer_sigma_m[:, None, None] ** 2 * _outer(shorter)
            lengths_of_class = [
                (part * (1 - series.longer_often), laid, scatter),
                (part * series.longer_often, replace(laid, corners_map=stretched), scatter_at_length),
            ]
        for part_of_length, laid_at_length, scatter_at_length in lengths_of_class:
            self.add(Kind.OF_CLASS, part_of_length / 2, laid_at_length, scatter_at_length)
            lengths = (1 - of_other_length, scatter_at_length), (of_other_length, any_length)
            self._add_wrong_ends(part_of_length, laid_at_length, lengths, ends, worn, [0.0, _SLANT_OF_END])

    def _other_lengths(
        self, laid: Laid, shorter: FloatArray, sigma_m: float
    ) -> tuple[FloatArray, FloatArray]:
        """Sigmas (N,), m, of other lengths, and log-likelihood ratios (N,) of a repeated to a new one.

        What a candidate is expected to be, the others alone tell: those at whose ends nothing seems to stand.
        """
        weight = self.probability[:, Kind.OTHER_LENGTH] * (self.standing_odds <= 0).all(axis=1)
        off_m = np.sum((laid.corners_map - self.candidates.corners_map).reshape(-1, 8) * shorter, axis=1)
        own_m2 = self.candidates.along(shorter, shorter)
        squared = weight * np.maximum(off_m**2 - own_m2, 0.0)
        squared_of_others = _REPEATED_COUNT * _LENGTH_SIGMA_M**2 + squared.sum() - squared
        spread_m = np.sqrt(squared_of_others / (_REPEATED_COUNT + weight.sum() - weight))
        alone = normal_density(off_m, 0.0, np.sqrt(own_m2 + spread_m**2))
        # One whose ends were never seen has any such length, and is no example of a certain one.
        seen_share = spread_m**2 / (spread_m**2 + own_m2)
        sigma_between = np.sqrt(own_m2[:, None] + seen_share * own_m2 + 2 * sigma_m**2)
        density = normal_density(off_m[:, None], seen_share * off_m, sigma_between)
        alike = weight * (1 - np.eye(len(weight))) * density
        drawn = (_REPEATED_COUNT * alone + alike.sum(axis=1)) / (_REPEATED_COUNT + weight.sum() - weight)
        return spread_m, np.asarray(np.log(np.maximum(drawn, 1e-300) / np.maximum(alone, 1e-300)))

    def _add_wrong_ends(
        self,
        part: float,
        laid: Laid,
        lengths: Sequence[tuple[float, FloatArray]],
        ends: Sequence[_End],
        worn: FloatArray,
        slants: Sequence[float],
    ) -> None:
        """Add those of one end worn, or merged with other paint, of any of the ``lengths`` and ``slants``.

        ``lengths`` are fractions of the ``part`` with the scatter (..., 8, 8) of their corners.
        """
        for end, ragged in zip(ends, worn, strict=True):
            ways: tuple[tuple[FloatArray, FloatArray | float], ...] = (
                (_MISPLACED_M * end.inwards, ragged),
                (_WORN_SHARE * end.limit_m * end.inwards, ragged),
                (-_RUN_ON_M * end.inwards, 0.0),
            )
            for (way, beside), (likely, scatter), slant in product(ways, lengths, slants):
                part_of_way = part * likely / len(ends) / len(ways) / len(slants)
                misplaced = _outer(way) + _cut(laid.corners_map, end.inwards, slant)
                self.add(Kind.WRONG_END, part_of_way, laid, scatter, misplaced, way[..., None], beside)

    def _add_pieces(self, part: float, laid: Laid, scatter: FloatArray, ends: Sequence[_End]) -> None:
        """Add those of two adjacent sides hidden, as another vehicle may leave a piece in view."""
        for side, adjacent in product(ends[:2], ends[2:]):
            sides = [side.limit_m * side.inwards, adjacent.limit_m * adjacent.inwards]
            hidden = np.asarray(_WORN_SHARE * np.stack(sides, axis=2))
            cut = _cut(laid.corners_map, side.inwards + adjacent.inwards, _SLANT_OF_PIECE)
            self.add(Kind.PIECE, part / 4, laid, scatter, hidden @ np.swapaxes(hidden, 1, 2) + cut, hidden)

    def _add_unlike(self, part: float, laid: Laid, scatter: FloatArray, ragged: FloatArray) -> None:
        """Add those of other paint and of clutter."""
        self.add(Kind.PART_OF_SYMBOL, part, laid, scatter, beside=ragged)
        self.add(Kind.CLUTTER, part, laid, scatter + _MISPLACED_M**2 * np.eye(8), beside=ragged)

    def paint_error(self, probability: FloatArray, whole: BoolArray) -> PaintError:
        """Paint error from the deviations of ``whole`` candidates (N,), given ``probability`` (H, N)."""
        residuals = []
        formal = []
        for hypothesis, probable in zip(self.members, probability > 0.5, strict=True):
            if hypothesis.kind == Kind.OF_CLASS:
                rows = np.flatnonzero(whole & probable)
                residuals += [hypothesis.residual[k] for k in rows]
                formal += [hypothesis.formal[k] for k in rows]
        return learn_paint_error(residuals, formal)

    def mixture(self, joint: FloatArray, paint: PaintError) -> Mixture:
        """The corners over the markings among ``members``, of ``joint`` (H, N)."""
        markings = [k for k, hypothesis in enumerate(self.members) if hypothesis.kind < Kind.PART_OF_SYMBOL]
        weight = np.exp(joint[markings] - logsumexp(joint[markings], axis=0))[..., None, None]
        solved = [self.members[k].corners(paint) for k in markings]
        mean = np.asarray(sum(w * corners.corners_map for w, corners in zip(weight, solved, strict=True)))
        spread = [
            corners.covariance_m2 + _outer((corners.corners_map - mean).reshape(-1, 8)) for corners in solved
        ]
        tolerance_m = SHAPE_TOLERANCE * diameters(mean, np.ones(mean.shape[:2], dtype=np.bool_))
        deformed = [_deformed(corners, mean, tolerance_m) for corners in solved]
        return Mixture(
            Candidates(mean, np.sum(weight * spread, axis=0)),
            np.sum(weight[..., 0, 0] * np.array(deformed), axis=0),
        )


def _deformed(candidates: Candidates, mean_map: FloatArray, tolerance_m: FloatArray) -> FloatArray:
    """Probability (N,) that a corner, seen from the centre, is farther than a tolerance (N,) from its mean.

    It is that of the worst corner of the ``candidates``, whose errors count as if they all lay in the
    direction of its offset.
    """
    off_m = np.linalg.norm(_about_centre(candidates.corners_map - mean_map), axis=2)
    covariance = _FROM_CENTRE @ candidates.covariance_m2 @ _FROM_CENTRE
    variance_m2 = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 4, 2).sum(axis=2)
    sigma_m = np.sqrt(np.maximum(variance_m2, 1e-12))
    limit_m = tolerance_m[:, None]
    beyond = ndtr((off_m - limit_m) / sigma_m) + ndtr(-(off_m + limit_m) / sigma_m)
    return np.asarray(beyond.max(axis=1))


def _about_centre(corners: FloatArray) -> FloatArray:
    """Corners (N, 4, 2) from their centres."""
    return np.asarray(corners - corners.mean(axis=1, keepdims=True))


def _inwards(corners: FloatArray, elongated: bool) -> list[_End]:
    """Both ends of an elongated shape at ``corners`` (N, 4, 2), else all sides, opposite ones in pairs."""
    pairs = []
    for along, side in ((corners[:, 1] - corners[:, 0], _FIRST), (corners[:, 2] - corners[:, 1], _SECOND)):
        extent_m = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        inwards = [
            -np.sign(sign) * (side * sign > 0)[:, None] * (along / extent_m)[:, None] for sign in (-1, 1)
        ]
        pairs.append([_End(motion.reshape(-1, 8), extent_m) for motion in inwards])
    first_pair, second_pair = pairs
    if not elongated:
        return [*first_pair, *second_pair]
    first_is_longer = first_pair[0].limit_m > second_pair[0].limit_m
    return [
        _End(np.where(first_is_longer, a.inwards, b.inwards), np.where(first_is_longer, a.limit_m, b.limit_m))
        for a, b in zip(first_pair, second_pair, strict=True)
    ]


def _worn_evidence(candidates: Candidates, ends: Sequence[FloatArray], weight: FloatArray) -> FloatArray:
    """Log-likelihood ratios (2, N) of a worn against a sound end, from the images' disagreement on it.

    ``ends`` (N, 8) move two corners by 1 m inwards; disagreement common to both is excluded.
    """
    whole = candidates.known.all(axis=1)
    variance = [candidates.along(end / 2, (end + ends[k ^ 1]) / 2) for k, end in enumerate(ends)]
    sigma = 0.5 * np.log(np.maximum(variance, 0.0) + SHAPE_SIGMA_M**2)
    excess = sigma - np.median(sigma[:, weight * whole > 0.5])
    worn_mean, worn_sigma = _WORN_SPREAD
    sound_mean, sound_sigma = _SOUND_SPREAD
    worn = normal_density(excess, worn_mean, worn_sigma)
    sound = normal_density(excess, sound_mean, sound_sigma)
    odds = worn + _CLEAR_SHARE * (sound - worn)
    odds /= sound + _UNCLEAR_SHARE * (worn - sound)
    return np.asarray(np.where(whole, np.log(odds), 0.0))


def _cut(corners: FloatArray, end: FloatArray, slant: float) -> FloatArray:
    """Covariance (N, 8, 8), m^2, of the corners of an ``end`` cut at a ``slant``, relative to the width."""
    breadth_m = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).min(axis=1)
    corner_motions = (end.reshape(-1, 4, 1, 2) * np.eye(4)[:, :, None]).reshape(-1, 4, 8)
    return np.asarray(
        (slant * breadth_m)[:, None, None] ** 2 * (np.swapaxes(corner_motions, 1, 2) @ corner_motions)
    )


def _outer(vectors: FloatArray) -> FloatArray:
    """Outer products (N, 8, 8) of ``vectors`` (N, 8) with themselves."""
    return np.asarray(vectors[:, :, None] * vectors[:, None, :])
