"""Posterior of a candidate: marking of its class, of its own shape, part of a symbol, or clutter.

Each place has one posterior, over the hypotheses of :mod:`v2hdm.site.hypotheses`. Five kinds of data, each
with its log-likelihood under every hypothesis, add up: the shape of the solved corners (for dashes also their
place among those of their line), the number of images, the detections in easy views, the agreement of the
observations together with symbols seen there, and the look. What the drive teaches of a class - shapes,
rates, frequencies of the hypotheses, paint errors - is learned together with the posterior (expectation
maximisation with a Dirichlet prior).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import betaln, expit, fdtrc, logsumexp

from v2hdm.densities import log_normal_density, log_student_density
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.site.candidates import Candidates, Counts
from v2hdm.site.hypotheses import Hypotheses, Kind
from v2hdm.site.shapes import learn_paint_error, learn_shapes

_PRIOR_COUNT = np.array([14.0, 0.5, 0.5, 0.5, 2.0, 1.0, 1.5])
"""Dirichlet prior: expected counts of the hypotheses among about twenty candidates."""


class _Beta(NamedTuple):
    """A beta distribution of a rate, as numbers of views with and without a detection."""

    hits: float
    misses: float


_RATE_STRENGTH = 4.0  # images that the class's detection rate is worth: how similar its markings' rates are
_NEGLECTED_SHARE = 0.1  # fraction of markings that are worn or hidden, with any detection rate
_ANY_RATE = _Beta(1.0, 1.0)  # detection rate of a worn or hidden marking or corner: all are as likely
_CLUTTER_FOUND = _Beta(0.5, 2.0)  # detection rate of clutter, or part of a symbol, in easy views: a fifth
_BARE_FOUND = _Beta(0.05, 10.0)  # detection rate of bare ground in easy views: one in two hundred

_CLUTTER_REPEATS = 0.7  # probability that clutter seen in some images is seen in one more
_AGREEING = (0.93, 0.6)  # fraction of observations of a marking, and of clutter, that agree with the solution
CORNERS_OF_IMAGE = 4.0  # number of correlated observations: those of one image

_UNDER_SYMBOL = (0.02, 0.5)
"""Fraction of a marking's images, and of a symbol part's, in which a symbol covers it.

