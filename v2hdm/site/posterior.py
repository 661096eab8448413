"""Posterior of a candidate: marking of its class, of its own shape, part of a symbol, or clutter.

A hypothesis has a scatter of painted corners about a laid shape, covariance N, and of solved about painted
corners: P from the adjustment, O for edges that all images misplace alike. All are indifferent to rigid
motions. In the other five directions the deviation r of the solved corners from the laid shape has the
marginal likelihood N(r; 0, P + O + N), which penalises freedom. The hypotheses' frequencies are learned per
class and drive (expectation maximisation with a Dirichlet prior).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import betaln, logsumexp
from scipy.stats import f, norm, t

from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.site.candidates import Candidates, Counts
from v2hdm.site.series import Series, in_series
from v2hdm.site.shapes import (
    SHAPE_SIGMA_M,
    Laid,
    PaintError,
    Shape,
    lay,
    learn_paint_error,
    learn_shapes,
    parallelograms,
)

OF_CLASS, OTHER_LENGTH, WRONG_END, WRONG_CORNER, PIECE, OWN_SHAPE, PART_OF_SYMBOL, CLUTTER = range(8)
"""Hypotheses about a candidate; the first six are markings."""

_PRIOR_COUNT = np.array([14.0, 0.5, 0.5, 0.5, 0.5, 2.0, 1.0, 1.5])
"""Dirichlet prior: expected counts of the hypotheses among about twenty candidates."""

_KINDS = len(_PRIOR_COUNT)

_SIZE_SIGMA_M = 1.0  # sigma of a side, m, of a marking of its own size: covers any paint on a road

_LENGTH_SIGMA_M = 0.3  # prior sigma of the length of paint rolled by the metre, m: a tenth of it

_REPEATED_COUNT = 3.0
"""Concentration of the Dirichlet process of lengths: paint of another length repeats a known one."""

_SOUND_SPREAD, _WORN_SPREAD = (0.0, 0.4), (1.5, 0.7)
"""Mean and standard deviation of the logarithm of an end's scatter relative to its class: images agree on a
sound end, a worn one ends elsewhere in each (229 sound and 10 worn ends of a rendered port)."""

_UNCLEAR_SHARE, _CLEAR_SHARE = 0.05, 0.1
"""Fraction of sound ends that scatter like worn ones, being distant, and of worn ones that all images show
alike (5 of 229 and 1 of 11 ends there)."""

_MISPLACED_M = 0.3  # sigma, m, of a worn end or a corner from another edge (17 worn ends: .08 to .74 m)

_WORN_SHARE = 0.5  # the same relative to the length: any part may be worn away

_CUT_SHARE = 0.1  # sigma, relative to the width, of a corner at a slanting cut

_RUN_ON_M = 1.0  # sigma, m, of an end that merges with other paint: about the length of letters

_RATE_STRENGTH = 4.0
"""Images that the class's detection rate is worth: how similar its markings' rates are."""

_NEGLECTED_SHARE = 0.1  # fraction of markings that are worn or hidden, with any detection rate

_CLUTTER_FOUND = (0.5, 2.0)
"""Beta distribution of the detection rate of clutter, or part of a symbol, in easy views: a fifth."""

_BARE_FOUND = (0.05, 10.0)
"""Beta distribution of the rate of such detections on bare ground: one view in two hundred."""

_LIKE_CLASS, _LIKE_SHARE = 0.7, 0.2
"""Fraction of other paint and clutter that is shaped like the class it was taken for, at any length, and the
sigma of its corners relative to the width: detections of a class resemble it, and are fitted as such."""

_CLUTTER_REPEATS = 0.7  # probability that clutter seen in some images is seen in one more

_AGREEING = (0.93, 0.6)  # fraction of observations of a marking, and of clutter, that agree with the solution

CORNERS_OF_IMAGE = 4.0  # number of correlated observations: those of one image

_UNDER_SYMBOL = (0.02, 0.5)
"""Fraction of a marking's images, and of a symbol part's, in which a symbol covers it.

