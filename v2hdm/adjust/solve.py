"""``solve(problem, options) -> Solution``: check, lay out, start, descend, report."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, make_arrays
from v2hdm.adjust.checks import check_model, check_options, check_problem
from v2hdm.adjust.coarse import coarse_extrinsics
from v2hdm.adjust.covariance import Covariance
from v2hdm.adjust.descent import Descent, descend
from v2hdm.adjust.gating import MEDIAN_SQUARED, judge
from v2hdm.adjust.problem import Problem, SolveOptions
from v2hdm.adjust.residuals import Estimate, Loss, cost_and_gradient, frame_tangent, observe, pair_table
from v2hdm.adjust.robust import loss
from v2hdm.adjust.solution import Solution, Status
from v2hdm.adjust.start import back_project
from v2hdm.errors import AdjustError
from v2hdm.geometry.camera import NEAR_M
from v2hdm.geometry.transform import exp, inverse
from v2hdm.records import FloatArray

# Squared residual that one good observation in a thousand exceeds: chi-square, 2 degrees of freedom.
_OUTLIER_SQUARED = 13.8
# Mean of half such a variable below that limit: leaving the tail out takes a little off the chi-square.
_TRIMMED_MEAN = 1 - _OUTLIER_SQUARED / 2 / math.expm1(_OUTLIER_SQUARED / 2)


def solve(problem: Problem, options: SolveOptions | None = None) -> Solution:
    """Adjust extrinsics, poses and corners together.

    Args:
        problem: what was seen, and from where.
        options: how to solve; the defaults suit a port vehicle.

    Raises:
        AdjustError: the problem is malformed; the message names the offending item.
    """
    began = time.perf_counter()
    options = options or SolveOptions()
    check_options(options)
    check_problem(problem)
    check_model(problem, options)
    arrays = make_arrays(problem, tuple(options.pose_states), options.device, options.clock_offset)
    start, spent = _start(problem, arrays, options)
    robust = Loss(options.loss, options.loss_scale)
    descent = descend(
        arrays,
        start,
        robust,
        options.solver,
        options.gap_tolerance,
        options.max_refreshes,
        options.max_evaluations,
    )
    return _report(problem, arrays, options, descent, spent, began)


def _start(problem: Problem, arrays: Arrays, options: SolveOptions) -> tuple[Estimate, int]:
    """Where the descent starts, and the evaluations spent on finding it."""
    cam_from_vehicle = torch.as_tensor(problem.cam_from_vehicle, dtype=torch.float64, device=options.device)
    spent = 0
    if options.coarse:
        cam_from_vehicle, spent = coarse_extrinsics(arrays, cam_from_vehicle)
    state = torch.zeros_like(arrays.state_information_root)
    if problem.corners_start is not None:
        given = torch.as_tensor(problem.corners_start, dtype=torch.float64, device=options.device)
        return Estimate(cam_from_vehicle, state, given[arrays.corner_order], arrays.no_clock()), spent
    corners, fixed = back_project(arrays, cam_from_vehicle)
    if not bool(fixed.all()):
        corner = int(arrays.corner_order[~fixed].min())
        raise AdjustError(
            f"no ray of corner {corner} meets the ground under the starting extrinsics: its observations "
            "lie above the horizon; leave it out or give corners_start"
        )
    return Estimate(cam_from_vehicle, state, corners, arrays.no_clock()), spent


def _report(
    problem: Problem, arrays: Arrays, options: SolveOptions, descent: Descent, spent: int, began: float
) -> Solution:
    estimate = descent.estimate
    seen = _seen(arrays, estimate)
    terms, _ = cost_and_gradient(arrays, estimate, Loss(options.loss, options.loss_scale))
    squared, camera = seen.squared, (arrays.pair // arrays.frame_count).cpu().numpy()
    residual_px = seen.off.T.cpu().numpy() * problem.intrinsic[camera, :2]
    map_from_vehicle = inverse(arrays.vehicle_from_map) @ exp(frame_tangent(arrays, estimate.frame_state))

    variance = _variance_factors(arrays, terms, squared)
    behind = _unsorted(seen.behind.double(), arrays.order) > 0
    mahalanobis2 = _unsorted(squared, arrays.order)
    return Solution(
        status=_status(descent, options, bool(behind.any())),
        cam_from_vehicle=estimate.cam_from_vehicle.cpu().numpy(),
        map_from_vehicle=map_from_vehicle.cpu().numpy(),
        corners_map=_unsorted(estimate.corners_map, arrays.corner_order),
        residual_px=_unsorted(residual_px, arrays.order),
        mahalanobis2=mahalanobis2,
        verdict=judge(problem.observations, mahalanobis2, behind, options.gate_probability),
        weight=_unsorted(loss(options.loss, squared, options.loss_scale)[1], arrays.order),
        clock_offset_s=_clock_offset_s(estimate),
        cost_terms={name: float(value) for name, value in terms.items()},
        evaluations=descent.evaluations + spent,
        gap=descent.gap,
        chi2_per_dof=variance.all,
        observation_factor=variance.observations,
        time_s=time.perf_counter() - began,
        covariance=Covariance(descent.whitening),
    )


@dataclass(frozen=True)
class _Seen:
    """Observations at the solution: squared residuals (K,), residuals (2, K) at depth 1, who lie behind."""

    squared: Tensor
    off: Tensor
    behind: Tensor


def _seen(arrays: Arrays, estimate: Estimate) -> _Seen:
    table = pair_table(arrays, estimate)
    squared, off, behind = [], [], []
    for _, part in arrays.parts():
        view = observe(part, estimate, table)
        squared.append(view.squared)
        off.append(view.point[:2] * view.inverse_depth - part.measured)
        behind.append(view.point[2] <= NEAR_M)
    return _Seen(torch.cat(squared), torch.cat(off, dim=1), torch.cat(behind))


def _clock_offset_s(estimate: Estimate) -> FloatArray:
    """Clock offsets (C,), zero where they are not estimated."""
    return np.asarray(estimate.clock_s.sum(1).cpu().numpy())


def _unsorted(values: Tensor | FloatArray, order: Tensor) -> FloatArray:
    """Rows of ``values`` back where the problem had them."""
    out = np.empty(values.shape)
    out[order.cpu().numpy()] = values.cpu().numpy() if isinstance(values, Tensor) else values
    return out


def _status(descent: Descent, options: SolveOptions, behind: bool) -> Status:
    if behind:
        return Status.BEHIND_CAMERA
    if descent.whitening.is_singular:
        return Status.UNDETERMINED
    if descent.gap <= options.gap_tolerance:
        return Status.CONVERGED
    return Status.EVALUATIONS_EXHAUSTED if descent.progressing else Status.STALLED


@dataclass(frozen=True)
class _VarianceFactors:
    """Variances as multiples of the stated ones: of everything, and of the observations alone."""

    all: float
    observations: float


def _variance_factors(arrays: Arrays, terms: dict[str, Tensor], squared: Tensor) -> _VarianceFactors:
    """Chi-square per degree of freedom, of good observations and priors together and of the former.

    What the priors have left of their own degrees of freedom is what the observations have taken of them:
    the expected chi-square of a prior is the one less the other (Foerstner and Wrobel, Photogrammetric
    Computer Vision, section 4.2.4, on variance components).
    """
    # The median tells the noise's own scale, whatever the outliers.
    scale = max(1.0, float(squared.median()) / MEDIAN_SQUARED)
    good = squared[squared <= _OUTLIER_SQUARED * scale]
    of_observations = float(good.sum()) / _TRIMMED_MEAN
    of_priors = 2 * sum(float(value) for name, value in terms.items() if name != "observations")
    centres = int((arrays.centre_information_root > 0).sum())
    surveyed = int((arrays.control_information > 0).sum())
    free = 2 * (arrays.corner_count - surveyed) + 6 * arrays.camera_count - centres
    redundancy = 2 * len(good) - free
    return _VarianceFactors(
        all=(of_observations + of_priors) / max(redundancy, 1),
        observations=of_observations / max(redundancy - of_priors, 1),
    )
