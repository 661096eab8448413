"""Refuses malformed problems, naming the offending item, before they can turn into NaN."""

from __future__ import annotations

import numpy as np

from v2hdm.adjust.problem import ENGINES, LOSSES, POSE_STATES, SOLVERS, Problem, SolveOptions
from v2hdm.errors import AdjustError
from v2hdm.records import FloatArray, IntArray

# Observations that are checked at once.
_ROWS = 1 << 18
# How symmetric a covariance must be, as a share of its diagonal: float32 is.
_SYMMETRIC_TO = 1e-5
# Tangent of the angle from a camera's axis beyond which nothing is seen on its plane: 89.9 degrees.
_MAX_SLOPE = 573.0


def check_problem(problem: Problem) -> None:
    """Raise :class:`AdjustError` for the first thing in ``problem`` that cannot be solved with.

    Except observations that are there twice: :func:`v2hdm.adjust.layout.make_arrays` finds them as it sorts.
    """
    _check_shapes(problem)
    sound = _observations_are_sound(problem)
    if not sound:
        _check_indices(problem)
    _check_finite(problem, observations_too=not sound)
    _check_rigid("cam_from_vehicle", problem.cam_from_vehicle)
    _check_rigid("map_from_vehicle", problem.map_from_vehicle)
    if not sound:
        _check_observations(problem)
    _check_priors(problem)
    _check_control(problem)
    _check_lengths(problem)


def _observations_are_sound(problem: Problem) -> bool:
    """Whether one compiled pass finds no fault in any observation."""
    from v2hdm.adjust.engines.numba.prepare import are_sound  # loads numba

    seen = problem.observations
    return are_sound(
        *(seen.camera, seen.frame, seen.corner),
        *(seen.pinhole_px, seen.covariance_px, problem.intrinsic),
        frames=len(problem.map_from_vehicle),
        corners=problem.corner_count,
        symmetric_to=_SYMMETRIC_TO,
        max_slope=_MAX_SLOPE,
    )


def _check_control(problem: Problem) -> None:
    control = problem.control
    if control is None:
        return
    count = len(control.corner)
    if np.shape(control.points_map) != (count, 2) or np.shape(control.sigma_m) != (count, 2):
        raise AdjustError(f"control points: {count} corners need as many points_map and sigma_m (x, y)")
    wrong = np.flatnonzero((control.corner < 0) | (control.corner >= problem.corner_count))
    if len(wrong):
        raise AdjustError(
            f"control point {wrong[0]} names corner {control.corner[wrong[0]]}, which is not there"
        )
    if len(np.unique(control.corner)) < count:
        raise AdjustError("two control points name the same corner: keep one of them")
    wrong = np.flatnonzero(~(np.isfinite(control.points_map) & (control.sigma_m > 0)).all(1))
    if len(wrong):
        raise AdjustError(f"control point {wrong[0]} is not finite or its sigma_m is not above 0")


def _check_lengths(problem: Problem) -> None:
    known = problem.lengths
    if known is None:
        return
    count = len(known.first)
    if any(np.shape(values) != (count,) for values in (known.second, known.length_m, known.sigma_m)):
        raise AdjustError(f"known lengths: {count} first corners need as many second, length_m and sigma_m")
    ends = np.stack([known.first, known.second])
    wrong = np.flatnonzero(((ends < 0) | (ends >= problem.corner_count)).any(0))
    if len(wrong):
        first, second = ends[:, wrong[0]]
        raise AdjustError(f"known length {wrong[0]} names corners {first} and {second}; one is not there")
    wrong = np.flatnonzero(ends[0] == ends[1])
    if len(wrong):
        raise AdjustError(f"known length {wrong[0]} is from corner {ends[0, wrong[0]]} to itself")
    _, index, times = np.unique(np.sort(ends, axis=0), axis=1, return_index=True, return_counts=True)
    if (times > 1).any():
        first, second = ends[:, index[np.argmax(times > 1)]]
        raise AdjustError(f"the distance of corners {first} and {second} is given twice: keep one of them")
    wrong = np.flatnonzero(~(np.isfinite(known.length_m) & (known.length_m > 0)))
    if len(wrong):
        raise AdjustError(f"known length {wrong[0]} is {known.length_m[wrong[0]]:g} m: give one above 0")
    wrong = np.flatnonzero(~(np.isfinite(known.sigma_m) & (known.sigma_m > 0)))
    if len(wrong):
        raise AdjustError(f"sigma_m of known length {wrong[0]} is not above 0 and finite")


