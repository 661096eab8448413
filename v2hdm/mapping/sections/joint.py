"""Messages of sections on a joint solve, and a section's solve as the joint one left it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from v2hdm.adjust import Problem, Solution, Verdict
from v2hdm.adjust.sections.parts import Part
from v2hdm.adjust.solution import VarianceFactors, noise_scale, variance_factors
from v2hdm.errors import AdjustError
from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.conclusion import FinalSolve
from v2hdm.mapping.recovery import Examined
from v2hdm.mapping.sections.common import Names
from v2hdm.mapping.sections.section import Section
from v2hdm.records import BoolArray, Drive, FloatArray, IntArray
from v2hdm.site.candidates import scatter_of

_CONTRADICTION_SIGMAS = 6.0
"""Mean shift of a drive against others, in sigmas of its positions, from which it contradicts them; chosen: a
receiver's slow errors average out over a network, to about one sigma along a single street."""

# Priors that every section has of the same cameras.
_OF_CAMERAS = ("camera_centre", "ground_planes", "clock_offsets")


@dataclass(frozen=True)
class Told:
    """A section's own images in a joint solve: poses of its frames (F,), residuals of K observations.

    ``frame`` and ``observation`` are names over the drive, both ascending.
    """

    frame: IntArray
    map_from_vehicle: FloatArray  # (F, 4, 4)
    observation: IntArray
    residual_px: FloatArray  # (K, 2)
    mahalanobis2: FloatArray  # (K,)


class Judged(NamedTuple):
    """Results of a section's own solve on its own images, with K observations by ascending names."""

    corner: IntArray  # (K,) over the drive
    shift_m: FloatArray  # (S, 2) sum of how far the frames of each session moved from their recorded poses
    frames: IntArray  # (S,) number of these


class Fit(NamedTuple):
    """How K observations of a section fit the joint solve, for what all sections together tell."""

    mahalanobis2: FloatArray  # (K,)
    corner: IntArray  # (K,) over the drive
    is_behind: BoolArray  # (K,) the camera
    freedom: FloatArray  # (K,) 2, or 1 of a corner that is known along one line
    of_priors: dict[str, float]  # their parts of the cost


class Gate(NamedTuple):
    """Which observations of a section's own images, K by ascending names, are no outliers."""

    is_accepted: BoolArray
    is_used: BoolArray  # accepted, of a corner with two such at least


def fit_of(part: Part, solution: Solution) -> Fit:
    """How the observations of a part fit."""
    observations = part.problem.observations
    return Fit(
        mahalanobis2=solution.mahalanobis2,
        corner=part.corners[observations.corner],
        is_behind=np.asarray(solution.verdict == Verdict.BEHIND_CAMERA),
        freedom=np.where(observations.on_line, 1.0, 2.0),
        of_priors={name: cost for name, cost in solution.cost_terms.items() if name != "observations"},
    )


def judged_of(section: Section, settled: Bundle, corner: IntArray) -> Judged:
    """Results of a section's solve on its own images, whose observations are of corners (K,)."""
    problem = settled.problem
    solution = settled.solution
    is_own = np.isin(settled.frames, section.own_frames)
    session = problem.session_of_frame[is_own]
    moved_m = (solution.map_from_vehicle - problem.map_from_vehicle)[is_own, :2, 3]
    shift_m = np.zeros((problem.session_count, 2))
    np.add.at(shift_m, session, moved_m)
    return Judged(
        corner=corner,
        shift_m=shift_m,
        frames=np.bincount(session, minlength=problem.session_count),
    )


