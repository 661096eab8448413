"""Rejects malformed problems, naming the offending item, before they can turn into NaN."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import torch

from v2hdm.adjust.kernels import NAMES
from v2hdm.adjust.problem import ENGINES, LOSSES, POSE_STATES, PoseSigma, Problem, SolveOptions
from v2hdm.doors import check_types
from v2hdm.errors import AdjustError, shown
from v2hdm.records import BoolArray, FloatArray, IntArray

_SYMMETRIC_TO = 1e-5  # asymmetry of a covariance, relative to its diagonal: that of float32
_ORTHONORMAL_TO = 1e-6  # largest entry of R R' - I of a rotation R
_MAX_SLOPE = 573.0  # tangent of the largest angle from a camera's axis to anything it sees: 89.9 degrees


def check_problem(problem: Problem) -> None:
    """Raise :class:`AdjustError` for an unsolvable problem, except for duplicate observations."""
    _check_arrays(problem)
    wrong = (problem.intrinsic[:, :2] <= 0).any(1)
    _refuse(wrong, "intrinsic of camera {} has a focal length that is not positive")
    _check_rigid("cam_from_vehicle", problem.cam_from_vehicle)
    _check_rigid("map_from_vehicle", problem.map_from_vehicle)
    check_observations(problem)
    _check_priors(problem)
    _check_control(problem)
    _check_lengths(problem)


def _refuse(wrong: BoolArray | np.bool_, said: str, *values: FloatArray | IntArray) -> None:
    """Raise for the first ``wrong`` item, if any, with its number and ``values`` filled in."""
    if wrong.any():
        k = int(np.argmax(wrong))
        raise AdjustError(said.format(k, *(column[k] for column in values)))


def _check_control(problem: Problem) -> None:
    control = problem.control
    if control is None:
        return
    count = len(control.corner)
    named = control.corner
    if np.shape(control.points_map) != (count, 2) or np.shape(control.sigma_m) != (count, 2):
        raise AdjustError(f"control points: {count} corners need as many points_map and sigma_m (x, y)")
    exists = (named >= 0) & (named < problem.corner_count)
    _refuse(~exists, "control point {} names corner {}, which does not exist", named)
    if len(np.unique(named)) < count:
        raise AdjustError("two control points name the same corner: keep one of them")
    sound = (np.isfinite(control.points_map) & (control.sigma_m > 0)).all(1)
    _refuse(~sound, "control point {} is not finite or its sigma_m is not above 0")


def _check_lengths(problem: Problem) -> None:
    lengths = problem.lengths
    if lengths is None:
        return
    count = len(lengths.first)
    length_m = lengths.length_m
    sigma_m = lengths.sigma_m
    if any(np.shape(values) != (count,) for values in (lengths.second, length_m, sigma_m)):
        raise AdjustError(f"known lengths: {count} first corners need as many second, length_m and sigma_m")
    ends = np.stack([lengths.first, lengths.second])
    first, second = ends
    exist = ((ends >= 0) & (ends < problem.corner_count)).all(0)
    _refuse(~exist, "known length {} names corners {} and {}; one does not exist", first, second)
    _refuse(first == second, "known length {} is from corner {} to itself", first)
    (low, high), times = np.unique(np.sort(ends, axis=0), axis=1, return_counts=True)
    _refuse(times > 1, "the distance of corners {1} and {2} is given twice: keep one of them", low, high)
    wrong = ~(np.isfinite(length_m) & (length_m > 0))
    _refuse(wrong, "known length {} is {:g} m: give one above 0", length_m)
    wrong = ~(np.isfinite(sigma_m) & (sigma_m > 0))
    _refuse(wrong, "sigma_m of known length {} is not above 0 and finite")


def check_model(problem: Problem, options: SolveOptions) -> None:
    """Raise :class:`AdjustError` where ``options`` need data that ``problem`` lacks."""
    if options.clock_offset and problem.twist_vehicle is None:
        raise AdjustError("a clock offset needs twist_vehicle: give the vehicle's motion at each frame")
    if options.read_out or problem.read_out_s is not None:
        needed = {"twist_vehicle": problem.twist_vehicle, "row_share": problem.observations.row_share}
        for name, values in needed.items():
            if values is None:
                raise AdjustError(f"a read-out time needs {name}: leave out read_out_s, or give it")


def check_options(options: SolveOptions) -> None:
    """Raise :class:`AdjustError` for an option out of range."""
    try:
        _check_values(*vars(options).values())
    except TypeError:  # a value without a hash
        _check_options(options)


@lru_cache(maxsize=64, typed=True)
def _check_values(*values: Any) -> None:
    """Check options by their values, sound ones once."""
    _check_options(SolveOptions(**dict(zip(vars(SolveOptions()), values, strict=True))))


def _check_options(options: SolveOptions) -> None:
    check_types(options)
    unknown = [name for name in options.pose_states if name not in POSE_STATES]
    if unknown:
        raise AdjustError(f"unknown pose state {shown(unknown[0])}: choose from {', '.join(POSE_STATES)}")
    for name, choices in (("loss", LOSSES), ("engine", ENGINES)):
        chosen = getattr(options, name)
        if chosen not in choices and not (name == "engine" and chosen in NAMES):
            raise AdjustError(f"unknown {name} {shown(chosen)}: choose from {', '.join(choices)}")
    try:
        torch.empty(0, device=options.device)
    except (RuntimeError, AssertionError) as failure:
        reason = str(failure).splitlines()[0]
        raise AdjustError(f"device is {shown(options.device)}, which torch cannot use: {reason}") from None
    if options.engine in NAMES and not options.on_cpu:
        raise AdjustError(f"engine={options.engine} computes on the CPU: choose engine=torch, or device=cpu")
    if not 0 < options.gate_probability < 1:
        raise AdjustError(f"gate_probability is {options.gate_probability}: give a fraction between 0 and 1")
    for name in ("gap_tolerance", "max_refreshes", "max_evaluations"):
        if not getattr(options, name) > 0:
            raise AdjustError(f"{name} is {getattr(options, name)}: give a number above 0")
    if not options.loss_scale > 0:
        raise AdjustError(f"loss_scale is {options.loss_scale}: give a number of standard deviations above 0")


_ARRAYS: Mapping[str, Mapping[str, tuple[int, ...]]] = {
    "camera": {
        "intrinsic": (4,), "cam_from_vehicle": (4, 4), "centre_vehicle": (3,), "centre_sigma_m": (3,),
        "read_out_s": (),
    },
    "frame": {"map_from_vehicle": (4, 4), "poses_start": (4, 4), "twist_vehicle": (6,)},
    "corner": {"corners_start": (2,)},
    "observation": {
        "camera": (), "frame": (), "corner": (), "pinhole_px": (2,), "covariance_px": (2, 2), "row_share": (),
    },
}  # fmt: skip
"""Shapes of a problem's arrays, per item."""


