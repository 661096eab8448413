"""From a checked problem to its :class:`~v2hdm.adjust.arrays.Arrays`, some rows at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, CameraQuadratic, Lengths
from v2hdm.adjust.engines.numba import available
from v2hdm.adjust.pose_prior import state_components, state_prior
from v2hdm.adjust.problem import Problem
from v2hdm.errors import AdjustError
from v2hdm.geometry.tensors import inverse
from v2hdm.records import BoolArray, FloatArray, IntArray

# Rows that are laid out at once.
_ROWS = 1 << 18
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

    corner_order, joined = _corners_in_route_order(problem)
    rank = np.empty_like(corner_order)
    rank[corner_order] = np.arange(len(corner_order))
    order, corner, pair = _sorted_observations(problem, rank)
    measured, root = _whitened(problem, order)
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
    count, lengths = problem.corner_count, problem.lengths
    first_frame = _first_frames(problem)
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
    unit_frame = np.full(unit.max() + 1, len(problem.map_from_vehicle))
    np.minimum.at(unit_frame, unit, first_frame)
    order = np.lexsort((first_frame, unit, unit_frame[unit]))
    return order, np.concatenate([[False], np.diff(unit[order]) == 0])


def _first_frames(problem: Problem) -> IntArray:
    """The first frame (N,) that saw each corner."""
    if available():
        from v2hdm.adjust.engines.numba.prepare import first_frames

        return first_frames(problem)
    out = np.full(problem.corner_count, len(problem.map_from_vehicle))
    np.minimum.at(out, problem.observations.corner, problem.observations.frame)
    return out


def _sorted_observations(
    problem: Problem, rank: IntArray
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Observations (K,) by corner, then camera, then frame; the corner and the pair of each."""
    if available():
        from v2hdm.adjust.engines.numba.prepare import sorted_observations

        order, corner, pair, again = sorted_observations(problem, rank)
        if again >= 0:
            _refuse_twice(problem, *sorted(order[again - 1 : again + 1].tolist()))
        return order, corner, pair
    seen = problem.observations
    pairs = len(problem.intrinsic) * len(problem.map_from_vehicle)
    key = rank[seen.corner]
    for size, number in ((len(problem.intrinsic), seen.camera), (len(problem.map_from_vehicle), seen.frame)):
        key *= size
        key += number
    # No two keys are equal, or it is an error: the order need not be stable.
    order = np.argsort(key).astype(np.int32)
    corner, pair = np.empty_like(order), np.empty_like(order)
    last = -1
    for begin in range(0, len(key), _ROWS):
        part = slice(begin, begin + _ROWS)
        keys = key[order[part]]
        same = np.flatnonzero(np.diff(keys, prepend=last) == 0)
        if len(same):
            _refuse_twice(problem, *sorted(order[begin + same[0] - 1 : begin + same[0] + 1].tolist()))
        last = keys[-1]
        corner[part], pair[part] = np.divmod(keys, pairs)
    return order, corner, pair


def _refuse_twice(problem: Problem, first: int, second: int) -> None:
    seen = problem.observations
    raise AdjustError(
        f"observations {first} and {second} are the same corner {seen.corner[first]} in frame "
        f"{seen.frame[first]} of camera {seen.camera[first]}: keep one of them"
    )


def _whitened(problem: Problem, order: NDArray[np.int32]) -> tuple[FloatArray, FloatArray]:
    """``measured`` (2, K) and ``root_information`` (3, K) of :class:`Arrays`."""
    if available():
        from v2hdm.adjust.engines.numba.prepare import whitened

        return whitened(problem, order)
    seen = problem.observations
    measured, root = np.empty((2, len(order))), np.empty((3, len(order)))
    for begin in range(0, len(order), _ROWS):
        part = slice(begin, begin + _ROWS)
        rows = order[part]
        intrinsic = problem.intrinsic[seen.camera[rows]]
        focal, principal = intrinsic[:, :2], intrinsic[:, 2:]
        measured[:, part] = ((seen.pinhole_px[rows] - principal) / focal).T
        root[:, part] = _root_information(seen.covariance_px[rows], focal)
    return measured, root


def _root_information(covariance_px: FloatArray, focal: FloatArray) -> FloatArray:
    """Inverse Cholesky factors (3, K) of covariances (K, 2, 2): a, b, c of :class:`Arrays`."""
    first = np.sqrt(covariance_px[:, 0, 0])
    below = covariance_px[:, 1, 0] / first
    last = np.sqrt(covariance_px[:, 1, 1] - below**2)
    return np.stack([focal[:, 0] / first, -below * focal[:, 0] / (first * last), focal[:, 1] / last])


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