Half of the parts of other paint belong to letters or drawings without a class, and count as markings here.
"""

_ODDS, _ODDS_SIGMA, _ODDS_FREEDOM = (5.0, 2.5), 1.2, 4.0
"""Log-odds of the detector, averaged over a marking: prior mean and standard deviation of a class's (in a
rendered port 335 diamonds have 7.9, 91 dashes 7.4, 3 stop lines 1.1), least scale of its members about it
(1.0 for diamonds), and degrees of freedom of Student's t distribution, for worn ones."""

_OTHER_ODDS = (1.5, 1.5)  # mean and sigma of the same for anything else (14 candidates of a rendered port)

_PASSES = 2  # rounds of expectation maximisation; a third changes no figure of six drives by a hundredth

_FIRST, _SECOND = np.array([-0.5, 0.5, 0.5, -0.5]), np.array([-0.5, -0.5, 0.5, 0.5])
"""Corner k of a parallelogram with sides u and v lies at its centre plus first[k] u + second[k] v."""

_CORNERS_MOVED = np.concatenate([np.eye(4), np.eye(4)[:2] - np.eye(4)[2:]])
"""Displaced corners (6, 4): one alone, or two opposite corners in opposite directions.

The quadrilateral fitted to an image is nearly a parallelogram, so that one wrong corner drags another.
"""

_NOTHING = np.zeros((8, 8))  # covariance of no misplacement

_OWN_SIZE = _SIZE_SIGMA_M**2 * np.kron(np.outer(_FIRST, _FIRST) + np.outer(_SECOND, _SECOND), np.eye(2))


@dataclass(frozen=True)
class Posterior:
    """The posterior of G candidates."""

    probability: FloatArray  # (G, 8) of each hypothesis
    log_odds: FloatArray  # (G,) of being a marking
    candidates: Candidates  # with the corners of a marking
    evidence: FloatArray  # (G, 5) nats for a marking, from shape, images, easy views, agreement, appearance
    misfit: FloatArray  # (G,) p-value of the deviation from the nearest shape of its class; 1 without


def posterior(candidates: Candidates, kind: IntArray, counts: Counts) -> Posterior:
    """Posterior of G candidates of classes ``kind`` (G,), given their positions and counts."""
    total = len(candidates)
    probability, evidence = np.zeros((total, _KINDS)), np.zeros((total, 5))
    log_odds, misfit = np.zeros(total), np.ones(total)
    corners, covariance = candidates.corners_map.copy(), candidates.covariance_m2.copy()
    for one in np.unique(kind):
        own = np.flatnonzero(kind == one)
        found = _of_class(candidates.subset(own), counts.subset(own))
        probability[own], log_odds[own], evidence[own] = found.probability, found.log_odds, found.evidence
        corners[own], covariance[own] = found.candidates.corners_map, found.candidates.covariance_m2
        misfit[own] = found.misfit
    return Posterior(probability, log_odds, Candidates(corners, covariance), evidence, misfit)


