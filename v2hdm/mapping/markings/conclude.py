"""From a solved bundle to its outcome: the accepted markings, the calibrations, the evidence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from v2hdm.errors import MappingError
from v2hdm.mapping.association.groups import Association, fuse_groups, vague_corners
from v2hdm.mapping.association.merge import group_kinds
from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.markings.acceptance import LACKS_A_CORNER, ODD_SHAPE, Candidates, judge
from v2hdm.mapping.markings.completion import SolvedCorners, solved_corners, without_misplaced_corners
from v2hdm.mapping.markings.known_shape import with_known_shapes
from v2hdm.mapping.markings.shape_prior import with_class_shapes, without_guessed_lengths
from v2hdm.mapping.options import AcceptanceOptions
from v2hdm.mapping.results import Exclusion
from v2hdm.mapping.sightings.location import locate
from v2hdm.mapping.sightings.rig import Rig
from v2hdm.mapping.sightings.symbols import images_with_symbol
from v2hdm.mapping.sightings.table import Sightings
from v2hdm.mapping.sightings.views import Views, easy_views, project_ground
from v2hdm.records import CORNERED_CLASSES, BoolArray, Calibration, Camera, FloatArray, Marking

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Evidence:
    """What the verdict on the markings rests on.

    ``final`` is the bundle solved over the accepted observations only, ``ungated`` the one before
    it over all, of which ``inlier`` (K,) were accepted; ``usable`` (S, 4) says the same per corner.
    """

    sightings: Sightings
    views: Views
    cameras: Mapping[str, Camera]
    final: Bundle
    ungated: Bundle
    inlier: BoolArray
    usable: BoolArray


@dataclass(frozen=True)
class Optimised:
    """The outcome of the joint optimisation.

    ``bundle`` holds the adjusted extrinsics and poses; marking m is its group ``groups[m]``;
    ``usable`` (S, 4) are the accepted corner observations. Reprojection errors are root mean squares
    over the observations of the accepted markings, under the optimised and the initial extrinsics.
    """

    bundle: Bundle
    usable: BoolArray
    groups: IntArray
    markings: tuple[Marking, ...]
    excluded: tuple[Exclusion, ...]
    calibrations: Mapping[str, Calibration]
    reprojection_rmse_px: float
    initial_reprojection_rmse_px: float


def conclude(
    evidence: Evidence, initial_rig: Rig, jitter_rad: float, options: AcceptanceOptions
) -> Optimised:
    """Judge the candidates and put the outcome together.

    Raises:
        MappingError: No candidate is accepted.
    """
    final = evidence.final
    judged = judge_and_mend(
        solved_corners(final),
        lambda solved: _candidates(evidence, solved),
        Seen(final.association, evidence.sightings, final.rig, jitter_rad),
        options,
    )
    candidates, accepted, solved = judged.candidates, judged.accepted, judged.solved
    excluded = exclusions(candidates, judged.verdict)
    if not len(accepted):
        raise MappingError(no_marking_message(excluded))
    markings = tuple(
        Marking(
            kind=CORNERED_CLASSES[candidates.kind[group]],
            corners_map=solved.corners_map[group],
            sightings=int(candidates.sightings[group]),
            covariance_m2=solved.covariance_m2[group],
        )
        for group in accepted
    )
    used = np.isin(final.group, accepted)
    return Optimised(
        bundle=final,
        usable=evidence.usable,
        groups=accepted,
        markings=markings,
        excluded=tuple(excluded),
        calibrations=_calibrations(final, evidence.sightings.cameras, evidence.cameras),
        reprojection_rmse_px=_rms(final.solution.residual_px[used]),
        initial_reprojection_rmse_px=_rms(_residuals_under(initial_rig, evidence, jitter_rad)[used]),
    )


@dataclass(frozen=True)
class Seen:
    """What was seen of the candidates: their sightings and the rig under which those are located."""

    association: Association
    sightings: Sightings
    rig: Rig
    jitter_rad: float


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


def judge_and_mend(
    solved: SolvedCorners,
    candidates_of: Callable[[SolvedCorners], Candidates],
    seen: Seen,
    options: AcceptanceOptions,
) -> Judged:
    """Judge candidates; what the shape of their class can mend is mended and judged again.

    Args:
        solved: The candidates' corners as they were solved for.
        candidates_of: What the verdict rests on, given corners.
        seen: Their sightings, for corners that could not be solved for.
        options: What a marking must show.
    """

    def judged_as(corners: SolvedCorners) -> Judged:
        candidates = candidates_of(corners)
        return Judged(corners, candidates, judge(candidates, options))

    now = judged_as(solved)
    odd = now.refused_for(ODD_SHAPE)
    if len(odd):
        now = judged_as(
            without_misplaced_corners(now.solved, odd, now.candidates.kind, now.accepted, options)
        )
    doubtful = now.refused_for(ODD_SHAPE, LACKS_A_CORNER)
    if len(doubtful):
        located = locate(seen.sightings, seen.rig)
        fused = fuse_groups(seen.association, located, seen.jitter_rad)
        vague_map = vague_corners(seen.association, located)
        kind, accepted = now.candidates.kind, now.accepted
        placed = with_known_shapes(now.solved, fused, vague_map, doubtful, kind, accepted)
        now = judged_as(without_guessed_lengths(now.solved, placed, fused.corners_map, kind, accepted))
    return replace(now, solved=with_class_shapes(now.solved, now.candidates.kind, now.accepted))


def _candidates(evidence: Evidence, solved: SolvedCorners) -> Candidates:
    final, ungated, sightings = evidence.final, evidence.ungated, evidence.sightings
    count = final.association.count
    variance = np.diagonal(solved.covariance_m2, axis1=1, axis2=2).reshape(-1, 4, 2).sum(axis=2)
    total = np.bincount(ungated.group, minlength=count)
    agreeing = np.bincount(ungated.group[evidence.inlier], minlength=count)
    seen = np.unique(np.stack([final.group, sightings.image[final.row]]), axis=1)
    easy = np.stack(
        easy_views(evidence.views, final.rig, list(evidence.cameras.values()), solved.corners_map)
    )
    found = np.isin(pair_keys(easy), pair_keys(seen))
    return Candidates(
        kind=group_kinds(final.association, sightings),
        corners_map=solved.corners_map,
        completed=solved.completed,
        sigma_m=np.sqrt(np.max(variance, axis=1)),
        sightings=np.bincount(seen[0], minlength=count),
        inlier_share=agreeing / np.maximum(total, 1),
        easy_views=np.bincount(easy[0], minlength=count),
        easy_detections=np.bincount(easy[0, found], minlength=count),
        seen_as_symbol=images_with_symbol(sightings.symbols, final.rig, solved.corners_map.mean(axis=1)),
    )


def exclusions(candidates: Candidates, verdict: Sequence[str | None]) -> list[Exclusion]:
    """What was refused and why; groups without a single solved corner were never candidates."""
    return [
        Exclusion(
            kind=CORNERED_CLASSES[candidates.kind[group]],
            position_map=np.nanmean(candidates.corners_map[group], axis=0),
            sightings=int(candidates.sightings[group]),
            reason=reason,
        )
        for group, reason in enumerate(verdict)
        if reason is not None and np.isfinite(candidates.corners_map[group]).any()
    ]


def _calibrations(
    bundle: Bundle, names: Sequence[str], cameras: Mapping[str, Camera]
) -> dict[str, Calibration]:
    """Calibrations by camera; one that saw no marking keeps its start and has no covariance."""
    covariance = bundle.solution.extrinsic_covariance * max(1.0, bundle.solution.chi2_per_dof)
    return {
        name: Calibration(
            info=cameras[name].info,
            cam_from_vehicle=bundle.rig.cam_from_vehicle[c],
            covariance=covariance[bundle.camera_index[name]] if name in bundle.camera_index else None,
        )
        for c, name in enumerate(names)
    }


def _residuals_under(rig: Rig, evidence: Evidence, jitter_rad: float) -> FloatArray:
    """Residuals (K, 2), px, of the final observations when ``rig`` and its own best corners hold."""
    bundle, sightings = evidence.final, evidence.sightings
    fused = fuse_groups(bundle.association, locate(sightings, rig), jitter_rad)
    camera, frame = sightings.camera[bundle.row], sightings.frame[bundle.row]
    cam_from_map = rig.cam_from_vehicle[camera] @ np.linalg.inv(rig.map_from_vehicle[frame])
    points = fused.corners_map[bundle.group, bundle.corner]
    pixel, _ = project_ground(rig.intrinsic[camera], cam_from_map, points[:, None])
    own_corner = bundle.association.corner_order()[bundle.row, bundle.corner]
    return np.asarray(pixel[:, 0] - sightings.corners_pinhole_px[bundle.row, own_corner])


def pair_keys(pairs: IntArray) -> IntArray:
    """One number per column of ``pairs`` (2, P)."""
    return np.asarray(pairs[0] * (1 << 32) + pairs[1])


def _rms(residual_px: FloatArray) -> float:
    """Root mean square length of residuals (K, 2); those that cannot be projected are left out."""
    squared = np.sum(residual_px**2, axis=1)
    finite = squared[np.isfinite(squared)]
    return float(np.sqrt(np.mean(finite))) if len(finite) else float("nan")


def no_marking_message(excluded: Sequence[Exclusion]) -> str:
    """What to say where no candidate was accepted."""
    reasons = [exclusion.reason for exclusion in excluded]
    commonest = max(set(reasons), key=reasons.count) if reasons else "nothing was seen twice"
    return (
        f"none of {len(reasons)} candidate markings could be accepted (most often: {commonest}); check the "
        "camera's IPM, the detector and that the drive passes its markings closely."
    )
