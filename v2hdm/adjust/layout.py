"""From a checked problem to its :class:`~v2hdm.adjust.arrays.Arrays`.

The origin is near the drive: in UTM coordinates a solver would lose seven digits to the distance of theirs.
The errors of the recorded poses become states of the frames, each expected from those of the frame before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, CameraQuadratic, Lengths
from v2hdm.adjust.problem import POSE_STATES, PoseSigma, Problem
from v2hdm.errors import AdjustError
from v2hdm.geometry.tensors import inverse
from v2hdm.records import BoolArray, FloatArray, IntArray

_NEAR_M = 10_000.0
"""Coordinates of this size are known to a picometre, and moving them would cost memory for nothing."""


def nearby_origin(problem: Problem) -> FloatArray:
    """A point (2,) of the map by the recorded poses: its origin, or their middle where that is far from it.

    It is in whole metres, so that shifts are exact.
    """
    position = problem.map_from_vehicle[:, :2, 3]
    middle = np.round((position.min(0) + position.max(0)) / 2)
    return np.asarray(middle if np.abs(middle).max() > _NEAR_M else np.zeros(2))


def shifted(problem: Problem, by_m: FloatArray) -> Problem:
    """``problem`` on a map whose points all are moved by ``by_m`` (2,)."""
    if not by_m.any():
        return problem
    poses = problem.map_from_vehicle.copy()
    poses[:, :2, 3] += by_m
    start, control = problem.corners_start, problem.control
    return replace(
        problem,
        map_from_vehicle=poses,
        corners_start=None if start is None else start + by_m,
        control=None if control is None else replace(control, points_map=control.points_map + by_m),
    )


MIN_STEP = 1e-4
"""Least step between frames, as a fraction of the distance over which a drift fades."""

# Below this share of an error its white part is rounding left over from the drift.
_MIN_WHITE_SHARE = 1e-3


@dataclass(frozen=True)
class StateComponent:
    """One state of a frame: the tangent's column, its sigma, and how far it fades (0: white)."""

    column: int
    sigma: float
    over_m: float


def state_components(
    pose_sigmas: Sequence[PoseSigma], pose_states: tuple[str, ...]
) -> list[list[StateComponent]]:
    """By visit the states of a frame: for each error its white part, then its drift, where there are any.

    All visits have the same columns. What only others have is rounding in a visit's own.
    """
    chosen = [k for k, name in enumerate(POSE_STATES) if name in pose_states]
    totals = [one.by_state() for one in pose_sigmas]
    drifts = [one.drift_by_state() for one in pose_sigmas]
    white = [
        {k: float(np.sqrt(max(total[k] ** 2 - drift[k].sigma ** 2, 0.0))) for k in chosen}
        for total, drift in zip(totals, drifts, strict=True)
    ]
    pairs = list(zip(totals, white, strict=True))
    scattering = [k for k in chosen if any(own[k] > _MIN_WHITE_SHARE * total[k] for total, own in pairs)]
    fading = [k for k in chosen if any(drift[k].sigma for drift in drifts)]
    return [
        [StateComponent(k, max(own[k], _MIN_WHITE_SHARE * total[k]), 0.0) for k in scattering]
        + [
            StateComponent(k, max(drift[k].sigma, _MIN_WHITE_SHARE * total[k]), drift[k].over_m)
            for k in fading
        ]
        for total, own, drift in zip(totals, white, drifts, strict=True)
    ]


