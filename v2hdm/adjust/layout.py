"""From a checked problem to its :class:`~v2hdm.adjust.arrays.Arrays`.

The origin is moved near the drive: UTM coordinates would cost seven digits. Errors of recorded poses become
states of the frames, each predicted from the frame before.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, Lengths
from v2hdm.adjust.problem import LINE_EXCESS, POSE_STATES, GroundPlanes, KnownLengths, Problem
from v2hdm.errors import AdjustError
from v2hdm.geometry.rigid import inverse
from v2hdm.records import BoolArray, FloatArray, IntArray

_NEAR_M = 10_000.0  # coordinates up to this are exact to a picometre; moving them would only cost memory


def nearby_origin(problem: Problem) -> FloatArray:
    """A point (2,) in whole metres near the recorded poses: the origin, or their centre if that is far."""
    position = problem.map_from_vehicle[:, :2, 3]
    middle = np.round((np.minimum.reduce(position) + np.maximum.reduce(position)) / 2)
    is_far = max(map(abs, middle.tolist())) > _NEAR_M
    return np.asarray(middle if is_far else np.zeros(2))


def shifted(problem: Problem, by_m: FloatArray) -> Problem:
    """``problem`` on a map with all points moved by ``by_m`` (2,)."""
    if not by_m.any():
        return problem
    moves = np.eye(4)
    moves[:2, 3] = by_m
    poses_start = problem.poses_start
    start = problem.corners_start
    control = problem.control
    return replace(
        problem,
        map_from_vehicle=moves @ problem.map_from_vehicle,
        poses_start=None if poses_start is None else moves @ poses_start,
        corners_start=None if start is None else start + by_m,
        control=None if control is None else replace(control, points_map=control.points_map + by_m),
    )


MIN_STEP = 1e-4  # least step between frames, as a fraction of a drift's correlation length
_MIN_WHITE_SHARE = 1e-3  # a smaller white fraction of an error is rounding of the drift


class StatePrior(NamedTuple):
    """The prior of the frames' S states."""

    columns: IntArray  # (S,) the tangent's column of each
    transition: FloatArray  # (J, S, S) from the frame before
    information_root: FloatArray  # (J, S) inverse sigma of the innovation


def state_prior(problem: Problem, pose_states: tuple[str, ...]) -> StatePrior:
    """The prior of a frame's states: of each error the white part, then the drift, where present.

    They are common to all sessions, and independent between them. A drift is a first-order Gauss-Markov
    process along the driven distance d: memory m = exp(-d / over_m), innovation variance sigma^2 (1 - m^2)
    (Gelb, Applied Optimal Estimation, section 3.8).
    """
    poses = problem.map_from_vehicle
    chosen = [k for k, name in enumerate(POSE_STATES) if name in pose_states]
    if not chosen:
        no_columns = np.zeros(0, dtype=np.int64)
        return StatePrior(no_columns, np.zeros((len(poses), 0, 0)), np.zeros((len(poses), 0)))
    session = problem.session_of_frame
    total = np.array([sigma.by_state() for sigma in problem.pose_sigmas])
    drifts = [[(d.sigma, d.over_m) for d in sigma.drift_by_state()] for sigma in problem.pose_sigmas]
    drift, over_m = np.array(drifts).transpose(2, 0, 1)
    white = np.sqrt(np.maximum(total**2 - drift**2, 0.0))
    least = _MIN_WHITE_SHARE * total
    scattering = [k for k in chosen if (white > least)[:, k].any()]
    fading = [k for k in chosen if drift[:, k].any()]
    columns = np.array(scattering + fading, dtype=np.int64)
    sigma = np.hstack([np.maximum(white, least)[:, scattering], np.maximum(drift, least)[:, fading]])
    step_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    memory = np.zeros((len(poses), len(columns)))
    fades = np.arange(len(columns)) >= len(scattering)
    # A standing vehicle repeats its error; a floor on the step keeps the innovation's sigma above 0.
    faded = np.exp(-np.maximum(step_m[:, None] / over_m[session][1:, fading], MIN_STEP))
    memory[1:, fades] = (np.diff(session) == 0)[:, None] * faded
    turn = np.tile(np.eye(6), (max(len(poses) - 1, 0), 1, 1))
    turn[:, :2, :2] = poses[1:, :2, :2].transpose(0, 2, 1) @ poses[:-1, :2, :2]
    transition = np.zeros((len(poses), len(columns), len(columns)))
    transition[1:] = memory[1:, :, None] * turn[:, columns][:, :, columns] * fades
    return StatePrior(columns, transition, 1 / (sigma[session] * np.sqrt(1 - memory**2)))


