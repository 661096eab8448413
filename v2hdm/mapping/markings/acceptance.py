"""Which of the solved groups are markings, and why the others are not.

Every rule compares a group with what a marking on the ground would have shown: seen as often as its
place in the drive allows, agreeing with the joint solution, known to a stated sigma, shaped like
its class, and not lying on top of another marking.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from v2hdm.geometry.planar import clip_convex, signed_area
from v2hdm.geometry.quadrilateral import characteristic_lengths, is_convex
from v2hdm.mapping.options import AcceptanceOptions
from v2hdm.records import CORNERED_CLASSES, LANE_DASH, BoolArray, FloatArray, IntArray

LACKS_A_CORNER = "a corner was never seen twice"
ODD_SHAPE = "not shaped like the others of its class"
"""Reasons that the shape of the class may mend."""

TOO_UNCERTAIN = "its position is too uncertain"

PART_OF_SYMBOL = "part of an arrow or a chevron"

MIN_EASY_VIEWS = 5
"""Easy views below which a share of detections says nothing."""

MIN_SYMBOL_VIEWS = 2
SYMBOL_SHARE = 0.34
"""What so many images show as part of a symbol, and so many for each that shows it alone, is no marking. It
is, though, if its shape is that of others of its class, unless as many images show the symbol, or some do and
most of those with an easy view did not show it alone: the head of an arrow is like a diamond. For a dash its
shape says nothing: shafts are alike, too."""

MIN_SHAPE_TOLERANCE_M = 0.05
"""Lengths that differ by less are the same, however short they are."""

MIN_PEERS = 2
PEER_SHARE = 0.1
"""A shape is established by this many others, and by this share of its class."""

MAX_LONELY_SHARE = 0.25
"""Where more of a class than this have no peers, it has no shapes of its own to judge by."""

MAX_OVERLAP = 0.2
"""Share of the smaller marking's area that may lie on another marking: paint does not overlap."""


@dataclass(frozen=True)
class Candidates:
    """What is known of G groups before the verdict.

    ``kind`` (G,) indexes the cornered classes; ``corners_map`` (G, 4, 2), nan where a corner is
    missing; ``completed`` (G,) whether one corner was implied by the other three; ``sigma_m`` (G,)
    of the worst corner; ``sightings`` (G,) images with accepted observations; ``inlier_share`` (G,)
    of the observations; ``easy_views`` (G,) images that had the whole marking in easy view and
    ``easy_detections`` (G,) those among them that it was found in; ``seen_as_symbol`` (G,) images in which an
    arrow or a chevron lies on its centre, None where nobody looked.
    """

    kind: IntArray
    corners_map: FloatArray
    completed: BoolArray
    sigma_m: FloatArray
    sightings: IntArray
    inlier_share: FloatArray
    easy_views: IntArray
    easy_detections: IntArray
    seen_as_symbol: IntArray | None = None


def judge(candidates: Candidates, options: AcceptanceOptions) -> list[str | None]:
    """For each candidate the reason why it is no marking of the map, or None where it is one."""
    verdict: list[str | None] = [None] * len(candidates.kind)
    incomplete = np.asarray(np.isnan(candidates.corners_map).any(axis=(1, 2)))
    _refuse(verdict, incomplete, LACKS_A_CORNER)
    _refuse(
        verdict,
        candidates.sightings < options.min_sightings,
        f"seen in fewer than {options.min_sightings} images",
    )
    _refuse(
        verdict,
        candidates.inlier_share < options.min_inlier_share,
        "its sightings contradict each other",
    )
    _refuse(verdict, ~is_convex(candidates.corners_map), "not a convex quadrilateral")
    _refuse(verdict, is_uncertain(candidates, options), TOO_UNCERTAIN)
    _refuse(verdict, _symbols_of_any_shape(candidates), PART_OF_SYMBOL)
    typical, odd = _judge_shapes(candidates, verdict, options)
    _refuse(verdict, odd, ODD_SHAPE)
    _refuse(verdict, _seen_as_symbol(candidates, SYMBOL_SHARE) & ~typical, PART_OF_SYMBOL)
    _refuse(verdict, candidates.completed & ~typical, LACKS_A_CORNER)
    seldom = _seldom_detected(candidates, verdict, options) & ~typical
    _refuse(verdict, seldom, "found in too few of its images")
    _refuse(verdict, _covered(candidates, verdict), "lies on a better supported marking")
    return verdict


def _symbols_of_any_shape(candidates: Candidates) -> BoolArray:
    """Groups that are parts of arrows or chevrons even if shaped like their class: shafts and heads."""
    shaft = candidates.kind == CORNERED_CLASSES.index(LANE_DASH)
    mostly_missed = 2 * candidates.easy_detections < candidates.easy_views
    mostly_missed &= candidates.easy_views >= MIN_EASY_VIEWS
    surely = _seen_as_symbol(candidates, SYMBOL_SHARE) & shaft
    surely |= _seen_as_symbol(candidates, 1.0)
    surely |= _seen_as_symbol(candidates, 0.0) & mostly_missed
    return np.asarray(surely)


