"""What the other lines of an image say of one.

A road's lines run beside each other, a lane apart. Kerbs, joints, cracks and the edges of shadows that look
like one run closer to the lines or to each other, or some other way.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2hdm.detection.lanes.curves import Horizon, basis
from v2hdm.detection.lanes.points import Line, LinePoints
from v2hdm.records import FloatArray

COMPANY = ("a_lane_apart", "too_near")
"""Names of the columns of :func:`company`, in order.

Of the others that run beside it, weighed by their probability: how much so is the likest one a lane away, and
how many are nearer than a lane can be.
"""

_LANE_M, _LANE_SIGMA_M = 3.2, 0.65
"""Lanes of roads are 2.5 to 4 m wide."""

_TOO_NEAR_M = 1.8
_MOST = 2.0
"""More company than this adds nothing."""

_CHANGE_M, _CHANGE_SHARE = 0.15, 0.06
"""The distance between lines that run beside each other changes by so much and by this share of it."""


def company(
    points: LinePoints, lines: Sequence[Line], horizon: Horizon, probability: FloatArray
) -> FloatArray:
    """The :data:`COMPANY` (N, 2) of N lines, each of such a ``probability`` (N,) as far as it shows alone."""
    if len(lines) < 2:
        return np.zeros((len(lines), len(COMPANY)))
    apart = _apart_m(points, lines, horizon)
    gap = np.abs(apart[1])
    change = np.ptp(apart, axis=0) / (_CHANGE_M + _CHANGE_SHARE * gap)
    beside = probability * np.exp(-0.5 * change**2)
    np.fill_diagonal(beside, 0.0)
    lane = beside * np.exp(-0.5 * ((gap - _LANE_M) / _LANE_SIGMA_M) ** 2)
    near = np.where(gap < _TOO_NEAR_M, beside, 0.0).sum(axis=1)
    return np.column_stack([lane.max(axis=1), np.minimum(near, _MOST)])


def _apart_m(points: LinePoints, lines: Sequence[Line], horizon: Horizon) -> FloatArray:
    """How far lines are apart along the horizon (3, N, N), m, at the far end, middle and near end of each."""
    parameters = np.array([line.curve.parameters for line in lines])
    spans = np.array([np.ptp(points.below[line.certain]) for line in lines])
    low = np.array([points.below[line.certain].min() for line in lines])
    below = (low + spans * np.array([[0.0], [0.5], [1.0]])).ravel()
    # Each line's own rows, at which all the others are looked at.
    rows = (basis(below) / (horizon.px_per_m * below)[:, None]).reshape(3, len(lines), 3)
    return np.asarray(np.einsum("sik,ijk->sij", rows, parameters[:, None] - parameters))
