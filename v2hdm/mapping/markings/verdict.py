"""The verdict on the candidates of a map, and what the shape of their class mends before it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from v2hdm.errors import MappingError
from v2hdm.mapping.association.groups import Association, fuse_groups, vague_corners
from v2hdm.mapping.markings.acceptance import (
    LACKS_A_CORNER,
    ODD_SHAPE,
    TOO_UNCERTAIN,
    Candidates,
    is_uncertain,
    judge,
)
from v2hdm.mapping.markings.completion import SolvedCorners, without_misplaced_corners
from v2hdm.mapping.markings.known_shape import with_known_shapes
from v2hdm.mapping.markings.shape_prior import with_class_shapes, without_guessed_lengths
from v2hdm.mapping.options import AcceptanceOptions
from v2hdm.mapping.results import Exclusion
from v2hdm.mapping.sightings.location import locate
from v2hdm.mapping.sightings.rig import Rig
from v2hdm.mapping.sightings.symbols import images_with_symbol
from v2hdm.mapping.sightings.table import Sightings
from v2hdm.mapping.sightings.views import Views, easy_views
from v2hdm.records import CORNERED_CLASSES, Camera, FloatArray, IntArray, Marking


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What was seen of the G candidates, and under which rig.

    ``kind`` (G,) is the class of each as an index into :data:`v2hdm.records.CORNERED_CLASSES`. Observation k
    that was accepted is one of row ``row`` (K,) of the sightings and of candidate ``group`` (K,);
    ``inlier_share`` (G,) is the part of each one's observations that was. ``cameras`` are in the rig's order;
    ``jitter_rad`` is how far the recorded attitude is off.
    """

    association: Association
    kind: IntArray
    sightings: Sightings
    rig: Rig
    views: Views
    cameras: tuple[Camera, ...]
    jitter_rad: float
    row: IntArray
    group: IntArray
    inlier_share: FloatArray

    def candidates(self, solved: SolvedCorners) -> Candidates:
        """What the verdict rests on, given corners."""
        count = len(self.kind)
        variance = np.diagonal(solved.covariance_m2, axis1=1, axis2=2).reshape(-1, 4, 2).sum(axis=2)
        seen = np.unique(np.stack([self.group, self.sightings.image[self.row]]), axis=1)
        easy = np.stack(easy_views(self.views, self.rig, list(self.cameras), solved.corners_map))
        found = np.isin(_pair_keys(easy), _pair_keys(seen))
        centres_map = solved.corners_map.mean(axis=1)
        return Candidates(
            kind=self.kind,
            corners_map=solved.corners_map,
            completed=solved.completed,
            sigma_m=np.sqrt(np.max(variance, axis=1)),
            sightings=np.bincount(seen[0], minlength=count),
            inlier_share=self.inlier_share,
            easy_views=np.bincount(easy[0], minlength=count),
            easy_detections=np.bincount(easy[0, found], minlength=count),
            seen_as_symbol=images_with_symbol(self.sightings.symbols, self.rig, centres_map),
        )


@dataclass(frozen=True)
class Judged:
    """Candidates with the corners that their classes' shapes leave them, and the verdict on each."""

    solved: SolvedCorners
    candidates: Candidates
    verdict: list[str | None]

    @property
    def accepted(self) -> IntArray:
        """The groups that are markings of the map."""
        return np.flatnonzero([reason is None for reason in self.verdict])

    def refused_for(self, *reasons: str) -> IntArray:
        """The groups that are none for one of ``reasons``."""
        return np.flatnonzero([reason in reasons for reason in self.verdict])

    def markings(self) -> tuple[Marking, ...]:
        """The markings of the map, one for each accepted group.

        Raises:
            MappingError: There is none.
        """
        if not len(self.accepted):
            raise MappingError(_no_marking_message(self.exclusions()))
        return tuple(
            Marking(
                kind=CORNERED_CLASSES[self.candidates.kind[group]],
                corners_map=self.solved.corners_map[group],
                sightings=int(self.candidates.sightings[group]),
                covariance_m2=self.solved.covariance_m2[group],
            )
            for group in self.accepted
        )

    def exclusions(self) -> tuple[Exclusion, ...]:
        """What was refused and why; groups without a single solved corner were never candidates."""
        candidates = self.candidates
        return tuple(
            Exclusion(
                kind=CORNERED_CLASSES[candidates.kind[group]],
                position_map=np.nanmean(candidates.corners_map[group], axis=0),
                sightings=int(candidates.sightings[group]),
                reason=reason,
            )
            for group, reason in enumerate(self.verdict)
            if reason is not None and np.isfinite(candidates.corners_map[group]).any()
        )


def judge_and_mend(solved: SolvedCorners, seen: Seen, options: AcceptanceOptions) -> Judged:
    """Judge candidates; what the shape of their class can mend is mended and judged again.

    Args:
        solved: The candidates' corners as they were solved for.
        seen: What was seen of them, also for corners that could not be solved for.
        options: What a marking must show.
    """

    def judged_as(corners: SolvedCorners) -> Judged:
        candidates = seen.candidates(corners)
        return Judged(corners, candidates, judge(candidates, options))

    now, kind = judged_as(solved), seen.kind
    odd = now.refused_for(ODD_SHAPE)
    if len(odd):
        now = judged_as(without_misplaced_corners(now.solved, odd, kind, now.accepted, options))
    doubtful = now.refused_for(ODD_SHAPE, LACKS_A_CORNER)
    if len(doubtful):
        located = locate(seen.sightings, seen.rig)
        fused = fuse_groups(seen.association, located, seen.jitter_rad)
        vague_map = vague_corners(seen.association, located)
        placed = with_known_shapes(now.solved, fused, vague_map, doubtful, kind, now.accepted)
        now = judged_as(without_guessed_lengths(now.solved, placed, fused.corners_map, kind, now.accepted))
    return _certain_enough(
        replace(now, solved=with_class_shapes(now.solved, kind, now.accepted)), seen, options
    )


def _certain_enough(judged: Judged, seen: Seen, options: AcceptanceOptions) -> Judged:
    """Without the markings that deviate from their class by so much that their corners are not known."""
    uncertain = is_uncertain(seen.candidates(judged.solved), options)
    verdict = [
        reason or (TOO_UNCERTAIN if vague else None)
        for reason, vague in zip(judged.verdict, uncertain, strict=True)
    ]
    return replace(judged, verdict=verdict)


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
