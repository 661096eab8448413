"""Optimisation, repeated without inputs that the drive contradicts and does not need.

Surveys, known sizes and clocks are tested against everything else before the final solve. A contradicted one
is dropped (a clock corrected) and reported; indispensable inputs, such as the focal length, stay and are
reported.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from v2hdm.adjust import pose_innovations
from v2hdm.association.ground import views_of
from v2hdm.association.sightings import Sightings
from v2hdm.errors import AdjustError, MappingError
from v2hdm.faults import Contradiction, Item, Recovery, ScoreTest, table
from v2hdm.faults.odds import (
    CLEAR_SIGMAS,
    RIVAL_LOG_ODDS,
    doubt,
    is_contradicted,
    is_doubtful,
    log_odds,
)
from v2hdm.faults.score_tests import score_faults
from v2hdm.geometry.rigid import camera_centre
from v2hdm.mapping.bundle import Bundle, name_of
from v2hdm.mapping.conclusion import FinalSolve, Optimised, conclude
from v2hdm.mapping.foreign import foreign_segment
from v2hdm.mapping.inputs import Inputs
from v2hdm.mapping.optimise import Optimiser
from v2hdm.mapping.options import AUTO, INCREMENTAL, SURFACE, SurveyOptions
from v2hdm.mapping.results import CameraFit, ForeignSegment, SolveEvidence
from v2hdm.records import BoolArray, Drive, FloatArray, IntArray

_log = logging.getLogger(__name__)

_AMBIGUOUS_SHARE = 0.8
"""Fraction of its sigmas from which another camera's fault may be the cause: a straight road at constant
speed determines the distance of two centres, or the difference of two clocks, alone."""

_MOST_CORRECTIONS = 4  # most inputs dropped one by one; with more of them wrong nothing is reliable

_MEDIAN_SQUARED = 2 * float(np.log(2))
"""Median of a squared Mahalanobis distance: chi-square with two degrees of freedom."""


@dataclass(frozen=True)
class Outcome:
    """An optimised camera set with its inputs, adjusted poses and evidence for the checks."""

    inputs: Inputs
    settled: Bundle  # of all observations
    bundle: Bundle  # of the accepted ones
    evidence: SolveEvidence
    final: FinalSolve


def optimise(inputs: Inputs, progress: Callable[[str], None]) -> tuple[Outcome, Optimised]:
    """Optimise a drive, dropping contradicted inputs one by one; MappingError if there is nothing to map."""
    corrected: list[Contradiction] = []
    survey = inputs.options.survey
    while True:
        # 1. Associate and solve, as a batch or marking by marking.
        settled = _settled(inputs, progress)
        # 2. Switch to a surface where the drive contradicts the plane and a surface explains all of it.
        tested = _over_ground(inputs, settled, progress)
        inputs = tested.inputs
        settled = tested.settled
        worst = _worst(tested.tests)
        optimiser = inputs.optimiser
        sessions = _session_names(inputs.drive)
        # 3. Start again without the most likely wrong input, if dispensable; foreign images stay.
        foreign = _foreign(inputs, settled, tested.tests, progress)
        remaining = None
        if worst is not None and log_odds(worst) > foreign.gain and len(corrected) < _MOST_CORRECTIONS:
            has_rival = is_ambiguous(worst, tested.tests)
            remaining = None if has_rival else _recovered(inputs, worst, settled)
        if worst is None or remaining is None:
            break
        corrected += _contradictions(settled, (worst,), inputs.sightings, sessions)
        _log_correction(inputs, corrected[-1])
        inputs = remaining
    # 4. Choose the pose model, solve without outliers and classify the candidates.
    final = optimiser.final_solve(settled, progress, inputs.find_knots, inputs.grey_of_image)
    optimised = conclude(final, inputs.options.acceptance, inputs.drive.noises)
    corrected = [
        _as_solved(error, settled) for error in corrected if _is_of_the_map(error, survey, optimised)
    ]
    suspected = _contradictions(settled, tested.tests, inputs.sightings, sessions)
    evidence = _evidence(settled, suspected, corrected, optimiser, optimised.bundle, inputs.sightings)
    evidence = replace(evidence, foreign=foreign, clock_m=optimised.clock_m)
    return Outcome(inputs, settled, optimised.bundle, evidence, final), optimised


class Examined(NamedTuple):
    """A solve of all observations with every input as stated, and what it says of these."""

    inputs: Inputs
    settled: Bundle
    evidence: SolveEvidence


def examine(inputs: Inputs, progress: Callable[[str], None]) -> Examined:
    """Solve with all observations and test the inputs, but correct none; MappingError for nothing to map."""
    tested = _over_ground(inputs, _settled(inputs, progress), progress)
    inputs = tested.inputs
    settled = tested.settled
    foreign = _foreign(inputs, settled, tested.tests, progress)
    suspected = _contradictions(settled, tested.tests, inputs.sightings, _session_names(inputs.drive))
    evidence = _evidence(settled, suspected, (), inputs.optimiser, settled, inputs.sightings)
    return Examined(inputs, settled, replace(evidence, foreign=foreign))


def _log_correction(inputs: Inputs, error: Contradiction) -> None:
    about = f" {error.about}" if error.about else ""
    _log.warning(
        "%s: mapped again, for the drive contradicts the %s%s of %s by %.0f sigmas (%+.3g %s)",
        ", ".join(inputs.cameras), error.fault.name, about, " and ".join(error.cameras), error.sigmas,
        error.value, error.fault.unit,
    )  # fmt: skip


def _settled(inputs: Inputs, progress: Callable[[str], None]) -> Bundle:
    """A solve of all observations on the plane, or on a surface if the options ask for it."""
    if inputs.options.mode == INCREMENTAL:
        return inputs.optimiser.grow(progress)
    return inputs.optimiser.settle(inputs.tracks, progress)


def _tested(inputs: Inputs, settled: Bundle, progress: Callable[[str], None]) -> tuple[ScoreTest, ...]:
    """Tests of the inputs of ``settled``, most likely fault first."""
    progress("tests of the inputs")
    tests = score_faults(settled.problem, settled.solution)
    stated = (test for test in tests if _is_stated(test, settled, inputs.drive))
    return tuple(sorted(stated, key=log_odds, reverse=True))


def _worst(tests: Sequence[ScoreTest]) -> ScoreTest | None:
    return next((test for test in tests if is_contradicted(test)), None)


class _Tested(NamedTuple):
    """A solve on the ground that the drive shows, and what it says of its inputs."""

    inputs: Inputs
    settled: Bundle
    tests: tuple[ScoreTest, ...]  # most likely fault first


def _over_ground(inputs: Inputs, settled: Bundle, progress: Callable[[str], None]) -> _Tested:
    """Inputs, ``settled`` and its tests, or those on a surface if the drive shows one.

    A fall or rise of the ground contradicts the plane even if only as small as outliers leave it.
    """
    if inputs.options.ground != AUTO:
        return _Tested(inputs, settled, _tested(inputs, settled, progress))
    surface, gain = inputs.optimiser.likeliest_surface(settled)
    is_bent = gain > CLEAR_SIGMAS**2 / 2
    tests = () if is_bent else _tested(inputs, settled, progress)
    if is_bent or any(test.fault is table.CROWN and test.sigmas > CLEAR_SIGMAS for test in tests):
        curved = replace(inputs, options=replace(inputs.options, ground=SURFACE))
        over = curved.optimiser.settle_from(settled, progress, surface)
        tests_over = _tested(curved, over, progress)
        rival = _worst(tests_over)
        explained = rival is None or not rival.fault.like_ground
        is_curved = explained and curved.optimiser.is_curved(over)
        shape = "a surface" if is_curved else "a plane: no surface explains the drive"
        _log.info("%s: the ground is mapped as %s", ", ".join(inputs.cameras), shape)
        if is_curved:
            return _Tested(curved, over, tests_over)
    return _Tested(inputs, settled, tests or _tested(inputs, settled, progress))


def _foreign(
    inputs: Inputs, settled: Bundle, tests: Sequence[ScoreTest], progress: Callable[[str], None]
) -> ForeignSegment:
    """The most likely segment of foreign images, with its log-odds as the cause of all doubts.

    It explains the corners, plus the doubts that a solve without its images removes.
    """
    drive = inputs.drive
    names = inputs.cameras
    cameras = tuple(drive.cameras[name] for name in names)
    segment = foreign_segment(settled, inputs.sightings, views_of(drive, names), cameras)
    suspect = next(filter(is_doubtful, tests), None)
    if suspect is None or segment.gain <= 0:
        return segment
    begin_s = segment.begin_s
    end_s = segment.end_s
    stamp_s = np.array([drive.images[detections.image].stamp_s for detections in inputs.detections])
    is_beyond = ((stamp_s < begin_s) | (stamp_s > end_s)).tolist()
    remaining = replace(inputs, detections=list(compress(inputs.detections, is_beyond)))
    try:
        without = _settled(remaining, progress)
        tests_without = _tested(remaining, without, progress)
    except (AdjustError, MappingError) as failure:
        _log.warning("whether images from %.1f to %.1f s are foreign: %s", begin_s, end_s, failure)
        return segment
    left = max([0.0, *map(log_odds, tests_without)]) * len(settled.row) / len(without.row)
    return segment._replace(gain=segment.gain + max(log_odds(suspect) - left, 0.0))


def _frame_s(settled: Bundle, sightings: Sightings) -> FloatArray:
    """Times (J,) of the frames of a bundle's problem, s."""
    return sightings.stamp_s[np.unique(sightings.frame[settled.row])]