_MOST_JOINED = 256  # most corners joined by known lengths: time grows with the cube, memory the square


def make_arrays(
    problem: Problem,
    pose_states: tuple[str, ...],
    device: str,
    clock_offset: bool = False,
    read_out: bool = False,
) -> Arrays:
    """Lay out a checked problem; AdjustError for a corner twice in an image, or too many joined corners."""
    is_on_cpu = device == "cpu"

    def index(values: NDArray[Any]) -> Tensor:
        tensor = torch.from_numpy(values)
        return tensor if is_on_cpu else tensor.to(device)

    def real(values: FloatArray) -> Tensor:
        return index(np.ascontiguousarray(values, dtype=np.float64))

    corner_order, joined = _corners_in_route_order(problem)
    rank = np.empty_like(corner_order)
    rank[corner_order] = np.arange(len(corner_order))
    observations = _sorted_observations(problem, rank)
    prior = state_prior(problem, pose_states)
    surveys = _surveys(problem)
    lengths = _lengths(problem)
    first_rank = rank[lengths.first]
    second_rank = rank[lengths.second]
    timing = _timing(problem, observations, clock_offset, read_out)
    return Arrays(
        order=index(observations.order),
        corner_order=index(corner_order),
        joined=index(joined),
        pair=index(timing.pair),
        corner=index(observations.corner),
        measured=real(observations.measured),
        root_information=real(observations.root_information),
        has_lines=observations.has_lines,
        vehicle_from_map=real(inverse(problem.map_from_vehicle)),
        session=index(np.asarray(problem.session_of_frame, dtype=np.int64)),
        states=tuple(prior.columns.tolist()),
        centre=real(surveys.centre),
        centre_information_root=real(surveys.centre_root),
        ground_plane=real(surveys.ground.plane_cam),
        ground_root=real(surveys.ground.root_information),
        state_transition=real(prior.transition),
        state_information_root=real(prior.information_root),
        clock_twist=real(timing.clock_twist),
        clock_information_root=real(1 / np.array(timing.sigma_s, dtype=np.float64)),
        control=real(surveys.control[corner_order]),
        control_root=real(surveys.control_root[corner_order]),
        lengths=Lengths(
            index(first_rank), index(second_rank), real(lengths.length_m), real(1 / lengths.sigma_m)
        ),
        frame_of_moment=None if timing.frame_of_moment is None else index(timing.frame_of_moment),
        read_out=None if timing.read_out is None else real(timing.read_out),
    )


class _Surveys(NamedTuple):
    """Surveyed centres and corners, and planes of the ground; root information is 0 where there is none."""

    centre: FloatArray  # (C, 3)
    centre_root: FloatArray  # (C, 3) root information
    control: FloatArray  # (N, 2)
    control_root: FloatArray  # (N, 3) root information
    ground: GroundPlanes  # of each camera


def _surveys(problem: Problem) -> _Surveys:
    """The surveys of each camera and each corner."""
    centre, centre_root = np.zeros((2, len(problem.intrinsic), 3))
    if problem.centre_vehicle is not None and problem.centre_sigma_m is not None:
        centre = problem.centre_vehicle
        centre_root = 1 / problem.centre_sigma_m
    control = np.zeros((problem.corner_count, 2))
    control_root = np.zeros((problem.corner_count, 3))
    if problem.control is not None:
        control[problem.control.corner] = problem.control.points_map
        control_root[problem.control.corner] = problem.control.root_information
    count = len(problem.intrinsic)
    none = GroundPlanes(np.zeros((count, 4)), np.zeros((count, 3, 4)), np.zeros((count, 2, 4)))
    return _Surveys(centre, centre_root, control, control_root, problem.ground or none)


def _lengths(problem: Problem) -> KnownLengths:
    """The known lengths; empty where there are none."""
    none = np.zeros(0)
    return problem.lengths or KnownLengths(none.astype(np.int64), none.astype(np.int64), none, none)


def _corners_in_route_order(problem: Problem) -> tuple[IntArray, BoolArray]:
    """Corners (N,) by first frame, joined ones contiguous, and whether (N,) each is joined to the last."""
    count = problem.corner_count
    lengths = problem.lengths
    frames = len(problem.map_from_vehicle)
    first_frame = np.full(count, frames)
    np.minimum.at(first_frame, problem.observations.corner, problem.observations.frame)
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


