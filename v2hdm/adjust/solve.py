"""``solve(problem, options) -> Solution``: check, lay out, start, descend, report.

A distant start first uses steep rays of part of the route, which converges from ten degrees away.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.audit import audit
from v2hdm.adjust.checks import check_model, check_options, check_problem
from v2hdm.adjust.covariance import Covariance
from v2hdm.adjust.descent import Descent, descend, open_descent, predicted_gap
from v2hdm.adjust.engine import TorchEngine
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.kernels.tables import move
from v2hdm.adjust.layout import make_arrays, nearby_origin, shifted
from v2hdm.adjust.model import Estimate, Loss, depression_sine, frame_tangent
from v2hdm.adjust.problem import Problem, SolveOptions
from v2hdm.adjust.solution import Solution, Status, as_of_point, classify, noise_scale, variance_factors
from v2hdm.adjust.split import likeliest_states
from v2hdm.adjust.threads import one_thread_in_torch
from v2hdm.adjust.whitening import Whitening
from v2hdm.doors import checked
from v2hdm.errors import AdjustError
from v2hdm.geometry.rigid import exp, log
from v2hdm.records import FloatArray

_MIN_DEPRESSION_SINES = (0.1, 0.2, 0.1)
"""Least depression sines of the coarse stage's rays: of the one from nearby, then of the two from afar."""

_NEAR_RAD = 0.052
"""Rotation of a camera, rad, up to which every start converged without steep rays: 3 degrees, of the 5 tried.
At ten degrees a first Newton step errs by a twentieth."""

_CLOSE_GAP = 1e-2
"""Gap of a start up to which a few evaluations lead to the optimum, so that no nearer start pays. Chosen."""

_WORTH_CORNERS = 1000  # least number of corners for a coarse stage: below, it costs more than it saves
_NEARBY_CORNERS = 100  # corners of the coarse stage from nearby
_CORNERS = 400  # corners of each coarse stage from afar
_BLOCKS = 10  # stretches of the route from which the coarse stage takes its corners
_MIN_OBSERVATIONS = 24  # least observations of a camera whose six unknowns the coarse stage estimates

_LOSS = Loss("huber", 1.0)  # of the coarse stage: convex
_GAP_TOLERANCE = 1e-3  # gap at which the coarse stage ends, a fraction of the cost: it only makes a start
_MAX_REFRESHES = 10  # most whitenings of a coarse stage
_MAX_EVALUATIONS = 200  # most evaluations of a coarse stage


def is_worth_a_look(arrays: Arrays) -> bool:
    """Whether a coarse stage pays for any start, as in large problems."""
    return arrays.corner_count > _WORTH_CORNERS


def is_near(whitening: Whitening) -> bool:
    """Whether the Newton step turns every camera by less than the descent's range of convergence."""
    turns = whitening.camera_step(whitening.gradient)[:, 3:6].numpy(force=True)
    return float(np.square(turns).sum(axis=1).max()) <= _NEAR_RAD**2


def coarse_extrinsics(engine: TorchEngine, cam_from_vehicle: Tensor) -> tuple[Tensor, int]:
    """Coarsely estimated extrinsics (C, 4, 4), and the number of evaluations.

    Near the horizon a small pitch error moves ground points by tens of metres; steep rays avoid that, and a
    few hundred corners fix an extrinsic. Poses stay as recorded: their errors are small here. The loss is
    convex, and wide enough for the residuals.
    """
    evaluations = 0
    # :func:`solve` has already found the start of a small problem to be distant.
    for stage in range(0 if is_worth_a_look(engine.arrays) else 1, len(_MIN_DEPRESSION_SINES)):
        arrays = _papers_model(engine.arrays, _CORNERS if stage else _NEARBY_CORNERS)
        whole = arrays.whole()
        poses = (cam_from_vehicle[:, None] @ arrays.vehicle_from_map).flatten(0, 1)
        chosen = _seen_twice(
            arrays, depression_sine(poses[whole.pair], whole.measured) > _MIN_DEPRESSION_SINES[stage]
        )
        if chosen is None:
            continue
        part = engine.over(chosen)
        corners, _ = part.back_project(cam_from_vehicle)
        start = Estimate(cam_from_vehicle, chosen.state_information_root, corners, chosen.no_clock())
        opening = open_descent(part, start, _LOSS)
        if stage == 0 and not is_near(opening):
            continue
        # From nearby the loss that the start calls for does: the descent of all corners narrows its own.
        robust = _LOSS if stage else opening.robust
        descent = descend(part, start, robust, _GAP_TOLERANCE, _MAX_REFRESHES, _MAX_EVALUATIONS, opening)
        cam_from_vehicle = descent.estimate.cam_from_vehicle
        evaluations += descent.evaluations
        if stage == 0:
            break
    return cam_from_vehicle, evaluations