def _of_class(candidates: Candidates, counts: Counts) -> Posterior:
    """Posterior of the candidates of one class, which jointly determine its markings' distribution."""
    share, paint = _PRIOR_COUNT / _PRIOR_COUNT.sum(), learn_paint_error([], [])
    # Initially, candidates that agreeing images show whole are taken for markings.
    taken = candidates.known.all(axis=1) & (2 * counts.agreeing > counts.observations)
    weight, probability = np.asarray(taken, dtype=np.float64), np.zeros((len(candidates), _KINDS))
    believed = candidates
    for number in range(1, _PASSES + 1):
        shapes = learn_shapes(candidates.subset(weight > 0.5))
        of_drive = share, paint, weight, probability[:, OTHER_LENGTH], _vague_evidence(counts, weight)
        space = _hypotheses(candidates, believed, shapes, *of_drive)
        hypotheses = space.found
        by_kind, sources = np.array([one.kind for one in hypotheses]), _counted(counts, weight)
        shaped = np.stack([one.log_likelihood for one in hypotheses])
        joint = shaped + np.array([one.log_prior for one in hypotheses])[:, None]
        joint += sources.sum(axis=0)[:, np.maximum(by_kind - OWN_SHAPE, 0)].T
        marking = by_kind < PART_OF_SYMBOL
        if space.series is not None:
            placed = [hypotheses[k].corners(_paint_m2(hypotheses[k], paint)) for k in np.flatnonzero(marking)]
            joint[marking] += np.stack([space.series.evidence(one) for one in placed])
        each = np.exp(joint - logsumexp(joint, axis=0))
        probability = np.stack([each[by_kind == one].sum(axis=0) for one in range(_KINDS)], axis=1)
        weight = probability[:, :PART_OF_SYMBOL].sum(axis=1)
        share = _PRIOR_COUNT + probability.sum(axis=0)
        share /= share.sum()
        paint = _paint_error(hypotheses, each, np.asarray(candidates.known.all(axis=1)))
        if space.series is not None and number < _PASSES:
            believed = _mixture(hypotheses, joint, paint)
    log_odds = logsumexp(joint[marking], axis=0) - logsumexp(joint[~marking], axis=0)
    by_shape = shaped[marking].max(axis=0) - shaped[by_kind == CLUTTER].max(axis=0)
    evidence = np.column_stack([by_shape, *(sources[:, :, 0] - sources[:, :, 2])])
    like_others = [one.fit[2] for one in hypotheses if one.kind in (OF_CLASS, OTHER_LENGTH)]
    # Paint errors follow Student's t distribution, their squares Fisher's F.
    misfit = f.sf(np.min(like_others, axis=0) / 5, 5, paint.freedom) if shapes else np.ones(len(candidates))
    return Posterior(probability, log_odds, _mixture(hypotheses, joint, paint), evidence, misfit)


def _counted(counts: Counts, weight: FloatArray) -> FloatArray:
    """Log-likelihoods (4, N, 3) of images, easy views, others, appearance; marking, other paint, clutter."""
    images = np.maximum(counts.images, 1)
    stay = 1 - (weight.sum() + 1) / (weight @ images + 2)
    shown = np.stack([_geometric(images, stay), *2 * [_geometric(images, _CLUTTER_REPEATS)]], axis=1)
    rate = float((weight @ counts.found + 1) / (weight @ counts.easy_views + 2))
    own = log_found(counts.found, counts.easy_views, rate)
    clutter = _rates(counts.found, counts.easy_views, *_CLUTTER_FOUND)
    found = np.stack([own, clutter, clutter], axis=1)
    agree, differ = counts.agreeing, counts.observations - counts.agreeing
    right, wrong = (agree[:, None] * np.log(p) + differ[:, None] * np.log1p(-p) for p in _AGREEING)
    under, alone = counts.as_symbol, counts.images
    plain, covered = (under[:, None] * np.log(p) + alone[:, None] * np.log1p(-p) for p in _UNDER_SYMBOL)
    covered = np.logaddexp(covered, plain) - np.log(2)
    rest = np.hstack([right, right, wrong]) / CORNERS_OF_IMAGE + np.hstack([plain, covered, plain])
    there = counts.images > 0
    alike = _log_like_class(counts.log_odds, weight * there)
    unlike = norm.logpdf(counts.log_odds, *_OTHER_ODDS)
    # The shaft of an arrow looks like a dash; most other clutter like no known class.
    either = np.logaddexp(alike, unlike) - np.log(2)
    looks = np.stack([alike, either, unlike], axis=1) * there[:, None]
    return np.stack([shown, found, rest, looks])


def _log_like_class(odds: FloatArray, weight: FloatArray) -> FloatArray:
    """Log-likelihood (N,) of a marking's mean log-odds ``odds`` (N,), under that of markings (``weight``)."""
    (usual, sigma), least, total = _ODDS, _ODDS_SIGMA**2, weight.sum()
    information = sigma**-2 + total / least
    mean = (usual / sigma**2 + weight @ odds / least) / information
    spread = weight @ (odds - mean) ** 2 * (1 - 2 / _ODDS_FREEDOM) / max(total, 1.0)
    scale = np.sqrt(max(least, float(spread)) + 1 / information)
    return np.asarray(t.logpdf(odds, _ODDS_FREEDOM, mean, scale))


def _geometric(images: IntArray, stay: float) -> FloatArray:
    """Log-likelihood of numbers of images, given the probability ``stay`` of one more."""
    return np.asarray(np.log1p(-stay) + (images - 1) * np.log(stay))


