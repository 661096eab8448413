"""The ground as a camera sees it: where every pixel meets it, its reflectance, its paint, its light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.geometry.planar import densified
from v2hdm.records import FloatArray
from v2hdm.simulate.render import drawing, kernels
from v2hdm.simulate.render.relief import Relief, meet_ground
from v2hdm.simulate.render.scene import (
    Box,
    Float32,
    Ground,
    GroundMarks,
    Light,
    Paint,
    Shade,
    Shadow,
    Tile,
    noise_tile,
    sample,
    scale_of,
)  # fmt: skip
from v2hdm.simulate.render.view import (
    NEAR_M,
    View,
    bands_of,
    begins,
    edges_of,
    following_row,
    in_view,
    outlines,
)  # fmt: skip

_FARTHEST_M = 400.0  # largest depth at which a pixel shows ground; sky lies beyond
_SHADOWS_TO_M = 90.0  # largest distance of a shadow's first corner from a camera that sees it
_DRAPED_M = 1.0  # largest distance between points of an outline that follows a relief


@dataclass(frozen=True)
class GroundField:
    """Ground seen by the image rows from ``first_row`` down, all arrays (H - first_row, W).

    ``x_m``, ``y_m`` are map coordinates, ``depth_m`` runs along the optical axis, ``footprint_m`` is the
    ground length of a pixel along the ray. Pixels above the horizon have ``below`` False and are far away.
    ``rays`` are two (H, W): pinhole pixels at which the plane beneath the camera shows what pixels show.
    ``slope`` are those of the ground by x and y, None where it is a plane.
    """

    first_row: int
    x_m: Float32
    y_m: Float32
    depth_m: Float32
    footprint_m: Float32
    below: NDArray[np.bool_]
    rays: tuple[Float32, Float32]
    slope: tuple[Float32, Float32] | None = None

    @property
    def planes(self) -> tuple[Float32, ...]:
        """``x_m``, ``y_m`` and ``footprint_m``, as kernels take them."""
        return self.x_m, self.y_m, self.footprint_m


def intersect_ground(view: View) -> GroundField | None:
    """Where the pixels' rays meet the ground, or None when no pixel looks at it."""
    if view.relief is not None:
        return _intersect_relief(view, view.relief)
    info = view.rays.info
    map_from_ray = view.cam_from_map[:3, :3].T @ np.linalg.inv(info.intrinsic)
    centre = view.centre_map
    by_pixel = np.stack([map_from_ray[0], map_from_ray[1], -map_from_ray[2] / centre[2]])
    rays = view.rays.u_pinhole_px, view.rays.v_pinhole_px
    below = np.empty(rays[0].shape, dtype=np.bool_)
    planes = tuple(np.empty_like(rays[0]) for _ in range(4))
    least = np.float32(1.0 / _FARTHEST_M)
    per_focal = np.float32(1.0 / (info.intrinsic[1, 1] * centre[2]))
    first = kernels.meet_plane(rays, float32s(by_pixel), float32s(centre), least, per_focal, planes, below)
    if first < 0:
        return None
    x, y, depth, footprint = (plane[first:] for plane in planes)
    return GroundField(first, x, y, depth, footprint, below[first:], rays)


def float32s(values: FloatArray) -> Any:
    """Values as tuples of float32, which kernels read faster than an array: none of them can change."""
    rounded = values.astype(np.float32)
    return tuple(rounded) if values.ndim == 1 else tuple(map(tuple, rounded))


def _intersect_relief(view: View, relief: Relief) -> GroundField | None:
    info = view.rays.info
    rays = (view.rays.u_pinhole_px, view.rays.v_pinhole_px)
    ground = np.empty((6, *rays[0].shape), dtype=np.float32)
    below = np.empty(rays[0].shape, dtype=np.bool_)
    map_from_ray = view.cam_from_map[:3, :3].T @ np.linalg.inv(info.intrinsic)
    at = view.centre_map
    per_focal = float(1.0 / info.intrinsic[1, 1])
    meet_ground(relief.placed, rays, map_from_ray, at, _FARTHEST_M, per_focal, ground, below)
    ground_rows = np.flatnonzero(below.any(axis=1))
    if len(ground_rows) == 0:
        return None
    # A homography of the plane: the images of its origin and of the points a metre along x and y.
    origin, along_x, along_y = view.homogeneous_px(view.on_plane(np.array([[0.0, 0], [1, 0], [0, 1]])))
    u, v, depth = (
        ground[0] * a + ground[1] * b + c
        for a, b, c in np.column_stack([along_x - origin, along_y - origin, origin]).astype(np.float32)
    )
    depth = np.where(depth > NEAR_M, depth, np.float32(np.inf))
    first = int(ground_rows[0])
    x, y, ray_depth, footprint, by_x, by_y = ground[:, first:]
    return GroundField(
        first_row=first,
        x_m=x,
        y_m=y,
        depth_m=ray_depth,
        footprint_m=footprint,
        below=below[first:],
        rays=(u / depth, v / depth),
        slope=(by_x, by_y),
    )


