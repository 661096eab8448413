"""The joint optimisation of one set of cameras as a result, and beside it the paper's naive methods."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from v2hdm.adjust import Status, observability
from v2hdm.association.ground import views_of
from v2hdm.association.sightings import frames_of
from v2hdm.errors import ConfigError
from v2hdm.faults import table
from v2hdm.io.maps.corrections import Heard
from v2hdm.io.maps.evidence import Residuals
from v2hdm.io.maps.features import with_heights
from v2hdm.lanes.knots import draw_lanes
from v2hdm.lanes.points import ground_by_rig
from v2hdm.mapping.alone import map_alone
from v2hdm.mapping.bundle import Bundle, without_corner
from v2hdm.mapping.conclusion import Optimised
from v2hdm.mapping.ground_evidence import off_ground
from v2hdm.mapping.inputs import Inputs
from v2hdm.mapping.optimise import silent
from v2hdm.mapping.options import MappingOptions, SurveyOptions, check_options
from v2hdm.mapping.recovery import Outcome, optimise
from v2hdm.mapping.results import AdjustedPoses, ClockOffset, MethodResult
from v2hdm.records import (
    BEST,
    Drive,
    Exclusion,
    FloatArray,
    HDMap,
    Image,
    ImageDetections,
    IntArray,
    Lane,
    Marking,
    Symbol,
)
from v2hdm.site.corrections import added_markings, with_symbols_corrected
from v2hdm.site.line_corrections import with_lines_corrected
from v2hdm.site.living.changes import Base, update_map
from v2hdm.site.living.looks import Observer
from v2hdm.site.standing import Pixels


def adjusted_poses(outcome: Outcome) -> AdjustedPoses:
    """Poses of all frames of the drive."""
    drive = outcome.inputs.drive
    sightings = outcome.inputs.sightings
    bundle = outcome.bundle
    by_session = np.stack([stated.by_state() for stated in bundle.model.pose_sigma])
    sigma = by_session[sightings.session]
    used = bundle.frames
    if bundle.model.solver.pose_states:
        sigma[used] = np.sqrt(bundle.solution.covariance.poses() * bundle.solution.variance_scale)
    is_used = np.zeros(len(sightings.stamp_s), dtype=bool)
    is_used[used] = True
    frames = frames_of(drive).frame_of_image
    return AdjustedPoses(
        stamp_s=sightings.stamp_s,
        before=sightings.map_from_vehicle,
        map_from_vehicle=bundle.rig.map_from_vehicle,
        sigma=sigma,
        has_marking=is_used,
        frame={image.path: int(frame) for image, frame in zip(drive.images, frames, strict=True)},
        session=sightings.session,
    )


def clock_offsets(outcome: Outcome) -> tuple[dict[str, ClockOffset], ...]:
    """Clock offset of each camera by session: the images' earlier shift plus the solve's estimate, s."""
    evidence = outcome.evidence
    drive = outcome.inputs.drive
    applied_s = {(image.session, image.camera): image.clock_offset_s for image in drive.images}
    score_tests = [test for test in evidence.score_tests if test.fault is table.CLOCK]
    out = []
    for session, (place, estimated) in enumerate(zip(drive.sessions, evidence.clock_s, strict=True)):
        tests_here = [test for test in score_tests if test.about in ("", f"in {place.name}")]
        clocks = {}
        for name in outcome.inputs.sightings.cameras:
            # A camera's own clock and one common to all cameras: the offset may differ by both.
            variances_s2 = [test.sigma**2 for test in tests_here if name in test.cameras]
            unobserved = 0.0, float(np.sqrt(sum(variances_s2))) if variances_s2 else float("inf")
            beyond_s, sigma_s = estimated.get(name, unobserved)
            if (session, name) in applied_s:
                clocks[name] = ClockOffset(applied_s[session, name] + beyond_s, sigma_s)
        out.append(clocks)
    return tuple(out)


def joint_covariance(optimised: Optimised, marking: IntArray, corner: IntArray) -> FloatArray:
    """Joint covariance (2N, 2N), m^2, of corners (N,) of markings (N,), stacked x0, y0, x1, ...

    Markings have the adjustment's errors in common; an unseen corner is given a seen one's.
    """
    bundle = optimised.bundle
    index = bundle.corner_index[optimised.groups[marking]]
    corner_index = index[np.arange(len(corner)), corner]
    number = np.where(corner_index >= 0, corner_index, index.max(axis=1))
    out = bundle.solution.variance_scale * bundle.solution.corner_covariance(number)
    _state(out, optimised.markings, marking, corner)
    # Combined from two sources, it may have negative eigenvalues of about a square millimetre.
    values, vectors = np.linalg.eigh(out)
    return out if values[0] >= 0 else np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def stated_covariance(markings: Sequence[Marking], marking: IntArray, corner: IntArray) -> FloatArray:
    """As :func:`joint_covariance` for markings of several maps, uncorrelated with each other."""
    out = np.zeros((2 * len(marking), 2 * len(marking)))
    _state(out, markings, marking, corner)
    return out


def _state(out: FloatArray, markings: Sequence[Marking], marking: IntArray, corner: IntArray) -> None:
    """Set each marking's blocks of ``out`` to its own covariance."""
    rows = 2 * corner[:, None] + np.arange(2)
    for k, number in enumerate(marking.tolist()):
        stated = markings[number].covariance_m2
        assert stated is not None
        for other in np.flatnonzero(marking == number):
            out[2 * k : 2 * k + 2, 2 * other : 2 * other + 2] = stated[np.ix_(rows[k], rows[other])]