def _session_names(drive: Drive) -> tuple[str, ...]:
    """Names of a joined drive's sessions; none for a single session."""
    return tuple(session.name for session in drive.joined)


def _is_stated(test: ScoreTest, bundle: Bundle, drive: Drive) -> bool:
    """Whether the suspected input was stated: an unsurveyed centre is a guess."""
    if not test.fault.needs_centres:
        return True
    return all(drive.cameras[name].centre_prior is not None for name in _cameras_of(bundle, test))


def _is_of_the_map(error: Contradiction, survey: SurveyOptions, optimised: Optimised) -> bool:
    """False for a surveyed point matched to a candidate outside the map, such as a worn marking."""
    if error.fault.recovery is not Recovery.DROP_POINT:
        return True
    point_map = next(point.position_map for point in survey.points if point.id == error.about)
    corners_map = np.array([marking.corners_map for marking in optimised.markings])
    if np.linalg.norm(corners_map - point_map, axis=-1).min() <= survey.reach_m:
        return True
    _log.warning("the surveyed point %s is not used: its marking did not enter the map", error.about)
    return False


def _as_solved(error: Contradiction, bundle: Bundle) -> Contradiction:
    """A dropped survey with its error from the solve without it; others unchanged."""
    if error.fault.recovery is not Recovery.DROP_CENTRES or bundle.problem.centre_vehicle is None:
        return error
    rows = [bundle.camera_index[name] for name in error.cameras if name in bundle.camera_index]
    off = camera_centre(bundle.solution.cam_from_vehicle)[rows] - bundle.problem.centre_vehicle[rows]
    return replace(error, value=float(off[:, error.axis].mean()))


