"""One camera at one place: the ray of every pixel, and where polygons of the world fall in the image.

Straight edges are straight in *pinhole* pixels, so all shapes are tested there: the signed distance of
a pixel to an edge is one linear function of its pinhole coordinates, exact to the last bit of float32.
Polygon fills of image libraries are not used: they dilate by half a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.planar import clip_half
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import CameraInfo, FloatArray, IntArray
from v2hdm.simulate.render import drawing
from v2hdm.simulate.render.relief import Relief
from v2hdm.simulate.render.scene import Float32

_GRID_STEP_PX = 8  # distance of the pixels at which the lens is inverted
_BAND_ROWS = 32  # rows of a window where an outline is covered by several
_BAND_AREA_PX = 4000  # area of an outline's bounds from which on several windows cover it
NEAR_M = 0.05  # least depth of what is drawn
_MARGIN_PX = 4.0  # width of the band around an image in which shapes are still drawn
_STEPS = np.array([np.pad(np.linspace(0.0, 1.0, 2 + more)[:-1], (0, 8 - more)) for more in range(9)])
"""Shares of a side at which its outline has points, by how many more it has: a lens bends it."""

Window = tuple[slice, slice]


@dataclass(frozen=True)
class Rays:
    """Pinhole coordinates (H, W) of every recorded pixel and their bounds (u0, v0, u1, v1)."""

    info: CameraInfo
    u_pinhole_px: Float32
    v_pinhole_px: Float32
    bounds: tuple[float, float, float, float]


@lru_cache(maxsize=8)
def _rays(width: int, height: int, intrinsic: bytes, model: str, distortion: tuple[float, ...]) -> Rays:
    k = np.frombuffer(intrinsic, dtype=np.float64).reshape(3, 3)
    info = CameraInfo("", width, height, k, model, distortion)
    columns = np.arange(0, width + _GRID_STEP_PX, _GRID_STEP_PX, dtype=np.float64)
    rows = np.arange(0, height + _GRID_STEP_PX, _GRID_STEP_PX, dtype=np.float64)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    shift = (undistort_points(info, grid.reshape(-1, 2)).reshape(grid.shape) - grid).astype(np.float32)
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    dense = cv2.remap(shift, u / _GRID_STEP_PX, v / _GRID_STEP_PX, cv2.INTER_LINEAR)
    u = u + dense[..., 0]
    v = v + dense[..., 1]
    bounds = (float(u.min()), float(v.min()), float(u.max()), float(v.max()))
    return Rays(info, u, v, bounds)


def camera_rays(info: CameraInfo) -> Rays:
    """The rays of a camera, remembered for the last few; inverted on a grid of 8 px: at most 0.01 px off."""
    intrinsic = np.ascontiguousarray(info.intrinsic, dtype=np.float64).tobytes()
    return _rays(info.width, info.height, intrinsic, info.distortion_model, tuple(info.distortion))


@dataclass(frozen=True)
class View:
    """A camera at ``cam_from_map`` (4 x 4), over a ``relief`` or else over the plane z = 0."""

    rays: Rays
    cam_from_map: FloatArray
    relief: Relief | None = None

    @property
    def centre_map(self) -> FloatArray:
        """The camera's centre (3,) in the map."""
        return camera_centre(self.cam_from_map)

    def homogeneous_px(self, points_map: FloatArray) -> FloatArray:
        """Map points (..., 3) as homogeneous pinhole pixels (..., 3), the last element their depth in m."""
        cam = points_map @ self.cam_from_map[:3, :3].T + self.cam_from_map[:3, 3]
        return np.asarray(cam @ self.rays.info.intrinsic.T)

    @cached_property
    def beneath(self) -> FloatArray:
        """Height, m, and slopes by x and y (3,) of the plane that touches the ground beneath the camera."""
        return np.zeros(3) if self.relief is None else self.relief.with_slopes(self.centre_map[:2])

    @property
    def height_m(self) -> float:
        """How high above the ground the camera is."""
        return float(self.centre_map[2] - self.beneath[0])

    def on_plane(self, points_map: FloatArray) -> FloatArray:
        """Points (..., 2) on the plane that touches the ground beneath the camera, (..., 3)."""
        height_m, *slope = self.beneath
        z = height_m + (points_map - self.centre_map[:2]) @ slope
        return np.concatenate([points_map, z[..., None]], axis=-1)

    def on_ground(self, points_map: FloatArray) -> FloatArray:
        """Points (..., 2) on the ground, (..., 3)."""
        if self.relief is None:
            return self.on_plane(points_map)
        return np.concatenate([points_map, self.relief.height_m(points_map)[..., None]], axis=-1)