def residuals_of(outcome: Outcome, optimised: Optimised) -> Residuals:
    """Residuals of accepted observations, of markings and of rejected candidates."""
    drive = outcome.inputs.drive
    sightings = outcome.inputs.sightings
    bundle = optimised.bundle
    numbers, row_image = np.unique(sightings.image[bundle.row], return_inverse=True)
    marking = np.zeros(bundle.association.count, dtype=np.int64)
    # Markings without ids are numbered in order, as in the files.
    marking[optimised.groups] = np.arange(1, len(optimised.groups) + 1)
    images = [drive.images[i] for i in numbers.tolist()]
    return Residuals(
        image=tuple(drive.name_of(image.path) for image in images),
        camera=tuple(image.camera for image in images),
        taken_s=np.array([image.taken_s for image in images]),
        row_image=row_image.astype(np.int64),
        marking=marking[bundle.group],
        corner=bundle.corner,
        is_point=np.asarray(sightings.valid[bundle.row, bundle.own_corner]),
        observed_px=sightings.corners_pinhole_px[bundle.row, bundle.own_corner],
        residual_px=bundle.solution.residual_px,
        distance_sigma=np.sqrt(bundle.solution.mahalanobis2),
    )


_log = logging.getLogger(__name__)


def run_methods(
    drive: Drive,
    detections: Sequence[ImageDetections],
    cameras: Sequence[str],
    options: MappingOptions | None = None,
    progress: Callable[[str], None] = silent,
    base: Base | None = None,
    grey: Callable[[Image], Pixels] | None = None,
    *,
    naive: bool = True,
    stated: bool = True,
) -> dict[str, MethodResult]:
    """Map a drive, ignoring ground truth, by every method that the cameras' IPMs allow.

    ``progress`` receives the name of each step at its start. ``Opt`` updates the earlier map ``base``;
    ``grey`` reads the images in which it looks at bare places and at ends: grey values (H, W) or colours
    (H, W, 3). Results are by method: those of :func:`map_as_stated`, ``Opt``, ``ONI``; without ``naive``
    ``Opt`` alone, without ``stated`` the last two. Raises MappingError if there is nothing to map,
    ConfigError for an option out of range.
    """
    options = options or MappingOptions()
    check_options(options)
    if options.survey.file is not None:
        raise ConfigError(f"mapping.survey.file is {options.survey.file!r}: read it and give its points")
    if naive:
        from v2hdm.mapping.naive import run_optimised, run_stated  # only a comparison needs them

    progress("linking sightings")
    inputs = Inputs(drive, detections, cameras, options, grey)
    results = run_stated(inputs, progress) if naive and stated else {}
    outcome, optimised = optimise(inputs, progress)
    optimal = optimised_result(outcome, optimised)
    if base is not None:
        progress("the earlier map")
        optimal = _brought_up_to_date(base, optimal, outcome, optimised)
    results[BEST] = optimal
    if naive:
        progress("ONI")
        results["ONI"] = run_optimised(outcome.inputs, optimal.calibrations)
    return results


