"""From crossings of row anchors and pieces of lane paint to the whole lines of lanes.

Crossings are linked from row to row into chains, near ones first: near the vehicle lines are far apart, so
that each is known by the time they run together. Chains and the centre lines of paint that one curve explains
are one line (:mod:`v2hdm.detection.lanes.groups`), which then runs on through the gaps between its dashes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes.bends import DRAWN_STEP_PX, Seen, beside_guide
from v2hdm.detection.lanes.curves import Horizon, basis
from v2hdm.detection.lanes.ends import alone_from, solid_end
from v2hdm.detection.lanes.groups import find_lines
from v2hdm.detection.lanes.looks import UNKNOWN_LOOKS, Looks
from v2hdm.detection.lanes.points import NEIGHBOURS, Line, LinePoints
from v2hdm.detection.markings.foreground import Foreground
from v2hdm.detection.odds import as_probability
from v2hdm.detection.sight import AnchorRow
from v2hdm.records import LANE_BOUNDARY, LANE_LINE, BoolArray, FloatArray, IntArray, LaneDetection

_MIN_CHAIN = 3
_CHAIN_ODDS = 0.0
"""Chains are made of crossings more likely than not; what is less likely may join a line that is known."""

LEAST_LOG_ODDS = -1.1
"""Of every four lines a little surer than this one is right; a higher bound misses more than it spares."""

_MAX_RANGE_M = 60.0
"""Farther away no line is followed: the network was shown none beyond 50 m."""

_MAX_GAP_PX = 40.0
_SLOPE_POINTS = 6
"""Over how many of its last points a chain's direction is taken."""

_MAX_SLOPE = 4.5
_GATE_PX = 12.0

_SIGMA_PX = (0.4, 2.7)
"""Crossings err by s + t / exp(log odds), in px of the resolution looked at; measured on renders."""

_PAINT_SIGMA_PX = 1.0
_LEAST_PAINT_LENGTH_M = 0.8
_MAX_PAINT_SLOPE = 8.0
"""Paint that runs flatter across the view, px along the horizon per px down, is on no curve of ours."""

_PASSING_M = 3.0
"""Over such a length a line passes from the middle of two strands to the one that goes on."""

_SMOOTH_PX = 24.0
_FREEDOM_M = 0.03
"""A line follows its points within such a distance, and by so much."""

_FAINTEST = -2.5
"""Crossings of lower log odds speak against a line's going on: beyond an end they fade out slowly."""

_EXTENSION_SIGMA = 0.03
"""Lines run on towards the vehicle while known within this share of the image's width."""


@dataclass
class _Chain:
    """A line so far: rows and columns, px, and indices of its crossings, from near to far."""

    v_px: list[float]
    u_px: list[float]
    index: list[int]
    slope: float | None = None
    """Columns per row over the last points; None as long as there is one only."""

    def add(self, v_px: float, u_px: float, index: int) -> None:
        self.v_px.append(v_px)
        self.u_px.append(u_px)
        self.index.append(index)
        first = max(-len(self.v_px), -_SLOPE_POINTS)
        self.slope = (u_px - self.u_px[first]) / (self.v_px[first] - v_px)

    def expected(self, v_px: float) -> tuple[float, float]:
        """Where the line should cross a row farther on, px, and how far off it may be."""
        ahead = self.v_px[-1] - v_px
        if self.slope is None:
            return self.u_px[-1], _MAX_SLOPE * ahead
        young = 1.5 if len(self.v_px) < _SLOPE_POINTS else 1.0
        return self.u_px[-1] + self.slope * ahead, _GATE_PX * young * (1 + 0.04 * (ahead - 8))


def link_anchors(
    rows: Sequence[AnchorRow],
    view: CameraView,
    paint: Sequence[LaneDetection] = (),
    paint_step_m: float = 0.5,
    looks: Looks = UNKNOWN_LOOKS,
    row_step_px: float = 8.0,
) -> list[LaneDetection]:
    """The whole lines of one image.

    Args:
        rows: Its row anchors, near to far; crossings unlikely by themselves help to follow a line.
        view: Its camera.
        paint: The centre lines of its lane paint, points ``paint_step_m`` apart.
        paint_step_m: That distance.
        looks: What the image shows of lines, if that is known.
        row_step_px: How far apart row anchors are, twice as far where half the resolution is looked at.
    """
    horizon = Horizon(view)
    points = _crossings(rows, view, horizon)
    # At, above and just below the horizon lines meet; a comparison with nan is false.
    points = points.where(view.range_m(points.ground) <= _MAX_RANGE_M)
    groups = [np.array(chain.index) for chain in _chains(points)]
    points, on_paint = _with_paint(points, paint, view, horizon)
    lines = find_lines(points, groups + on_paint, view, horizon, paint_step_m, looks, LEAST_LOG_ODDS)
    drawn = [_drawn(points, line, view, horizon, looks.foreground, row_step_px) for line in lines]
    found = [lane for lane in drawn if lane is not None]
    return _identified(beside_guide(found, view), view)


