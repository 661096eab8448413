"""From a solved bundle to its outcome: the accepted markings, the calibrations, the evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.association.ground import Located, Views, locate
from v2hdm.association.groups import fuse_groups, group_kinds
from v2hdm.association.sightings import Rig, Sightings
from v2hdm.geometry.ipm import project_ground
from v2hdm.mapping.bundle import Bundle
from v2hdm.records import BoolArray, Calibration, Camera, FloatArray, IntArray, Marking
from v2hdm.site.candidates import Candidates, Dissent, Exclusion, with_dissent, with_shared_errors
from v2hdm.site.markings import Support, classify, with_relative_sigma
from v2hdm.site.options import AcceptanceOptions
from v2hdm.site.parallax import PointViews, measure_parallax
from v2hdm.site.suspicion import Suspicion, most_suspicious


@dataclass(frozen=True)
class Evidence:
    """The solves that the classification of the candidates rests on.

    ``final`` is solved over the accepted observations only, ``ungated`` over all, of which ``inlier`` (K,)
    were accepted; ``usable`` (S, 4) says the same per corner.
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

    ``bundle`` holds the adjusted extrinsics and poses; marking m is its group ``groups[m]``. Reprojection
    errors are root mean squares over the points seen of the accepted markings, under the optimised and the
    initial extrinsics.
    ``suspicions`` are of the most suspicious markings, the worst first.
    """

    bundle: Bundle
    groups: IntArray
    markings: tuple[Marking, ...]
    excluded: tuple[Exclusion, ...]
    calibrations: Mapping[str, Calibration]
    reprojection_rmse_px: float
    initial_reprojection_rmse_px: float
    suspicions: Sequence[Suspicion] = ()


def conclude(
    evidence: Evidence, initial_rig: Rig, jitter_rad: float, options: AcceptanceOptions
) -> Optimised:
    """Classify the candidates and put the outcome together.

    Raises:
        MappingError: no candidate is accepted.
    """
    final, ungated = evidence.final, evidence.ungated
    seen = Support(
        kind=group_kinds(final.association, evidence.sightings),
        sightings=evidence.sightings,
        rig=final.rig,
        views=evidence.views,
        cameras=tuple(evidence.cameras.values()),
        row=ungated.row,
        group=ungated.group,
        accepted=evidence.inlier,
    )
    located = locate(evidence.sightings, final.rig)
    located.informs[:] &= evidence.usable
    fused = fuse_groups(final.association, located, jitter_rad=0.0)
    solved = _solved_candidates(final, ungated)
    solved = with_dissent(with_shared_errors(solved, fused), fused, _dissent(evidence, located))
    noise = final.model.variance_factor, final.model.pose_sigma
    corners = PointViews.of_corners(final.association, evidence.sightings, located, *noise)
    parallax = measure_parallax(corners, final.association.count)
    classified = classify(solved, seen, parallax, options)
    scale = max(1.0, final.solution.chi2_per_dof)
    covariance = final.solution.extrinsic_covariance * scale
    index, names = final.camera_index, evidence.sightings.cameras
    markings = with_relative_sigma(
        classified.markings(),
        final.corner_index[classified.accepted],
        lambda pairs: scale * final.solution.corner_covariance(pairs),
    )
    squared = np.bincount(final.group, final.solution.mahalanobis2, len(classified.kind)).astype(np.float64)
    used = np.isin(final.group, classified.accepted) & evidence.sightings.valid[final.row, final.own_corner]
    at_start = _residuals_under(initial_rig, evidence.sightings, final, jitter_rad)
    return Optimised(
        bundle=final,
        groups=classified.accepted,
        markings=markings,
        excluded=classified.exclusions(),
        # A camera that saw no marking keeps its start and has no covariance.
        calibrations={
            name: Calibration(
                info=evidence.cameras[name].info,
                cam_from_vehicle=final.rig.cam_from_vehicle[c],
                covariance=covariance[index[name]] if name in index else None,
            )
            for c, name in enumerate(names)
        },
        reprojection_rmse_px=_root_mean_square(final.solution.residual_px[used]),
        initial_reprojection_rmse_px=_root_mean_square(at_start[used]),
        suspicions=most_suspicious(classified.accepted, classified.misfit, squared, classified.counts),
    )


def _dissent(evidence: Evidence, located: Located) -> Dissent:
    """The corners seen as points that were left out of the final solve, under its rig."""
    ungated = evidence.ungated
    own = ungated.own_corner
    left_out = np.flatnonzero(~evidence.inlier & evidence.sightings.valid[ungated.row, own])
    row, own = ungated.row[left_out], own[left_out]
    return Dissent(
        row=row,
        group=ungated.group[left_out],
        corner=ungated.corner[left_out],
        seen_map=located.corners_map[row, own],
        covariance_m2=located.covariance_m2[row, own],
    )


def _solved_candidates(bundle: Bundle, ungated: Bundle) -> Candidates:
    """The corners of every group of ``bundle``; one that has lost them all lies where ``ungated`` had it.

    Covariances are scaled by chi^2 per degree of freedom where that exceeds one: residuals larger than stated
    make the map less certain than the noise model claims.
    """
    known = bundle.corner_index >= 0
    covariance = np.full((len(known), 8, 8), np.nan)
    scale = max(1.0, bundle.solution.chi2_per_dof)
    for count in range(1, 5):
        groups = np.flatnonzero(known.sum(axis=1) == count)
        if not len(groups):
            continue
        corner = np.nonzero(known[groups])[1].reshape(-1, count)
        indices = np.take_along_axis(bundle.corner_index[groups], corner, axis=1)
        rows = (2 * corner[..., None] + np.arange(2)).reshape(len(groups), -1)
        blocks = scale * bundle.solution.corner_covariance(indices)
        covariance[groups[:, None, None], rows[:, :, None], rows[:, None, :]] = blocks
    before = ungated.corners_map
    count = np.maximum(np.isfinite(before[..., 0]).sum(axis=1), 1)
    about = np.nansum(before, axis=1) / count[:, None]
    return Candidates.seen(bundle.corners_map, covariance, about)


def _residuals_under(rig: Rig, sightings: Sightings, bundle: Bundle, jitter_rad: float) -> FloatArray:
    """Residuals (K, 2), px, of the bundle's observations when ``rig`` and its own best corners hold."""
    fused = fuse_groups(bundle.association, locate(sightings, rig), jitter_rad)
    camera, frame = sightings.camera[bundle.row], sightings.frame[bundle.row]
    points = fused.corners_map[bundle.group, bundle.corner]
    own = bundle.row, bundle.own_corner
    cam_from_map = rig.cam_from_map(camera, frame, sightings.row_share[own])
    pixel, _ = project_ground(rig.intrinsic[camera], cam_from_map, points[:, None])
    return np.asarray(pixel[:, 0] - sightings.corners_pinhole_px[own])


def _root_mean_square(residual_px: FloatArray) -> float:
    """Root mean square length of residuals (K, 2); those that cannot be projected are left out."""
    squared = np.sum(residual_px**2, axis=1)
    finite = squared[np.isfinite(squared)]
    return float(np.sqrt(np.mean(finite))) if len(finite) else float("nan")
