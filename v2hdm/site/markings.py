"""The choice of candidates that become markings of the map, with reasons against the others.

Also suspicion: unlike others of their class in shape, residuals or disputed observations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import betainc, fdtrc

from v2hdm.errors import MappingError
from v2hdm.geometry.planar import Quad
from v2hdm.io.maps.corrections import Heard
from v2hdm.records import BoolArray, Exclusion, FloatArray, IntArray, Marking
from v2hdm.site.candidates import (
    FOUND_SELDOM,
    LACKS_A_CORNER,
    SEEN_SELDOM,
    TOO_UNCERTAIN,
    Candidates,
    Counts,
    variance_prior,
)
from v2hdm.site.corrections import MAX_OVERLAP, Stated, heard_of, overlap
from v2hdm.site.hypotheses import Kind
from v2hdm.site.lengths import STANDARD_M
from v2hdm.site.options import AcceptanceOptions
from v2hdm.site.parallax import Parallax
from v2hdm.site.posterior import CORNERS_OF_IMAGE, Posterior, posterior

OF_SYMBOL = "part of other paint, such as an arrow or a solid line"
COVERED = "overlaps a better supported marking"
Standing = Callable[[FloatArray, BoolArray], FloatArray]
"""Log-likelihood ratios (G, 4) that something stands beyond sides, flagged (G, 4), of corners (G, 4, 2)."""

_LONG = 2.0  # least length over width of a candidate with ends, which things hide a part at a time
_LEAST_ODDS = -3.0  # log odds of being a marking from which a candidate's ends are worth a look

_CLUTTER_BY = (
    "not shaped like a marking of its class",
    SEEN_SELDOM,
    FOUND_SELDOM,
    "its sightings contradict each other",
    "does not look like its class",
)
"""Reasons for clutter, in the order of :attr:`Posterior.evidence`."""


@dataclass(frozen=True)
class Classified:
    """G candidates, the reason against each, if any, and the posterior's misfit (G,)."""

    kind: tuple[str, ...]
    candidates: Candidates
    counts: Counts
    misfit: FloatArray
    verdict: list[str | None]
    heard: tuple[Heard, ...] = ()  # of a person's corrections

    @property
    def accepted(self) -> IntArray:
        """Candidates accepted as markings."""
        return np.flatnonzero([reason is None for reason in self.verdict])

    def check(self) -> None:
        """Raise MappingError if no candidate is accepted."""
        if not len(self.accepted):
            reasons = [exclusion.reason for exclusion in self.exclusions()]
            commonest = max(set(reasons), key=reasons.count) if reasons else "nothing was seen twice"
            raise MappingError(
                f"none of {len(reasons)} candidate markings could be accepted (most often: {commonest}); "
                "check the camera's IPM and the detector, and that the drive passes close to its markings."
            )

    def markings(self) -> tuple[Marking, ...]:
        """Markings of the map, one per accepted candidate."""
        return tuple(
            Marking(
                kind=self.kind[group],
                corners_map=self.candidates.corners_map[group],
                sightings=int(self.counts.images[group]),
                covariance_m2=self.candidates.covariance_m2[group],
            )
            for group in self.accepted
        )

    def exclusions(self) -> tuple[Exclusion, ...]:
        """The rejected candidates and the reasons; groups without a solved corner are no candidates."""
        return tuple(
            Exclusion(
                kind=self.kind[group],
                position_map=self.candidates.corners_map[group].mean(axis=0),
                sightings=int(self.counts.images[group]),
                reason=reason,
            )
            for group, reason in enumerate(self.verdict)
            if reason is not None
            and np.isfinite(self.candidates.corners_map[group]).all()
            and self.counts.images[group]
        )


def classify(
    solved: Candidates,
    kind: IntArray,
    kinds: Sequence[str],
    counted: Callable[[FloatArray], Counts],
    parallax: Parallax,
    options: AcceptanceOptions,
    standing: Standing | None = None,
) -> Classified:
    """Decide which ``solved`` candidates are markings of the map, and where their corners are.

    ``kind`` (G,) indexes the class names ``kinds``; ``counted`` counts their sightings, ``parallax`` tests
    that they lie on the ground, ``standing`` looks for what stands beyond ends.
    """
    known_corners = np.where(solved.known[..., None], solved.corners_map, np.nan)
    standard_m = {index: STANDARD_M[name] for index, name in enumerate(kinds) if name in STANDARD_M}
    known_counts = counted(known_corners)
    uncorrected = posterior(solved, kind, known_counts, None, standard_m)
    # What was never seen twice has no place. Left at the origin, it would be missed by all images there.
    is_placed = known_counts.observations > 0
    placed_map = np.where(is_placed[:, None, None], uncorrected.candidates.corners_map, np.nan)
    names = [kinds[index] for index in kind]
    number = kind.copy()
    stated = Stated.of(options.corrections, placed_map, names)
    index_of_name = {kinds[index]: index for index in np.unique(kind).tolist()}
    for group, correction in stated.confirmed.items():
        names[group] = correction.stated_kind or names[group]
        # The shape of a class is learned from its candidates: without other candidates there is none.
        number[group] = index_of_name.get(names[group], number[group])
    solved = stated.placed(solved, uncorrected.candidates)
    # With the class's shape, a missing corner has a place where it should have been visible.
    counts = counted(placed_map)
    standing_odds = None
    if standing is not None:
        standing_odds = standing(solved.corners_map, _known_ends(solved, uncorrected))
    judged = posterior(solved, number, counts, standing_odds, standard_m)
    judged = replace(judged, candidates=stated.placed(judged.candidates, uncorrected.candidates))
    judged.log_odds[list(stated.confirmed)] = np.inf
    least = np.log(options.min_probability / (1 - options.min_probability))
    is_part = judged.probability[:, Kind.PART_OF_SYMBOL] > judged.probability[:, Kind.CLUTTER]
    verdict: list[str | None] = []
    for group, odds in enumerate(judged.log_odds):
        against = OF_SYMBOL if is_part[group] else _CLUTTER_BY[judged.evidence[group].argmin()]
        verdict.append(None if odds >= least else against)
    seen_corners = solved.known.sum(axis=1)
    # How well its place is known is its accuracy, and no reason against a marking of known shape.
    for group in np.flatnonzero(judged.deformed > 1 - options.min_probability).tolist():
        verdict[group] = TOO_UNCERTAIN if seen_corners[group] == 4 else LACKS_A_CORNER
    objections = parallax.objections(options.min_probability)
    verdict = [reason or objection for reason, objection in zip(verdict, objections, strict=True)]
    heard = heard_of(stated, verdict, uncorrected.log_odds, counts.images, uncorrected.candidates)
    for group in stated.confirmed:
        verdict[group] = None
    verdict = [stated.rejected.get(group, reason) for group, reason in enumerate(verdict)]
    in_map = np.flatnonzero([reason is None for reason in verdict])
    for group in _covered(judged, in_map).tolist():
        verdict[group] = COVERED
    return Classified(tuple(names), judged.candidates, counts, judged.misfit, verdict, heard)


