"""The end of the joint optimisation: from the final solve to classified markings with their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from v2hdm.adjust.covariance import Moves
from v2hdm.association.ground import Located, Views, easy_views, images_with_line, images_with_symbol, locate
from v2hdm.association.groups import fuse_groups, group_kinds
from v2hdm.association.sightings import Rig, Sightings
from v2hdm.faults.clock_errors import ClockErrors, moves_with_clocks
from v2hdm.geometry.ipm import project_ground
from v2hdm.io.maps.corrections import Heard
from v2hdm.mapping.bundle import Bundle
from v2hdm.records import (
    LANE_DASH,
    BoolArray,
    Calibration,
    Camera,
    Exclusion,
    FloatArray,
    IntArray,
    Marking,
    PoseNoise,
)
from v2hdm.site.accuracy import corner_radii_m, radius_of_all_m
from v2hdm.site.candidates import Candidates, Counts, scatter_of, with_dissent, with_shared_errors
from v2hdm.site.markings import Classified, Suspicion, classify, most_suspicious
from v2hdm.site.options import AcceptanceOptions
from v2hdm.site.parallax import Parallax, PointViews, measure_parallax
from v2hdm.site.relative import with_relative_sigma
from v2hdm.site.standing import Grey, Watch
from v2hdm.surface.surface import Surface


@dataclass(frozen=True)
class Optimised:
    """The result of the joint optimisation; reprojection errors are RMS over the markings' points."""

    bundle: Bundle  # the adjusted extrinsics and poses
    groups: IntArray  # of the markings
    markings: tuple[Marking, ...]
    excluded: tuple[Exclusion, ...]
    calibrations: Mapping[str, Calibration]
    reprojection_rmse_px: float  # under the optimised extrinsics
    initial_reprojection_rmse_px: float  # under the initial ones
    suspicions: Sequence[Suspicion] = ()  # the worst first
    heard: tuple[Heard, ...] = ()  # of a person's corrections
    clock_m: float | None = None  # 95 % radius of the corners by what clocks may err alone; None: they do not


@dataclass(frozen=True)
class FinalSolve:
    """The solve of the accepted observations, and what it was made from."""

    bundle: Bundle  # of the accepted observations alone
    ungated: Bundle  # of all K observations
    inlier: BoolArray  # (K,) the accepted ones
    usable: BoolArray  # (S, 4) their corners in the sightings
    sightings: Sightings
    views: Views
    cameras: Mapping[str, Camera]
    initial_rig: Rig
    jitter_rad: float  # of roll and pitch
    grey: Grey | None = None  # reads the images; None for none
    surface: Surface | None = None  # of the ground; None for the plane
    scatter: FloatArray | None = None  # (G, 4) as of :func:`scatter_of`, where others know more of it

    def candidates(self, located: Located) -> Candidates:
        """Solved candidates with the errors that their images share, and the dissent of outliers."""
        fused = fuse_groups(self.bundle.association, located, jitter_rad=0.0)
        ungated = self.ungated
        solved = _solved_candidates(self.bundle, ungated)
        scatter = scatter_of(*spread_of(self.bundle)) if self.scatter is None else self.scatter
        solved = with_shared_errors(solved, fused, scatter)
        row = ungated.row
        corner = ungated.own_corner
        rejected = np.flatnonzero(~self.inlier & self.sightings.valid[row, corner])
        place = (row[rejected], corner[rejected])
        return with_dissent(
            solved,
            fused,
            row=row[rejected],
            group=ungated.group[rejected],
            corner=ungated.corner[rejected],
            seen_map=located.corners_map[place],
            covariance_m2=located.covariance_m2[place],
        )

    def counts(self, corners_map: FloatArray) -> Counts:
        """Counts of candidates with corners (G, 4, 2), from all observations."""
        count = len(corners_map)
        all_seen = self.ungated
        rig = self.bundle.rig
        image = self.sightings.image[all_seen.row]
        group = all_seen.group[self.inlier]
        accepted = all_seen.row[self.inlier]
        shown = np.unique(np.stack([group, image[self.inlier]]), axis=1)
        odds = np.bincount(group, self.sightings.log_odds[accepted], minlength=count)
        easy = np.stack(easy_views(self.views, rig, list(self.cameras.values()), corners_map))
        is_detected = np.isin(_pairs(easy), _pairs(shown))
        ended = self.inlier & self.sightings.valid[all_seen.row, all_seen.own_corner]
        ended &= np.isin(_pairs(np.stack([all_seen.group, image])), _pairs(easy[:, is_detected]))
        corner = 4 * all_seen.group[ended] + all_seen.corner[ended]
        return Counts(
            images=np.bincount(shown[0], minlength=count),
            observations=np.bincount(all_seen.group, minlength=count),
            agreeing=np.bincount(group, minlength=count),
            log_odds=odds / np.maximum(np.bincount(group, minlength=count), 1),
            easy_views=np.bincount(easy[0], minlength=count),
            detected_views=np.bincount(easy[0, is_detected], minlength=count),
            pointed=np.bincount(corner, minlength=4 * count).reshape(-1, 4),
            as_symbol=images_with_symbol(self.sightings.symbols, rig, corners_map)
            + images_with_line(self.sightings.lines, rig, corners_map),
        )

    def standing_odds(self, corners_map: FloatArray, is_end: BoolArray) -> FloatArray:
        """Log-likelihood ratios (G, 4) that something stands beyond sides ``is_end`` (G, 4)."""
        if self.grey is None:
            return np.zeros(is_end.shape)
        cameras = tuple(self.cameras.values())
        surface = self.surface
        height_m = None if surface is None else lambda points_map: surface.height_m(points_map)[0]
        watch = Watch(self.views, self.bundle.rig, cameras, self.grey, height_m)
        return watch.standing_odds(corners_map, is_end)

    def residual_px(self, rig: Rig) -> FloatArray:
        """Residuals (K, 2), px, of the accepted observations under ``rig`` with its own best corners."""
        bundle = self.bundle
        sightings = self.sightings
        fused = fuse_groups(bundle.association, locate(sightings, rig), self.jitter_rad)
        camera = sightings.camera[bundle.row]
        frame = sightings.frame[bundle.row]
        points = fused.corners_map[bundle.group, bundle.corner]
        place = bundle.row, bundle.own_corner
        cam_from_map = rig.cam_from_map(camera, frame, sightings.row_share[place])
        pixel, _ = project_ground(rig.intrinsic[camera], cam_from_map, points[:, None])
        return np.asarray(pixel[:, 0] - sightings.corners_pinhole_px[place])