def _crossings(rows: Sequence[AnchorRow], view: CameraView, horizon: Horizon) -> LinePoints:
    u = np.concatenate([np.empty(0), *(row.u_px for row in rows)])
    v = np.repeat([row.v_px for row in rows], [len(row.u_px) for row in rows]) if rows else np.empty(0)
    odds = np.concatenate([np.empty(0), *(row.odds for row in rows)])
    scale = np.where(view.coarse(v), 2.0, 1.0)
    sigma_px = scale * (_SIGMA_PX[0] + _SIGMA_PX[1] * np.exp(-odds))
    return LinePoints.of(view, horizon, np.column_stack([u, v]), odds, sigma_px)


def _with_paint(
    points: LinePoints, paint: Sequence[LaneDetection], view: CameraView, horizon: Horizon
) -> tuple[LinePoints, list[IntArray]]:
    """The points with those of pieces of paint after them, and which those are, piece by piece."""
    pieces = _along_the_view(paint, view, horizon)
    if not pieces:
        return points, []
    length = [len(lane.points_px) for lane in pieces]
    odds = np.repeat([_logit(lane.score) for lane in pieces], length)
    points_px = np.concatenate([lane.points_px for lane in pieces])
    painted = LinePoints.of(view, horizon, points_px, odds, np.full(len(odds), _PAINT_SIGMA_PX))
    solid = np.repeat([lane.kind == LANE_LINE for lane in pieces], length)
    painted = replace(painted, is_paint=np.ones(len(odds), dtype=np.bool_), is_solid=solid)
    ends_at = len(points.odds) + np.cumsum(length)
    groups = [np.arange(end - n, end) for end, n in zip(ends_at, length, strict=True)]
    both = {name: np.concatenate([getattr(points, name), getattr(painted, name)]) for name in vars(points)}
    return LinePoints(**both), groups


def _along_the_view(
    paint: Sequence[LaneDetection], view: CameraView, horizon: Horizon
) -> list[LaneDetection]:
    """Pieces of paint that are long enough to have a direction, and not one across the view."""
    if not paint:
        return []
    ends_px = view.undistort(np.concatenate([lane.points_px[[0, -1]] for lane in paint]))
    length_m = np.linalg.norm(np.diff(view.ground(ends_px).reshape(-1, 2, 2), axis=1)[:, 0], axis=1)
    along, below = (np.abs(np.diff(at.reshape(-1, 2)))[:, 0] for at in horizon.coordinates(ends_px))
    # False where the length is nan.
    usable = (length_m >= _LEAST_PAINT_LENGTH_M) & (along <= _MAX_PAINT_SLOPE * below)
    return [lane for lane, use in zip(paint, usable, strict=True) if use]


def _logit(probability: float) -> float:
    clipped = min(max(probability, 1e-3), 1 - 1e-3)
    return float(np.log(clipped / (1 - clipped)))


def _drawn(
    points: LinePoints,
    line: Line,
    view: CameraView,
    horizon: Horizon,
    foreground: Foreground | None,
    row_step_px: float,
) -> Seen | None:
    """A line's points in the image, near to far, with their standard deviations."""
    nearest = float(points.below[line.members].max())
    lowest = horizon.coordinates(view.undistort(_lower_corners(view)))[1].max()
    farthest = _far_end(points, line)
    at = np.arange(farthest, max(lowest, nearest) + DRAWN_STEP_PX, DRAWN_STEP_PX)[::-1]
    along, sigma = _followed(points, line, horizon, at)
    parts_at = alone_from(line, at, view, horizon, foreground)
    if parts_at is not None:
        along = _parted(line, along, at, parts_at, horizon)
    points_px = view.distort(horizon.pinhole_px(along, at))
    ends = solid_end(points, line, at, points_px, view, horizon, foreground, row_step_px)
    known = (at <= nearest) | (sigma < _EXTENSION_SIGMA * view.info.width) if ends is None else at <= ends
    kept = known & view.inside(points_px, -DRAWN_STEP_PX)
    if kept.sum() < 2:
        return None
    score = float(as_probability(np.array(line.log_odds)))
    lane = LaneDetection(LANE_BOUNDARY, score, points_px[kept], sigma_px=sigma[kept])
    return Seen(lane, _is_seen(points.below[line.certain], at[kept]))


def _parted(line: Line, along: FloatArray, at: FloatArray, parts_at: float, horizon: Horizon) -> FloatArray:
    """A double line ``along`` (N,) the horizon that passes to the strand which goes on alone."""
    assert line.strands is not None
    passed_m = horizon.depth_m(np.array([parts_at])) - horizon.depth_m(at)
    alone = np.clip(0.5 + passed_m / _PASSING_M, 0, 1)
    return along + alone * (line.strands.longer.along(basis(at)) - along)


def _far_end(points: LinePoints, line: Line) -> float:
    """How far below the horizon, px, a line ends: as far on as the faint crossings on it speak for it."""
    far = float(points.below[line.certain].min())
    faint = line.perhaps[points.below[line.perhaps] < far]
    faint = faint[np.argsort(-points.below[faint])]
    total = np.cumsum(points.odds[faint] - _FAINTEST)
    return float(points.below[faint[np.argmax(total)]]) if total.max(initial=0.0) > 0 else far