class Outlines(NamedTuple):
    """Convex planar polygons as seen, those in view alone.

    ``edges`` (E, 3) are unit lines in pinhole pixels, positive inside; ``boundaries_px`` (M, 2) are their
    boundaries in recorded pixels, clipped to the neighbourhood of the image. Polygon p is the one of number
    ``numbers[p]``; its edges begin at ``edge_rows[p]`` (P + 1,), its boundary at ``boundary_rows[p]``.
    """

    numbers: IntArray
    edges: FloatArray
    edge_rows: IntArray
    boundaries_px: FloatArray
    boundary_rows: IntArray


def outlines(
    view: View, polygons: Sequence[FloatArray], draped: Sequence[FloatArray] | None = None
) -> Outlines | None:
    """Outlines of polygons of homogeneous pixels (N, 3), None if none is in view.

    Boundaries are those of ``draped``, if given.
    """
    if not polygons:
        return None
    count = np.array([len(polygon) for polygon in polygons])
    points = np.concatenate(polygons)
    ends = np.cumsum(count)
    parts = _visible_parts(view, polygons if draped is None else draped)
    place = np.arange(1, len(points) + 1)
    place[ends - 1] = ends - count
    following = points[place]
    # The cross product by columns: numpy's own takes ten times as long on four rows.
    edges = points[:, [1, 2, 0]] * following[:, [2, 0, 1]] - points[:, [2, 0, 1]] * following[:, [1, 2, 0]]
    norms = np.hypot(edges[:, 0], edges[:, 1])
    usable = norms > 1e-12
    edges /= np.where(usable, norms, 1.0)[:, None]
    means = np.add.reduceat(points, ends - count) / count[:, None]
    towards = np.where(usable, (edges * np.repeat(means, count, axis=0)).sum(axis=1), 0.0)
    outward = np.add.reduceat(towards, ends - count) < 0
    edges[np.repeat(outward, count)] *= -1.0
    usable_counts = np.add.reduceat(usable, ends - count, dtype=np.int64)
    size = np.array([len(part) for part in parts])
    is_seen = (size >= 3) & (usable_counts >= 3)
    if not is_seen.any():
        return None
    numbers = np.flatnonzero(is_seen)
    boundaries_px, boundary_sizes = _boundaries(view, [parts[number] for number in numbers])
    return Outlines(
        numbers,
        edges[usable & np.repeat(is_seen, count)],
        begins(usable_counts[numbers]),
        boundaries_px,
        begins(boundary_sizes),
    )


def begins(sizes: ArrayLike) -> IntArray:
    """Where each of several parts (P,) in one array begins, and the last one's end (P + 1,)."""
    return np.concatenate([[0], np.cumsum(sizes)])


def _boundaries(view: View, parts: Sequence[FloatArray]) -> tuple[FloatArray, IntArray]:
    """Boundaries (M, 2) px, as recorded, of visible parts (N, 3), and their sizes; long sides have points."""
    size = np.array([len(part) for part in parts])
    ends = np.cumsum(size)
    first = ends - size
    corners = np.concatenate(parts)
    corners_px = corners[:, :2] / corners[:, 2:]
    extents_px = np.maximum.reduceat(corners_px, first) - np.minimum.reduceat(corners_px, first)
    # Points of a side beyond its first.
    more = np.minimum(extents_px.max(axis=1) / 40.0, 8.0).astype(np.int64)
    following = np.arange(1, len(corners) + 1)
    following[ends - 1] = first
    points = np.repeat(more, size) + 1  # of each side
    last = np.cumsum(points)
    number = np.arange(last[-1]) - np.repeat(last - points, points)
    share = _STEPS[np.repeat(points - 1, points), number][:, None]
    first_px = np.repeat(corners_px, points, axis=0)
    along_px = np.repeat(corners_px[following] - corners_px, points, axis=0)
    return distort_points(view.rays.info, first_px + share * along_px), size * (more + 1)