def check_model(problem: Problem, options: SolveOptions) -> None:
    """Raise :class:`AdjustError` where ``options`` ask for more than ``problem`` says."""
    prior, each = problem.camera_prior, 6 + problem.visit_count * int(options.clock_offset)
    if prior is not None:
        size = len(problem.intrinsic) * each
        for name, values, shape in (
            ("base", prior.base, problem.cam_from_vehicle.shape),
            ("mean", prior.mean, (len(problem.intrinsic), each)),
            ("information", prior.information, (size, size)),
        ):
            if np.shape(values) != shape or not np.isfinite(values).all():
                raise AdjustError(f"camera_prior.{name} must hold finite numbers in the shape {shape}")
    if options.clock_offset and problem.twist_vehicle is None:
        raise AdjustError("a clock offset needs twist_vehicle: say how the vehicle moves at each frame")


def check_options(options: SolveOptions) -> None:
    """Raise :class:`AdjustError` for an option out of range."""
    unknown = [name for name in options.pose_states if name not in POSE_STATES]
    if unknown:
        raise AdjustError(f"unknown pose state '{unknown[0]}': choose from {', '.join(POSE_STATES)}")
    for name, choices in (("loss", LOSSES), ("solver", SOLVERS), ("engine", ENGINES)):
        if getattr(options, name) not in choices:
            chosen = getattr(options, name)
            raise AdjustError(f"unknown {name} '{chosen}': choose from {', '.join(choices)}")
    if options.engine == "numba" and not options.on_cpu:
        raise AdjustError("engine=numba computes on the CPU: choose engine=torch, or device=cpu")
    if not 0 < options.gate_probability < 1:
        raise AdjustError(f"gate_probability is {options.gate_probability}: give a share between 0 and 1")
    for name in ("gap_tolerance", "max_refreshes", "max_evaluations"):
        if not getattr(options, name) > 0:
            raise AdjustError(f"{name} is {getattr(options, name)}: give a number above 0")
    if not options.loss_scale > 0:
        raise AdjustError(f"loss_scale is {options.loss_scale}: give a number of standard deviations above 0")


def _check_shapes(problem: Problem) -> None:
    cameras, frames = len(problem.intrinsic), len(problem.map_from_vehicle)
    seen = problem.observations
    count = len(seen.camera)
    expected: list[tuple[str, FloatArray | IntArray | None, tuple[int, ...]]] = [
        ("intrinsic", problem.intrinsic, (cameras, 4)),
        ("cam_from_vehicle", problem.cam_from_vehicle, (cameras, 4, 4)),
        ("map_from_vehicle", problem.map_from_vehicle, (frames, 4, 4)),
        ("centre_vehicle", problem.centre_vehicle, (cameras, 3)),
        ("centre_sigma_m", problem.centre_sigma_m, (cameras, 3)),
        ("corners_start", problem.corners_start, (problem.corner_count, 2)),
        ("twist_vehicle", problem.twist_vehicle, (frames, 6)),
        ("observations.camera", seen.camera, (count,)),
        ("observations.frame", seen.frame, (count,)),
        ("observations.corner", seen.corner, (count,)),
        ("observations.pinhole_px", seen.pinhole_px, (count, 2)),
        ("observations.covariance_px", seen.covariance_px, (count, 2, 2)),
    ]
    for name, values, shape in expected:
        if values is not None and not isinstance(values, np.ndarray):
            raise AdjustError(f"{name} is a {type(values).__name__}: give a numpy array")
        if values is not None and np.shape(values) != shape:
            raise AdjustError(f"{name} has shape {np.shape(values)}, expected {shape}")
    if count == 0:
        raise AdjustError("there is no observation to adjust: detect and associate markings first")
    for name in ("camera", "frame", "corner"):
        kind = getattr(seen, name).dtype
        if not np.issubdtype(kind, np.integer):
            raise AdjustError(f"observations.{name} holds {kind}: give whole numbers")


def _check_indices(problem: Problem) -> None:
    seen = problem.observations
    for name, index, size in (
        ("camera", seen.camera, len(problem.intrinsic)),
        ("frame", seen.frame, len(problem.map_from_vehicle)),
        ("corner", seen.corner, problem.corner_count),
    ):
        wrong = np.flatnonzero((index < 0) | (index >= size))
        if len(wrong):
            raise AdjustError(
                f"observation {wrong[0]} names {name} {index[wrong[0]]}, but there are only {size}"
            )