def log_found(found: IntArray, easy_views: IntArray, rate: float) -> FloatArray:
    """Log-likelihood (N,) of ``found`` out of ``easy_views`` (N,), at the class's ``rate`` or any."""
    usual = _rates(found, easy_views, _RATE_STRENGTH * rate, _RATE_STRENGTH * (1 - rate))
    neglected = _rates(found, easy_views, 1.0, 1.0)
    both = np.log1p(-_NEGLECTED_SHARE) + usual, np.log(_NEGLECTED_SHARE) + neglected
    return np.asarray(np.logaddexp(*both))


def log_found_where_none_is(found: IntArray, easy_views: IntArray) -> FloatArray:
    """Log-likelihood (N,) of ``found`` detections out of ``easy_views`` (N,) on bare ground."""
    return _rates(found, easy_views, *_BARE_FOUND)


def _rates(found: IntArray, easy_views: IntArray, hits: float, misses: float) -> FloatArray:
    """Beta-binomial log-likelihood (N,) of the easy views."""
    left = easy_views - found
    return np.asarray(betaln(found + hits, left + misses) - betaln(hits, misses))


@dataclass(frozen=True)
class _Hypothesis:
    """One hypothesis on N candidates."""

    kind: int
    log_prior: float
    candidates: Candidates
    directions: FloatArray  # (N, 5, 8) in which deviations are tested
    residual: FloatArray  # (N, 5) from the laid shape
    scatter: FloatArray  # (..., 8, 8) covariance of painted corners
    misplaced: FloatArray  # (..., 8, 8) covariance common to all images
    paint_m2: float
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
        innovation = innovation + self.paint_m2 * np.eye(5)
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

    def corners(self, paint_m2: FloatArray) -> Candidates:
        """Corners under the hypothesis (a Kalman update) with edge errors ``paint_m2`` (N,)."""
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
class _Space:
    """Hypotheses on N ``candidates``; ``believed`` are their corners from the previous pass.

    ``share`` (8,) are frequencies, ``paint`` the edge errors, ``series`` the evidence of lines of dashes.
    """

    candidates: Candidates
    believed: Candidates
    share: FloatArray
    paint: PaintError
    found: list[_Hypothesis] = field(default_factory=list)
    series: Series | None = None

    def add(
        self,
        kind: int,
        part: float,
        laid: Laid,
        scatter: FloatArray,
        misplaced: FloatArray = _NOTHING,
        one_way: FloatArray | None = None,
        beside: FloatArray | float = 0.0,
    ) -> None:
        """Add one with a ``part`` of its kind's frequency; see :class:`_Hypothesis` for the rest."""
        off = (self.candidates.corners_map - laid.corners_map).reshape(-1, 8, 1)
        residual = (laid.directions @ off)[..., 0]
        errors = scatter, misplaced, self.paint.sigma_m**2, one_way, beside
        prior = float(np.log(part * self.share[kind]))
        self.found.append(_Hypothesis(kind, prior, self.candidates, laid.directions, residual, *errors))


def _hypotheses(
    candidates: Candidates,
    believed: Candidates,
    shapes: Sequence[Shape],
    share: FloatArray,
    paint: PaintError,
    weight: FloatArray,
    other_length: FloatArray,
    vague: FloatArray,
) -> _Space:
    """All hypotheses on N candidates, ``believed`` in the previous pass, given the class's shapes.

    ``weight`` and ``other_length`` (N,) are the probabilities of a marking, and of another length; ``vague``
    (N, 4) is the log-likelihood ratio of views that disagree on a corner.
    """
    space = _Space(candidates, believed, share, paint)
    total, ragged = sum(shape.share for shape in shapes), np.zeros(len(candidates))
    for shape in shapes:
        ragged = _add_shape(space, shape, shape.share / total, weight, other_length, vague)
    centre = candidates.corners_map.mean(axis=1)
    turns, shifts = np.tile(np.eye(2), (len(centre), 1, 1)), np.zeros(len(centre), dtype=np.int64)
    own = Laid(parallelograms(candidates.corners_map) + centre[:, None], turns, centre, shifts)
    own = lay(shapes[0].corners, SHAPE_SIGMA_M, candidates)[0] if shapes else own
    any_size = SHAPE_SIGMA_M**2 * np.eye(8) + _OWN_SIZE
    space.add(OWN_SHAPE, 1.0, own, any_size)
    unlike = 1 - _LIKE_CLASS if shapes else 1.0
    space.add(PART_OF_SYMBOL, unlike, own, any_size, beside=ragged)
    space.add(CLUTTER, unlike, own, any_size + _MISPLACED_M**2 * np.eye(8), beside=ragged)
    return space