class _Sorted(NamedTuple):
    """Observations by corner, camera and frame."""

    order: NDArray[np.int32]  # (K,) their indices in the problem
    corner: NDArray[np.int32]  # (K,) rank of each one's corner
    pair: NDArray[np.int32]  # (K,) its camera and frame
    measured: FloatArray  # (2, K)
    root_information: FloatArray  # (3, K)
    has_lines: bool


def _sorted_observations(problem: Problem, rank: IntArray) -> _Sorted:
    """The observations in order; raises AdjustError if one image observes a corner twice."""
    from v2hdm.adjust.kernels.layout import Seen, arrange, lay_out

    columns = Seen.of(problem.observations.columns, problem.intrinsic)
    count = len(problem.observations.corner)
    frames = len(problem.map_from_vehicle)
    order = np.empty(count, dtype=np.int32)
    corner = np.empty_like(order)
    pair = np.empty_like(order)
    corner_at = np.zeros(len(rank) + 1, dtype=np.int64)
    repeated = arrange(columns, rank, frames, corner_at, order, corner, pair)
    if repeated >= 0:
        first, second = order[repeated - 1 : repeated + 1].tolist()
        raise AdjustError(
            f"observations {first} and {second} are the same corner {columns.corner[first]} in frame "
            f"{columns.frame[first]} of camera {columns.camera[first]}: keep one of them"
        )
    measured = np.empty((2, count))
    root = np.empty((3, count))
    lines = lay_out(columns, order, pair, frames, LINE_EXCESS, measured, root)
    return _Sorted(order, corner, pair, measured, root, lines > 0)


def _clock_twist(problem: Problem, clock_offset: bool) -> tuple[FloatArray, list[float]]:
    """Twists (J, 6, Q), one column per session if clock offsets are estimated; prior sigmas."""
    if not clock_offset or problem.twist_vehicle is None:
        return np.zeros((len(problem.map_from_vehicle), 6, 0)), []
    is_in_session = problem.session_of_frame[:, None] == np.arange(problem.session_count)
    sigma_s = problem.session_count * [problem.clock_sigma_s]
    return np.asarray(problem.twist_vehicle[:, :, None] * is_in_session[:, None]), sigma_s


class _Moments(NamedTuple):
    """The M moments of row read-out, ascending."""

    frame: IntArray  # (M,)
    of_observation: IntArray  # (K,) each observation's moment
    motion: FloatArray  # (M, 6) the vehicle's since its frame's stamp, per unit of read-out time


def _moments(problem: Problem) -> _Moments:
    """The moments at which the rows of observations were read out."""
    observations = problem.observations
    rows = np.column_stack([observations.frame, np.asarray(observations.row_share)])
    moments, of_observation = np.unique(rows, axis=0, return_inverse=True)
    frame = moments[:, 0].astype(np.int64)
    motion = np.asarray(problem.twist_vehicle)[frame] * moments[:, 1:]
    return _Moments(frame, of_observation.ravel().astype(np.int64), motion)


class _Timing(NamedTuple):
    """Pairs of camera and moment, and how images move with Q unknowns of time; without moments M is J."""

    pair: NDArray[np.int32]  # (K,) of each sorted observation
    clock_twist: FloatArray  # (M, 6, Q) the vehicle's motion per second of each unknown
    sigma_s: list[float]  # (Q,) prior sigmas of the unknowns
    frame_of_moment: IntArray | None  # (M,) None if all rows of an image were read out at once
    read_out: FloatArray | None  # (C, M, 6) motion during the stated read-out, None without one


def _timing(problem: Problem, observations: _Sorted, clock_offset: bool, read_out: bool) -> _Timing:
    """The pairs of sorted observations and their motion, with the unknowns of time to be estimated."""
    clock_twist, sigma_s = _clock_twist(problem, clock_offset)
    if not read_out and problem.read_out_s is None:
        return _Timing(observations.pair, clock_twist, sigma_s, None, None)
    moments = _moments(problem)
    camera = observations.pair // len(clock_twist)
    of_observation = moments.of_observation[observations.order]
    pair = (camera * len(moments.frame) + of_observation).astype(np.int32)
    clock_twist = clock_twist[moments.frame]
    if read_out:
        clock_twist = np.concatenate([clock_twist, moments.motion[..., None]], axis=2)
        sigma_s = [*sigma_s, problem.read_out_sigma_s]
    stated_s = problem.read_out_s
    motion = None if stated_s is None else stated_s[:, None, None] * moments.motion
    return _Timing(pair, clock_twist, sigma_s, moments.frame, motion)