def _pairs(views: IntArray) -> IntArray:
    """One number (N,) for each pair of a group and an image (2, N)."""
    group, image = views
    return np.asarray(group * (1 << 32) + image)


class Proposed(NamedTuple):
    """G candidates of a final solve, before they are classified."""

    solved: Candidates
    kind: IntArray  # (G,) classes, into the sightings' kinds
    parallax: Parallax


def conclude(solve: FinalSolve, acceptance: AcceptanceOptions, noises: Sequence[PoseNoise] = ()) -> Optimised:
    """Classify the candidates of the final solve; raises MappingError if none is accepted.

    What the clocks may err by under the ``noises`` of the sessions moves all markings, and is a reason
    against none of them: it is stated of those that are accepted.
    """
    candidates = proposed(solve)
    classified = classify(
        candidates.solved,
        candidates.kind,
        solve.sightings.kinds,
        solve.counts,
        candidates.parallax,
        acceptance,
        solve.standing_odds,
    )
    classified.check()
    return concluded(solve, classified, noises)


def proposed(solve: FinalSolve) -> Proposed:
    """The candidates of the final solve."""
    bundle = solve.bundle
    sightings = solve.sightings
    located = locate(sightings, bundle.rig)
    located.informs[:] &= solve.usable
    model = bundle.model
    # Of all observations, from the poses as recorded: something that moves moves the adjusted ones.
    recorded = locate(sightings, replace(bundle.rig, map_from_vehicle=sightings.map_from_vehicle))
    corners = PointViews.of_corners(
        bundle.association, sightings, recorded, model.variance_factor, model.pose_sigma
    )
    kind = group_kinds(bundle.association, sightings)
    is_bar = np.array([name == LANE_DASH for name in sightings.kinds], dtype=np.bool_)[kind]
    return Proposed(
        solved=solve.candidates(located),
        kind=kind,
        parallax=measure_parallax(corners, bundle.association.count, is_bar),
    )


def concluded(
    solve: FinalSolve,
    classified: Classified,
    noises: Sequence[PoseNoise] = (),
    clocks: ClockErrors | None = None,
) -> Optimised:
    """The result of the final solve, whose candidates are ``classified``; see :func:`conclude`.

    ``clocks`` is what a drive says of its clocks, where the solve is a part of it.
    """
    bundle = solve.bundle
    sightings = solve.sightings
    scale = bundle.solution.variance_scale
    by_clock = _by_clock(bundle, noises, clocks)
    markings = classified.markings()
    clock_m = None
    if by_clock is not None:
        bundle = _with_errors(bundle, by_clock)
        shared_m2 = scale * _shared_by(by_clock, bundle.corner_index[classified.accepted])
        clock_m = radius_of_all_m(np.concatenate([corner_radii_m(block) for block in shared_m2]))
        markings = tuple(
            replace(marking, covariance_m2=marking.covariance_m2 + block)
            for marking, block in zip(markings, shared_m2, strict=True)
        )
    markings = with_relative_sigma(
        markings,
        bundle.corner_index[classified.accepted],
        lambda pairs: scale * bundle.solution.corner_covariance(pairs),
    )
    squared = np.bincount(bundle.group, bundle.solution.mahalanobis2, len(classified.kind)).astype(float)
    used = np.isin(bundle.group, classified.accepted) & sightings.valid[bundle.row, bundle.own_corner]
    return Optimised(
        bundle=bundle,
        groups=classified.accepted,
        markings=markings,
        excluded=classified.exclusions(),
        calibrations=calibrations_of(bundle, solve.cameras),
        reprojection_rmse_px=_root_mean_square(bundle.solution.residual_px[used]),
        initial_reprojection_rmse_px=_root_mean_square(solve.residual_px(solve.initial_rig)[used]),
        suspicions=most_suspicious(classified.accepted, classified.misfit, squared, classified.counts),
        heard=classified.heard,
        clock_m=clock_m,
    )