def _add_shape(
    space: _Space, shape: Shape, part: float, weight: FloatArray, other_length: FloatArray, vague: FloatArray
) -> FloatArray:
    """Add one shape's hypotheses, a ``part`` of the class; log-likelihood (N,) of equally ragged clutter."""
    candidates, share = space.candidates, space.share
    laid, otherwise = lay(shape.corners, shape.sigma_m, candidates)
    scatter: FloatArray = shape.sigma_m**2 * np.eye(8)
    ends = _inwards(laid.corners_map, shape.is_elongated)
    shorter, ways = (ends[0][0] + ends[1][0]) / 2, [(part, laid, scatter)]
    series = None
    if shape.is_elongated:
        series = in_series(candidates, space.believed, laid, shorter, shape.sigma_m, weight)
    if series is not None:
        space.series = space.series or series
        stretched = laid.corners_map - (series.longer_m[:, None] * shorter).reshape(-1, 4, 2)
        about = scatter + series.longer_sigma_m[:, None, None] ** 2 * _outer(shorter)
        often = series.longer_often
        ways = [
            (part * (1 - often), laid, scatter),
            (part * often, replace(laid, corners_map=stretched), about),
        ]
    for each, one, about in ways:
        space.add(OF_CLASS, each / 2, one, about)
    space.add(OF_CLASS, part / 2, otherwise, scatter)
    for moved in _CORNERS_MOVED:
        block = _MISPLACED_M**2 * np.kron(np.outer(moved, moved), np.eye(2))
        space.add(WRONG_CORNER, part / len(_CORNERS_MOVED), laid, scatter, np.asarray(block, np.float64))
    _add_pieces(space, part, laid, scatter, ends)
    none = np.zeros(len(candidates))
    sides_m = np.linalg.norm(np.roll(shape.corners, -1, axis=0) - shape.corners, axis=1)
    alike = scatter + (_LIKE_SHARE * sides_m.min()) ** 2 * np.eye(8)
    if not shape.is_elongated:
        _add_wrong_ends(space, part, laid, [(1.0, scatter)], ends, [[_NOTHING]] * 4, [none] * 4)
        _add_alike(space, part, laid, alike, none)
        return none
    worn = [
        ragged + np.sum(end.reshape(-1, 4, 2).any(axis=2) * vague, axis=1) / 2
        for ragged, (end, _) in zip(
            _worn_evidence(candidates, [end for end, _ in ends], weight), ends, strict=True
        )
    ]
    spread_m, again = _other_lengths(candidates, laid, shorter, shape.sigma_m, other_length)
    longer = scatter + spread_m**2 * _outer(shorter)
    space.add(OTHER_LENGTH, part, laid, longer, beside=again)
    other = share[OTHER_LENGTH] / (share[OF_CLASS] + share[OTHER_LENGTH])
    angles = [[_NOTHING, _slanted(laid.corners_map, end)] for end, _ in ends]
    for each, one, about in ways:
        _add_wrong_ends(space, each, one, [(1 - other, about), (other, longer)], ends, angles, worn)
    # An end of clutter is ragged with probability one half.
    ragged = np.asarray(np.sum(np.logaddexp(worn, 0.0) - np.log(2), axis=0))
    _add_alike(space, part, laid, alike + (_WORN_SHARE * sides_m.max()) ** 2 * _outer(shorter), ragged)
    return ragged


def _add_alike(space: _Space, part: float, laid: Laid, scatter: FloatArray, beside: FloatArray) -> None:
    """Add hypotheses of other paint and of clutter shaped like the class."""
    ragged = scatter + _MISPLACED_M**2 * np.eye(8)
    for kind, about in ((PART_OF_SYMBOL, scatter), (CLUTTER, ragged)):
        space.add(kind, part * _LIKE_CLASS, laid, about, beside=beside)


