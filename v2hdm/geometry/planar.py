"""Polygons in a plane (their area, points inside, the part that two of them share), polylines, angles."""

from __future__ import annotations

import cv2
import numpy as np

from v2hdm.records import BoolArray, FloatArray


def inside_convex(polygon: FloatArray, points: FloatArray) -> BoolArray:
    """Whether points (..., 2) lie inside a convex polygon (N, 2) of either turning; nan is outside."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    offsets = np.asarray(points)[..., None, :] - polygon
    cross = edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0]
    return np.asarray((cross >= 0).all(axis=-1) | (cross <= 0).all(axis=-1))


def signed_area(polygon: FloatArray) -> FloatArray:
    """Shoelace area (...) of polygons (..., N, 2): positive where they turn from the x towards the y axis.

    That is counter-clockwise in the map and clockwise on the screen, whose v axis points down.
    """
    ahead = np.concatenate([polygon[..., 1:, :], polygon[..., :1, :]], axis=-2)
    cross = polygon[..., 0] * ahead[..., 1] - polygon[..., 1] * ahead[..., 0]
    return np.asarray(cross.sum(axis=-1) / 2)


def winding(polygon: FloatArray) -> int:
    """The turning of a convex polygon (N, 2), 1 or -1 as :func:`signed_area` has it; 0 if it is not convex.

    Straight corners are fine; a star turns one way at every corner but goes around twice.
    """
    edges = np.roll(polygon, -1, axis=0) - polygon
    ahead = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * ahead[:, 1] - edges[:, 1] * ahead[:, 0]
    winding_rad = np.arctan2(turns, np.sum(edges * ahead, axis=1)).sum()
    one_way = (turns >= 0).all() or (turns <= 0).all()
    if not one_way or not turns.any() or not np.isclose(abs(winding_rad), 2 * np.pi):
        return 0
    return 1 if winding_rad > 0 else -1


def is_simple(polygon: FloatArray) -> bool:
    """Whether no two sides of a polygon (N, 2) cross each other."""
    ends = np.roll(polygon, -1, axis=0)
    side, apart = ends - polygon, polygon[:, None] - polygon
    beyond = ends[:, None] - polygon
    # Where side i begins and ends, (N, N), beside side j: on different sides where it crosses j's line.
    begin, end = (one[..., 0] * side[:, 1] - one[..., 1] * side[:, 0] for one in (apart, beyond))
    crosses = begin * end < 0
    return not (crosses & crosses.T).any()


def clip_convex(polygon: FloatArray, window: FloatArray) -> FloatArray:
    """A polygon (N, 2) cut to a convex window (M, 2); OpenCV gives nothing where they nearly coincide."""
    inside = window.mean(axis=0)
    for start, end in zip(window, np.roll(window, -1, axis=0), strict=True):
        along = end - start
        normal = np.array([-along[1], along[0]])
        inwards = np.sign(normal @ (inside - start))
        polygon = clip_half(polygon, inwards * ((polygon - start) @ normal))
        if not len(polygon):
            break
    return polygon


def clip_half(polygon: FloatArray, depth: FloatArray) -> FloatArray:
    """The part of a polygon (N, D) where ``depth`` (N,), linear in its plane, is not negative."""
    kept: list[FloatArray] = []
    for k in range(len(polygon)):
        before = k - 1
        if (depth[k] >= 0) != (depth[before] >= 0):
            part = depth[before] / (depth[before] - depth[k])
            kept.append(polygon[before] + part * (polygon[k] - polygon[before]))
        if depth[k] >= 0:
            kept.append(polygon[k])
    return np.array(kept).reshape(-1, polygon.shape[1])


def densified(polygon: FloatArray, pieces: int) -> FloatArray:
    """A polygon (N, 2) with every side cut into ``pieces``, as lenses bend straight lines."""
    part = np.arange(pieces)[:, None] / pieces
    sides = np.roll(polygon, -1, axis=0) - polygon
    return (polygon[:, None] + part * sides[:, None]).reshape(-1, 2)


def length_along(line: FloatArray) -> FloatArray:
    """How far along a polyline (N, D) each of its vertices (N,) lies."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def points_along(line: FloatArray, at: FloatArray) -> FloatArray:
    """Points (M, D) as far along a polyline (N, D) as ``at`` (M,) says, from end to end of it."""
    return np.column_stack([np.interp(at, length_along(line), axis) for axis in line.T])


def angle_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """Angles (N,), rad within +-pi, from vectors (N, 2) to others, counter-clockwise."""
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return np.asarray(np.arctan2(cross, (first * second).sum(axis=1)))


def rectangle_size(points: FloatArray) -> tuple[float, float]:
    """Length and width of the smallest rectangle around points (N, 2); nan for fewer than three not nan."""
    seen = points[np.isfinite(points[:, 0])]
    if len(seen) < 3:
        return float("nan"), float("nan")
    _, size, _ = cv2.minAreaRect(seen.astype(np.float32))
    return float(max(size)), float(min(size))