Half of the parts of other paint belong to letters or drawings without a class, and count as markings here.
"""

# Log-odds of the detector, averaged over a marking. In a rendered port 335 diamonds have 7.9, 91 dashes 7.4,
# 3 stop lines 1.1, and 14 other candidates 1.5.
_ODDS = (5.0, 2.5)  # prior mean and standard deviation of a class's log-odds
_ODDS_SIGMA = 1.2  # least scale of a marking's log-odds about its class's (1.0 for diamonds)
_ODDS_FREEDOM = 4.0  # degrees of freedom of their Student's t distribution, for worn markings
_OTHER_ODDS = (1.5, 1.5)  # mean and standard deviation of the log-odds of anything else
_PASSES = 2  # rounds of expectation maximisation; a third changes no figure of six drives by a hundredth


@dataclass(frozen=True)
class Posterior:
    """The posterior of G candidates."""

    probability: FloatArray  # (G, 7) of each kind of hypothesis
    log_odds: FloatArray  # (G,) of being a marking
    candidates: Candidates  # with the corners of a marking
    evidence: FloatArray  # (G, 5) nats for a marking, from shape, images, easy views, agreement, appearance
    misfit: FloatArray  # (G,) p-value of the deviation from the nearest shape of its class; 1 without
    deformed: FloatArray  # (G,) probability that a marking there has another shape than its corners


def posterior(
    candidates: Candidates,
    kind: IntArray,
    counts: Counts,
    standing_odds: FloatArray | None = None,
    standard_m: Mapping[int, tuple[float, ...]] | None = None,
) -> Posterior:
    """Posterior of G candidates of classes ``kind`` (G,), given their positions and counts.

    ``standing_odds`` (G, 4) are log-likelihood ratios that something stands beyond a side and hides the rest,
    ``standard_m`` the lengths to which markings of a class are painted.
    """
    standards = standard_m or {}
    total = len(candidates)
    odds = np.zeros((total, 4)) if standing_odds is None else standing_odds
    probability = np.zeros((total, len(Kind)))
    evidence = np.zeros((total, 5))
    log_odds = np.zeros(total)
    misfit = np.ones(total)
    deformed = np.ones(total)
    corners = candidates.corners_map.copy()
    covariance = candidates.covariance_m2.copy()
    for class_index in np.unique(kind):
        members = np.flatnonzero(kind == class_index)
        lengths_m = standards.get(int(class_index), ())
        of_class = _of_class(candidates.subset(members), counts.subset(members), odds[members], lengths_m)
        probability[members] = of_class.probability
        log_odds[members] = of_class.log_odds
        evidence[members] = of_class.evidence
        corners[members] = of_class.candidates.corners_map
        covariance[members] = of_class.candidates.covariance_m2
        misfit[members] = of_class.misfit
        deformed[members] = of_class.deformed
    return Posterior(probability, log_odds, Candidates(corners, covariance), evidence, misfit, deformed)


def _of_class(
    candidates: Candidates, counts: Counts, standing_odds: FloatArray, standard_m: tuple[float, ...]
) -> Posterior:
    """Posterior of the candidates of one class, which jointly determine its markings' distribution."""
    share = _PRIOR_COUNT / _PRIOR_COUNT.sum()
    paint = learn_paint_error([], [])
    # Initially, candidates that agreeing images show whole are taken for markings, others for clutter.
    whole = np.asarray(candidates.known.all(axis=1))
    believed = candidates
    is_clear = whole & (2 * counts.agreeing > counts.observations)
    probability = np.eye(len(Kind))[np.where(is_clear, Kind.OF_CLASS, Kind.CLUTTER)]
    for number in range(1, _PASSES + 1):
        weight = probability[:, : Kind.PART_OF_SYMBOL].sum(axis=1)
        vague = _vague_evidence(counts, weight)
        space = Hypotheses(candidates, believed, probability, share, paint, vague, standing_odds, standard_m)
        shapes = learn_shapes(candidates.subset(_examples(weight, standing_odds)))
        space.add_all(shapes)
        by_kind = np.array([hypothesis.kind for hypothesis in space.members])
        sources = _counted(counts, weight)
        marking = by_kind < Kind.PART_OF_SYMBOL
        column = np.where(marking, 0, by_kind - Kind.OWN_SHAPE)  # of the sources: marking, symbol, clutter
        shaped = np.stack([hypothesis.log_likelihood for hypothesis in space.members])
        joint = shaped + np.array([hypothesis.log_prior for hypothesis in space.members])[:, None]
        joint += sources.sum(axis=0)[:, column].T
        if space.series is not None:
            placed = [
                hypothesis.corners(paint)
                for hypothesis in space.members
                if hypothesis.kind < Kind.PART_OF_SYMBOL
            ]
            joint[marking] += np.stack([space.series.evidence(corners) for corners in placed])
        responsibility = np.exp(joint - logsumexp(joint, axis=0))
        probability = np.stack([responsibility[by_kind == kind].sum(axis=0) for kind in Kind], axis=1)
        share = _PRIOR_COUNT + probability.sum(axis=0)
        share /= share.sum()
        paint = space.paint_error(responsibility, whole)
        if space.series is not None and number < _PASSES:
            believed = space.mixture(joint, paint).candidates
    log_odds = logsumexp(joint[marking], axis=0) - logsumexp(joint[~marking], axis=0)
    by_shape = shaped[marking].max(axis=0) - shaped[by_kind == Kind.CLUTTER].max(axis=0)
    evidence = np.column_stack([by_shape, *(sources[:, :, 0] - sources[:, :, 2])])
    like_others = [
        hypothesis.fit.squared
        for hypothesis in space.members
        if hypothesis.kind in (Kind.OF_CLASS, Kind.OTHER_LENGTH)
    ]
    # Paint errors follow Student's t distribution, their squares Fisher's F.
    misfit = fdtrc(5, paint.freedom, np.min(like_others, axis=0) / 5) if shapes else np.ones(len(candidates))
    mixture = space.mixture(joint, paint)
    return Posterior(probability, log_odds, mixture.candidates, evidence, misfit, mixture.deformed)


def _examples(weight: FloatArray, standing_odds: FloatArray) -> BoolArray:
    """Likely markings (N,) to learn shapes from: those beyond which nothing seems to stand, if any."""
    is_likely = weight > 0.5
    is_clear = is_likely & (standing_odds <= 0).all(axis=1)
    return is_clear if is_clear.any() else is_likely


def _counted(counts: Counts, weight: FloatArray) -> FloatArray:
    """Log-likelihoods (4, N, 3) of images, easy views, others, appearance; marking, other paint, clutter."""
    repetition = _repetition(counts.images, counts.easy_views, counts.detected_views, weight)
    shown, detected = repetition[..., [0, 1, 1]]
    agree = counts.agreeing
    differ = counts.observations - counts.agreeing
    right, wrong = (agree[:, None] * np.log(p) + differ[:, None] * np.log1p(-p) for p in _AGREEING)
    with_symbol = counts.as_symbol
    without_symbol = counts.images
    plain, covered = (
        with_symbol[:, None] * np.log(p) + without_symbol[:, None] * np.log1p(-p) for p in _UNDER_SYMBOL
    )
    covered = np.logaddexp(covered, plain) - np.log(2)
    agreement = np.hstack([right, right, wrong]) / CORNERS_OF_IMAGE + np.hstack([plain, covered, plain])
    is_in_images = counts.images > 0
    alike = _log_like_class(counts.log_odds, weight * is_in_images)
    other_mean, other_sigma = _OTHER_ODDS
    unlike = log_normal_density(counts.log_odds, other_mean, other_sigma)
    # The shaft of an arrow looks like a dash; most other clutter like no known class.
    either = np.logaddexp(alike, unlike) - np.log(2)
    looks = np.stack([alike, either, unlike], axis=1) * is_in_images[:, None]
    return np.stack([shown, detected, agreement, looks])


