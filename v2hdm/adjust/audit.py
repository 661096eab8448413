"""The audit that ends every solve: its engine's report is the model's, by kornia's projection.

A kernel that is wrong, or wrongly compiled, cannot end a solve unnoticed: residuals, squared distances and
flags are compared with :mod:`v2hdm.adjust.model`, for all observations of a small problem and a sample of a
large one, and the cost of the observations with the sum over the reported distances.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust import model
from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.engine import Report
from v2hdm.adjust.model import Estimate, Loss
from v2hdm.errors import AdjustError
from v2hdm.geometry.tensors import NEAR_M
from v2hdm.records import FloatArray

_SAMPLE = 1_000
"""Most observations that are audited, in blocks spread over the route; of fewer, all are. Of a kernel that is
wrong for one in 150, so many miss the error once in a thousand times."""

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


class _Sample(NamedTuple):
    """The k observations that are audited, as in :class:`Arrays`."""

    pair: Tensor
    corner: Tensor
    measured: Tensor
    root_information: Tensor
    order: Tensor


class _Expected(NamedTuple):
    """The model's prediction of the audited observations."""

    residual_px: FloatArray  # (k, 2)
    distance: FloatArray  # (k,) Mahalanobis
    off_axis: FloatArray  # (k,) sum of the residual's parts at depth 1
    depth_m: FloatArray  # (k,)


def _audit_observations(arrays: Arrays, estimate: Estimate, focal_px: FloatArray, report: Report) -> None:
    sample = _sample(arrays)
    place = sample.order.numpy(force=True)
    residual_px = report.residual_px[place]
    squared = report.mahalanobis2[place]
    behind = report.behind[place]
    expected = _expected(arrays, sample, estimate, focal_px)
    a, b, c = sample.root_information.numpy(force=True)
    rounding = (1 + expected.off_axis) * _ROUNDING
    with np.errstate(invalid="ignore"):
        agrees = np.abs(np.sqrt(squared) - expected.distance) <= rounding * (a + np.abs(b) + c)
        apart_px = np.abs(residual_px - expected.residual_px)
        agrees &= np.maximum(apart_px[:, 0], apart_px[:, 1]) <= focal_px.max() * rounding
        is_same_side = behind == (expected.depth_m <= NEAR_M)
        if (agrees & is_same_side).all():
            return
        # The status of a failed descent already reports it: values that are finite for neither agree.
        agrees |= ~(np.isfinite(squared) | np.isfinite(expected.distance))
        agrees &= is_same_side | (np.abs(expected.depth_m - NEAR_M) <= _ROUNDING)
    if not agrees.all():
        k = int(np.argmin(agrees))
        said = _px(residual_px[k])
        raise _refusal(
            f"the residual of observation {place[k]} is {said}, not {_px(expected.residual_px[k])}"
        )


def _sample(arrays: Arrays) -> _Sample:
    whole = _Sample(arrays.pair, arrays.corner, arrays.measured, arrays.root_information, arrays.order)
    count = len(arrays.pair)
    if count <= _SAMPLE:
        return whole
    blocks = _SAMPLE // _BLOCK
    begin = np.arange(blocks) * (count - _BLOCK) // (blocks - 1)
    rows = (begin[:, None] + np.arange(_BLOCK)).ravel()
    of_sample = torch.from_numpy(rows).to(arrays.pair.device)
    return _Sample(*(column.index_select(-1, of_sample) for column in whole))


def _expected(arrays: Arrays, sample: _Sample, estimate: Estimate, focal_px: FloatArray) -> _Expected:
    pair = sample.pair
    camera = pair.numpy(force=True) // arrays.moment_count
    state = estimate.frame_state
    if arrays.moment_count > len(pair):
        part = replace(arrays, pair=pair).by_moment()
        arrays = part.arrays
        pair = arrays.pair
        state = state[part.frames]
    poses = model.cam_from_map(arrays, estimate.cam_from_vehicle, state, estimate.clock_s)
    points = model.points_in_camera(
        poses.flatten(0, 1).index_select(0, pair), estimate.corners_map.index_select(0, sample.corner)
    )
    error = model.reprojection_error(points, sample.measured).numpy(force=True)
    x, y = np.ascontiguousarray(error.T)
    a, b, c = sample.root_information.numpy(force=True)
    with np.errstate(invalid="ignore", over="ignore"):
        return _Expected(
            residual_px=error * focal_px[camera],
            distance=np.sqrt((a * x) ** 2 + (b * x + c * y) ** 2),
            off_axis=np.abs(x) + np.abs(y),
            depth_m=points[:, 2].numpy(force=True),
        )


def _px(residual: FloatArray) -> str:
    return f"({residual[0]:.9g}, {residual[1]:.9g}) px"


def _refusal(difference: str) -> AdjustError:
    return AdjustError(f"the compiled adjustment departs from its model: {difference}; choose engine=torch")