def _known_ends(solved: Candidates, judged: Posterior) -> BoolArray:
    """Sides (G, 4) that are ends of long candidates which may be markings, and known to be where they are."""
    is_marking = judged.log_odds > _LEAST_ODDS
    sides_m = Quad(solved.corners_map).length
    is_end = np.roll(sides_m, 1, axis=1) + np.roll(sides_m, -1, axis=1) > 2 * _LONG * sides_m
    is_known = solved.known & np.roll(solved.known, -1, axis=1)
    return np.asarray(is_end & is_known & is_marking[:, None])


def _covered(judged: Posterior, standing: IntArray) -> IntArray:
    """Candidates of ``standing`` that overlap one with better odds."""
    if len(standing) < 2:
        return np.zeros(0, dtype=np.int64)
    corners = judged.candidates.corners_map
    odds = judged.log_odds
    centres = corners[standing].mean(axis=1)
    reach_m = 2 * float(np.max(np.linalg.norm(corners[standing] - centres[:, None], axis=2)))
    pairs = standing[cKDTree(centres).query_pairs(reach_m, output_type="ndarray")].reshape(-1, 2)
    covered: set[int] = set()
    for a, b in sorted(pairs.tolist(), key=lambda pair: -max(odds[pair[0]], odds[pair[1]])):
        if a not in covered and b not in covered and overlap(corners[a], corners[b]) > MAX_OVERLAP:
            covered.add(b if odds[a] >= odds[b] else a)
    return np.array(sorted(covered), dtype=np.int64)


_LISTED = 10  # length of the list: as many as a user looks at


@dataclass(frozen=True)
class Suspicion:
    """p-values of a marking under the distribution of its class."""

    marking: int
    p_shape: float  # posterior predictive; 1 for a class without shape
    p_residuals: float  # of its accepted observations
    p_sightings: float  # of the ``disputed`` fraction
    disputed: float  # fraction of its observations that the joint solution rejected

    @property
    def p(self) -> float:
        """The smallest of the three p-values, with Bonferroni's correction."""
        return min(1.0, 3 * min(self.p_shape, self.p_residuals, self.p_sightings))


def most_suspicious(
    accepted: IntArray, misfit: FloatArray, squared: FloatArray, counts: Counts
) -> Sequence[Suspicion]:
    """The most suspicious of the ``accepted`` (M,), worst first, by p-values of shape and residuals."""
    observations = counts.observations[accepted]
    agreed = counts.agreeing[accepted]
    freedom = np.maximum(2.0 * agreed - 8, 1.0)  # two per observation, less eight of the corners
    # With an inverse-gamma prior, the variance follows Fisher's F distribution.
    variance = np.nan_to_num(squared[accepted], nan=1e9) / freedom
    scale, prior = variance_prior(variance, freedom)
    residuals = fdtrc(freedom, prior, variance / scale)
    # Binomial tail, continued to fractions of an image.
    rate = (observations - agreed).sum() / max(observations.sum(), 1)
    disputes = (observations - agreed) / CORNERS_OF_IMAGE
    images = observations / CORNERS_OF_IMAGE
    sightings = np.where(disputes > 0, betainc(np.maximum(disputes, 1e-9), images - disputes + 1, rate), 1.0)
    rows = zip(
        misfit[accepted],
        residuals,
        sightings,
        (observations - agreed) / np.maximum(observations, 1),
        strict=True,
    )
    suspicions = [
        Suspicion(
            marking=number,
            p_shape=float(p_shape),
            p_residuals=float(p_residuals),
            p_sightings=float(p_sightings),
            disputed=float(disputed),
        )
        for number, (p_shape, p_residuals, p_sightings, disputed) in enumerate(rows, start=1)
    ]
    return sorted(suspicions, key=lambda suspicion: suspicion.p)[:_LISTED]