def _check_finite(problem: Problem, observations_too: bool) -> None:
    seen = problem.observations
    named = {
        "intrinsic of camera": problem.intrinsic,
        "cam_from_vehicle of camera": problem.cam_from_vehicle,
        "map_from_vehicle of frame": problem.map_from_vehicle,
        "pinhole_px of observation": seen.pinhole_px if observations_too else None,
        "covariance_px of observation": seen.covariance_px if observations_too else None,
        "centre_vehicle of camera": problem.centre_vehicle,
        "corners_start of corner": problem.corners_start,
        "twist_vehicle of frame": problem.twist_vehicle,
    }
    for name, values in named.items():
        if values is None:
            continue
        wrong = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(1))
        if len(wrong):
            raise AdjustError(f"{name} {wrong[0]} is not finite: remove it or correct its source")
    if np.any(problem.intrinsic[:, :2] <= 0):
        camera = int(np.flatnonzero((problem.intrinsic[:, :2] <= 0).any(1))[0])
        raise AdjustError(f"intrinsic of camera {camera} has a focal length that is not positive")


def _check_rigid(name: str, transforms: FloatArray) -> None:
    rotation = transforms[:, :3, :3]
    off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0.0)
    wrong = np.flatnonzero((off > 1e-6) | (np.linalg.det(rotation) < 0))
    if len(wrong):
        raise AdjustError(f"{name} {wrong[0]} is no rigid transform: its rotation is not orthonormal")
    wrong = np.flatnonzero((transforms[:, 3] != [0, 0, 0, 1]).any(1))
    if len(wrong):
        raise AdjustError(f"{name} {wrong[0]} is no rigid transform: its last row is not 0, 0, 0, 1")


def _check_observations(problem: Problem) -> None:
    seen = problem.observations
    for name, index, size in (
        ("corner", seen.corner, problem.corner_count),
        ("camera", seen.camera, len(problem.intrinsic)),
    ):
        unseen = np.flatnonzero(np.bincount(index, minlength=size) == 0)
        if len(unseen):
            raise AdjustError(f"{name} {unseen[0]} has no observation: leave it out of the problem")
    for begin in range(0, len(seen.corner), _ROWS):
        part = slice(begin, begin + _ROWS)
        covariance = seen.covariance_px[part]
        own, across = np.diagonal(covariance, axis1=1, axis2=2), covariance[:, 1, 0]
        wrong = np.flatnonzero(~((own[:, 0] > 0) & (own.prod(axis=1) > across**2)))
        if len(wrong):
            raise AdjustError(f"covariance_px of observation {begin + wrong[0]} is not positive definite")
        uneven = np.abs(covariance[:, 0, 1] - across)
        wrong = np.flatnonzero(uneven > _SYMMETRIC_TO * np.sqrt(own.prod(axis=1)))
        if len(wrong):
            raise AdjustError(f"covariance_px of observation {begin + wrong[0]} is not symmetric")
        intrinsic = problem.intrinsic[seen.camera[part]]
        aside = np.abs((seen.pinhole_px[part] - intrinsic[:, 2:]) / intrinsic[:, :2]).max(axis=1)
        wrong = np.flatnonzero(aside > _MAX_SLOPE)
        if len(wrong):
            raise AdjustError(
                f"pinhole_px of observation {begin + wrong[0]} lies {aside[wrong[0]]:.3g} focal lengths "
                "from the principal point, where no camera looks: leave it out"
            )


def _check_priors(problem: Problem) -> None:
    if (problem.centre_vehicle is None) != (problem.centre_sigma_m is None):
        raise AdjustError("centre_vehicle and centre_sigma_m belong together: give both or neither")
    if problem.centre_sigma_m is not None and not np.all(problem.centre_sigma_m > 0):
        camera = int(np.flatnonzero(~(problem.centre_sigma_m > 0).all(1))[0])
        raise AdjustError(f"centre_sigma_m of camera {camera} must be above 0 (inf where nothing is known)")
    if not problem.clock_sigma_s > 0:
        raise AdjustError(f"clock_sigma_s is {problem.clock_sigma_s}: give a number of seconds above 0")
    _check_visits(problem)
    for one in problem.pose_sigmas:
        sigma = one.by_state()
        if not (np.isfinite(sigma).all() and (sigma > 0).all()):
            raise AdjustError(f"pose_sigma must be above 0 and finite: {one}")
        for total, drift in zip(sigma, one.drift_by_state(), strict=True):
            if not (0 <= drift.sigma <= total and drift.over_m > 0):
                raise AdjustError(
                    f"{drift} must be part of its pose_sigma {total:g} and fade over a distance"
                )


def _check_visits(problem: Problem) -> None:
    visit = problem.visit_of_frame
    if visit.shape != (len(problem.map_from_vehicle),) or (np.diff(visit, prepend=0) < 0).any():
        raise AdjustError("visit must number each frame's visit, from 0 and rising along the frames")
    if visit.max(initial=0) >= len(problem.pose_sigmas):
        raise AdjustError(
            f"visit {visit.max()} has no pose_sigma: give one for all visits, or one for each of them"
        )