def _check_arrays(problem: Problem) -> None:
    """Check types, shapes and finiteness, except that of centre sigmas and observations."""
    observations = problem.observations
    if len(observations.camera) == 0:
        raise AdjustError("there are no observations to adjust: detect and associate markings first")
    indices = _sizes(problem)
    sizes = indices | {"observation": len(observations.camera)}
    for of, arrays in _ARRAYS.items():
        owner, prefix = (observations, "observations.") if of == "observation" else (problem, "")
        for name, item_shape in arrays.items():
            values = getattr(owner, name)
            shape = (sizes[of], *item_shape)
            if values is None:
                continue
            if not isinstance(values, np.ndarray):
                raise AdjustError(f"{prefix}{name} is a {type(values).__name__}: give a numpy array")
            if values.shape != shape:
                raise AdjustError(f"{prefix}{name} has shape {values.shape}, expected {shape}")
            if name in indices and values.dtype.kind not in "iu":
                raise AdjustError(f"{prefix}{name} holds {values.dtype}: give whole numbers")
            if name in indices or name in ("centre_sigma_m", "pinhole_px", "covariance_px"):
                continue
            if not _has_finite_sum(values):
                finite = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
                _refuse(~finite, f"{name} of {of} {{}} is not finite: remove it or fix its source")


def _has_finite_sum(values: FloatArray) -> bool:
    """Whether a sum, which is finite only if all of its terms are, is: cheaper than looking at each."""
    with np.errstate(invalid="ignore", over="ignore"):
        return math.isfinite(np.add.reduce(values, axis=None))


def _check_rigid(name: str, transforms: FloatArray) -> None:
    from v2hdm.adjust.kernels.layout import first_not_rigid

    k = first_not_rigid(np.ascontiguousarray(transforms, dtype=np.float64), _ORTHONORMAL_TO)
    if k >= 0:
        is_closed = (transforms[k, 3] == [0, 0, 0, 1]).all()
        wrong = "rotation is not orthonormal" if is_closed else "last row is not 0, 0, 0, 1"
        raise AdjustError(f"{name} {k} is not a rigid transform: its {wrong}")