def _evidence(
    settled: Bundle,
    suspected: tuple[Contradiction, ...],
    corrected: Sequence[Contradiction],
    optimiser: Optimiser,
    final: Bundle,
    sightings: Sightings,
) -> SolveEvidence:
    innovations = pose_innovations(settled.solution)
    largest = np.abs(innovations.normalised).max(axis=1, initial=0.0)
    stated_m = max(sigma.position_m for sigma in settled.problem.pose_sigmas)
    twist = settled.problem.twist_vehicle
    speed_mps = 0.0 if twist is None else float(np.median(np.hypot(twist[:, 0], twist[:, 1])))
    return SolveEvidence(
        score_tests=suspected,
        corrected=tuple(corrected),
        pose_model=optimiser.pose_model,
        held_out=optimiser.held_out,
        fits=_camera_fits(settled),
        variance_factor=_factor(settled, settled.solution.mahalanobis2),
        pose_noise=optimiser.pose_noise,
        worst_innovation=float(largest.max()),
        worst_innovation_s=float(_frame_s(settled, sightings)[int(largest.argmax())]),
        clock_s=clocks_of(final),
        read_out_s=read_outs_of(final),
        # A coordinate's noise averages both directions; along the path alone its variance is twice that.
        jitter_s=math.sqrt(2) * stated_m * optimiser.pose_noise.get("position_m", 0.0) / max(speed_mps, 0.1),
        along_over_across=innovations.along_over_across,
    )