def refuse_contradicting_drives(judged: Sequence[Judged], drive: Drive) -> None:
    """Raise AdjustError where the markings shift one drive of a network against the others.

    A shift of all drives shows in no marking; so the mean shift of each is compared with that of all others.
    """
    frames = np.sum([section.frames for section in judged], axis=0)
    shift_m = np.sum([section.shift_m for section in judged], axis=0)
    worst: tuple[float, str, float] | None = None
    for number, session in enumerate(drive.joined):
        others = frames.sum() - frames[number]
        if not frames[number] or not others:
            continue
        of_others_m = (shift_m.sum(axis=0) - shift_m[number]) / others
        off_m = float(np.linalg.norm(shift_m[number] / frames[number] - of_others_m))
        sigmas = off_m / session.pose_noise.position_m
        if sigmas > _CONTRADICTION_SIGMAS and (worst is None or sigmas > worst[0]):
            worst = sigmas, session.name, off_m
    if worst is not None:
        raise AdjustError(
            f"the drives contradict each other: markings shift drive {worst[1]} by {100 * worst[2]:.0f} cm "
            f"against the others, {worst[0]:.0f} times the noise stated for its positions; map the drives "
            "one by one to find the one whose poses are wrong, or state more noise (pose_noise.position_m)"
        )


def open_gates(corners: Sequence[IntArray]) -> list[Gate]:
    """Gates that all observations pass; of the corners (K,), by section, those with two are used."""
    return _gates(corners, [np.ones(len(corner), dtype=np.bool_) for corner in corners])


def gates(fits: Sequence[Fit], before: Sequence[Gate], probability: float) -> list[Gate]:
    """The gates of all observations under a solve of those used ``before``, at their common scale.

    They are those of :func:`v2hdm.adjust.solution.classify`.
    """
    scale = noise_scale(np.concatenate([fit.mahalanobis2 for fit in fits]))
    limit = -2 * np.log(probability) * scale
    passed = _gates(
        [fit.corner for fit in fits], [(fit.mahalanobis2 <= limit) & ~fit.is_behind for fit in fits]
    )
    return [_of_all(gate, used.is_used) for gate, used in zip(passed, before, strict=True)]


def _gates(corners: Sequence[IntArray], accepted: Sequence[BoolArray]) -> list[Gate]:
    """The gates of observations of corners (K,), by section, which are ``accepted`` (K,) or not."""
    size = 1 + max(int(corner.max(initial=-1)) for corner in corners)
    count = np.zeros(size, dtype=np.int64)
    for corner, is_accepted in zip(corners, accepted, strict=True):
        count += np.bincount(corner[is_accepted], minlength=size)
    return [
        Gate(is_accepted, is_accepted & (count[corner] >= 2))
        for corner, is_accepted in zip(corners, accepted, strict=True)
    ]


def _of_all(gate: Gate, is_in: BoolArray) -> Gate:
    """The gate of observations ``is_in`` a solve as that of all (K,), of which the others do not pass."""
    columns = [np.zeros(len(is_in), dtype=np.bool_) for _ in gate]
    for column, passed in zip(columns, gate, strict=True):
        column[is_in] = passed
    return Gate(*columns)


def variance_of(fits: Sequence[Fit], whole: Problem) -> VarianceFactors:
    """The variance factors of a joint solve of all sections; ``whole`` has the cameras and their priors."""
    squared = np.concatenate([fit.mahalanobis2 for fit in fits])
    corners = np.unique(np.concatenate([fit.corner for fit in fits]))
    costs = [cost for fit in fits for name, cost in fit.of_priors.items() if name not in _OF_CAMERAS]
    of_cameras = sum(float(np.mean([fit.of_priors.get(name, 0.0) for fit in fits])) for name in _OF_CAMERAS)
    cameras = len(whole.intrinsic)
    held = 0 if whole.centre_sigma_m is None else 3 * cameras
    if whole.ground is not None:
        held += int(whole.ground.root_information.any(axis=2).sum())
    free = 2 * len(corners) + 6 * cameras - held
    return variance_factors(squared, 2 * (sum(costs) + of_cameras), free)


def scatter_by_marking(fits: Sequence[Fit], count: int) -> FloatArray:
    """Variance inflation (M, 4) of each corner's images, of ``count`` markings over the drive."""
    squared = np.zeros(4 * count)
    freedom = np.full(4 * count, -2.0)
    for fit in fits:
        squared += np.bincount(fit.corner, fit.mahalanobis2, minlength=4 * count)
        freedom += np.bincount(fit.corner, fit.freedom, minlength=4 * count)
    return scatter_of(squared.reshape(-1, 4), freedom.reshape(-1, 4))


