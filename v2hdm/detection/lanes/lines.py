"""Lines of lanes: the centre lines of paint, and the whole lines made of crossings of row anchors and paint.

Crossings are linked into chains (:mod:`.chains`); chains and paint that one curve explains are one line
(:mod:`.curves`). A hidden Markov model finds its ends (:mod:`.boundaries`), a logistic function its
probability (:mod:`.score`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter

import numpy as np

from v2hdm.detection.camera import FARTHEST_M, RoadCamera
from v2hdm.detection.lanes.boundaries import boundaries, draw, with_spans
from v2hdm.detection.lanes.chains import find_chains
from v2hdm.detection.lanes.curves import LaneImage, Line, LinePoints, find_lines
from v2hdm.detection.lanes.score import log_odds, log_odds_alone
from v2hdm.detection.network import crossings
from v2hdm.detection.quads.blobs import Blob
from v2hdm.detection.quads.propose import Proposal
from v2hdm.native import kernels
from v2hdm.records import FloatArray, IntArray, LaneDetection

_CAP_WIDTH_RATIO = 0.7  # cuts whose width differs more from the median are through slanted ends
_MIN_POINTS = 2  # least number of points of a centre line
_ROWS_MIN_ASPECT = 0.35  # height over width from which a blob is cut by rows


def trace_lanes(
    paints: Sequence[tuple[Proposal, float]], camera: RoadCamera, step_m: float, max_range_m: float
) -> list[LaneDetection]:
    """Centre lines of lane paint with its score: a point every ``step_m`` on the ground, near to far.

    A blob is cut by image rows, a flat one by columns. Each cut's edge points are averaged on the ground, so
    that perspective does not bias the centre; cuts through slanted ends are omitted.
    """
    branches = [(paint, edges) for paint in paints for edges in _branches(paint[0].blob)]
    if not branches:
        return []
    edges_vehicle = _at_once(camera.unproject, [edges for _, edges in branches])
    compiled = kernels()
    if compiled is not None:
        lines = compiled.centre_lines(
            edges_vehicle, camera.foot_vehicle, step_m, max_range_m, _CAP_WIDTH_RATIO, _MIN_POINTS
        )
    else:
        lines = [_resample(_centre(edges), camera, step_m, max_range_m) for edges in edges_vehicle]
    traced = [
        (paint, line) for (paint, _), line in zip(branches, lines, strict=True) if len(line) >= _MIN_POINTS
    ]
    if not traced:
        return []
    points_px = _at_once(camera.project, [points for _, points in traced])
    return [
        LaneDetection(piece.kind, score, points)
        for ((piece, score), _), points in zip(traced, points_px, strict=True)
    ]


def _at_once(function: Callable[[FloatArray], FloatArray], parts: Sequence[FloatArray]) -> list[FloatArray]:
    """Values of a vectorised function at several arrays of points, by one call."""
    return np.split(function(np.concatenate(parts)), np.cumsum([len(part) for part in parts])[:-1])


def _branches(blob: Blob) -> list[FloatArray]:
    """Edge points (n, 2, 2), recorded px, of the cuts of each branch of a blob."""
    height, width = blob.level.shape
    by_rows = height >= _ROWS_MIN_ASPECT * width
    level = blob.level if by_rows else blob.level.T
    order = [1, 0] if by_rows else [0, 1]
    compiled = kernels()
    chains = _chains(_runs(level)) if compiled is None else compiled.branches(level, _MIN_POINTS)
    return [
        blob.origin_px + blob.stride * np.stack([chain[:, [0, 1]], chain[:, [0, 2]]], axis=1)[..., order]
        for chain in chains
    ]


def _runs(level: np.ndarray) -> FloatArray:
    """Runs (R, 3) of paint: row, start and end column."""
    i, j = np.nonzero((level[:, :-1] > 0) != (level[:, 1:] > 0))
    crossing = j + level[i, j] / (level[i, j] - level[i, j + 1])
    return np.column_stack([i[::2], crossing[::2], crossing[1::2]]).astype(np.float64)


def _chains(runs: FloatArray) -> list[FloatArray]:
    """Branches of a blob: its runs (R, 3), row, start and end column, linked where they overlap."""
    if len(runs) < _MIN_POINTS:
        return []
    above = runs[:-1]
    below = runs[1:]
    linked = (below[:, 0] == above[:, 0] + 1) & (above[:, 1] < below[:, 2]) & (below[:, 1] < above[:, 2])
    if linked.all():
        return [runs]
    # Some rows hold several runs; plain floats take a third of the time of arrays.
    open_chains: list[list[list[float]]] = []
    closed: list[list[list[float]]] = []
    for _, cut in groupby(runs.tolist(), key=itemgetter(0)):
        following: list[list[list[float]]] = []
        extended = set()
        for run in cut:
            _, begin, end = run
            meets = (chain[-1][1] < end and begin < chain[-1][2] for chain in open_chains)
            match = next((c for c, met in enumerate(meets) if met and c not in extended), None)
            if match is None:
                following.append([run])
            else:
                extended.add(match)
                open_chains[match].append(run)
                following.append(open_chains[match])
        closed += [chain for c, chain in enumerate(open_chains) if c not in extended]
        open_chains = following
    return [np.array(chain) for chain in closed + open_chains if len(chain) >= _MIN_POINTS]


def _centre(edges_vehicle: FloatArray) -> FloatArray:
    """Centres (n, 2) of cuts with edge points (n, 2, 2) on the ground, without slanted ends."""
    width_m = np.linalg.norm(edges_vehicle[:, 1] - edges_vehicle[:, 0], axis=1)
    finite = np.isfinite(width_m)
    if not finite.any():
        return np.empty((0, 2))
    typical_m = float(np.median(width_m[finite]))
    whole = finite & (width_m > _CAP_WIDTH_RATIO * typical_m) & (width_m < typical_m / _CAP_WIDTH_RATIO)
    return np.asarray(edges_vehicle.mean(axis=1)[whole])


def _resample(at_vehicle: FloatArray, camera: RoadCamera, step_m: float, max_range_m: float) -> FloatArray:
    """Means of the points within each ``step_m`` along the line, from near to far."""
    at_vehicle = at_vehicle[camera.range_m(at_vehicle) <= max_range_m]
    if len(at_vehicle) < _MIN_POINTS:
        return np.empty((0, 2))
    first_m, last_m = camera.range_m(at_vehicle[[0, -1]])
    if first_m > last_m:
        at_vehicle = at_vehicle[::-1]
    gap_m = np.linalg.norm(np.diff(at_vehicle, axis=0), axis=1)
    bins = np.floor(np.concatenate([[0.0], np.cumsum(gap_m)]) / step_m)
    starts = np.flatnonzero(np.diff(bins, prepend=-1.0))
    counts = np.diff(np.append(starts, len(bins)))
    return np.asarray(np.add.reduceat(at_vehicle, starts, axis=0) / counts[:, None])


LEAST_LOG_ODDS = -0.5
"""Least log odds of a reported line. With -1.4, TuSimple's accuracy is .7 points higher, and false lines on
renders are 40 % more."""

_DOUBTFUL = 1.5  # log odds that a line may gain among the others

_SIGMA_PX = (0.4, 2.7)
"""Crossings have the sigma s + t / exp(log odds), px of the resolution in use; measured on renders."""

_PAINT_SIGMA_PX = 1.0  # standard deviation of points of paint, px
_LEAST_PAINT_LENGTH_M = 0.8  # least length, m, of paint that shows a direction
_MAX_PAINT_SLOPE = 8.0  # px along the horizon per px down: flatter paint runs across the view
_LEAST_EXTENT_M = 0.5  # least extent ahead, m, of a line's near half that is extrapolated to the vehicle


def find_boundaries(image: LaneImage) -> list[LaneDetection]:
    """The whole lines of one image, numbered from the vehicle outwards."""
    points, lines = propose(image)
    drawn = [draw(line, points, image) for line in lines]
    return _identified([lane for lane in drawn if lane is not None], image.camera)


def propose(image: LaneImage, least_log_odds: float | None = None) -> tuple[LinePoints, list[Line]]:
    """The points of an image, and the lane boundaries through them above ``least_log_odds``, best first."""
    least_log_odds = LEAST_LOG_ODDS if least_log_odds is None else least_log_odds
    points = _crossing_points(image)
    # Lines meet at the horizon. Above it the range is nan, and the comparison false.
    points = points.where(image.camera.range_m(points.ground) <= FARTHEST_M)
    groups = find_chains(points.points_px, points.odds)
    points, on_paint = _with_paint(points, image)
    lines = find_lines(points, groups + on_paint, image)
    lines = _surest(lines, log_odds_alone(lines, points, image), least_log_odds - _DOUBTFUL)
    lines = with_spans(lines, points, image)
    lines = boundaries(lines, points, image)
    return points, _surest(lines, log_odds(lines, points, image), least_log_odds)


def _surest(lines: Sequence[Line], odds: FloatArray, least_log_odds: float) -> list[Line]:
    """The lines whose ``odds`` (N,) exceed ``least_log_odds``, best first."""
    order = [k for k in np.argsort(-odds, kind="stable").tolist() if odds[k] > least_log_odds]
    return [replace(lines[k], log_odds=float(odds[k])) for k in order]


def _crossing_points(image: LaneImage) -> LinePoints:
    """The crossings of an image's row anchors."""
    points_px, odds = crossings(image.rows)
    scale = np.where(image.camera.coarse(points_px[:, 1]), 2.0, 1.0)
    return LinePoints.of(image, points_px, odds, scale * crossing_sigma_px(odds), paint=False)


