"""Double lines: two lines so close that their nodes run together midway, told apart by the cloud beside it.

Far pieces of a double line are seen as one, near ones as two. Where a mixture of two lines, and of what lies
midway, explains the points across a lane line better than any one line, however uncertain, the line is two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.geometry.planar import cross, length_along, turned_left
from v2hdm.lanes.points import SAME_DIRECTION, LaneCloud
from v2hdm.records import LANE_DASH, LANE_LINE, FloatArray, IntArray, Lane

_REACH_M = 0.5  # distance across the line, m, up to which points are of it or of its two lines
_WINDOW_M = 3.0  # length, m, of the pieces that are judged: a dash is as long
_APART_M = np.arange(0.16, 0.5, 0.02)  # distances between the two lines' centres, m, that are tried
_OFF_M = np.arange(-0.26, 0.27, 0.02)  # places of the middle beside the mapped line, m, that are tried
_SMEAR_M = 0.02  # standard deviation, m, of points about their line besides their own: poses, ragged paint
_WIDER_M = (0.0, 0.05, 0.1)  # more of it, m, that one line may have
_POINTS_OF_IMAGE = 2.0  # independent points that an image's piece of a line in a window is worth
_STRAY = 0.05  # share of points that belong to no line, evenly over the reach
_SHARES = (0.4, 0.15)  # share of points of each of the two lines, and of what is seen midway
_LEAST_ODDS = 1.0  # log odds of two lines against one that every window of a double line has
_LEAST_SUM = 8.0  # log odds that all of its windows have together: doubles are rare
_LEAST_WINDOWS = 2  # such windows: a single one may be a crack or a rut
_MOST_GAP = 4  # windows from one of them to the next: gaps between dashes are up to 9 m long


class _Beside(NamedTuple):
    """The P points of a cloud beside a lane line."""

    along_m: FloatArray  # (P,) along the line
    off_m: FloatArray  # (P,) to its left
    sigma_m: FloatArray  # (P,)
    worth: FloatArray  # (P,) in independent points
    dash: FloatArray  # (P,) whether detected as a dash


def with_doubles(lanes: Sequence[Lane], cloud: LaneCloud) -> tuple[Lane, ...]:
    """The lane lines, in which one that runs midway between two is these two for as long as they are."""
    if not len(cloud.points_map):
        return tuple(lanes)
    tree = cKDTree(cloud.points_map)
    return tuple(line for lane in lanes for line in _told_apart(lane, cloud, tree))


def _told_apart(lane: Lane, cloud: LaneCloud, tree: cKDTree) -> list[Lane]:
    beside = _beside(lane, cloud, tree)
    windows = np.floor(beside.along_m / _WINDOW_M).astype(np.int64)
    count = int(windows.max(initial=-1)) + 1
    odds = np.full((count, len(_APART_M)), -np.inf)
    middle_m = np.zeros((count, len(_APART_M)))
    for window in np.unique(windows[windows >= 0]).tolist():
        odds[window], middle_m[window] = _odds(_part(beside, windows == window))
    if not count:
        return [lane]
    best = int(np.maximum(odds, 0.0).sum(axis=0).argmax())
    is_double = odds[:, best] >= _LEAST_ODDS
    doubles = np.flatnonzero(is_double)
    out: list[Lane] = []
    arc_m = length_along(lane.points_map)
    done_m = 0.0
    for rows in np.split(doubles, np.flatnonzero(np.diff(doubles) > _MOST_GAP) + 1):
        if len(rows) < _LEAST_WINDOWS or odds[rows, best].sum() < _LEAST_SUM:
            continue
        begin, end = int(rows[0]), int(rows[-1]) + 1
        start_m, stop_m = begin * _WINDOW_M, min(end * _WINDOW_M, float(arc_m[-1]))
        out += _cut(lane, arc_m, done_m, start_m)
        of_run = _part(beside, (windows >= begin) & (windows < end))
        out += _both(
            lane, arc_m, (start_m, stop_m), rows, middle_m[rows, best], float(_APART_M[best]), of_run
        )
        done_m = stop_m
    return [*out, *_cut(lane, arc_m, done_m, float(arc_m[-1]))] if out else [lane]


def _beside(lane: Lane, cloud: LaneCloud, tree: cKDTree) -> _Beside:
    """The points of a cloud beside a line, in its direction."""
    points = lane.points_map
    ahead = np.gradient(points, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    near = np.unique(
        np.concatenate([np.zeros(0, np.int64), *map(np.array, tree.query_ball_point(points, 0.7))])
    )
    near = near.astype(np.int64)
    vertex = cKDTree(points).query(cloud.points_map[near])[1]
    offset = cloud.points_map[near] - points[vertex]
    off_m = cross(ahead[vertex], offset)
    along_m = (ahead[vertex] * offset).sum(axis=1)
    fits = (np.abs(off_m) <= _REACH_M) & (np.abs(along_m) <= _REACH_M)
    fits &= np.abs((cloud.tangent[near] * ahead[vertex]).sum(axis=1)) >= SAME_DIRECTION
    rows = near[fits]
    along_m = length_along(points)[vertex[fits]] + along_m[fits]
    window = np.floor(along_m / _WINDOW_M)
    _, group, size = np.unique(
        np.column_stack([cloud.image[rows], window]), axis=0, return_inverse=True, return_counts=True
    )
    worth = np.minimum(1.0, _POINTS_OF_IMAGE / size[group.ravel()])
    sigma_m = np.hypot(1.0 / np.sqrt(cloud.weight[rows]), _SMEAR_M)
    return _Beside(np.maximum(along_m, 0.0), off_m[fits], sigma_m, worth, cloud.dash[rows].astype(np.float64))


def _part(beside: _Beside, chosen: np.ndarray) -> _Beside:
    return _Beside(*(values[chosen] for values in beside))


def _density(off_m: FloatArray, sigma_m: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-0.5 * (off_m / sigma_m) ** 2) / (np.sqrt(2 * np.pi) * sigma_m))


def _odds(beside: _Beside) -> tuple[FloatArray, FloatArray]:
    """Log odds (D,) of two lines at each distance against one line, and the place of their middle (D,), m."""
    off_m = beside.off_m[:, None] - _OFF_M
    sigma_m = beside.sigma_m[:, None]
    even = _STRAY / (2 * _REACH_M)
    one = [
        beside.worth @ np.log((1 - _STRAY) * _density(off_m, np.hypot(sigma_m, wider_m)) + even)
        for wider_m in _WIDER_M
    ]
    midway = _SHARES[1] * _density(off_m, sigma_m) + even
    two = np.array(
        [
            beside.worth
            @ np.log(
                _SHARES[0] * (_density(off_m - apart / 2, sigma_m) + _density(off_m + apart / 2, sigma_m))
                + midway
            )
            for apart in _APART_M
        ]
    )
    return two.max(axis=1) - np.max(one), _OFF_M[two.argmax(axis=1)]


def _both(
    lane: Lane,
    arc_m: FloatArray,
    reach_m: tuple[float, float],
    windows: IntArray,
    middle_m: FloatArray,
    apart_m: float,
    beside: _Beside,
) -> list[Lane]:
    """The two lines of a run of windows, left and right, each of the class that most of its points have."""
    inside = np.flatnonzero((arc_m >= reach_m[0] - 1e-6) & (arc_m <= reach_m[1] + 1e-6))
    if len(inside) < 2:
        return []
    points = lane.points_map[inside]
    left = np.gradient(points, axis=0)
    left = turned_left(left / np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9))
    centres_m = (windows + 0.5) * _WINDOW_M
    at_m = np.interp(arc_m[inside], centres_m, middle_m)
    of_point_m = np.interp(beside.along_m, centres_m, middle_m)
    lines = []
    for sign in (1, -1):
        weight = beside.worth * _density(beside.off_m - of_point_m - sign * apart_m / 2, beside.sigma_m)
        dash = float(weight @ beside.dash / max(weight.sum(), 1e-9))
        kind = LANE_DASH if dash > 0.5 else LANE_LINE
        moved = points + (at_m + sign * apart_m / 2)[:, None] * left
        lines.append(replace(lane, kind=kind, points_map=moved))
    return lines


def _cut(lane: Lane, arc_m: FloatArray, start_m: float, stop_m: float) -> list[Lane]:
    """The piece of a line between two places along it, if it is longer than a step."""
    inside = (arc_m >= start_m - 1e-6) & (arc_m <= stop_m + 1e-6)
    return [replace(lane, points_map=lane.points_map[inside])] if inside.sum() > 2 else []