def _repetition(
    images: IntArray, easy_views: IntArray, detected_views: IntArray, weight: FloatArray
) -> FloatArray:
    """Log-likelihoods (2, N, 2) of images and easy views, of paint and of clutter.

    Paint, with ``weight`` (N,), is found in nearly every easy view, clutter in some.
    """
    images = np.maximum(images, 1)
    stay = 1 - (weight.sum() + 1) / (weight @ images + 2)
    shown = np.stack([_geometric(images, stay), _geometric(images, _CLUTTER_REPEATS)], axis=1)
    rate = float((weight @ detected_views + 1) / (weight @ easy_views + 2))
    of_paint = log_found(detected_views, easy_views, rate)
    of_clutter = _rates(detected_views, easy_views, _CLUTTER_FOUND)
    return np.stack([shown, np.stack([of_paint, of_clutter], axis=1)])


class Presence(NamedTuple):
    """Whether N symbols are paint."""

    log_odds: FloatArray  # (N,)
    evidence: FloatArray  # (N, 2) nats for paint, from the number of images and the detections in easy views


def symbols_presence(images: IntArray, easy_views: IntArray, detected_views: IntArray) -> Presence:
    """Posterior of N symbols of one class: painted, or clutter such as erased paint or an edge of shade.

    Clutter may have the shape of a symbol, and repeats too, but in fewer of the ``easy_views`` (N,).
    """
    of_paint = _PRIOR_COUNT[: Kind.PART_OF_SYMBOL].sum()
    of_clutter = _PRIOR_COUNT[Kind.PART_OF_SYMBOL :].sum()
    weight = (2 * detected_views >= easy_views).astype(np.float64)
    for _ in range(_PASSES):
        painted, clutter = np.moveaxis(_repetition(images, easy_views, detected_views, weight), 2, 0)
        evidence = (painted - clutter).T
        prior = np.log((of_paint + weight.sum()) / (of_clutter + (1 - weight).sum()))
        log_odds = prior + evidence.sum(axis=1)
        weight = expit(log_odds)
    return Presence(log_odds, evidence)


def _vague_evidence(counts: Counts, weight: FloatArray) -> FloatArray:
    """Log-likelihood ratio (N, 4) of a worn or hidden corner, from views that disagree on it."""
    detections = np.maximum(counts.detected_views[:, None], counts.pointed)
    vague = detections - counts.pointed
    rate = float((weight @ vague.sum(axis=1) + 1) / (4 * weight @ counts.detected_views + 2))
    sound = _rates(vague, detections, _about(rate))
    return np.asarray(np.logaddexp(_rates(vague, detections, _ANY_RATE) - sound, 0.0) - np.log(2))


def _log_like_class(odds: FloatArray, weight: FloatArray) -> FloatArray:
    """Log-likelihood (N,) of a marking's mean log-odds ``odds`` (N,), under that of markings (``weight``)."""
    (usual, sigma) = _ODDS
    least = _ODDS_SIGMA**2
    total = weight.sum()
    information = sigma**-2 + total / least
    mean = (usual / sigma**2 + weight @ odds / least) / information
    spread = weight @ (odds - mean) ** 2 * (1 - 2 / _ODDS_FREEDOM) / max(total, 1.0)
    scale = np.sqrt(max(least, float(spread)) + 1 / information)
    return log_student_density(odds, _ODDS_FREEDOM, mean, scale)


def _geometric(images: IntArray, stay: float) -> FloatArray:
    """Log-likelihood of numbers of images, given the probability ``stay`` of one more."""
    return np.asarray(np.log1p(-stay) + (images - 1) * np.log(stay))


def log_found(detections: IntArray, easy_views: IntArray, rate: float) -> FloatArray:
    """Log-likelihood (N,) of ``detections`` in ``easy_views`` (N,), at the class's ``rate`` or any."""
    usual = np.log1p(-_NEGLECTED_SHARE) + _rates(detections, easy_views, _about(rate))
    neglected = np.log(_NEGLECTED_SHARE) + _rates(detections, easy_views, _ANY_RATE)
    return np.asarray(np.logaddexp(usual, neglected))


def log_found_where_none_is(detections: IntArray, easy_views: IntArray) -> FloatArray:
    """Log-likelihood (N,) of ``detections`` in ``easy_views`` (N,) on bare ground."""
    return _rates(detections, easy_views, _BARE_FOUND)


def _about(rate: float) -> _Beta:
    """The distribution of markings' rates about their class's."""
    return _Beta(_RATE_STRENGTH * rate, _RATE_STRENGTH * (1 - rate))


def _rates(detections: IntArray, easy_views: IntArray, rate: _Beta) -> FloatArray:
    """Beta-binomial log-likelihood (N,) of the easy views."""
    missed = easy_views - detections
    return np.asarray(betaln(detections + rate.hits, missed + rate.misses) - betaln(rate.hits, rate.misses))