def crossing_sigma_px(odds: FloatArray) -> FloatArray:
    """Standard deviations (N,) of crossings with log ``odds`` (N,), px of the resolution in use."""
    return np.asarray(_SIGMA_PX[0] + _SIGMA_PX[1] * np.exp(-odds))


def _with_paint(points: LinePoints, image: LaneImage) -> tuple[LinePoints, list[IntArray]]:
    """The points followed by those of pieces of paint, and the indices of each piece's points."""
    pieces = _along_the_view(image)
    if not pieces:
        return points, []
    length = [len(lane.points_px) for lane in pieces]
    score = np.clip([lane.score for lane in pieces], 1e-3, 1 - 1e-3)
    odds = np.repeat(np.log(score / (1 - score)), length)
    points_px = np.concatenate([lane.points_px for lane in pieces])
    painted = LinePoints.of(image, points_px, odds, np.full(len(odds), _PAINT_SIGMA_PX), paint=True)
    ends_at = len(points.odds) + np.cumsum(length)
    groups = [np.arange(end - n, end) for end, n in zip(ends_at, length, strict=True)]
    return LinePoints.joined([points, painted]), groups


def _along_the_view(image: LaneImage) -> list[LaneDetection]:
    """Pieces of paint long enough to show a direction, not across the view."""
    if not image.paint:
        return []
    ends_px = image.camera.undistort(np.concatenate([lane.points_px[[0, -1]] for lane in image.paint]))
    ends_vehicle = image.camera.ground(ends_px).reshape(-1, 2, 2)
    length_m = np.linalg.norm(ends_vehicle[:, 1] - ends_vehicle[:, 0], axis=1)
    along, below = (
        np.abs(np.diff(coordinate.reshape(-1, 2)))[:, 0] for coordinate in image.horizon.coordinates(ends_px)
    )
    # False where the length is nan.
    usable = (length_m >= _LEAST_PAINT_LENGTH_M) & (along <= _MAX_PAINT_SLOPE * below)
    return [lane for lane, use in zip(image.paint, usable, strict=True) if use]