def in_view(view: View, homogeneous_px: FloatArray, farthest_m: float) -> NDArray[np.intp]:
    """Which point sets (M, N, 3) of homogeneous pixels may reach into the image, within ``farthest_m``."""
    depth = homogeneous_px[..., 2]
    u0, v0, u1, v1 = view.rays.bounds
    outside = (depth < NEAR_M).all(axis=1) | (depth.min(axis=1, initial=np.inf) > farthest_m)
    for axis, low, high in ((0, u0, u1), (1, v0, v1)):
        value = homogeneous_px[..., axis]
        outside |= (value < (low - _MARGIN_PX) * depth).all(axis=1)
        outside |= (value > (high + _MARGIN_PX) * depth).all(axis=1)
    return np.flatnonzero(~outside)


def following_row(array: FloatArray) -> FloatArray:
    """Each row's successor, the first row following the last; what numpy's roll does, five times as fast."""
    return np.concatenate([array[1:], array[:1]])


def _visible_parts(view: View, polygons: Sequence[FloatArray]) -> list[FloatArray]:
    """The parts (M, 3) of homogeneous polygons in front of and near the image."""
    first = begins([len(polygon) for polygon in polygons])[:-1]
    u0, v0, u1, v1 = view.rays.bounds
    sides = [[1.0, 0.0, _MARGIN_PX - u0], [-1.0, 0.0, u1 + _MARGIN_PX]]
    sides += [[0.0, 1.0, _MARGIN_PX - v0], [0.0, -1.0, v1 + _MARGIN_PX]]
    limits = np.array([[0.0, 0.0, 1.0], *sides])
    least = (NEAR_M, 0.0, 0.0, 0.0, 0.0)
    inside = np.concatenate(polygons) @ limits.T >= least
    whole = np.all(np.logical_and.reduceat(inside, first), axis=1).tolist()
    in_reach = np.all(np.logical_or.reduceat(inside, first), axis=1).tolist()
    parts = [polygon if reaches else polygon[:0] for polygon, reaches in zip(polygons, in_reach, strict=True)]
    for k in [k for k in range(len(parts)) if in_reach[k] and not whole[k]]:
        for line, level in zip(limits, least, strict=True):
            parts[k] = clip_half(parts[k], parts[k] @ line - level)
    return parts


class Bands(NamedTuple):
    """Image windows (K, 4) that cover outlines closely; those of outline p begin at ``rows[p]`` (P + 1,)."""

    windows: IntArray
    rows: IntArray


def bands_of(view: View, shapes: Outlines, first_row: int = 0) -> Bands:
    """Bands of image rows as wide as outlines are there."""
    height, width = view.rays.u_pinhole_px.shape
    count = len(shapes.numbers)
    windows = np.empty((count * (height // _BAND_ROWS + 2), 4), dtype=np.int64)
    rows = np.zeros(count + 1, dtype=np.int64)
    limits = (_BAND_ROWS, _BAND_AREA_PX)
    bounds = (first_row, height, width)
    drawing.bands(shapes.boundaries_px, shapes.boundary_rows, bounds, limits, windows, rows)
    return Bands(windows[: rows[-1]], rows)


def edges_of(shapes: Outlines, grown_px: float = 0.0) -> Float32:
    """Lines (E, 3) for kernels, whose value at a pixel is the share of it that the edge leaves, from 0 to 1.

    An edge covers ``clip(1/2 + d)`` of a pixel at signed distance d. Opposite edges of a quadrilateral add up
    (so a strip narrower than a pixel keeps its area), neighbouring ones multiply; with other numbers of
    edges what each cuts off is added. ``grown_px`` pushes every edge outwards, which closes the seam between
    faces that share one.
    """
    return np.add(shapes.edges, [0.0, 0.0, 0.5 + grown_px], dtype=np.float64).astype(np.float32)