def _papers_model(arrays: Arrays, corners: int) -> Arrays:
    """The problem of ``corners`` corners and their frames, without states and clocks."""
    if arrays.corner_count > corners:
        arrays, _ = arrays.take(_route_blocks(arrays, corners))
    part = arrays.by_moment().arrays
    return replace(
        part,
        states=(),
        state_transition=part.state_transition[:, :0, :0],
        state_information_root=part.state_information_root[:, :0],
        clock_twist=part.clock_twist[:, :, :0],
        clock_information_root=part.clock_information_root[:0],
    )


def _route_blocks(arrays: Arrays, corners: int) -> Tensor:
    """Observations (k,) of corners in contiguous blocks spread over the route."""
    first = torch.arange(_BLOCKS, device=arrays.corner.device) * arrays.corner_count // _BLOCKS
    bounds = torch.stack([first, first + corners // _BLOCKS]).to(arrays.corner.dtype)
    begin, end = torch.searchsorted(arrays.corner, bounds).tolist()
    parts = (torch.arange(*block, device=first.device) for block in zip(begin, end, strict=True))
    return torch.cat(list(parts))


def _seen_twice(arrays: Arrays, keep: Tensor) -> Arrays | None:
    """The problem of corners with at least two observations in ``keep``, if there are enough."""
    sightings = torch.bincount(arrays.corner[keep], minlength=arrays.corner_count)
    keep = keep & (sightings >= 2)[arrays.corner]
    camera = arrays.camera_of(arrays.pair[keep])
    if int(torch.bincount(camera, minlength=arrays.camera_count).min()) < _MIN_OBSERVATIONS:
        return None
    part, _ = arrays.take(keep)
    return part


@checked
def solve(problem: Problem, options: SolveOptions | None = None) -> Solution:
    """Adjust extrinsics, poses and corners together; the default options suit a port vehicle.

    Raises AdjustError, which names the malformed item of ``problem``.

    >>> solution = solve(build_problem(port, result.detections))
    >>> solution.cam_from_vehicle.shape, solution.corners_map.shape[1:]
    ((1, 4, 4), (2,))
    """
    options = options or SolveOptions()
    check_options(options)
    check_problem(problem)
    check_model(problem, options)
    compiled = options.on_cpu and options.engine != "torch"
    with one_thread_in_torch(len(problem.observations.corner), compiled):
        return _solve(problem, options)


def _solve(problem: Problem, options: SolveOptions) -> Solution:
    """Solve a checked problem."""
    origin_map = nearby_origin(problem)
    nearby = shifted(problem, -origin_map)
    states = tuple(options.pose_states)
    arrays = make_arrays(nearby, states, options.device, options.clock_offset, options.read_out)
    engine = make_engine(options.engine, arrays)
    robust = Loss(options.loss, options.loss_scale)
    start = _start(nearby, engine, robust, options)
    del nearby
    descent = descend(
        engine,
        start.estimate,
        robust,
        options.gap_tolerance,
        options.max_refreshes,
        options.max_evaluations,
        start.opening,
    )
    spent = start.evaluations
    del start
    return report_of(problem, origin_map, options, descent, spent)


class Start(NamedTuple):
    """Where the descent begins."""

    estimate: Estimate
    opening: Whitening | None  # its first whitening, if known
    evaluations: int  # spent so far


def _start(problem: Problem, engine: TorchEngine, robust: Loss, options: SolveOptions) -> Start:
    """Start of the descent. Raises AdjustError."""
    cam_from_vehicle = torch.as_tensor(problem.cam_from_vehicle, dtype=torch.float64, device=options.device)
    if options.coarse and not is_worth_a_look(engine.arrays):
        estimate, corner = _estimate(problem, engine, cam_from_vehicle)
        opening = open_descent(engine, estimate, robust) if corner is None else None
        if opening is not None and is_near(opening):
            return _nearer(problem, engine, robust, estimate, opening)
        del opening
    spent = 0
    if options.coarse:
        cam_from_vehicle, spent = coarse_extrinsics(engine, cam_from_vehicle)
    estimate, corner = _estimate(problem, engine, cam_from_vehicle)
    if corner is not None:
        raise AdjustError(
            f"no ray of corner {corner} meets the ground under the starting extrinsics: its observations "
            "lie above the horizon; leave it out or give corners_start"
        )
    return Start(estimate, None, spent)


def _nearer(
    problem: Problem, engine: TorchEngine, robust: Loss, estimate: Estimate, opening: Whitening
) -> Start:
    """The start with its cameras moved by a Newton step, if that is nearer to the optimum.

    Corners are back-projected anew, and so follow the cameras exactly: by the step itself they would to first
    order. Of 4,000 observations that saves three of six evaluations, with frame states four of fourteen.
    """
    start = Start(estimate, opening, 0)
    cost = sum(opening.terms.values())
    if problem.corners_start is not None or predicted_gap(cost, opening.gradient) <= _CLOSE_GAP:
        return start
    tangents = opening.camera_step(-opening.gradient)[:, :6].numpy(force=True)
    cameras = estimate.cam_from_vehicle
    moved, _ = move(np.ascontiguousarray(tangents), np.ascontiguousarray(cameras.numpy(force=True)))
    moved_estimate, corner = _estimate(problem, engine, torch.as_tensor(moved, device=cameras.device))
    if corner is not None:
        return start
    moved_opening = open_descent(engine, moved_estimate, robust)
    # A start farther away has larger residuals, for which the loss is opened.
    before = (opening.robust.scale, cost)
    after = (moved_opening.robust.scale, sum(moved_opening.terms.values()))
    return Start(moved_estimate, moved_opening, 0) if after < before else start


def start_of(
    problem: Problem, origin_map: FloatArray, engine: TorchEngine, robust: Loss, options: SolveOptions
) -> Start:
    """Start of the descent of a problem that is laid out about ``origin_map`` (2,). Raises AdjustError."""
    return _start(shifted(problem, -origin_map), engine, robust, options)


def _estimate(problem: Problem, engine: TorchEngine, cam_from_vehicle: Tensor) -> tuple[Estimate, int | None]:
    """The start under some extrinsics, and a corner that no ray determines, if any."""
    arrays = engine.arrays
    state = _states_start(problem, arrays)
    if problem.corners_start is not None:
        corners_start = torch.as_tensor(
            problem.corners_start, dtype=torch.float64, device=cam_from_vehicle.device
        )
        return Estimate(cam_from_vehicle, state, corners_start[arrays.corner_order], arrays.no_clock()), None
    corners, fixed = engine.back_project(cam_from_vehicle, state)
    loose = None if bool(fixed.all()) else int(arrays.corner_order[~fixed].min())
    return Estimate(cam_from_vehicle, state, corners, arrays.no_clock()), loose


def _states_start(problem: Problem, arrays: Arrays) -> Tensor:
    """States (J, S) whose poses are where the problem starts, the likeliest such."""
    zero = torch.zeros_like(arrays.state_information_root)
    if problem.poses_start is None or not arrays.states:
        return zero
    tangent = log(np.linalg.inv(problem.map_from_vehicle) @ problem.poses_start)
    states = likeliest_states(
        tangent,
        arrays.states,
        arrays.state_transition.cpu().numpy(),
        arrays.state_information_root.cpu().numpy(),
    )
    return zero.new_tensor(states)


def report_of(
    problem: Problem, origin_map: FloatArray, options: SolveOptions, descent: Descent, spent: int
) -> Solution:
    """The solution in the frame of ``problem``; ``origin_map`` is the arrays' origin in it."""
    robust = Loss(options.loss, options.loss_scale)
    engine = descent.engine
    estimate = descent.estimate
    terms = descent.terms
    arrays = engine.arrays
    if descent.robust != robust:
        terms = engine.terms(estimate, robust)
    report = engine.report(estimate, problem.intrinsic[:, :2])
    audit(arrays, estimate, robust, problem.intrinsic[:, :2], report, terms["observations"])
    residual_px, mahalanobis2, behind = report
    if arrays.has_lines:
        is_on_line = problem.observations.on_line
        mahalanobis2[is_on_line] = as_of_point(mahalanobis2[is_on_line])
    scale = noise_scale(mahalanobis2)
    of_priors = 2 * sum(cost for name, cost in terms.items() if name != "observations")
    free = 2 * arrays.corner_count + 6 * arrays.camera_count - _held(arrays)
    variance = variance_factors(mahalanobis2, of_priors, free, scale)
    corners_map = np.empty(estimate.corners_map.shape)
    corners_map[arrays.corner_order.cpu().numpy()] = estimate.corners_map.cpu().numpy()
    map_from_vehicle = problem.map_from_vehicle.copy()
    clock_s = estimate.clock_s.cpu().numpy()
    read_out_s = np.zeros(len(clock_s)) if problem.read_out_s is None else problem.read_out_s
    if options.read_out:
        read_out_s = read_out_s + clock_s[:, -1]
        clock_s = clock_s[:, :-1]
    if arrays.states:
        map_from_vehicle = map_from_vehicle @ exp(frame_tangent(arrays, estimate.frame_state).cpu().numpy())
    return Solution(
        status=_status(descent, options, bool(behind.any())),
        cam_from_vehicle=estimate.cam_from_vehicle.cpu().numpy(),
        map_from_vehicle=map_from_vehicle,
        corners_map=corners_map + origin_map,
        residual_px=residual_px,
        mahalanobis2=mahalanobis2,
        verdict=classify(problem.observations, mahalanobis2, behind, options.gate_probability, scale),
        clock_offset_s=clock_s if clock_s.size else np.zeros((len(clock_s), problem.session_count)),
        read_out_s=read_out_s,
        cost_terms=terms,
        evaluations=descent.evaluations + spent,
        gap=descent.gap,
        chi2_per_dof=variance.all,
        observation_factor=variance.observations,
        covariance=Covariance(descent),
    )


def _held(arrays: Arrays) -> int:
    """The number of unknowns that priors other than the poses' determine."""
    centre = np.count_nonzero(arrays.centre_information_root.numpy(force=True))
    control = np.count_nonzero(arrays.control_root[:, ::2].numpy(force=True))
    ground = np.count_nonzero(arrays.ground_root.numpy(force=True).any(axis=2))
    return int(centre + control + ground) + len(arrays.lengths.first)


def _status(descent: Descent, options: SolveOptions, behind: bool) -> Status:
    if behind:
        return Status.BEHIND_CAMERA
    if descent.is_singular:
        return Status.UNDETERMINED
    if descent.gap <= options.gap_tolerance:
        return Status.CONVERGED
    return Status.EVALUATIONS_EXHAUSTED if descent.progressing else Status.STALLED