def _add_wrong_ends(
    space: _Space,
    part: float,
    laid: Laid,
    lengths: Sequence[tuple[float, FloatArray]],
    ends: Sequence[tuple[FloatArray, FloatArray]],
    angles: Sequence[Sequence[FloatArray]],
    worn: Sequence[FloatArray],
) -> None:
    """Add hypotheses of one end worn, or merged with other paint, of any length and cut angle."""
    for (end, extent_m), cuts, ragged in zip(ends, angles, worn, strict=True):
        ways: tuple[tuple[FloatArray, FloatArray | float], ...] = (
            (_MISPLACED_M * end, ragged),
            (_WORN_SHARE * extent_m * end, ragged),
            (-_RUN_ON_M * end, 0.0),
        )
        for (way, beside), cut, (likely, size) in itertools.product(ways, cuts, lengths):
            each = part * likely / len(ends) / len(ways) / len(cuts)
            space.add(WRONG_END, each, laid, size, _outer(way) + cut, way[..., None], beside)


def _add_pieces(
    space: _Space, part: float, laid: Laid, scatter: FloatArray, ends: Sequence[tuple[FloatArray, FloatArray]]
) -> None:
    """Add hypotheses of a marking without one end and one side, as another vehicle may leave it in view."""
    for (one, reach_m), (other_end, other_m) in itertools.product(ends[:2], ends[2:]):
        both = np.asarray(_WORN_SHARE * np.stack([reach_m * one, other_m * other_end], axis=2))
        slanted = _slanted(laid.corners_map, one + other_end, _CUT_SHARE)
        space.add(PIECE, part / 4, laid, scatter, both @ np.swapaxes(both, 1, 2) + slanted, both)


def _worn_evidence(
    candidates: Candidates, ends: Sequence[FloatArray], weight: FloatArray
) -> list[FloatArray]:
    """Log-likelihood ratios (N,) of a worn against a sound end, from the images' disagreement on it.

    ``ends`` (N, 8) move two corners by 1 m inwards, in opposite pairs; disagreement common to a pair is
    excluded.
    """
    whole = candidates.known.all(axis=1)
    variance = [candidates.along(end / 2, (end + ends[k ^ 1]) / 2) for k, end in enumerate(ends)]
    sigma = 0.5 * np.log(np.maximum(variance, 0.0) + SHAPE_SIGMA_M**2)
    off = sigma - np.median(sigma[:, weight * whole > 0.5])
    worn, sound = norm.pdf(off, *_WORN_SPREAD), norm.pdf(off, *_SOUND_SPREAD)
    odds = worn + _CLEAR_SHARE * (sound - worn)
    odds /= sound + _UNCLEAR_SHARE * (worn - sound)
    return list(np.where(whole, np.log(odds), 0.0))


def _vague_evidence(counts: Counts, weight: FloatArray) -> FloatArray:
    """Log-likelihood ratio (N, 4) of a worn or hidden corner, from views that disagree on it."""
    found = np.maximum(counts.found[:, None], counts.pointed)
    vague = found - counts.pointed
    rate = float((weight @ vague.sum(axis=1) + 1) / (4 * weight @ counts.found + 2))
    sound = _rates(vague, found, _RATE_STRENGTH * rate, _RATE_STRENGTH * (1 - rate))
    return np.asarray(np.logaddexp(_rates(vague, found, 1.0, 1.0) - sound, 0.0) - np.log(2))