def state_prior(
    map_from_vehicle: FloatArray, by_visit: Sequence[list[StateComponent]], visit: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Transition (J, S, S) and inverse sigma (J, S) of the innovation of each frame's states.

    ``by_visit`` are the components of each visit, ``visit`` (J,) is that of each frame; no state outlasts
    its visit. A drift is a first-order Gauss-Markov process along the driven distance d: memory
    m = exp(-d / over_m), innovation variance sigma^2 (1 - m^2) (Gelb, Applied Optimal Estimation, section
    3.8).
    """
    poses, components = map_from_vehicle, by_visit[0]
    if not components:
        return np.zeros((len(poses), 0, 0)), np.zeros((len(poses), 0))
    step_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turn = np.tile(np.eye(6), (max(len(poses) - 1, 0), 1, 1))
    turn[:, :2, :2] = poses[1:, :2, :2].transpose(0, 2, 1) @ poses[:-1, :2, :2]
    continued = np.diff(visit) == 0
    sigma = np.array([[one.sigma for one in states] for states in by_visit])[visit]
    over_m = np.array([[one.over_m for one in states] for states in by_visit])[visit]
    transition = np.zeros((len(poses), len(components), len(components)))
    information_root = np.empty((len(poses), len(components)))
    for a, state in enumerate(components):
        memory = np.zeros(len(poses))
        if state.over_m:
            # A vehicle at rest repeats its error; a floor on the step keeps the innovation's sigma above 0.
            memory[1:] = continued * np.exp(-np.maximum(step_m / over_m[1:, a], MIN_STEP))
            for b, before in enumerate(components):
                if before.over_m:
                    transition[1:, a, b] = memory[1:] * turn[:, state.column, before.column]
        information_root[:, a] = 1 / (sigma[:, a] * np.sqrt(1 - memory**2))
    return transition, information_root


# Corners that known lengths may join; time and memory grow with the square and the cube.
_MOST_JOINED = 256


def make_arrays(
    problem: Problem, pose_states: tuple[str, ...], device: str, clock_offset: bool = False
) -> Arrays:
    """Lay a checked problem out for the solver.

    Raises:
        AdjustError: two observations are the same corner in the same image, or known lengths join too
            many corners.
    """

    def real(values: FloatArray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float64, device=device)

    def index(values: NDArray[Any]) -> Tensor:
        return torch.as_tensor(values, device=device)

    from v2hdm.adjust.engines.numba.prepare import whitened  # loads numba

    corner_order, joined = _corners_in_route_order(problem)
    rank = np.empty_like(corner_order)
    rank[corner_order] = np.arange(len(corner_order))
    order, corner, pair = _sorted_observations(problem, rank)
    seen = problem.observations
    measured, root = whitened(order, seen.camera, seen.pinhole_px, seen.covariance_px, problem.intrinsic)
    components = state_components(problem.pose_sigmas, pose_states)
    transition, information_root = state_prior(problem.map_from_vehicle, components, problem.visit_of_frame)
    centre, centre_root = _centre_prior(problem)
    control, control_information = _control(problem)
    return Arrays(
        order=index(order),
        corner_order=index(corner_order),
        joined=index(joined),
        pair=index(pair),
        corner=index(corner),
        measured=real(measured),
        root_information=real(root),
        vehicle_from_map=inverse(real(problem.map_from_vehicle)),
        visit=index(np.asarray(problem.visit_of_frame, dtype=np.int64)),
        states=tuple(component.column for component in components[0]),
        centre=real(centre),
        centre_information_root=real(centre_root),
        state_transition=real(transition),
        state_information_root=real(information_root),
        clock_twist=real(_clock_twist(problem, clock_offset)),
        clock_information_root=1 / problem.clock_sigma_s,
        control=real(control[corner_order]),
        control_information=real(control_information[corner_order]),
        lengths=_lengths(problem, rank, device),
        camera_prior=None
        if problem.camera_prior is None
        else CameraQuadratic(*(real(values) for values in vars(problem.camera_prior).values())),
    )


def _corners_in_route_order(problem: Problem) -> tuple[IntArray, BoolArray]:
    """Corners (N,) by the frame that first saw them, and which (N,) are joined to the one before.

    Corners that known lengths join come side by side, where the first of them belongs.
    """
    from v2hdm.adjust.engines.numba.prepare import first_frames  # loads numba

    count, lengths = problem.corner_count, problem.lengths
    seen, frames = problem.observations, len(problem.map_from_vehicle)
    first_frame = first_frames(seen.corner, seen.frame, count, frames)
    if lengths is None or not len(lengths.first):
        return np.argsort(first_frame, kind="stable"), np.zeros(count, dtype=bool)
    edges = coo_matrix((np.ones(len(lengths.first)), (lengths.first, lengths.second)), shape=(count, count))
    _, unit = connected_components(edges, directed=False)
    largest = int(np.bincount(unit).max())
    if largest > _MOST_JOINED:
        raise AdjustError(
            f"known lengths join {largest} corners, which would be solved for as one block: state those "
            f"within a marking, at most {_MOST_JOINED} corners together"
        )
    unit_frame = np.full(unit.max() + 1, frames)
    np.minimum.at(unit_frame, unit, first_frame)
    order = np.lexsort((first_frame, unit, unit_frame[unit]))
    return order, np.concatenate([[False], np.diff(unit[order]) == 0])


def _sorted_observations(
    problem: Problem, rank: IntArray
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Observations (K,) by corner, then camera, then frame; the corner and the pair of each."""
    from v2hdm.adjust.engines.numba.prepare import sorted_observations  # loads numba

    seen, frames = problem.observations, len(problem.map_from_vehicle)
    order, corner, pair, again = sorted_observations(rank, seen.camera, seen.frame, seen.corner, frames)
    if again >= 0:
        _refuse_twice(problem, *sorted(order[again - 1 : again + 1].tolist()))
    return order, corner, pair


def _refuse_twice(problem: Problem, first: int, second: int) -> None:
    seen = problem.observations
    raise AdjustError(
        f"observations {first} and {second} are the same corner {seen.corner[first]} in frame "
        f"{seen.frame[first]} of camera {seen.camera[first]}: keep one of them"
    )


def _control(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Surveyed positions (N, 2) and 1 / sigma^2 (N, 2) of the problem's corners."""
    points, information = np.zeros((problem.corner_count, 2)), np.zeros((problem.corner_count, 2))
    if problem.control is not None:
        points[problem.control.corner] = problem.control.points_map
        information[problem.control.corner] = 1 / problem.control.sigma_m**2
    return points, information


def _lengths(problem: Problem, rank: IntArray, device: str) -> Lengths:
    """The known lengths between the corners as they are numbered here."""
    known = problem.lengths
    if known is None:
        nothing = torch.zeros(0, dtype=torch.float64, device=device)
        return Lengths(nothing.long(), nothing.long(), nothing, nothing)
    return Lengths(
        torch.as_tensor(rank[known.first], device=device),
        torch.as_tensor(rank[known.second], device=device),
        torch.as_tensor(known.length_m, dtype=torch.float64, device=device),
        torch.as_tensor(1 / known.sigma_m, dtype=torch.float64, device=device),
    )


def _clock_twist(problem: Problem, clock_offset: bool) -> FloatArray:
    """(J, 6, Q), Q visits if clock offsets are estimated: a frame moves with that of its own visit."""
    if not clock_offset or problem.twist_vehicle is None:
        return np.zeros((len(problem.map_from_vehicle), 6, 0))
    own = problem.visit_of_frame[:, None] == np.arange(problem.visit_count)
    return np.asarray(problem.twist_vehicle[:, :, None] * own[:, None])


def _centre_prior(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Prior centres and inverse sigmas (C, 3); without a survey the latter are 0."""
    if problem.centre_vehicle is None or problem.centre_sigma_m is None:
        nothing = np.zeros((len(problem.intrinsic), 3))
        return nothing, nothing
    return problem.centre_vehicle, 1 / problem.centre_sigma_m