def map_as_stated(
    drive: Drive,
    detections: Sequence[ImageDetections],
    cameras: Sequence[str],
    options: MappingOptions,
    progress: Callable[[str], None] = silent,
) -> dict[str, MethodResult]:
    """Naive maps under the IPMs that were stated: ``CNI`` and ``ENI``, where every camera has such an IPM."""
    from v2hdm.mapping.naive import run_stated  # only a comparison needs it

    return run_stated(Inputs(drive, detections, cameras, options), progress)


def _unused_points(survey: SurveyOptions, bundle: Bundle) -> list[str]:
    """Names of the surveyed points that match no corner, with a warning if there are any."""
    lost = without_corner(survey, bundle.problem.control)
    if lost:
        _log.warning(
            "%d of %d surveyed points are not used, since no map corner matches them within %g m: %s",
            len(lost), len(survey.points), survey.reach_m, ", ".join(lost),
        )  # fmt: skip
    return lost


def _symbols(inputs: Inputs, optimised: Optimised) -> tuple[tuple[Symbol, ...], tuple[Exclusion, ...]]:
    """Symbols of the map, and those left out, with a warning by class of those that no polygon explains."""
    symbols = inputs.optimiser.sightings.symbols
    if not symbols.kinds:
        return (), ()
    from v2hdm.site.symbols import NO_POLYGON, map_symbols

    cameras = inputs.sightings.cameras
    mapped, excluded = map_symbols(
        symbols,
        optimised.bundle.rig,
        views_of(inputs.drive, cameras),
        [inputs.drive.cameras[name] for name in cameras],
        inputs.drive.pose_noise.roll_pitch_rad,
        optimised.markings,
        inputs.options.acceptance,
    )
    kinds = Counter(exclusion.kind for exclusion in excluded if exclusion.reason == NO_POLYGON)
    for kind, count in kinds.items():
        _log.warning("class %s: %d left out: %s", kind, count, NO_POLYGON)
    return mapped, excluded


class _DrawnMap(NamedTuple):
    hd_map: HDMap
    excluded: tuple[Exclusion, ...]  # symbols that are too doubtful, or that a person rejected
    heard: tuple[Heard, ...]  # what the map follows of a person's corrections
    has_additions: bool  # whether a person added markings


def _drawn_map(inputs: Inputs, optimised: Optimised, lanes: tuple[Lane, ...]) -> _DrawnMap:
    """The adjusted markings with lanes, symbols, heights and a person's corrections."""
    drive = inputs.drive
    corrections = inputs.options.acceptance.corrections
    surface = inputs.optimiser.surface
    symbols, no_symbols = _symbols(inputs, optimised)
    added, heard_of_paint = added_markings(corrections, optimised.markings)
    markings = (*optimised.markings, *added)
    hd_map = HDMap(markings, lanes, drive.origin, symbols, drive.pose_noise.position_drift_over_m)
    if surface is not None:
        # A spline already contains the recorded heights.
        hd_map = with_heights(hd_map, None, surface.height_m)
        hd_map = replace(hd_map, ground=surface.strips())
    hd_map, rejected = with_symbols_corrected(hd_map, corrections)
    hd_map, heard_of_lines = with_lines_corrected(hd_map, corrections)
    return _DrawnMap(
        hd_map=hd_map,
        excluded=(*no_symbols, *rejected),
        heard=(*heard_of_paint, *heard_of_lines),
        has_additions=bool(added),
    )