def is_ambiguous(worst: ScoreTest, tests: Sequence[ScoreTest]) -> bool:
    """Whether another camera's fault, or for centres the poses' scale, would explain nearly as much."""
    if worst.fault.recovery is Recovery.DROP_CENTRES:
        least = doubt(worst) - RIVAL_LOG_ODDS
        if any(test.fault is table.SCALE and is_contradicted(test) and doubt(test) > least for test in tests):
            return True
    rivals = [
        test.sigmas
        for test in tests
        if test.fault is worst.fault
        and test.axis == worst.axis
        and test.item == worst.item
        and min(test.camera, worst.camera) >= 0
        and test.camera != worst.camera
    ]
    return max(rivals, default=0.0) > _AMBIGUOUS_SHARE * worst.sigmas


def clocks_of(bundle: Bundle) -> tuple[dict[str, tuple[float, float]], ...]:
    """Clock offsets by session and camera, s, with their sigmas; empty where they are not estimated."""
    offset_s = bundle.solution.clock_offset_s.T.tolist()
    if not bundle.model.solver.clock_offset:
        return tuple({} for _ in offset_s)
    sigma_s = np.sqrt(bundle.solution.covariance.clock_s2()).T.tolist()[: len(offset_s)]
    index = bundle.camera_index.items()
    sessions = zip(offset_s, sigma_s, strict=True)
    return tuple({name: (off[c], sigma[c]) for name, c in index} for off, sigma in sessions)


def read_outs_of(bundle: Bundle) -> dict[str, tuple[float, float]]:
    """Read-out times by camera, s, with their sigmas; empty where they are not estimated."""
    if not bundle.model.solver.read_out:
        return {}
    read_out_s = bundle.solution.read_out_s
    sigma_s = np.sqrt(bundle.solution.covariance.clock_s2()[:, -1])
    return {name: (float(read_out_s[c]), float(sigma_s[c])) for name, c in bundle.camera_index.items()}


def _recovered(inputs: Inputs, worst: ScoreTest, settled: Bundle) -> Inputs | None:
    """The inputs without the fault ``worst``; None if the drive needs them."""
    if worst.sigma > worst.fault.recoverable_sigma:
        return None
    options = inputs.options
    match worst.fault.recovery:
        case Recovery.NONE:
            return None
        case Recovery.SHIFT_CLOCKS:
            return inputs.with_clocks(inputs.optimiser.clock_offsets_s(settled))
        case Recovery.DROP_CENTRES:
            return inputs.without_axis(_cameras_of(settled, worst), worst.axis)
        case Recovery.DROP_SIZES:
            # One wrong size means paint of another standard; corners of others may look like outliers, which
            # the robust loss hides from the tests.
            options = replace(options, known_sizes=replace(options.known_sizes, by_class_m={}))
        case Recovery.DROP_POINT:
            options = replace(options, survey=options.survey.without(_point_of(settled, worst.item)))
        case Recovery.DROP_POINTS:
            options = replace(options, survey=options.survey.only([]))
    return replace(inputs, options=options)