def _seen_as_symbol(candidates: Candidates, share: float) -> BoolArray:
    """Groups that lie under what looks like an arrow or a chevron so often for each sighting of theirs."""
    if candidates.seen_as_symbol is None:
        return np.zeros(len(candidates.kind), dtype=bool)
    limit = np.maximum(MIN_SYMBOL_VIEWS, share * candidates.sightings)
    return np.asarray(candidates.seen_as_symbol >= limit)


def _refuse(verdict: list[str | None], refused: NDArray[np.bool_], reason: str) -> None:
    for group in np.flatnonzero(refused):
        verdict[group] = verdict[group] or reason


def _standing(verdict: list[str | None]) -> BoolArray:
    return np.array([reason is None for reason in verdict], dtype=bool)


def _seldom_detected(
    candidates: Candidates, verdict: list[str | None], options: AcceptanceOptions
) -> BoolArray:
    """Groups found far less often, for the chances that they had, than is usual for their class.

    A chance artefact shows in a few images; but so does a worn marking, which is why this speaks only
    against groups whose shape is not known from others.
    """
    share = candidates.easy_detections / np.maximum(candidates.easy_views, 1)
    telling = candidates.easy_views >= MIN_EASY_VIEWS
    seldom = np.zeros(len(share), dtype=bool)
    for kind in np.unique(candidates.kind):
        own = (candidates.kind == kind) & telling
        usual = share[own & _standing(verdict)]
        if len(usual):
            seldom |= own & (share < options.min_detection_share * np.median(usual))
    return seldom


def is_uncertain(candidates: Candidates, options: AcceptanceOptions) -> BoolArray:
    """Groups less certain than the best by more than is allowed.

    What even the best one has is shared by all: a shift of the whole map, which a straight drive
    leaves to the prior on the camera's position, says nothing against a single marking.
    """
    sigma2 = np.where(np.isfinite(candidates.sigma_m), candidates.sigma_m, np.inf) ** 2
    return np.asarray(sigma2 > np.min(sigma2, initial=np.inf) + options.max_sigma_m**2)


def _judge_shapes(
    candidates: Candidates, verdict: list[str | None], options: AcceptanceOptions
) -> tuple[BoolArray, BoolArray]:
    """Groups with peers, and groups without, in classes whose members mostly have peers.

    Peers agree in sides and diagonals. A class may hold several shapes, such as the dashes of two
    kinds of road; what is odd is a shape that hardly any other shares.
    """
    lengths = characteristic_lengths(candidates.corners_map)
    typical = np.zeros(len(lengths), dtype=bool)
    odd = np.zeros(len(lengths), dtype=bool)
    for kind in np.unique(candidates.kind):
        own = np.flatnonzero((candidates.kind == kind) & _standing(verdict))
        if len(own) < options.consensus_count:
            continue
        peers = count_peers(lengths[own], lengths[own], options) - 1
        lonely = peers < least_peers(len(own))
        if lonely.mean() <= MAX_LONELY_SHARE:
            odd[own[lonely]] = True
            typical[own[~lonely]] = True
    return typical, odd


def count_peers(lengths: FloatArray, others: FloatArray, options: AcceptanceOptions) -> IntArray:
    """How many of the shapes ``others`` (P, 4) each of the shapes ``lengths`` (G, 4) agrees with."""
    tolerance = np.maximum(options.shape_tolerance * lengths, MIN_SHAPE_TOLERANCE_M)
    alike = np.abs(lengths[:, None] - others[None]) <= tolerance[:, None]
    return np.asarray(alike.all(axis=2).sum(axis=1))


def least_peers(members: int) -> float:
    """Peers that establish a shape in a class of so many members."""
    return max(MIN_PEERS, PEER_SHARE * members)


def _covered(candidates: Candidates, verdict: list[str | None]) -> BoolArray:
    """Groups that overlap another one with more sightings (of equals, the later one)."""
    covered = np.zeros(len(candidates.kind), dtype=bool)
    standing = np.flatnonzero(_standing(verdict))
    if len(standing) < 2:
        return covered
    corners = candidates.corners_map
    centres = corners[standing].mean(axis=1)
    reach_m = 2 * float(np.max(np.linalg.norm(corners[standing] - centres[:, None], axis=2)))
    pairs = standing[cKDTree(centres).query_pairs(reach_m, output_type="ndarray")].reshape(-1, 2)
    support = candidates.sightings
    for a, b in sorted(pairs.tolist(), key=lambda pair: (-max(support[pair[0]], support[pair[1]]), pair)):
        if covered[a] or covered[b] or _overlap(corners[a], corners[b]) <= MAX_OVERLAP:
            continue
        covered[b if support[a] >= support[b] else a] = True
    return covered


def _overlap(a: FloatArray, b: FloatArray) -> float:
    """Common area of two convex quadrilaterals as a share of the smaller one's."""
    common = abs(float(signed_area(clip_convex(a, b))))
    return common / max(float(min(signed_area(a), signed_area(b))), 1e-9)
