"""From crossings of row anchors to the lines of lanes: linked from row to row.

Rows are taken from near to far: near the vehicle lines are far apart, so that each is known by the time
they run together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from v2hdm.detection.sight import AnchorRow
from v2hdm.detection.view import CameraView
from v2hdm.records import LANE_BOUNDARY, FloatArray, LaneDetection

_MIN_POINTS = 6
"""Lines seen on fewer row anchors are chance."""

_MAX_GAP_PX = 40.0
_SLOPE_POINTS = 6
"""Over how many of its last points a line's direction is taken."""

_MAX_SLOPE = 4.5
_GATE_PX = 12.0


@dataclass
class _Chain:
    """A line so far: image points and log odds, from near to far."""

    v_px: list[float] = field(default_factory=list)
    u_px: list[float] = field(default_factory=list)
    odds: list[float] = field(default_factory=list)

    def add(self, v_px: float, u_px: float, odds: float) -> None:
        self.v_px.append(v_px)
        self.u_px.append(u_px)
        self.odds.append(odds)

    def expected(self, v_px: float) -> tuple[float, float]:
        """Where the line should cross a row farther on, px, and how far off it may be."""
        ahead = self.v_px[-1] - v_px
        if len(self.v_px) == 1:
            return self.u_px[-1], _MAX_SLOPE * ahead
        first = max(-len(self.v_px), -_SLOPE_POINTS)
        slope = (self.u_px[-1] - self.u_px[first]) / (self.v_px[first] - self.v_px[-1])
        young = 1.5 if len(self.v_px) < _SLOPE_POINTS else 1.0
        return self.u_px[-1] + slope * ahead, _GATE_PX * young * (1 + 0.04 * (ahead - 8))


def link_anchors(rows: Sequence[AnchorRow], view: CameraView) -> list[LaneDetection]:
    """The whole lines of one image, from its row anchors ``rows``, near to far."""
    found = []
    for chain in _chains(rows):
        score = float((1 / (1 + np.exp(-np.array(chain.odds)))).mean())
        points_px = np.column_stack([chain.u_px, chain.v_px])
        found.append(LaneDetection(LANE_BOUNDARY, score, points_px))
    return _identified(found, view)


def _chains(rows: Sequence[AnchorRow]) -> list[_Chain]:
    open_chains: list[_Chain] = []
    done: list[_Chain] = []
    for row in rows:
        done += [chain for chain in open_chains if chain.v_px[-1] - row.v_px > _MAX_GAP_PX]
        open_chains = [chain for chain in open_chains if chain.v_px[-1] - row.v_px <= _MAX_GAP_PX]
        open_chains += _extend(open_chains, row)
    return [chain for chain in done + open_chains if len(chain.v_px) >= _MIN_POINTS]


def _extend(chains: list[_Chain], row: AnchorRow) -> list[_Chain]:
    """Give each crossing of a row to the chain that it suits best; what is left over starts chains."""
    columns, odds = row.u_px.tolist(), row.odds.tolist()
    pairs = []
    for c, chain in enumerate(chains):
        expected, gate = chain.expected(row.v_px)
        pairs += [
            (abs(u - expected) / gate, c, p) for p, u in enumerate(columns) if abs(u - expected) <= gate
        ]
    taken: set[int] = set()
    extended: set[int] = set()
    for _, c, p in sorted(pairs):
        if c not in extended and p not in taken:
            chains[c].add(row.v_px, columns[p], odds[p])
            extended.add(c)
            taken.add(p)
    return [_Chain([row.v_px], [columns[p]], [odds[p]]) for p in range(len(columns)) if p not in taken]


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