def _by_clock(bundle: Bundle, noises: Sequence[PoseNoise], clocks: ClockErrors | None) -> Moves | None:
    """Motion of a solution by the clocks; its scale is of residuals, and none of the clocks."""
    if not noises:
        return None
    moves = moves_with_clocks(bundle.problem, bundle.solution, noises, clocks)
    root = bundle.solution.variance_scale**-0.5
    return None if moves is None else Moves(*(root * part for part in vars(moves).values()))


def _with_errors(bundle: Bundle, moves: Moves) -> Bundle:
    """``bundle`` with covariances that hold further errors."""
    covariance = bundle.solution.covariance
    covariance = replace(covariance, held=moves.beside(covariance.held))
    return replace(bundle, solution=replace(bundle.solution, covariance=covariance))


def _shared_by(moves: Moves, corner_index: IntArray) -> FloatArray:
    """Covariances (M, 8, 8) of markings with corners (M, 4), of which unseen ones (-1) move as a seen one."""
    index = np.where(corner_index >= 0, corner_index, corner_index.max(axis=1, keepdims=True))
    moved = moves.corners[index].reshape(len(index), 8, -1)
    return np.asarray(moved @ moved.swapaxes(1, 2))


def calibrations_of(bundle: Bundle, cameras: Mapping[str, Camera]) -> dict[str, Calibration]:
    """Adjusted calibrations; a camera without markings keeps its start and has no covariance."""
    covariance = bundle.solution.extrinsic_covariance * bundle.solution.variance_scale
    return {
        name: Calibration(
            info=camera.info,
            cam_from_vehicle=bundle.rig.cam_from_vehicle[c],
            covariance=covariance[bundle.camera_index[name]] if name in bundle.camera_index else None,
        )
        for c, (name, camera) in enumerate(cameras.items())
    }


class Spread(NamedTuple):
    """How far the images of each corner (G, 4) differ: ``squared`` residuals, of so much ``freedom``."""

    squared: FloatArray
    freedom: FloatArray


def spread_of(bundle: Bundle) -> Spread:
    """The spread of each corner's images."""
    corner = 4 * bundle.group + bundle.corner
    size = 4 * bundle.association.count
    freedom = 2.0 - bundle.problem.observations.on_line[: len(corner)]
    squared = np.zeros(size)
    degrees = np.full(size, -2.0)
    np.add.at(squared, corner, bundle.solution.mahalanobis2)
    np.add.at(degrees, corner, freedom)
    return Spread(squared.reshape(-1, 4), degrees.reshape(-1, 4))


def _solved_candidates(bundle: Bundle, ungated: Bundle) -> Candidates:
    """Corners of every group of ``bundle``; a group that lost all of them is placed as in ``ungated``.

    Covariances are scaled by chi^2 per degree of freedom above one.
    """
    solved = bundle.corner_index >= 0
    covariance = np.full((len(solved), 8, 8), np.nan)
    scale = bundle.solution.variance_scale
    for count in range(1, 5):
        groups = np.flatnonzero(solved.sum(axis=1) == count)
        if not len(groups):
            continue
        corner = np.nonzero(solved[groups])[1].reshape(-1, count)
        indices = np.take_along_axis(bundle.corner_index[groups], corner, axis=1)
        rows = (2 * corner[..., None] + np.arange(2)).reshape(len(groups), -1)
        blocks = scale * bundle.solution.corner_covariance(indices)
        covariance[groups[:, None, None], rows[:, :, None], rows[:, None, :]] = blocks
    before = ungated.corners_map
    count = np.maximum(np.isfinite(before[..., 0]).sum(axis=1), 1)
    about = np.nansum(before, axis=1) / count[:, None]
    return Candidates.seen(bundle.corners_map, covariance, about)


def _root_mean_square(residual_px: FloatArray) -> float:
    """RMS norm of residuals (K, 2), without points that have no projection."""
    squared = np.sum(residual_px**2, axis=1)
    finite = squared[np.isfinite(squared)]
    return float(np.sqrt(np.mean(finite))) if len(finite) else float("nan")