def _contradictions(
    bundle: Bundle, tests: Sequence[ScoreTest], sightings: Sightings, sessions: Sequence[str] = ()
) -> tuple[Contradiction, ...]:
    """``tests`` of the bundle's problem, in terms of the user's inputs; several ``sessions`` are named."""
    frame_s = _frame_s(bundle, sightings)
    return tuple(
        Contradiction(
            **vars(test), cameras=_cameras_of(bundle, test), about=_about(bundle, test, frame_s, sessions)
        )
        for test in tests
    )


def _cameras_of(bundle: Bundle, test: ScoreTest) -> tuple[str, ...]:
    names = tuple(bundle.camera_index)
    return names if test.camera < 0 else (names[test.camera],)


def _point_of(bundle: Bundle, item: int) -> str:
    """Name of the surveyed point of a test's ``item``."""
    control = bundle.problem.control
    assert control is not None
    return name_of(bundle.model.survey, control.points_map[item])


def _camera_fits(bundle: Bundle) -> dict[str, CameraFit]:
    """Fit of each camera's observations in ``bundle``, a solve with all of them."""
    observations = bundle.problem.observations
    fits = {}
    # Corners weigh by their information: distant and outlying detections err by more than stated.
    information = 1 / np.trace(observations.covariance_px, axis1=1, axis2=2)
    for name, c in bundle.camera_index.items():
        of_camera = observations.camera == c
        weight = information[of_camera]
        sightings = _effective_count(bundle.row[of_camera], weight)
        fits[name] = CameraFit(
            observations=int(of_camera.sum()),
            variance_factor=_factor(bundle, bundle.solution.mahalanobis2[of_camera]),
            rejected_share=float(1 - np.average(bundle.inliers[of_camera], weights=weight)),
            sightings=sightings,
            by_candidate=_by_candidate(bundle, of_camera, sightings * weight / weight.sum()),
        )
    return fits


def _by_candidate(bundle: Bundle, of_camera: BoolArray, sightings: FloatArray) -> FloatArray:
    """Sightings, and contradicted ones, of each candidate (J, 2), by those of K observations of a camera."""
    group = bundle.group[of_camera]
    counts = np.bincount(group, sightings)
    contradicted = np.bincount(group, sightings * ~bundle.inliers[of_camera])
    return np.column_stack([counts, contradicted])[counts > 0].astype(np.float64)


def _effective_count(group: IntArray, weight: FloatArray) -> float:
    """Number of equally weighted groups with as uncertain a mean, of weights (K,) in groups (Kish, 1965)."""
    weights = np.bincount(group, weight)
    return float(weights.sum() ** 2 / np.sum(weights**2))


def _factor(bundle: Bundle, mahalanobis2: FloatArray) -> float:
    return bundle.model.variance_factor * float(np.median(mahalanobis2)) / _MEDIAN_SQUARED


def _about(bundle: Bundle, test: ScoreTest, frame_s: FloatArray, sessions: Sequence[str]) -> str:
    """Which session, size or point a test is of, or from when on; empty for all of them."""
    match test.fault.item:
        case Item.FRAME:
            return f"from {frame_s[test.item]:.1f} s on"
        case Item.SESSION if test.item >= 0 and sessions:
            return f"in {sessions[test.item]}"
        case Item.LENGTH if bundle.problem.lengths is not None:
            length_m = float(np.unique(bundle.problem.lengths.length_m)[test.item])
            stated = bundle.model.sizes.by_class_m.items()
            names = [name for name, sides_m in stated if any(abs(m - length_m) < 1e-9 for m in sides_m)]
            return f"{', '.join(names)} {length_m:.2f} m"
        case Item.POINT:
            return _point_of(bundle, test.item)
    return ""
