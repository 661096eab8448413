"""Geometry in a plane: polygons, polylines, angles and quadrilaterals.

Corners of quadrilaterals (..., 4, 2) run counter-clockwise as seen from above the ground, in the map and on
the screen, from any first one. The shoelace area is positive in the map, where y points up, and negative in
an image, where v points down: use :func:`is_convex` there, :func:`order_corners` and :func:`is_convex_px`
here. Side ``e`` runs from corner ``e`` to ``e + 1``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from v2hdm.records import BoolArray, FloatArray, IntArray


def inside_convex(polygon: FloatArray, points: FloatArray) -> BoolArray:
    """Whether points (..., 2) lie inside a convex polygon (N, 2) of either orientation; False for nan."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    offsets = np.asarray(points)[..., None, :] - polygon
    beside = cross(edges, offsets)
    return np.asarray((beside >= 0).all(axis=-1) | (beside <= 0).all(axis=-1))


def cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """Cross product (...) of vectors (..., 2): positive where ``second`` is turned from x towards y."""
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


def inverse_2x2(matrices: FloatArray) -> FloatArray:
    """Inverses (..., 2, 2) of matrices (..., 2, 2), for which numpy's routine takes ten times as long."""
    (a, b), (c, d) = np.moveaxis(matrices, (-2, -1), (0, 1))
    adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    return np.asarray(adjugate / (a * d - b * c)[..., None, None])


def turned_left(vectors: FloatArray) -> FloatArray:
    """Vectors (..., 2) rotated by 90 degrees from x towards y: to the left of headings in the map."""
    return np.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)


def signed_area(polygon: FloatArray) -> FloatArray:
    """Shoelace area (...) of polygons (..., N, 2): positive if they turn from the x towards the y axis.

    That is counter-clockwise in the map, clockwise on the screen, whose v axis points down.
    """
    ahead = np.concatenate([polygon[..., 1:, :], polygon[..., :1, :]], axis=-2)
    return np.asarray(cross(polygon, ahead).sum(axis=-1) / 2)


def winding(polygon: FloatArray) -> int:
    """Orientation of a convex polygon (N, 2), 1 or -1 with :func:`signed_area`'s sign; 0 if not convex.

    Straight corners are fine; a star turns one way at every corner but goes around twice.
    """
    edges = np.roll(polygon, -1, axis=0) - polygon
    ahead = np.roll(edges, -1, axis=0)
    turns = cross(edges, ahead)
    winding_rad = np.arctan2(turns, np.sum(edges * ahead, axis=1)).sum()
    one_way = (turns >= 0).all() or (turns <= 0).all()
    if not one_way or not turns.any() or not np.isclose(abs(winding_rad), 2 * np.pi):
        return 0
    return 1 if winding_rad > 0 else -1


def is_simple(polygon: FloatArray) -> bool:
    """Whether no two sides of a polygon (N, 2) cross each other."""
    ends = np.roll(polygon, -1, axis=0)
    side = ends - polygon
    begin_offset = polygon[:, None] - polygon
    end_offset = ends[:, None] - polygon
    # Signed areas (N, N) of the ends of side i beside side j: of opposite signs where i crosses j's line.
    crosses = cross(begin_offset, side) * cross(end_offset, side) < 0
    return not (crosses & crosses.T).any()


def are_simple(quads: FloatArray) -> BoolArray:
    """Whether no two sides of quadrilaterals (N, 4, 2) cross, as :func:`is_simple`."""
    sides = np.roll(quads, -1, axis=1) - quads
    turns = cross(sides, np.roll(sides, -1, axis=1))
    # Four turns to one side are one round; only others are looked at one by one.
    out = np.asarray((turns > 0).all(axis=1) | (turns < 0).all(axis=1))
    out[~out] = [is_simple(quad) for quad in quads[~out]]
    return out


def clip_convex(polygon: FloatArray, window: FloatArray) -> FloatArray:
    """A polygon (N, 2) clipped to a convex window (M, 2), unlike OpenCV also if nearly coincident."""
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
    vertices: list[FloatArray] = []
    for k in range(len(polygon)):
        before = k - 1
        if (depth[k] >= 0) != (depth[before] >= 0):
            part = depth[before] / (depth[before] - depth[k])
            vertices.append(polygon[before] + part * (polygon[k] - polygon[before]))
        if depth[k] >= 0:
            vertices.append(polygon[k])
    return np.array(vertices).reshape(-1, polygon.shape[1])


