"""From crossings of row anchors to the lines of lanes: linked from row to row.

Rows are taken from near to far: near the vehicle lines are far apart, so that each is known by the time
they run together.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from v2hdm.detection.sight import AnchorRow
from v2hdm.detection.view import CameraView
from v2hdm.records import LANE_BOUNDARY, FloatArray, LaneDetection

_MIN_PIECE_POINTS = 3
_MIN_POINTS = 6
"""Lines seen on fewer row anchors are chance."""

_MAX_GAP_M = 16.0
_MAX_OFFSET_M = 0.3
_MAX_TURN = 0.15
"""Pieces of a line may be that far apart along the ground; beyond it, their offset and the angle (rad)
between them, and per metre between them a sixth as much more, must be no larger than this."""

_DIRECTION_M = 5.0
_LEAST_LENGTH_M = 1.5
"""Length of a piece's end that its direction is taken from, and the least that gives one."""

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


@dataclass
class _Piece:
    """A chain with its points on the ground (N, 2), vehicle frame, near to far."""

    points_px: FloatArray
    odds: FloatArray
    ground: FloatArray

    @property
    def near_m(self) -> float:
        """How far ahead it begins."""
        return float(np.linalg.norm(self.ground[0]))

    def direction(self, far_end: bool) -> FloatArray | None:
        """Unit vector of one end, from near to far; None where the piece is too short to tell."""
        end = self.ground[-1] if far_end else self.ground[0]
        away = np.linalg.norm(self.ground - end, axis=1)
        other = int(np.argmin(np.abs(away - min(_DIRECTION_M, float(away.max())))))
        if away[other] < _LEAST_LENGTH_M:
            return None
        step = (end - self.ground[other]) * (1 if far_end else -1)
        return np.asarray(step / np.linalg.norm(step))


def link_anchors(rows: Sequence[AnchorRow], view: CameraView) -> list[LaneDetection]:
    """The whole lines of one image, from its row anchors ``rows``, near to far."""
    pieces = _joined(_pieces(_chains(rows), view))
    found = [
        LaneDetection(LANE_BOUNDARY, float((1 / (1 + np.exp(-piece.odds))).mean()), piece.points_px)
        for piece in pieces
        if len(piece.odds) >= _MIN_POINTS
    ]
    return _identified(found, view)


def _pieces(chains: Iterable[_Chain], view: CameraView) -> list[_Piece]:
    """The chains with their points on the ground; what lies above the horizon is left out."""
    pieces = []
    for chain in chains:
        points_px = np.column_stack([chain.u_px, chain.v_px])
        ground = view.ground(view.undistort(points_px))
        below = np.isfinite(ground).all(axis=1)
        if below.sum() >= _MIN_PIECE_POINTS:
            pieces.append(_Piece(points_px[below], np.array(chain.odds)[below], ground[below]))
    return sorted(pieces, key=lambda piece: piece.near_m)


def _joined(pieces: list[_Piece]) -> list[_Piece]:
    """Pieces, near ones first, each joined to the line that it continues across a gap."""
    lines: list[_Piece] = []
    for piece in pieces:
        misfits = [_misfit(line, piece) for line in lines]
        best = int(np.argmin(misfits)) if misfits else -1
        if best < 0 or misfits[best] > 1:
            lines.append(piece)
            continue
        line = lines[best]
        lines[best] = _Piece(
            np.concatenate([line.points_px, piece.points_px]),
            np.concatenate([line.odds, piece.odds]),
            np.concatenate([line.ground, piece.ground]),
        )
    return lines


def _misfit(line: _Piece, piece: _Piece) -> float:
    """How badly a piece continues a line: up to 1 it does."""
    gap = piece.ground[0] - line.ground[-1]
    gap_m = float(np.linalg.norm(gap))
    ends = [d for d in (line.direction(far_end=True), piece.direction(far_end=False)) if d is not None]
    if not ends or gap_m > _MAX_GAP_M or min(float(gap @ d) for d in ends) <= 0:
        return np.inf
    slack = 1 + gap_m / 6
    across_m = min(abs(float(d[0] * gap[1] - d[1] * gap[0])) for d in ends)
    turn = float(np.arccos(np.clip(ends[0] @ ends[-1], -1, 1)))
    return max(across_m / (_MAX_OFFSET_M * slack), turn / (_MAX_TURN * slack))


def _chains(rows: Sequence[AnchorRow]) -> list[_Chain]:
    open_chains: list[_Chain] = []
    done: list[_Chain] = []
    for row in rows:
        done += [chain for chain in open_chains if chain.v_px[-1] - row.v_px > _MAX_GAP_PX]
        open_chains = [chain for chain in open_chains if chain.v_px[-1] - row.v_px <= _MAX_GAP_PX]
        open_chains += _extend(open_chains, row)
    return [chain for chain in done + open_chains if len(chain.v_px) >= _MIN_PIECE_POINTS]


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