class Passed(NamedTuple):
    """Names over the drive of the observations of a section and its neighbours that pass their gates."""

    accepted: IntArray
    used: IntArray


def final_of(
    section: Section,
    examined: Examined,
    names: Names,
    passed: Passed,
    told: Sequence[Told],
    joint: tuple[Part, Solution, float],
    scatter: FloatArray,
) -> FinalSolve:
    """A section's final solve as the joint one left it: the part's ``joint`` solution, at its chi-square.

    Corners that only other sections' images show are not in it.
    """
    inputs = examined.inputs
    sightings = inputs.optimiser.sightings
    settled = examined.settled
    observation = section.observation_names(sightings, settled)
    inlier = np.isin(observation, passed.accepted)
    usable = np.zeros_like(sightings.valid)
    usable[settled.row[inlier], settled.own_corner[inlier]] = True
    is_used = np.isin(observation, passed.used)
    bundle = _joint_bundle(section, examined, names, told, joint, is_used)
    return FinalSolve(
        bundle=bundle,
        ungated=settled,
        inlier=inlier,
        usable=usable,
        sightings=sightings,
        views=inputs.optimiser.views,
        cameras={name: section.drive.cameras[name] for name in sightings.cameras},
        initial_rig=inputs.optimiser.initial_rig,
        jitter_rad=section.drive.pose_noise.roll_pitch_rad,
        scatter=scatter,
    )


def _joint_bundle(
    section: Section,
    examined: Examined,
    names: Names,
    told: Sequence[Told],
    joint: tuple[Part, Solution, float],
    is_used: BoolArray,
) -> Bundle:
    """The bundle of the settled one's observations ``is_used`` (K,) that the joint solution places."""
    part, solution, chi2_per_dof = joint
    settled = examined.settled
    corner = names.corners(settled)
    place = np.searchsorted(part.corners, corner).clip(max=len(part.corners) - 1)
    chosen = np.flatnonzero(is_used & (part.corners[place] == corner))
    corner_index = np.full_like(settled.corner_index, -1)
    corner_index[settled.group[chosen], settled.corner[chosen]] = place[chosen]
    observation = section.observation_names(examined.inputs.optimiser.sightings, settled)[chosen]
    residual_px = np.zeros((len(chosen), 2))
    mahalanobis2 = np.zeros(len(chosen))
    map_from_vehicle = settled.rig.map_from_vehicle.copy()
    for of_section in told:
        rows, at = _common(observation, of_section.observation)
        residual_px[rows] = of_section.residual_px[at]
        mahalanobis2[rows] = of_section.mahalanobis2[at]
        frames, at = _common(section.frames, of_section.frame)
        map_from_vehicle[frames] = of_section.map_from_vehicle[at]
    cam_from_vehicle = settled.rig.cam_from_vehicle.copy()
    cam_from_vehicle[part.cameras] = solution.cam_from_vehicle
    rig = replace(settled.rig, cam_from_vehicle=cam_from_vehicle, map_from_vehicle=map_from_vehicle)
    if rig.read_out_s is not None:
        rig = replace(rig, read_out_s=solution.read_out_s)
    return Bundle(
        rig=rig,
        model=settled.model,
        problem=part.problem,
        solution=replace(
            solution,
            residual_px=residual_px,
            mahalanobis2=mahalanobis2,
            verdict=np.full(len(chosen), Verdict.ACCEPTED, dtype=np.int8),
            chi2_per_dof=chi2_per_dof,
        ),
        association=settled.association,
        row=settled.row[chosen],
        group=settled.group[chosen],
        corner=settled.corner[chosen],
        corner_index=corner_index,
        camera_index=settled.camera_index,
        frames=section.own_frames,
    )


def _common(names: IntArray, others: IntArray) -> tuple[IntArray, IntArray]:
    """Where names (N,) are among ``others`` (M,), ascending: their places in both."""
    if not len(others):
        none = np.zeros(0, dtype=np.int64)
        return none, none
    place = np.searchsorted(others, names).clip(max=len(others) - 1)
    rows = np.flatnonzero(others[place] == names)
    return rows, place[rows]
