"""Which lanes the paths of drives pass, where, and in which direction."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.geometry.planar import length_along, points_along
from v2hdm.records import FloatArray, IntArray
from v2hdm.topology.closed_lanes import LANE_WIDTH_M, ClosedLane
from v2hdm.topology.paths import STEP_M, Path

_ALONG = 0.8  # least cosine of the angle between a path and a lane that it goes along: 37 degrees; chosen
_AT_ONCE = 64  # neighbouring points that are compared with a lane at once; chosen
_HOLE = 4  # points of a path that may lie beside a lane within one stay: 2 m; chosen


class LaneShape:
    """A closed lane as geometry: its outline, its middle, and the directions along it."""

    def __init__(self, lane: ClosedLane, lines_map: Sequence[FloatArray]) -> None:
        self.lane = lane
        self.left = lines_map[lane.left.line][lane.left.order]
        self.right = lines_map[lane.right.line][lane.right.order]
        self.outline = np.concatenate([self.left, self.right[::-1]])

    @cached_property
    def centre(self) -> FloatArray:
        """Points (N, 2), m, midway between its sides, about :data:`STEP_M` apart."""
        lengths_m = [length_along(side)[-1] for side in (self.left, self.right)]
        share = np.linspace(0.0, 1.0, max(int(np.ceil(max(lengths_m) / STEP_M)), 1) + 1)
        left, right = (
            points_along(side, share * length_m)
            for side, length_m in zip((self.left, self.right), lengths_m, strict=True)
        )
        return np.asarray((left + right) / 2)

    @cached_property
    def at_m(self) -> FloatArray:
        """The way (N,) along the middle, m."""
        return length_along(self.centre)

    @cached_property
    def ahead(self) -> FloatArray:
        """Unit directions (N, 2) along the middle."""
        ahead = np.gradient(self.centre, axis=0)
        return np.asarray(ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12))

    @property
    def length_m(self) -> float:
        """Its length."""
        return float(self.at_m[-1])

    def nearest(self, points: FloatArray) -> IntArray:
        """The points (M,) of its middle nearest to ``points`` (M, 2)."""
        nearest = [_nearest(points[k : k + _AT_ONCE], self.centre) for k in range(0, len(points), _AT_ONCE)]
        return np.concatenate([np.zeros(0, dtype=np.int64), *nearest])

    def holding(self, points: FloatArray) -> IntArray:
        """The numbers of the ``points`` (M, 2) inside its outline."""
        low = self.outline.min(axis=0)
        high = self.outline.max(axis=0)
        numbers_near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
        # Far from the map's origin single precision is too coarse.
        outline = (self.outline - low).astype(np.float32)
        return np.array(
            [
                k
                for k in numbers_near
                if cv2.pointPolygonTest(outline, (points[k] - low).tolist(), False) >= 0
            ],
            dtype=np.int64,
        )


def _nearest(points: FloatArray, line: FloatArray) -> IntArray:
    """The vertices (M,) of a line (N, 2) nearest to neighbouring ``points`` (M, 2)."""
    vertices = np.arange(len(line))
    low = points.min(axis=0) - LANE_WIDTH_M[1]
    high = points.max(axis=0) + LANE_WIDTH_M[1]
    vertices_within = np.flatnonzero(((line >= low) & (line <= high)).all(axis=1))
    vertices = vertices_within if len(vertices_within) else vertices
    offsets = points[:, None] - line[vertices]
    return np.asarray(vertices[np.argmin(np.einsum("mni,mni->mn", offsets, offsets), axis=1)])


class Stay(NamedTuple):
    """A stretch of a path along a lane."""

    path: int
    lane: int
    first: int  # point of the path
    last: int  # point of the path
    is_forward: bool
    length_m: float


def stays_of(path: int, paths: Sequence[Path], shapes: Sequence[LaneShape]) -> list[Stay]:
    """The stays of a path in lanes, by number, in its order: where it is inside one and goes along it."""
    points = paths[path].points_map
    lane_of_point = np.full(len(points), -1)
    cosine_of_point = np.zeros(len(points))
    for number, shape in enumerate(shapes):
        inside = shape.holding(points)
        if not len(inside):
            continue
        cosine = (paths[path].ahead[inside] * shape.ahead[shape.nearest(points[inside])]).sum(axis=1)
        is_better = np.abs(cosine) > np.maximum(np.abs(cosine_of_point[inside]), _ALONG)
        lane_of_point[inside[is_better]] = number
        cosine_of_point[inside[is_better]] = cosine[is_better]
    return _runs(path, lane_of_point, cosine_of_point > 0)


def _runs(path: int, lane_of_point: IntArray, is_forward: np.ndarray) -> list[Stay]:
    """Stretches of equal lane and direction, short holes closed."""
    runs: list[Stay] = []
    for k in np.flatnonzero(lane_of_point >= 0).tolist():
        lane = int(lane_of_point[k])
        forward = bool(is_forward[k])
        last = runs[-1] if runs else None
        is_same = last is not None and (last.lane, last.is_forward) == (lane, forward)
        if last is not None and is_same and k - last.last <= _HOLE:
            runs[-1] = last._replace(last=k, length_m=(k - last.first) * STEP_M)
        else:
            runs.append(Stay(path, lane, k, k, forward, 0.0))
    return [run for run in runs if run.last > run.first]