def _is_seen(own: FloatArray, at: FloatArray) -> BoolArray:
    """Which places (N,), px below the horizon, lie between a line's points, at ``own`` (M,), and near one."""
    own = np.sort(own)
    after = np.minimum(np.searchsorted(own, at), len(own) - 1)
    off = np.minimum(np.abs(own[after] - at), np.abs(own[np.maximum(after - 1, 0)] - at))
    return np.asarray((at >= own[0]) & (at <= own[-1]) & (off <= _SMOOTH_PX))


def _lower_corners(view: CameraView) -> FloatArray:
    return np.array([[0.0, view.info.height - 1.0], [view.info.width - 1.0, view.info.height - 1.0]])


def _followed(
    points: LinePoints, line: Line, horizon: Horizon, at: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where a line is along the horizon and its standard deviation (N,), px, ``at`` (N,) px below it.

    The mean of the points around, weighted, and of the curve, as good as lines follow curves.
    """
    phi = basis(at)
    curve_sigma, along = line.curve.sigma(phi), line.curve.along(phi)
    freedom = _FREEDOM_M * horizon.px_per_m * at
    if line.double:
        return along, np.hypot(curve_sigma, freedom)
    members = line.certain
    off = points.along[members] - line.curve.along(points.phi[members])
    near = np.maximum(1 - np.abs(at[:, None] - points.below[members]) / _SMOOTH_PX, 0)
    weight = near / (NEIGHBOURS * points.sigma_px[members] ** 2)
    own = 1 / (curve_sigma**2 + freedom**2)
    total = weight.sum(axis=1) + own
    return along + weight @ off / total, np.sqrt(1 / total)


def _chains(points: LinePoints) -> list[_Chain]:
    """Likely crossings, in order from near to far, linked from row to row."""
    likely = np.flatnonzero(points.odds > _CHAIN_ODDS)
    u_px, v_px = points.points_px[likely].T
    if not len(likely):
        return []
    begins = np.flatnonzero(np.diff(v_px, prepend=np.nan)).tolist()  # nan differs from any row
    columns, indices, row_px = u_px.tolist(), likely.tolist(), v_px[begins].tolist()
    open_chains: list[_Chain] = []
    done: list[_Chain] = []
    for begin, end, row in zip(begins, [*begins[1:], len(likely)], row_px, strict=True):
        done += [chain for chain in open_chains if chain.v_px[-1] - row > _MAX_GAP_PX]
        open_chains = [chain for chain in open_chains if chain.v_px[-1] - row <= _MAX_GAP_PX]
        open_chains += _extend(open_chains, row, columns[begin:end], indices[begin:end])
    return [chain for chain in done + open_chains if len(chain.v_px) >= _MIN_CHAIN]


def _extend(chains: list[_Chain], row_px: float, columns: list[float], indices: list[int]) -> list[_Chain]:
    """Give each crossing of a row to the chain that it suits best; what is left over starts chains."""
    pairs = []
    for c, chain in enumerate(chains):
        expected, gate = chain.expected(row_px)
        pairs += [
            (off / gate, c, p) for p, u_px in enumerate(columns) if (off := abs(u_px - expected)) <= gate
        ]
    taken: set[int] = set()
    extended: set[int] = set()
    for _, c, p in sorted(pairs):
        if c not in extended and p not in taken:
            chains[c].add(row_px, columns[p], indices[p])
            extended.add(c)
            taken.add(p)
    return [_Chain([row_px], [columns[p]], [indices[p]]) for p in range(len(columns)) if p not in taken]


def _identified(lanes: list[LaneDetection], view: CameraView) -> list[LaneDetection]:
    """Number the lines from the vehicle outwards, by where each is beside the vehicle."""
    if not lanes:
        return []
    ground = view.ground(view.undistort(np.concatenate([lane.points_px for lane in lanes])))
    parts = np.split(ground, np.cumsum([len(lane.points_px) for lane in lanes])[:-1])
    beside_m = np.array([_lateral_m(part, view) for part in parts])
    order = np.argsort(beside_m)
    left = [k for k in order if beside_m[k] >= 0]
    right = [k for k in order[::-1] if beside_m[k] < 0]
    identity = {int(k): n for n, k in enumerate(left, start=1)} | {
        int(k): -n for n, k in enumerate(right, start=1)
    }
    return [replace(lane, identity=identity.get(k)) for k, lane in enumerate(lanes)]


def _lateral_m(ground: FloatArray, view: CameraView) -> float:
    """How far left of the vehicle a line (N, 2) is, its near half carried on to there; nan if unknown."""
    ground = ground[np.isfinite(ground).all(axis=1)]
    near = ground[: max(2, len(ground) // 2)]
    if len(near) < 2:
        return float("nan")
    along = near[:, 0] - view.foot_vehicle[0]
    if np.ptp(along) < 0.5:
        return float(near[0, 1])
    apart = along - along.mean()
    slope = float(apart @ near[:, 1] / (apart @ apart))
    beside = float(near[:, 1].mean()) - slope * float(along.mean())
    return float(beside if abs(slope) < 1 else near[0, 1])