def fine_tile(texture: str | Tile) -> Tile:
    """The millimetre to decimetre grain of a ground texture: concrete, asphalt, or a tile of one's own."""
    if isinstance(texture, Tile):
        return texture
    if texture == "concrete":
        return noise_tile(11, 4.0, 0.6, finest_px=0.8)
    return noise_tile(12, 4.0, 0.1, finest_px=0.7, skew=0.5)


MEDIUM_TILE = noise_tile(13, 19.0, 1.0)  # stains of the ground, repeating after 19 m
COARSE_TILE = noise_tile(14, 83.0, 1.5)  # tones of the ground over metres, repeating after 83 m
WET_TILE = noise_tile(19, 47.0, 1.9, finest_px=3.0)  # depth of water on the ground, repeating after 47 m


def tone(ground: Ground, field: GroundField) -> Float32:
    """Relative reflectance (H, W) of the bare, dry ground, about 1."""
    shift = texture_shift(ground.seed)
    fine = fine_tile(ground.texture)
    scales = np.array([scale_of(fine, shift), scale_of(MEDIUM_TILE, shift)], dtype=np.float32)
    amplitudes = np.array([ground.contrast, 0.6 * ground.stains, 0.8 * ground.stains], dtype=np.float32)
    coarse = _sample_smooth(COARSE_TILE, field, shift)
    out = np.empty_like(field.x_m)
    kernels.ground_tone((fine.padded, MEDIUM_TILE.padded), scales, amplitudes, coarse, field.planes, out)
    if ground.slab_m is not None:
        _slabs(ground, ground.slab_m, field, out)
    if ground.marks is not None:
        _marks(ground.marks, field, out)
    return out


