"""Spacing of lane dashes: a check that needs no ground truth, since road codes fix the cycle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.geometry.quadrilateral import long_axis
from v2hdm.records import LANE_DASH, FloatArray, HdMap

MAX_CYCLE_M = 15.0
"""Successors farther away belong to another row of dashes."""

MAX_OFFSET_M = 0.5
"""A successor lies at most this far beside the axis of its dash."""


@dataclass(frozen=True)
class DashSpacing:
    """Distance from dash to next dash of the same line, centre to centre: count, median, spread (m)."""

    pairs: int
    median_m: float
    deviation_m: float


def dash_spacing(hd_map: HdMap) -> DashSpacing:
    """Measure the cycle of all dashed lines of a map; nan where no dash has a successor."""
    dashes = [m.corners_map for m in hd_map.markings if m.kind == LANE_DASH]
    gaps = _successor_distances(np.array(dashes).reshape(-1, 4, 2))
    if not len(gaps):
        return DashSpacing(0, float("nan"), float("nan"))
    median = float(np.median(gaps))
    # 1.4826 makes the median absolute deviation the sigma of a Gaussian.
    return DashSpacing(len(gaps), median, float(1.4826 * np.median(np.abs(gaps - median))))


def _successor_distances(dashes: FloatArray) -> FloatArray:
    """Distance (P,) from each dash (J, 4, 2) to the nearest one ahead of it along its own axis."""
    if len(dashes) < 2:
        return np.empty(0)
    centres, axes = dashes.mean(axis=1), np.array([long_axis(corners) for corners in dashes])
    offset = centres[None] - centres[:, None]
    along = (offset * axes[:, None]).sum(axis=2)
    across = offset[..., 0] * axes[:, None, 1] - offset[..., 1] * axes[:, None, 0]
    ahead = (along > 0.5) & (along <= MAX_CYCLE_M) & (np.abs(across) <= MAX_OFFSET_M)
    nearest = np.where(ahead, along, np.inf).min(axis=1)
    return np.asarray(nearest[np.isfinite(nearest)])