def check_observations(problem: Problem) -> None:
    """Raise :class:`AdjustError` for the first unusable observation."""
    from v2hdm.adjust.kernels.layout import Seen, first_unsound

    by_corner = np.zeros(problem.corner_count, dtype=np.int64)
    by_camera = np.zeros(len(problem.intrinsic), dtype=np.int64)
    columns = Seen.of(problem.observations.columns, problem.intrinsic)
    frame_count = len(problem.map_from_vehicle)
    k = first_unsound(columns, frame_count, _SYMMETRIC_TO, _MAX_SLOPE, by_corner, by_camera)
    if k >= 0:
        raise AdjustError(_fault(problem, k))
    for name, times in (("corner", by_corner), ("camera", by_camera)):
        if not times.all():
            raise AdjustError(f"{name} {times.argmin()} has no observation: leave it out of the problem")


def _fault(problem: Problem, k: int) -> str:
    """The message for the unsound observation k."""
    observations = problem.observations
    for name, size in _sizes(problem).items():
        index = getattr(observations, name)[k]
        if not 0 <= index < size:
            return f"observation {k} names {name} {index}, but there are only {size}"
    for name in ("pinhole_px", "covariance_px"):
        if not np.isfinite(getattr(observations, name)[k]).all():
            return f"{name} of observation {k} is not finite: remove it or fix its source"
    (xx, xy), (yx, yy) = observations.covariance_px[k].astype(np.float64)
    intrinsic = problem.intrinsic[observations.camera[k]]
    aside = np.abs((observations.pinhole_px[k] - intrinsic[2:]) / intrinsic[:2]).max()
    if aside > _MAX_SLOPE:
        return (
            f"pinhole_px of observation {k} lies {aside:.3g} focal lengths "
            "from the principal point, where no camera looks: leave it out"
        )
    if xx > 0 and xx * yy > yx**2 and abs(xy - yx) > _SYMMETRIC_TO * np.sqrt(xx * yy):
        return f"covariance_px of observation {k} is not symmetric"
    return f"covariance_px of observation {k} is not positive definite"


def _sizes(problem: Problem) -> dict[str, int]:
    """Number of each thing that an observation refers to."""
    frames = len(problem.map_from_vehicle)
    return {"camera": len(problem.intrinsic), "frame": frames, "corner": problem.corner_count}


def _check_priors(problem: Problem) -> None:
    if (problem.centre_vehicle is None) != (problem.centre_sigma_m is None):
        raise AdjustError("centre_vehicle and centre_sigma_m belong together: give both or neither")
    if problem.centre_sigma_m is not None:
        wrong = ~(problem.centre_sigma_m > 0).all(1)
        _refuse(wrong, "centre_sigma_m of camera {} must be above 0 (inf where nothing is known)")
    if problem.ground is not None:
        shapes = {"plane_cam": (4,), "root_information": (3, 4), "by_lens": (2, 4)}
        for name, of_camera in shapes.items():
            values = getattr(problem.ground, name)
            shape = (len(problem.intrinsic), *of_camera)
            if values.shape != shape:
                raise AdjustError(f"ground.{name} has shape {values.shape}, expected {shape}")
            finite = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
            _refuse(~finite, f"ground.{name} of camera {{}} is not finite: leave that camera's ground out")
    if not problem.clock_sigma_s > 0:
        raise AdjustError(f"clock_sigma_s is {problem.clock_sigma_s}: give a number of seconds above 0")
    if not problem.read_out_sigma_s > 0:
        raise AdjustError(f"read_out_sigma_s is {problem.read_out_sigma_s}: give a number of seconds above 0")
    if problem.read_out_s is not None:
        said = "read_out_s of camera {} is {} s: give 0 (all rows at once) or more"
        _refuse(problem.read_out_s < 0, said, problem.read_out_s)
    if problem.session is None and isinstance(problem.pose_sigma, PoseSigma):
        _check_pose_sigma(problem.pose_sigma)
        return
    _check_sessions(problem)
    for pose_sigma in problem.pose_sigmas:
        _check_pose_sigma(pose_sigma)


@lru_cache(maxsize=64)
def _check_pose_sigma(pose_sigma: PoseSigma) -> None:
    sigma = pose_sigma.by_state()
    if not (np.isfinite(sigma).all() and (sigma > 0).all()):
        raise AdjustError(f"pose_sigma must be above 0 and finite: {pose_sigma}")
    for total, drift in zip(sigma, pose_sigma.drift_by_state(), strict=True):
        if not (0 <= drift.sigma <= total and drift.over_m > 0):
            raise AdjustError(f"{drift} must be part of its pose_sigma {total:g} and fade over a distance")


def _check_sessions(problem: Problem) -> None:
    session = problem.session_of_frame
    if session.shape != (len(problem.map_from_vehicle),) or (np.diff(session, prepend=0) < 0).any():
        raise AdjustError("session must number each frame's session, from 0 and rising along the frames")
    if session.max(initial=0) >= len(problem.pose_sigmas):
        raise AdjustError(
            f"session {session.max()} has no pose_sigma: give one for all sessions, or one for each"
        )
