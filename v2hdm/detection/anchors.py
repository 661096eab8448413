"""From the network's row anchors to the lines of lanes: peaks along each row, linked from row to row.

Rows are taken from near to far: near the vehicle lines are far apart, so that each is known by the time
they run together.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from v2hdm.detection.view import CameraView
from v2hdm.records import LANE_BOUNDARY, FloatArray, LaneDetection

_MIN_ROWS = 6
"""Lines seen on fewer row anchors are chance."""

_MAX_GAP_ROWS = 4
_SLOPE_ROWS = 6
"""Over how many of its last rows a line's direction is taken."""

_MAX_SLOPE_CELLS = 4.5
_GATE_CELLS = 1.5


@dataclass
class _Chain:
    """A line so far: cell rows, pixel columns in cells, and log odds, from near to far."""

    rows: list[int] = field(default_factory=list)
    columns: list[float] = field(default_factory=list)
    odds: list[float] = field(default_factory=list)

    def add(self, row: int, column: float, odds: float) -> None:
        self.rows.append(row)
        self.columns.append(column)
        self.odds.append(odds)

    def distance(self, row: int, columns: np.ndarray) -> np.ndarray:
        """How far peaks of a later row are from where this line should cross it, 1 being just near enough."""
        ahead = self.rows[-1] - row
        if len(self.rows) == 1:
            return np.asarray(np.abs(columns - self.columns[-1]) / (_MAX_SLOPE_CELLS * ahead))
        first = max(-len(self.rows), -_SLOPE_ROWS)
        slope = (self.columns[-1] - self.columns[first]) / (self.rows[first] - self.rows[-1])
        gate = _GATE_CELLS * (1 + 0.3 * (ahead - 1)) * (1.5 if len(self.rows) < _SLOPE_ROWS else 1.0)
        return np.asarray(np.abs(columns - self.columns[-1] - slope * ahead) / gate)


def link_anchors(lanes: np.ndarray, stride: int, view: CameraView) -> list[LaneDetection]:
    """The whole lines of one image.

    Args:
        lanes: (2, h, w) as in :class:`v2hdm.detection.network.NetworkOutput`.
        stride: recorded px per cell.
        view: the camera; its band of rows is what ``lanes`` covers.
    """
    found = []
    for chain in _chains(lanes):
        u = stride * (np.array(chain.columns) + 0.5) - 0.5
        v = stride * np.array(chain.rows) + (stride - 1) / 2 + view.top
        score = float((1 / (1 + np.exp(-np.array(chain.odds)))).mean())
        found.append(LaneDetection(LANE_BOUNDARY, score, np.column_stack([u, v])))
    return _identified(found, view)


def _chains(lanes: np.ndarray) -> list[_Chain]:
    odds, offset = lanes
    padded = np.pad(odds, ((0, 0), (1, 1)), constant_values=-np.inf)
    peak = (odds > 0) & (odds >= padded[:, :-2]) & (odds > padded[:, 2:])
    open_chains: list[_Chain] = []
    done: list[_Chain] = []
    for row in range(len(odds) - 1, -1, -1):
        cells = np.flatnonzero(peak[row])
        done += [chain for chain in open_chains if chain.rows[-1] - row > _MAX_GAP_ROWS]
        open_chains = [chain for chain in open_chains if chain.rows[-1] - row <= _MAX_GAP_ROWS]
        if not len(cells):
            continue
        columns = cells + np.clip(offset[row, cells], -0.5, 0.5)
        started = _extend(open_chains, row, columns, odds[row, cells])
        open_chains += started
    return [chain for chain in done + open_chains if len(chain.rows) >= _MIN_ROWS]


def _extend(chains: list[_Chain], row: int, columns: np.ndarray, odds: np.ndarray) -> list[_Chain]:
    """Give each peak of a row to the chain that it suits best, nearest pairs first; the rest start chains."""
    free = np.ones(len(columns), dtype=np.bool_)
    if chains:
        distance = np.stack([chain.distance(row, columns) for chain in chains])
        while distance.size and distance.min() <= 1:
            c, p = (int(n) for n in np.unravel_index(np.argmin(distance), distance.shape))
            chains[c].add(row, float(columns[p]), float(odds[p]))
            free[p] = False
            distance[c], distance[:, p] = np.inf, np.inf
    return [_Chain([row], [float(columns[p])], [float(odds[p])]) for p in np.flatnonzero(free)]


def _identified(lanes: list[LaneDetection], view: CameraView) -> list[LaneDetection]:
    """Number the lines from the vehicle outwards, by where each is beside the vehicle."""
    beside_m = np.array([_lateral_m(lane.points_px, view) for lane in lanes])
    order = np.argsort(beside_m)
    left = [k for k in order if beside_m[k] >= 0]
    right = [k for k in order[::-1] if beside_m[k] < 0]
    identity = {int(k): n for n, k in enumerate(left, start=1)} | {
        int(k): -n for n, k in enumerate(right, start=1)
    }
    return [
        LaneDetection(lane.kind, lane.score, lane.points_px, identity.get(k)) for k, lane in enumerate(lanes)
    ]


def _lateral_m(points_px: FloatArray, view: CameraView) -> float:
    """How far left of the vehicle a line is, its near half extended to beside the camera; nan if unknown."""
    ground = view.ground(view.undistort(points_px))
    ground = ground[np.isfinite(ground).all(axis=1)]
    near = ground[: max(2, len(ground) // 2)]
    if len(near) < 2:
        return float("nan")
    along = near[:, 0] - view.foot_vehicle[0]
    if np.ptp(along) < 0.5:
        return float(near[0, 1])
    slope, beside = np.polyfit(along, near[:, 1], 1)
    return float(beside if abs(slope) < 1 else near[0, 1])
