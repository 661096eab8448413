"""The boxes on the ground, drawn from far to near over it, and the sky and skyline behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.records import FloatArray
from v2hdm.simulate.render import kernels
from v2hdm.simulate.render.scene import Backdrop, Box, Light, box_footprint
from v2hdm.simulate.render.textures import Float32, noise_tile, sample, scale_of
from v2hdm.simulate.render.view import Outline, View, bands_of, edges_of, in_view, outlines

_CORRUGATION_M = 0.28
_DIRT_TILE = noise_tile(17, 6.0, 1.2)
_FARTHEST_M = 250.0


@dataclass(frozen=True)
class _Face:
    """A rectangle: its corners (4, 3), its axes from the first corner with their lengths, its normal."""

    corners_map: FloatArray
    normal: FloatArray
    upright: bool
    picture: NDArray[np.uint8] | None = None


def draw_boxes(
    boxes: tuple[Box, ...], light: Light, view: View, radiance: Float32, hidden: NDArray[np.bool_]
) -> None:
    """Draw boxes over ``radiance`` (H, W, 3) and mark in ``hidden`` (H, W) what lies behind them."""
    centre = view.centre_map
    if not boxes:
        return
    footprints = np.array([box_footprint(box) for box in boxes])
    levels = np.array([[box.base_m, box.base_m + box.size_m[2]] for box in boxes])
    corners = np.concatenate([np.insert(footprints, 2, level[:, None], axis=2) for level in levels.T], axis=1)
    visible = [boxes[k] for k in in_view(view, view.homogeneous_px(corners), _FARTHEST_M)]

    def distance(box: Box) -> float:
        return float(np.hypot(*(np.array(box.centre_map) - centre[:2])))

    # Of stacked boxes the upper comes first: its underside lies behind the one below.
    ordered = sorted(visible, key=lambda b: (distance(b), b.base_m), reverse=True)
    faces = [(box, face) for box in ordered for face in _faces(box)]
    turned = [one for one in faces if (centre - one[1].corners_map[0]) @ one[1].normal > 1e-3]
    shapes = outlines(view, [view.homogeneous_px(face.corners_map) for _, face in turned])
    for (box, face), shape in zip(turned, shapes, strict=True):
        if shape is not None:
            _draw_face(box, face, shape, light, view, radiance, hidden)


def _faces(box: Box) -> list[_Face]:
    footprint = box_footprint(box)
    low, high = box.base_m, box.base_m + box.size_m[2]
    faces = []
    pictures = (*box.pictures, *(None,) * 6)
    for k in range(4):
        a, b = footprint[k], footprint[(k + 1) % 4]
        along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
        corners = np.array([[*a, low], [*b, low], [*b, high], [*a, high]])
        faces.append(_Face(corners, np.array([along[1], -along[0], 0.0]), True, pictures[k]))
    for level, up, picture in ((high, 1.0, pictures[4]), (low, -1.0, None)):
        if level > 0:
            corners = np.column_stack([footprint, np.full(4, level)])
            faces.append(_Face(corners, np.array([0.0, 0.0, up]), False, picture))
    return faces


def _draw_face(
    box: Box,
    face: _Face,
    shape: Outline,
    light: Light,
    view: View,
    radiance: Float32,
    hidden: NDArray[np.bool_],
) -> None:
    sun = max(float(face.normal @ np.array(light.sun_direction_map)), 0.0)
    sky = 0.55 + 0.45 * face.normal[2]
    lit = [
        sun * s + (sky if face.normal[2] >= 0 else 0.35) * d
        for s, d in zip(light.sun_bgr, light.sky_bgr, strict=True)
    ]
    edges, rays = edges_of(shape, grown_px=0.5), (view.rays.u_pinhole_px, view.rays.v_pinhole_px)
    face_from_pinhole, per_focal = _plane_of(face, view), np.float32(1.0 / view.rays.info.intrinsic[0, 0])
    offset = (float(box.seed % 101) * 0.37, float(box.seed % 71) * 0.29)
    scale, waves = np.array(scale_of(_DIRT_TILE, offset), dtype=np.float32), np.empty((0, 0), np.float32)
    found, count = bands_of(view, shape)
    for window in found[:count]:
        seen = np.empty((4, window[1] - window[0], window[3] - window[2]), dtype=np.float32)
        if not kernels.look_at_face(window, edges, rays, face_from_pinhole, per_focal, seen):
            continue
        if box.corrugated and face.upright:
            waves = np.sin(seen[1] * np.float32(2 * np.pi / _CORRUGATION_M))
        colour = _colour(box, face, lit, *seen[1:])
        kernels.draw_face(
            window, seen, _DIRT_TILE.padded, scale, waves, face.upright, colour, radiance, hidden
        )


def _colour(
    box: Box, face: _Face, lit: Sequence[float], along_m: Float32, up_m: Float32, footprint_m: Float32
) -> Float32:
    """The light (3, h, w) that a face of no other tone sends from a window, or (3, 1, 1) where it is one."""
    albedo = _albedo(box, face, along_m, up_m, footprint_m)
    parts = [np.asarray(part * light, dtype=np.float32) for part, light in zip(albedo, lit, strict=True)]
    return np.stack(parts).reshape(3, *(parts[0].shape or (1, 1)))


def _albedo(
    box: Box, face: _Face, along_m: Float32, up_m: Float32, footprint_m: Float32
) -> Sequence[float] | Float32:
    """Reflectance of a face in blue, green and red: its box's colour, or its picture's (3, h, w)."""
    if face.picture is None:
        return box.albedo_bgr
    origin, first, _, last = face.corners_map
    sides_m = np.array([np.linalg.norm(first - origin), np.linalg.norm(last - origin)])
    # Fewer texels than pixels would shimmer: the picture is first averaged to the size it is seen at.
    most = np.ceil(sides_m / max(float(np.median(footprint_m)), 1e-4)).astype(int)
    columns, rows = (int(n) for n in np.clip(most, 1, face.picture.shape[1::-1]))
    picture = cv2.resize(face.picture, (columns, rows), interpolation=cv2.INTER_AREA)
    u = along_m * np.float32(columns / sides_m[0]) - np.float32(0.5)
    v = np.float32(rows - 0.5) - up_m * np.float32(rows / sides_m[1])
    shown = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.moveaxis(shown.astype(np.float32) * np.float32(1 / 255), 2, 0)


def _plane_of(face: _Face, view: View) -> Float32:
    """Metres along a face's first and last edge, and the inverse depth, from pinhole pixels (3, 3)."""
    origin, first, last = face.corners_map[0], face.corners_map[1], face.corners_map[3]
    sides = (first - origin, last - origin)
    axes = np.column_stack([side / max(float(np.linalg.norm(side)), 1e-9) for side in sides])
    rotation, translation = view.cam_from_map[:3, :3], view.cam_from_map[:3, 3]
    cam_from_face = np.column_stack([rotation @ axes, rotation @ origin + translation])
    return np.linalg.inv(view.rays.info.intrinsic @ cam_from_face).astype(np.float32)