def _sample_smooth(tile: Tile, field: GroundField, shift: tuple[float, float]) -> Float32:
    """A tile of metre-sized features at a quarter of the resolution, enlarged."""
    small = sample(tile, field.x_m[::4, ::4], field.y_m[::4, ::4], shift)
    height, width = field.x_m.shape
    full = cv2.resize(small, (small.shape[1] * 4, small.shape[0] * 4), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(full[:height, :width], dtype=np.float32)


def _slabs(ground: Ground, slab_m: tuple[float, float], field: GroundField, out: Float32) -> None:
    """Multiply joints and the slightly different tones of the slabs into ``out``."""
    cos = np.float32(np.cos(ground.slab_yaw_rad))
    sin = np.float32(np.sin(ground.slab_yaw_rad))
    index = []
    for pitch, along in (
        (slab_m[0], field.x_m * cos + field.y_m * sin),
        (slab_m[1], field.y_m * cos - field.x_m * sin),
    ):
        along *= np.float32(1.0 / pitch)
        cell = np.floor(along)
        along -= cell
        distance = np.minimum(along, np.float32(1.0) - along) * np.float32(pitch)
        width = np.maximum(field.footprint_m, np.float32(0.004))
        line = np.clip((np.float32(ground.joint_width_m / 2) - distance) / width + np.float32(0.5), 0, 1)
        line *= np.minimum(np.float32(ground.joint_width_m) / width, 1)
        out *= np.float32(1.0) - line * np.float32(1.0 - ground.joint_factor)
        index.append(cell.astype(np.int32))
    tones = np.random.default_rng([ground.seed, 5]).normal(1.0, 0.035, 1024).astype(np.float32)
    out *= tones[(index[0] * 31 + index[1] * 57) & 1023]


def _marks(marks: GroundMarks, field: GroundField, out: Float32) -> None:
    scale = np.float32(1.0 / marks.resolution_m)
    columns = (field.x_m - np.float32(marks.origin_map[0])) * scale
    rows = (field.y_m - np.float32(marks.origin_map[1])) * scale
    factor = cv2.remap(
        marks.factor, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=128
    )
    out *= factor.astype(np.float32) * np.float32(1.0 / 128.0)


class Wetness(NamedTuple):
    """Water on the ground: its depth (H, W), of no size where all is dry, and its levels for kernels."""

    depth: Float32
    levels: tuple[np.float32, np.float32]


def wetness(ground: Ground, field: GroundField) -> Wetness:
    """How wet the ground is; between two levels of depth, dry ground turns to standing water."""
    if ground.wet_fraction <= 0:
        return Wetness(np.empty((0, 0), dtype=np.float32), (np.float32(0), np.float32(0)))
    level = float(np.quantile(WET_TILE.values[::8, ::8], 1.0 - ground.wet_fraction))
    low = level - 0.1
    depth = _sample_smooth(WET_TILE, field, texture_shift(ground.seed + 1))
    return Wetness(depth, (np.float32(low), np.float32(1.0 / (level + 0.3 - low))))


def may_cast(box: Box, light: Light, view: View) -> bool:
    """Whether the shadow of a box may be near enough to a camera to be seen."""
    east, north, up = light.sun_direction_map
    falls = np.hypot(east, north) / max(up, 0.1)
    reach_m = np.hypot(box.size_m[0], box.size_m[1]) / 2 + (box.base_m + box.size_m[2]) * falls
    offset_map = np.array(box.centre_map) - view.centre_map[:2]
    return bool(np.hypot(offset_map[0], offset_map[1]) < _SHADOWS_TO_M + reach_m)


class ShadowLayer:
    """Shadows of a scene, prepared once, so that those out of view are cheaply skipped."""

    def __init__(self, shadows: Sequence[Shadow]) -> None:
        self._lines = [inward_lines(np.asarray(shadow.polygon_map, dtype=np.float64)) for shadow in shadows]
        self._wider = [_with_penumbra(shadow) for shadow in shadows]
        self._vertices = padded_vertices(self._wider)
        self._first_map = np.array([shadow.polygon_map[0] for shadow in shadows]).reshape(-1, 2)
        self._softness_m = np.array([shadow.softness_m for shadow in shadows], dtype=np.float32)
        self._darkness = np.array([1.0 - shadow.transmission for shadow in shadows], dtype=np.float32)

    def cast(self, view: View, field: GroundField, out: Float32) -> None:
        """Lower the sun's visibility ``out`` (H', W) to that in the shadows."""
        first = field.first_row
        offset_map = self._first_map - view.centre_map[:2]
        numbers = np.flatnonzero(np.hypot(offset_map[:, 0], offset_map[:, 1]) < _SHADOWS_TO_M)
        if view.relief is None:  # on a relief a shadow is where its vertices need not be
            numbers = numbers[
                in_view(view, view.homogeneous_px(view.on_ground(self._vertices[numbers])), np.inf)
            ]
        shapes = outlines(view, [on_ground_px(view, self._wider[number]) for number in numbers])
        if shapes is None:
            return
        cast = numbers[shapes.numbers]
        lines = [self._lines[number] for number in cast]
        line_rows = begins([len(part) for part in lines])
        drawing.cast_shadows(
            bands_of(view, shapes, first), first, np.concatenate(lines), line_rows, self._softness_m[cast],
            self._darkness[cast], field.planes, np.empty_like(out[:1]), out,
        )  # fmt: skip


def sun_visibility(
    shadows: Sequence[ShadowLayer], shades: tuple[Shade, ...], view: View, field: GroundField
) -> Float32:
    """Fraction (H, W) of the sun's light that reaches the ground."""
    out = np.ones_like(field.x_m)
    for layer in shadows:
        layer.cast(view, field, out)
    for shade in shades:
        shade(view, field, out)
    return out


def padded_vertices(polygons: Sequence[FloatArray]) -> FloatArray:
    """Vertices (P, N, 2) of polygons in one array; those with fewer repeat their last."""
    most = max((len(polygon) for polygon in polygons), default=3)
    out = np.zeros((len(polygons), most, 2))
    for row, polygon in zip(out, polygons, strict=True):
        row[: len(polygon)] = polygon
        row[len(polygon) :] = polygon[-1]
    return out


def _with_penumbra(shadow: Shadow) -> FloatArray:
    """A shadow's polygon (N, 2), half its penumbra wider."""
    polygon = np.asarray(shadow.polygon_map, dtype=np.float64)
    away = polygon - polygon.mean(axis=0)
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return np.asarray(polygon + 0.5 * shadow.softness_m * away)


def on_ground_px(view: View, polygon_map: FloatArray) -> FloatArray:
    """A polygon (N, 2) on the ground as homogeneous pinhole pixels (M, 3); on a relief with more points."""
    if view.relief is not None:
        longest_m = float(np.linalg.norm(polygon_map - following_row(polygon_map), axis=1).max())
        polygon_map = densified(polygon_map, int(np.ceil(longest_m / _DRAPED_M)))
    return view.homogeneous_px(view.on_ground(polygon_map))


def inward_lines(polygon: NDArray[np.float64]) -> Float32:
    """Lines (N, 3) of a convex polygon's sides: x n - d is the distance of a point inwards, n first."""
    following = following_row(polygon)
    edge = following - polygon
    area2 = float((polygon[:, 0] * following[:, 1] - following[:, 0] * polygon[:, 1]).sum())
    normal = np.column_stack([-edge[:, 1], edge[:, 0]]) * np.sign(area2)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    along = [n @ p for n, p in zip(normal, polygon, strict=True)]
    return np.column_stack([normal, along]).astype(np.float32)


def texture_shift(seed: int) -> tuple[float, float]:
    """By how much a seed moves a texture, m."""
    x, y = np.random.default_rng([seed, 3]).uniform(0.0, 80.0, 2)
    return float(x), float(y)


Labels = NDArray[np.uint8]

_WEAR_TILE = noise_tile(16, 5.0, 0.8, finest_px=0.8)  # wear of paint, repeating after 5 m
_FARTHEST_PAINT_M = 60.0  # largest depth of paint that is drawn


class PaintLayer:
    """All paint of a scene, prepared once, so that what is out of view is cheaply skipped."""

    def __init__(self, paints: tuple[Paint, ...], classes: tuple[str, ...]) -> None:
        self._tiles = [_WEAR_TILE, MEDIUM_TILE, fine_tile("asphalt")]
        self._polygons = [np.asarray(paint.polygon_map, dtype=np.float64) for paint in paints]
        self._vertices = padded_vertices(self._polygons)
        label = {kind: label for label, kind in enumerate(classes, start=1)}
        self._kinds = np.array([label[paint.kind] for paint in paints], dtype=np.uint8)
        self._looks = np.array([_look(paint) for paint in paints], dtype=np.float32).reshape(-1, 5)
        shifts = [(float(paint.seed % 97) * 0.53, float(paint.seed % 89) * 0.71) for paint in paints]
        scales = [[scale_of(tile, shift) for tile in self._tiles] for shift in shifts]
        self._scales = np.array(scales, dtype=np.float32).reshape(-1, 3, 4)

    def draw(self, view: View, field: GroundField, albedo: Float32, labels: Labels) -> None:
        """Paint onto the ground field's ``albedo`` (H', 3 W) and into ``labels`` (H, W)."""
        visible = in_view(view, view.homogeneous_px(view.on_ground(self._vertices)), _FARTHEST_PAINT_M)
        flat = view.homogeneous_px(view.on_plane(self._vertices[visible]))
        shown = [self._polygons[number] for number in visible]
        polygons = [points[: len(polygon)] for points, polygon in zip(flat, shown, strict=True)]
        draped = [on_ground_px(view, polygon) for polygon in shown] if view.relief else None
        shapes = outlines(view, polygons, draped)
        if shapes is None:
            return
        painted = visible[shapes.numbers]
        first = field.first_row
        bands = bands_of(view, shapes, first)
        drawing.draw_paint(
            bands, first, edges_of(shapes), shapes.edge_rows, field.rays, field.planes,
            tuple(tile.padded for tile in self._tiles), self._scales[painted], self._looks[painted],
            self._kinds[painted], np.empty_like(field.x_m[:1]), albedo, labels,
        )  # fmt: skip


def _look(paint: Paint) -> Float32:
    """The level of noise below which paint has worn off, its dirt and its reflectance."""
    # The standard normal quantile by Tukey's lambda approximation (0.14), good to 0.01 within +-2.5.
    p = min(max(paint.wear, 1e-3), 1 - 1e-3)
    threshold = float((p**0.14 - (1 - p) ** 0.14) * 4.91) * 1.22
    return np.array([threshold, paint.dirt, *paint.albedo_bgr], dtype=np.float32)