def _other_lengths(
    candidates: Candidates, laid: Laid, shorter: FloatArray, sigma_m: float, weight: FloatArray
) -> tuple[float, FloatArray]:
    """Standard deviation, m, of other lengths, and the log-likelihood ratio (N,) of a repeated to a new one.

    Paint of another length, by ``weight`` (N,), may repeat (a Dirichlet process); ``shorter`` (N, 8) shortens
    it by 1 m.
    """
    off_m = np.sum((laid.corners_map - candidates.corners_map).reshape(-1, 8) * shorter, axis=1)
    own_m2 = candidates.along(shorter, shorter)
    squared = _REPEATED_COUNT * _LENGTH_SIGMA_M**2 + weight @ np.maximum(off_m**2 - own_m2, 0.0)
    spread_m = float(np.sqrt(squared / (_REPEATED_COUNT + weight.sum())))
    alone = norm.pdf(off_m, 0.0, np.sqrt(own_m2 + spread_m**2))
    apart = np.sqrt(own_m2 + own_m2[:, None] + 2 * sigma_m**2)
    alike = weight * (1 - np.eye(len(weight))) * norm.pdf(off_m, off_m[:, None], apart)
    drawn = (_REPEATED_COUNT * alone + alike.sum(axis=1)) / (_REPEATED_COUNT + weight.sum() - weight)
    return spread_m, np.asarray(np.log(np.maximum(drawn, 1e-300) / np.maximum(alone, 1e-300)))


def _inwards(corners: FloatArray, elongated: bool) -> list[tuple[FloatArray, FloatArray]]:
    """Motions (N, 8) of corners for a side moving inwards by 1 m, and their limits (N, 1), m."""
    ways = []
    for along, side in ((corners[:, 1] - corners[:, 0], _FIRST), (corners[:, 2] - corners[:, 1], _SECOND)):
        extent_m = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        both = [-np.sign(sign) * (side * sign > 0)[:, None] * (along / extent_m)[:, None] for sign in (-1, 1)]
        ways.append([(one.reshape(-1, 8), extent_m) for one in both])
    if not elongated:
        return [*ways[0], *ways[1]]
    first = ways[0][0][1] > ways[1][0][1]
    return [(np.where(first, a[0], b[0]), np.where(first, a[1], b[1])) for a, b in zip(*ways, strict=True)]


def _slanted(corners: FloatArray, end: FloatArray, share: float = 0.5) -> FloatArray:
    """Covariance (N, 8, 8), m^2, of an ``end`` cut at any angle: half the width at 45 degrees."""
    breadth_m = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).min(axis=1)
    each = (end.reshape(-1, 4, 1, 2) * np.eye(4)[:, :, None]).reshape(-1, 4, 8)
    return np.asarray((share * breadth_m)[:, None, None] ** 2 * (np.swapaxes(each, 1, 2) @ each))


def _outer(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors[:, :, None] * vectors[:, None, :])


def _paint_error(hypotheses: Sequence[_Hypothesis], each: FloatArray, whole: BoolArray) -> PaintError:
    """Paint error from the deviations of ``whole`` candidates (N,) from their class's shapes."""
    members = [
        (one.residual[k], one.formal[k])
        for one, probability in zip(hypotheses, each, strict=True)
        if one.kind == OF_CLASS
        for k in np.flatnonzero(whole & (probability > 0.5))
    ]
    return learn_paint_error([residual for residual, _ in members], [formal for _, formal in members])


def _mixture(hypotheses: Sequence[_Hypothesis], joint: FloatArray, paint: PaintError) -> Candidates:
    """Mean and covariance of the corners under the mixture of marking hypotheses."""
    markings = [k for k, one in enumerate(hypotheses) if one.kind < PART_OF_SYMBOL]
    weight = np.exp(joint[markings] - logsumexp(joint[markings], axis=0))
    each = [hypotheses[k].corners(_paint_m2(hypotheses[k], paint)) for k in markings]
    mean = sum(w[:, None, None] * one.corners_map for w, one in zip(weight, each, strict=True))
    covariance = sum(
        w[:, None, None] * (one.covariance_m2 + _outer((one.corners_map - mean).reshape(-1, 8)))
        for w, one in zip(weight, each, strict=True)
    )
    return Candidates(np.asarray(mean), np.asarray(covariance))


def _paint_m2(hypothesis: _Hypothesis, paint: PaintError) -> FloatArray:
    """Variance (N,) of errors common to all images, given a candidate's deviation from its shape."""
    if hypothesis.kind != OF_CLASS:
        return np.full(len(hypothesis.residual), paint.sigma_m**2)
    pairs = zip(hypothesis.residual, hypothesis.formal, strict=True)
    return np.array([paint.variance_m2(residual, formal) for residual, formal in pairs])