def _identified(lanes: list[LaneDetection], camera: RoadCamera) -> list[LaneDetection]:
    """Number the lines from the vehicle outwards, by their offset beside it."""
    if not lanes:
        return []
    ground = _at_once(camera.unproject, [lane.points_px for lane in lanes])
    beside_m = np.array([_lateral_m(part, camera) for part in ground])
    order = np.argsort(beside_m).tolist()
    to_the_left = [k for k in order if beside_m[k] >= 0]
    to_the_right = [k for k in reversed(order) if beside_m[k] < 0]
    identity = {k: n for n, k in enumerate(to_the_left, start=1)}
    identity |= {k: -n for n, k in enumerate(to_the_right, start=1)}
    return [replace(lane, identity=identity.get(k)) for k, lane in enumerate(lanes)]


def _lateral_m(ground: FloatArray, camera: RoadCamera) -> float:
    """Offset, m, of a line (N, 2) to the vehicle's left, extrapolated from its near half; nan if unknown."""
    ground = ground[np.isfinite(ground).all(axis=1)]
    near_half = ground[: max(2, len(ground) // 2)]
    if len(near_half) < 2:
        return float("nan")
    along = near_half[:, 0] - camera.foot_vehicle[0]
    if np.ptp(along) < _LEAST_EXTENT_M:
        return float(near_half[0, 1])
    from_mean = along - along.mean()
    slope = float(from_mean @ near_half[:, 1] / (from_mean @ from_mean))
    beside = float(near_half[:, 1].mean()) - slope * float(along.mean())
    return float(beside if abs(slope) < 1 else near_half[0, 1])
