"""Which places become markings of the map, and why the others do not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.errors import MappingError
from v2hdm.geometry.planar import clip_convex, signed_area
from v2hdm.mapping.options import AcceptanceOptions
from v2hdm.mapping.results import Exclusion
from v2hdm.mapping.sightings.rig import Rig
from v2hdm.mapping.sightings.symbols import images_with_symbol
from v2hdm.mapping.sightings.table import Sightings
from v2hdm.mapping.sightings.views import Views, easy_views
from v2hdm.mapping.site_model.places import Counts, Places
from v2hdm.mapping.site_model.posterior import CLUTTER, PART_OF_SYMBOL, Posterior, posterior
from v2hdm.records import BoolArray, Camera, FloatArray, IntArray, Marking

OF_SYMBOL = "part of a symbol, such as an arrow"
TOO_UNCERTAIN = "its position is too uncertain"
LACKS_A_CORNER = "a corner was never seen twice"
COVERED = "lies on a better supported marking"
CLUTTER_BY = (
    "not shaped like a marking of its class",
    "seen in too few images",
    "found in too few of its images",
    "its sightings contradict each other",
)
"""What speaks most for clutter, in the order of :attr:`Posterior.evidence`."""

_MAX_OVERLAP = 0.2
"""Share of the smaller marking's area that may lie on another marking: paint does not overlap."""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What was seen of G places, and under which rig.

    ``kind`` (G,) is the class of each as an index into ``sightings.kinds``. Observation k
    is one of row ``row`` (K,) of the sightings and of place ``group`` (K,), and has been ``accepted`` (K,) or
    not. ``cameras`` are in the rig's order.
    """

    kind: IntArray
    sightings: Sightings
    rig: Rig
    views: Views
    cameras: tuple[Camera, ...]
    row: IntArray
    group: IntArray
    accepted: BoolArray

    def names(self) -> tuple[str, ...]:
        """The class of each place."""
        return tuple(self.sightings.kinds[kind] for kind in self.kind)

    def counts(self, corners_map: FloatArray) -> Counts:
        """How often places of corners (G, 4, 2) were seen."""
        count = len(self.kind)
        group, image = self.group[self.accepted], self.sightings.image[self.row[self.accepted]]
        shown = np.unique(np.stack([group, image]), axis=1)
        easy = np.stack(easy_views(self.views, self.rig, list(self.cameras), corners_map))
        found = np.isin(_pair_keys(easy), _pair_keys(shown))
        return Counts(
            images=np.bincount(shown[0], minlength=count),
            observations=np.bincount(self.group, minlength=count),
            agreeing=np.bincount(group, minlength=count),
            easy_views=np.bincount(easy[0], minlength=count),
            found=np.bincount(easy[0, found], minlength=count),
            as_symbol=images_with_symbol(self.sightings.symbols, self.rig, corners_map),
        )


@dataclass(frozen=True)
class Judged:
    """G places, and of each the reason why it is no marking of the map, None if it is one."""

    kind: tuple[str, ...]
    places: Places
    images: IntArray
    verdict: list[str | None]

    @property
    def accepted(self) -> IntArray:
        """The places that are markings of the map."""
        return np.flatnonzero([reason is None for reason in self.verdict])

    def markings(self) -> tuple[Marking, ...]:
        """The markings of the map, one for each accepted place.

        Raises:
            MappingError: There is none.
        """
        if not len(self.accepted):
            raise MappingError(_no_marking_message(self.exclusions()))
        return tuple(
            Marking(
                kind=self.kind[group],
                corners_map=self.places.corners_map[group],
                sightings=int(self.images[group]),
                covariance_m2=self.places.covariance_m2[group],
            )
            for group in self.accepted
        )

    def exclusions(self) -> tuple[Exclusion, ...]:
        """What was refused and why; places without a single solved corner were never candidates."""
        return tuple(
            Exclusion(
                kind=self.kind[group],
                position_map=self.places.corners_map[group].mean(axis=0),
                sightings=int(self.images[group]),
                reason=reason,
            )
            for group, reason in enumerate(self.verdict)
            if reason is not None and np.isfinite(self.places.corners_map[group]).all() and self.images[group]
        )


def judge(solved: Places, seen: Seen, options: AcceptanceOptions) -> Judged:
    """Decide which of the ``solved`` places are markings of the map, and where their corners are."""
    counts = seen.counts(np.where(solved.known[..., None], solved.corners_map, np.nan))
    first = posterior(solved, seen.kind, counts)
    # Of a place that lacked a corner the class's shape now says where it should have been seen.
    counts = seen.counts(first.places.corners_map)
    found = posterior(solved, seen.kind, counts)
    least = np.log(options.min_probability / (1 - options.min_probability))
    verdict: list[str | None] = [
        None if odds >= least else _reason(found, group) for group, odds in enumerate(found.log_odds)
    ]
    sigma_m, seen_corners = found.places.sigma_m.max(axis=1), solved.known.sum(axis=1)
    # What even the best one has is shared by all: a shift of the whole map speaks against no marking.
    uncertain = sigma_m**2 > np.min(sigma_m, initial=np.inf) ** 2 + options.max_sigma_m**2
    for group in np.flatnonzero(uncertain):
        verdict[group] = TOO_UNCERTAIN if seen_corners[group] == 4 else LACKS_A_CORNER
    for group in _covered(found, np.flatnonzero([reason is None for reason in verdict])):
        verdict[group] = COVERED
    return Judged(seen.names(), found.places, counts.images, verdict)


def _reason(found: Posterior, group: int) -> str:
    """The hypothesis that has won against a marking, in words."""
    if found.probability[group, PART_OF_SYMBOL] > found.probability[group, CLUTTER]:
        return OF_SYMBOL
    return CLUTTER_BY[int(np.argmin(found.evidence[group]))]


def _covered(found: Posterior, standing: IntArray) -> IntArray:
    """Those of the places ``standing`` that overlap another one of better odds."""
    if len(standing) < 2:
        return np.zeros(0, dtype=np.int64)
    corners, odds = found.places.corners_map, found.log_odds
    centres = corners[standing].mean(axis=1)
    reach_m = 2 * float(np.max(np.linalg.norm(corners[standing] - centres[:, None], axis=2)))
    pairs = standing[cKDTree(centres).query_pairs(reach_m, output_type="ndarray")].reshape(-1, 2)
    covered: set[int] = set()
    for a, b in sorted(pairs.tolist(), key=lambda pair: -max(odds[pair[0]], odds[pair[1]])):
        if a not in covered and b not in covered and _overlap(corners[a], corners[b]) > _MAX_OVERLAP:
            covered.add(b if odds[a] >= odds[b] else a)
    return np.array(sorted(covered), dtype=np.int64)


def _overlap(a: FloatArray, b: FloatArray) -> float:
    """Common area of two convex quadrilaterals as a share of the smaller one's."""
    common = abs(float(signed_area(clip_convex(a, b))))
    return common / max(float(min(signed_area(a), signed_area(b))), 1e-9)


def _pair_keys(pairs: IntArray) -> IntArray:
    """One number per column of ``pairs`` (2, P)."""
    return np.asarray(pairs[0] * (1 << 32) + pairs[1])


def _no_marking_message(excluded: tuple[Exclusion, ...]) -> str:
    """What to say where no candidate was accepted."""
    reasons = [exclusion.reason for exclusion in excluded]
    commonest = max(set(reasons), key=reasons.count) if reasons else "nothing was seen twice"
    return (
        f"none of {len(reasons)} candidate markings could be accepted (most often: {commonest}); check the "
        "camera's IPM, the detector and that the drive passes its markings closely."
    )
