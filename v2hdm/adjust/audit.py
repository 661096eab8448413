"""The audit that ends every solve: its engine's report is the model's, by kornia's projection.

A kernel that is wrong, or wrongly compiled, cannot end a solve unnoticed: residuals, squared distances and
flags are compared with :mod:`v2hdm.adjust.model`, for all observations of a small problem and a sample of a
large one, and the cost of the observations with the sum over the reported distances.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from v2hdm.adjust import model
from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.engine import Report
from v2hdm.adjust.model import Estimate, Loss
from v2hdm.errors import AdjustError
from v2hdm.geometry.tensors import NEAR_M
from v2hdm.records import FloatArray

_SAMPLE = 10_000
"""Most observations that are audited, in blocks spread over the route; of fewer, all are."""

_BLOCK = 50
"""Observations of a block: neighbours in memory."""

_ROUNDING = 1e-7
"""Difference up to which two image points at depth 1, relative to 1 plus the residual, or two depths, m, are
roundings of one. Chosen: a point 1 m ahead of a camera 10 km from the origin is rounded by some 1e-11."""

_COST_ROUNDING = 1e-8
"""The same for two values of a cost, relative to a cost above 1. Chosen."""


def audit(
    arrays: Arrays,
    estimate: Estimate,
    robust: Loss,
    focal_px: FloatArray,
    report: Report,
    cost: float,
) -> None:
    """Raise AdjustError unless a report and the observations' cost at an estimate are the model's.

    ``focal_px`` (C, 2) are the focal lengths.
    """
    _audit_observations(arrays, estimate, focal_px, report)
    losses, _ = model.robustified(robust, torch.from_numpy(report.mahalanobis2))
    expected = float(losses.sum()) / 2
    is_finite = math.isfinite(cost) or math.isfinite(expected)
    if is_finite and not abs(cost - expected) <= _COST_ROUNDING * max(expected, 1.0):
        raise _refusal(f"the cost of the observations is {cost:.12g}, not {expected:.12g}")


def _audit_observations(arrays: Arrays, estimate: Estimate, focal_px: FloatArray, report: Report) -> None:
    pair, corner, measured, root_information, place = _sample(arrays)
    poses = model.cam_from_map(arrays, estimate.cam_from_vehicle, estimate.frame_state, estimate.clock_s)
    points = model.points_in_camera(
        poses.flatten(0, 1).index_select(0, pair), estimate.corners_map.index_select(0, corner)
    )
    x, y = model.reprojection_error(points, measured).cpu().T
    depth_m = points[:, 2].cpu()
    focal = torch.as_tensor(focal_px).repeat_interleave(arrays.moment_count, 0).index_select(0, pair.cpu())
    a, b, c = root_information.cpu()
    place = place.cpu()

    residual_px, squared, behind = (torch.from_numpy(column).index_select(0, place) for column in report)
    expected_px = torch.stack([x, y], dim=1) * focal
    distance = torch.hypot(a * x, b * x + c * y)
    rounding = (1 + x.abs() + y.abs()) * _ROUNDING
    agrees = (squared.sqrt() - distance).abs() <= rounding * (a + b.abs() + c)
    apart_px = (residual_px - expected_px).abs()
    agrees &= torch.maximum(*apart_px.T) <= rounding * float(focal_px.max())
    # A descent that got lost says so by its status: what is finite for neither agrees.
    agrees |= ~(squared.isfinite() | distance.isfinite())
    agrees &= (behind == (depth_m <= NEAR_M)) | ((depth_m - NEAR_M).abs() <= _ROUNDING)
    if not bool(agrees.all()):
        k = int(agrees.to(torch.uint8).argmin())
        reported, expected = (_px(residual[k].tolist()) for residual in (residual_px, expected_px))
        raise _refusal(f"the residual of observation {int(place[k])} is {reported}, not {expected}")


def _sample(arrays: Arrays) -> tuple[Tensor, ...]:
    """Pairs, corners, measurements, root information and places in the problem of audited observations."""
    columns = (arrays.pair, arrays.corner, arrays.measured, arrays.root_information, arrays.order)
    count = len(arrays.pair)
    if count <= _SAMPLE:
        return columns
    begin = torch.linspace(0, count - _BLOCK, _SAMPLE // _BLOCK, dtype=torch.float64).long()
    rows = (begin[:, None] + torch.arange(_BLOCK)).flatten().to(arrays.pair.device)
    return tuple(column.index_select(-1, rows) for column in columns)


def _px(residual: list[float]) -> str:
    return f"({residual[0]:.9g}, {residual[1]:.9g}) px"


def _refusal(difference: str) -> AdjustError:
    return AdjustError(f"the compiled adjustment departs from its model: {difference}; choose engine=torch")