def optimised_result(
    outcome: Outcome, optimised: Optimised, *, with_lanes: bool = True, with_alone: bool = True
) -> MethodResult:
    """The result ``Opt`` of an optimised set of cameras, with lanes, symbols and evidence.

    Without ``with_lanes`` it has no lanes, without ``with_alone`` no cameras alone.
    """
    inputs = outcome.inputs
    options = inputs.options
    drive = inputs.drive
    cameras = inputs.cameras
    bundle = optimised.bundle
    solution = bundle.solution
    if solution.status is not Status.CONVERGED:
        status = solution.status
        _log.warning("the joint optimisation ended early (%s): %s", status.value, status.advice)
    unused_points = _unused_points(options.survey, bundle)
    observed = observability(bundle.problem, solution)
    surface = inputs.optimiser.surface
    if bundle.knots is not None:
        lanes = draw_lanes(bundle.knots, solution)
    elif with_lanes:
        lanes = inputs.find_lanes(ground_by_rig(drive, cameras, bundle.rig, surface))
    else:
        lanes = ()
    drawn = _drawn_map(inputs, optimised, lanes)
    return MethodResult(
        name=BEST,
        cameras=tuple(cameras),
        hd_map=drawn.hd_map,
        calibrations=optimised.calibrations,
        excluded=(*optimised.excluded, *drawn.excluded),
        reprojection_rmse_px=optimised.reprojection_rmse_px,
        initial_reprojection_rmse_px=optimised.initial_reprojection_rmse_px,
        diagnostics={
            "observations": float(len(bundle.row)),
            "candidates": float(bundle.association.count),
            "control_points": float(len(options.survey.points) - len(unused_points)),
            "evaluations": float(solution.evaluations),
            "gap": solution.gap,
            "chi2_per_dof": solution.chi2_per_dof,
        },
        certainty={name: observed[index].sentence(name) for name, index in bundle.camera_index.items()},
        evidence=outcome.evidence,
        poses=adjusted_poses(outcome),
        clocks=clock_offsets(outcome),
        # The adjustment knows nothing of what a person added.
        joint_covariance=partial(stated_covariance, drawn.hd_map.markings)
        if drawn.has_additions
        else partial(joint_covariance, optimised),
        residuals=residuals_of(outcome, optimised),
        suspicions=optimised.suspicions,
        heard=(*optimised.heard, *drawn.heard),
        surface=surface,
        off_ground=off_ground(bundle),
        alone=map_alone(outcome, optimised) if with_alone else {},
    )


def _brought_up_to_date(
    base: Base,
    result: MethodResult,
    outcome: Outcome,
    optimised: Optimised,
) -> MethodResult:
    drive = outcome.inputs.drive
    group = optimised.bundle.association.group
    observer = Observer(
        outcome.inputs.optimiser.sightings,
        views_of(drive, result.cameras),
        tuple(drive.cameras[name] for name in result.cameras),
        optimised.bundle.rig,
        drive.pose_noise.roll_pitch_rad,
        outcome.inputs.grey_of_image,
    )
    mapped = np.isin(group, optimised.groups)
    over_m = drive.pose_noise.position_drift_over_m
    update = update_map(base, result.hd_map, observer, mapped, over_m)
    hd_map = replace(update.hd_map, ground=result.hd_map.ground)
    residuals = None if result.residuals is None else result.residuals.renamed(update.ids, update.corners)
    suspicions = [
        replace(suspicion, marking=int(update.ids[suspicion.marking - 1])) for suspicion in result.suspicions
    ]
    return replace(
        result,
        hd_map=hd_map,
        changes=update.changes,
        joint_covariance=partial(stated_covariance, hd_map.markings),
        residuals=residuals,
        suspicions=suspicions,
    )