_CLOUD_TILE = noise_tile(18, 3.0, 1.5)


@cache
def _skyline(seed: int, blocks: int) -> Float32:
    """Heights relative to the tallest, and tones, (2, blocks) of the blocks around the horizon."""
    rng = np.random.default_rng([seed, 41])
    heights = rng.choice([0.15, 0.3, 0.5, 0.7, 1.0], blocks) * rng.uniform(0.85, 1.0, blocks)
    return np.stack([heights, rng.uniform(0.5, 1.6, blocks)]).astype(np.float32)


def draw_background(view: View, light: Light, backdrop: Backdrop, last_row: int) -> Float32:
    """Radiance (last_row, W, 3) of sky and skyline for the image rows above ``last_row``."""
    rotation = (view.cam_from_map[:3, :3].T @ np.linalg.inv(view.rays.info.intrinsic)).astype(np.float32)
    u, v = view.rays.u_pinhole_px[:last_row], view.rays.v_pinhole_px[:last_row]
    x, y, z = (row[0] * u + row[1] * v + row[2] for row in rotation)
    level = np.hypot(x, y)
    elevation = np.arctan2(z, level)
    azimuth = np.arctan2(y, x)
    height = np.clip(elevation * np.float32(2.2), 0, 1)[..., None]
    clouds = sample(_CLOUD_TILE, azimuth, elevation * 2)[..., None]
    horizon, zenith = (np.array(c, dtype=np.float32) for c in (light.horizon_bgr, light.zenith_bgr))
    out = horizon + (zenith - horizon) * np.sqrt(height)
    out *= np.float32(1.0) + np.float32(0.05) * clouds
    blocks = max(int(2 * np.pi / backdrop.block_rad), 8)
    skyline = _skyline(backdrop.seed, blocks)
    turn = (azimuth + np.float32(np.pi)) * np.float32(blocks / (2 * np.pi))
    index = np.floor(turn).astype(np.int32) % blocks
    above = skyline[0][index] * np.float32(backdrop.height_rad) - elevation
    covered = np.clip(above / np.float32(1.0 / view.rays.info.intrinsic[0, 0]) + 0.5, 0, 1)
    wall = np.array(backdrop.albedo_bgr, dtype=np.float32) * skyline[1][index][..., None]
    return np.asarray(out + covered[..., None] * (wall - out), dtype=np.float32)