def centroid(polygon: FloatArray) -> FloatArray:
    """The middle (2,) of the area of a polygon (N, 2) of either orientation."""
    origin = polygon.mean(axis=0)
    points = polygon - origin
    ahead = np.roll(points, -1, axis=0)
    doubled = cross(points, ahead)
    return np.asarray(origin + (doubled[:, None] * (points + ahead)).sum(axis=0) / (3 * doubled.sum()))


def densified(polygon: FloatArray, pieces: int) -> FloatArray:
    """A polygon (N, 2) with every side cut into ``pieces``: lenses bend straight lines."""
    part = np.arange(pieces)[:, None] / pieces
    sides = np.roll(polygon, -1, axis=0) - polygon
    return (polygon[:, None] + part * sides[:, None]).reshape(-1, 2)


def length_along(line: FloatArray) -> FloatArray:
    """Arc length (N,) along a polyline (N, D) to each vertex."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def points_along(line: FloatArray, at: FloatArray) -> FloatArray:
    """Points (M, D) at arc lengths ``at`` (M,) along a polyline (N, D), clamped to its ends."""
    return np.column_stack([np.interp(at, length_along(line), axis) for axis in line.T])


def angle_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """Angles (N,), rad within +-pi, from vectors (N, 2) to others, counter-clockwise."""
    return np.asarray(np.arctan2(cross(first, second), (first * second).sum(axis=1)))


def wrapped(angle_rad: FloatArray) -> FloatArray:
    """Angles (...) wrapped to +-pi."""
    return np.asarray((angle_rad + np.pi) % (2 * np.pi) - np.pi)


def rectangle_size(points: FloatArray) -> tuple[float, float]:
    """Length and width of the smallest rectangle around points (N, 2); nan for fewer than three finite."""
    finite = points[np.isfinite(points[:, 0])]
    if len(finite) < 3:
        return float("nan"), float("nan")
    import cv2  # as in rigid.rotation_from_vector

    _, size, _ = cv2.minAreaRect(finite.astype(np.float32))
    return float(max(size)), float(min(size))


def smallest_rectangle(points: FloatArray) -> FloatArray:
    """Corners (4, 2) of the smallest rectangle around points (N, 2)."""
    import cv2  # as in rigid.rotation_from_vector

    middle = points.mean(axis=0)  # OpenCV computes in float32: far from the origin that is too coarse
    box = cv2.boxPoints(cv2.minAreaRect((points - middle).astype(np.float32)))
    return np.asarray(box.astype(np.float64) + middle)


# Much faster than np.roll, which the fit of a few markings would call very often.
_NEXT = np.array([1, 2, 3, 0])  # index of the corner that follows each of four
_LAST = np.array([3, 0, 1, 2])  # index of the corner before each of four

_TURN = np.array([-1.0, 1.0])  # signs that turn a swapped direction (y, x) into its normal (-y, x)

_CORNER = np.arange(4)  # indices of four corners
SHIFTS = (_CORNER[:, None] + _CORNER[None, :]) % 4
"""Row s lists, for corner c of one quadrilateral, corner (c + s) mod 4 of the other."""

_LEAST_SINE = 1e-3  # least sine of the angle between adjacent sides; parallel ones do not intersect
# A corner starts its own side and ends the one before: the index of that end among the side moves.
_END = 4 + (_CORNER - 1) % 4


@dataclass(frozen=True)
class Quad:
    """Quadrilaterals (..., 4, 2) with cached properties; normals point outwards in an image."""

    corners: FloatArray

    @cached_property
    def _sides(self) -> SideFrames:
        return side_frames(self.corners)

    @property
    def tangent(self) -> FloatArray:
        """Unit direction (..., 4, 2) of each side."""
        return self._sides.tangent

    @property
    def normal(self) -> FloatArray:
        """Unit normal (..., 4, 2) of each side."""
        return self._sides.normal

    @property
    def length(self) -> FloatArray:
        """Length (..., 4) of each side."""
        return self._sides.length

    @cached_property
    def area(self) -> FloatArray:
        """Area (...) of each quadrilateral."""
        return np.asarray(np.abs(signed_area(self.corners)))

    @cached_property
    def width(self) -> FloatArray:
        """Mean extent (...) across the longest side."""
        return np.asarray(self.area / self.length.max(axis=-1))

    @cached_property
    def lengthwise(self) -> BoolArray:
        """Whether (...) the first and third side are the longer ones."""
        length = self.length
        return np.asarray(length[..., 0] + length[..., 2] >= length[..., 1] + length[..., 3])

    @cached_property
    def outward(self) -> FloatArray:
        """Rows (..., 4, 3) that take (x, y, 1) of an image to the signed distance outside each side."""
        offset = -(self.normal * self.corners).sum(axis=-1)
        return np.concatenate([self.normal, offset[..., None]], axis=-1)

    @cached_property
    def corner_from_side(self) -> FloatArray:
        """Jacobian (M, 8, 8) of the corners by moves of the sides' starts and ends along their normals."""
        tangent = self.tangent
        before = tangent.take(_LAST, axis=-2)
        determinant = cross(before, tangent)
        determinant = np.where(np.abs(determinant) < _LEAST_SINE, -_LEAST_SINE, determinant)[..., None]
        jacobian = np.zeros((len(tangent), 4, 2, 8))
        # Moving one side slides the corner along the other.
        jacobian[:, _CORNER, :, _CORNER] = (-before / determinant).swapaxes(0, 1)
        jacobian[:, _CORNER, :, _END] = (tangent / determinant).swapaxes(0, 1)
        return jacobian.reshape(-1, 8, 8)

    def moved(self, by_side: FloatArray) -> Quad:
        """The quadrilaterals whose sides' starts and ends have moved by (M, 8) along the normals."""
        return Quad(self.corners + (self.corner_from_side @ by_side[..., None]).reshape(-1, 4, 2))

    def long_first(self, lengthwise: BoolArray | None = None) -> Quad:
        """The quadrilaterals from a longer side on, or from the second side where not ``lengthwise`` (M,)."""
        along = self.lengthwise if lengthwise is None else lengthwise
        return Quad(np.where(along[..., None, None], self.corners, following(self.corners)))

    def at(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Points (..., N, 2) at fractions ``a`` (N,) along the first side and ``b`` (N,) along the fourth."""
        weight = np.stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b], axis=1)
        return np.asarray(weight @ self.corners)


class Alignment(NamedTuple):
    """Quadrilaterals b aligned to quadrilaterals a under the best cyclic shift."""

    shift: IntArray  # corner c of a matches (c + shift) mod 4 of b
    offset: FloatArray  # (..., 2) mean displacement of b's corners
    deformation_m: FloatArray  # largest deviation from ``offset``, infinite for fewer than two common corners


def quads_from_hulls(hulls: Sequence[np.ndarray]) -> list[FloatArray | None]:
    """The tightest quadrilateral (4, 2) about each hull (N, 1, 2), or None (Low and Ilie 2003)."""
    import cv2  # as in rigid.rotation_from_vector

    quads: list[FloatArray | None] = [None] * len(hulls)
    large = [k for k, hull in enumerate(hulls) if len(hull) >= 4 and cv2.contourArea(hull) >= 1.0]
    approximate = {k: np.asarray(cv2.approxPolyN(hulls[k], 4), dtype=np.float64) for k in large}
    of_four = [k for k in large if approximate[k].size == 8]
    if not of_four:
        return quads
    corners = order_corners(np.array([approximate[k].reshape(4, 2) for k in of_four]))
    are_known = np.asarray(np.isfinite(corners).all(axis=(1, 2))).tolist()
    for k, quad, is_known in zip(of_four, corners, are_known, strict=True):
        quads[k] = quad if is_known else None
    return quads


def quad_from_hull(hull: np.ndarray) -> FloatArray | None:
    """The tightest quadrilateral (4, 2) about a hull (N, 1, 2), or None."""
    return quads_from_hulls([hull])[0]


def order_corners(corners: FloatArray) -> FloatArray:
    """Corners (..., 4, 2) of convex quadrilaterals of an image, sorted counter-clockwise on the screen."""
    outward = corners - corners.mean(axis=-2, keepdims=True)
    order = np.argsort(np.arctan2(-outward[..., 1], outward[..., 0]), axis=-1)
    return np.asarray(np.take_along_axis(corners, order[..., None], axis=-2))


def following(values: np.ndarray, axis: int = -2) -> np.ndarray:
    """Values of four corners or sides, each replaced by the next one's."""
    return np.asarray(values.take(_NEXT, axis=axis))


class SideFrames(NamedTuple):
    """The sides of quadrilaterals, each from its corner to the next."""

    tangent: FloatArray  # (..., 4, 2) unit direction t
    normal: FloatArray  # (..., 4, 2) unit normal (-t_y, t_x)
    length: FloatArray  # (..., 4)


def side_frames(corners: FloatArray) -> SideFrames:
    """The frames of the sides of quadrilaterals (..., 4, 2)."""
    along = following(corners) - corners
    length = np.hypot(along[..., 0], along[..., 1])
    tangent = along / np.maximum(length, 1e-9)[..., None]
    return SideFrames(tangent, tangent[..., ::-1] * _TURN, length)


def is_convex(corners_map: FloatArray) -> BoolArray:
    """Whether quadrilaterals (..., 4, 2) of the map are convex and counter-clockwise."""
    return np.asarray((_turns(corners_map) > 0).all(axis=-1))


def is_convex_px(corners_px: FloatArray) -> BoolArray:
    """Whether quadrilaterals (..., 4, 2) of an image are convex and counter-clockwise on the screen."""
    return np.asarray((_turns(corners_px) < 0).all(axis=-1))


def align(a: FloatArray, valid_a: BoolArray, b: FloatArray, valid_b: BoolArray) -> Alignment:
    """Align ``b`` (..., 4, 2) to ``a`` by the cyclic shift that brings the common valid corners nearest."""
    is_common = valid_a[..., None, :] & valid_b[..., SHIFTS]
    difference = np.where(is_common[..., None], b[..., SHIFTS, :] - a[..., None, :, :], 0.0)
    common = is_common.sum(axis=-1)
    count = np.maximum(common, 1)
    squared = np.sum(difference**2, axis=(-1, -2)) / count
    shift = np.argmin(np.where(common >= 2, squared, np.inf), axis=-1)
    chosen = shift[..., None]
    mean = difference.sum(axis=-2) / count[..., None]
    offset = np.take_along_axis(mean, chosen[..., None], axis=-2)[..., 0, :]
    from_mean = difference - mean[..., None, :]
    deviation = np.hypot(from_mean[..., 0], from_mean[..., 1])
    worst = np.max(np.where(is_common, deviation, 0.0), axis=-1)
    common = np.take_along_axis(common, chosen, axis=-1)[..., 0]
    worst = np.take_along_axis(worst, chosen, axis=-1)[..., 0]
    return Alignment(shift, offset, np.where(common >= 2, worst, np.inf))


_PAIRS = np.triu_indices(4, 1)  # of corners


def diameters(corners: FloatArray, valid: BoolArray) -> FloatArray:
    """Largest distance (...) between two valid corners of quadrilaterals (..., 4, 2)."""
    first, second = _PAIRS
    difference = corners[..., first, :] - corners[..., second, :]
    distance = np.hypot(difference[..., 0], difference[..., 1])
    is_valid_pair = valid[..., first] & valid[..., second]
    return np.asarray(np.max(np.where(is_valid_pair, distance, 0.0), axis=-1))


def mean_corners(corners: FloatArray, valid: BoolArray) -> FloatArray:
    """Mean (..., 2) of the valid corners of quadrilaterals (..., 4, 2), 0 where none is."""
    weight = valid / np.maximum(valid.sum(axis=-1, keepdims=True), 1)
    return np.asarray(np.sum(np.where(valid[..., None], corners, 0.0) * weight[..., None], axis=-2))


def _turns(corners: FloatArray) -> FloatArray:
    """Cross product (..., 4) of each side with the next: positive where they turn from x towards y."""
    side = following(corners) - corners
    return cross(side, following(side))


def block_diagonal(blocks: FloatArray) -> FloatArray:
    """Blocks (M, 4, 2, 2), one per corner, as block-diagonal matrices (M, 8, 8)."""
    full = np.zeros((len(blocks), 4, 2, 4, 2))
    full[:, _CORNER, :, _CORNER] = blocks.swapaxes(0, 1)
    return full.reshape(-1, 8, 8)
