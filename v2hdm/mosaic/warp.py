"""From images to the ground: which tiles of a canvas each shows, and where their pixels lie in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from kornia.geometry.linalg import transform_points
from scipy.spatial import cKDTree
from torch import Tensor

from v2hdm.detection.frames import read_bgr
from v2hdm.errors import DriveError
from v2hdm.geometry import tensors
from v2hdm.geometry.ipm import apply_homography
from v2hdm.geometry.planar import turned_left
from v2hdm.mosaic.views import Canvas, Lens, Shot
from v2hdm.records import BoolArray, FloatArray

TILE_PX = 64  # side of a tile, px of the canvas
_NODE_PX = 4  # distance of the points of a tile at which the lens is evaluated, px of the canvas
_FAR_OUT = 99.0  # a place outside of any image, in halves of its size from its middle
SHEET_PX = 2048  # side of a sheet, px of the canvas: 70 MB of weighted sums where all of it is seen
_ROW_M = 6.0  # markings of a row are no farther apart than twice this, m; chosen
_FARTHEST_M = 14.0  # distance of paint from the way up to which the mosaic reaches, m; chosen
_KEPT_IMAGES = 96  # decoded images that neighbouring sheets share, 1.5 MB each


Views = list[tuple[int, FloatArray]]
"""Images that show a sheet: the index of each and the (column, row) of the tiles (T, 2) that it shows."""


def plan_sheets(
    canvas: Canvas, shots: Sequence[Shot], lenses: Mapping[str, Lens], area: Area | None
) -> list[tuple[tuple[int, int], Views]]:
    """By the first pixel (row, column) of each sheet, in the order of the first image: its views.

    Tiles outside of the ``area`` are left out.
    """
    canvas_from_map = canvas.canvas_from_map
    in_sheet = SHEET_PX // TILE_PX
    limit = np.ceil([canvas.columns / TILE_PX, canvas.rows / TILE_PX]).astype(int)
    plan: dict[tuple[int, int], Views] = {}
    for index, shot in enumerate(shots):
        outline = shot.outline_map(lenses[shot.camera])
        tiles = tiles_under(outline @ canvas_from_map[:2, :2].T + canvas_from_map[:2, 2], limit)
        if area is not None:
            tiles = tiles[area.meets(canvas, tiles)]
        for sheet in np.unique(tiles // in_sheet, axis=0):
            mine = tiles[(tiles // in_sheet == sheet).all(axis=1)] - sheet * in_sheet
            key = (int(sheet[1]) * SHEET_PX, int(sheet[0]) * SHEET_PX)
            plan.setdefault(key, []).append((index, mine))
    return list(plan.items())


def tiles_under(polygon: FloatArray, limit: np.ndarray) -> np.ndarray:
    """The (column, row) of the tiles (T, 2) that share ground with a convex polygon (N, 2), in pixels."""
    low = np.maximum(np.floor((polygon.min(axis=0) - 1) / TILE_PX).astype(int), 0)
    high = np.minimum(np.floor((polygon.max(axis=0) + 1) / TILE_PX).astype(int) + 1, limit)
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    tiles = np.column_stack([columns.ravel(), rows.ravel()])
    normal = turned_left(np.roll(polygon, -1, axis=0) - polygon)
    normal *= np.sign(np.einsum("ni,ni->n", normal, polygon.mean(axis=0) - polygon))[:, None]
    corners = TILE_PX * np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) - 0.5
    reach = ((TILE_PX * tiles[:, None, None] + corners[:, None] - polygon) * normal).sum(axis=-1)
    return np.asarray(tiles[(reach.max(axis=1) >= 0).all(axis=1)])


@dataclass(frozen=True)
class Area:
    """The ground that a mosaic shows: discs about points of the cameras' way, each with a radius, m."""

    way: cKDTree
    reach_m: FloatArray  # (P,)

    @classmethod
    def along(cls, way_map: FloatArray, paint_map: FloatArray, least_m: float, beyond_m: float) -> Area:
        """The ground ``least_m`` beside a way (P, 2), and ``beyond_m`` beyond the paint (N, 2) beside it."""
        way = cKDTree(way_map)
        aside_m, nearest = way.query(paint_map)
        reach_m = np.full(len(way_map), least_m)
        np.maximum.at(reach_m, nearest, np.minimum(aside_m, _FARTHEST_M) + beyond_m)
        # As wide between two markings of a row as beside them.
        around = way.query_ball_point(way_map, _ROW_M)
        reach_m = np.array([reach_m[indices].max() for indices in around])
        return cls(way, reach_m)

    @property
    def corners_map(self) -> FloatArray:
        """The corners (2, 2) of a box that holds it all."""
        points_map = np.asarray(self.way.data)
        reach_m = self.reach_m[:, None]
        return np.stack([(points_map - reach_m).min(axis=0), (points_map + reach_m).max(axis=0)])

    def holds(self, points_map: FloatArray, further_m: float = 0.0) -> BoolArray:
        """Which points (N, 2) lie within it, or ``further_m`` from it."""
        distance_m, nearest = self.way.query(points_map)
        return np.asarray(distance_m <= self.reach_m[nearest] + further_m)

    def meets(self, canvas: Canvas, tiles: np.ndarray) -> BoolArray:
        """Which tiles (T, 2) of (column, row) of a canvas may hold some of it."""
        centres = apply_homography(canvas.map_from_canvas, TILE_PX * (tiles + 0.5) - 0.5)
        return self.holds(centres, canvas.cell_m * TILE_PX / np.sqrt(2))


@dataclass(frozen=True)
class Source:
    """An image cut to the rows and columns that are trusted: (4, height, width), B, G, R and trust."""

    values: Tensor
    corner_px: tuple[int, int]
    lens: Lens


def sources(
    shots: Sequence[Shot], lenses: Mapping[str, Lens], device: str, order: Sequence[int]
) -> Iterator[Source]:
    """The images of shots in some order; the next is decoded meanwhile, the last used stay decoded."""
    boxes = {name: _box(lens.trust) for name, lens in lenses.items()}
    trusts = {key: torch.from_numpy(lenses[key].trust[box].copy()).to(device) for key, box in boxes.items()}

    @lru_cache(maxsize=_KEPT_IMAGES)
    def decoded(path: Path, camera: str) -> np.ndarray:
        pixels = read_bgr(path)
        lens = lenses[camera]
        if pixels.shape[:2] != lens.trust.shape:
            raise DriveError(
                f"{path}: the image is {pixels.shape[1]}x{pixels.shape[0]} but camera {camera!r} has "
                f"{lens.info.width}x{lens.info.height}; fix its camera_info or images"
            )
        return pixels[boxes[camera]].copy()

    ordered = [shots[index] for index in order]
    with ThreadPoolExecutor(1) as decoder:
        ahead = [decoder.submit(decoded, shot.path, shot.camera) for shot in ordered[:1]]
        for shot, following in zip(ordered, [*ordered[1:], None], strict=True):
            pixels = ahead.pop().result()
            if following is not None:
                ahead.append(decoder.submit(decoded, following.path, following.camera))
            box = boxes[shot.camera]
            trust = trusts[shot.camera]
            values = torch.empty((4, *trust.shape), dtype=torch.float32, device=device)
            values[:3] = torch.from_numpy(pixels).to(device).permute(2, 0, 1)
            values[3] = trust
            yield Source(values, (box[1].start, box[0].start), lenses[shot.camera])


def _box(trust: np.ndarray) -> tuple[slice, slice]:
    """The rows and columns that are trusted at all, and one around them."""
    trusted = (np.flatnonzero(trust.any(axis=axis)) for axis in (1, 0))
    rows, columns = (slice(max(int(index[0]) - 1, 0), int(index[-1]) + 2) for index in trusted)
    return rows, columns


class Warped(NamedTuple):
    """Where pixels (T, side, side) lie in an image, as ``grid_sample`` has it, and their density."""

    x: Tensor
    y: Tensor
    density: Tensor  # px of the image that a px of the canvas covers; 0 behind the camera


class Warp:
    """The way from the tiles of a sheet into images."""

    def __init__(self, device: str) -> None:
        at = torch.arange(0, TILE_PX + 1, _NODE_PX, device=device).float()
        self._nodes = torch.cartesian_prod(at, at).flip(1)
        x, y = (self._nodes / TILE_PX).T
        self._from_corners = torch.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], dim=1)
        distance_px = (torch.arange(TILE_PX, device=device)[:, None] - at).abs()
        self._from_nodes = (1 - distance_px / _NODE_PX).clamp(min=0)  # hat functions (TILE_PX, nodes)

    def __call__(self, source: Source, shot: Shot, map_from_sheet: FloatArray, tiles: np.ndarray) -> Warped:
        """Where the pixels of tiles (T, 2) of (column, row) lie in an image.

        The lens is evaluated at nodes. Times the third coordinate, where a pixel lies is linear on the ground
        but for the lens: interpolated so, a pixel is at most 0.01 px off, or 0.1 px a metre from a fisheye.
        """
        points = TILE_PX * torch.from_numpy(tiles).to(self._nodes)[:, None] + self._nodes
        if shot.on_plane is not None:
            corners = TILE_PX * (tiles[:, None] + np.array([[0, 0], [1, 0], [0, 1], [1, 1]])).reshape(-1, 2)
            sheet_from_map = np.asarray(np.linalg.inv(map_from_sheet), dtype=np.float64)
            moved = shot.on_plane(apply_homography(map_from_sheet, corners.astype(np.float64)))
            moved_px = torch.from_numpy(apply_homography(sheet_from_map, moved) - corners)
            points = points + self._from_corners @ moved_px.reshape(-1, 4, 2).to(points)
        pinhole_px_from_sheet = shot.pinhole_px_from_map @ map_from_sheet
        homography = torch.from_numpy(pinhole_px_from_sheet).to(points)
        third = points @ homography[2, :2] + homography[2, 2]
        pinhole_px = transform_points(homography.expand(len(tiles), 3, 3), points)
        px = tensors.distort_points(source.lens.info, pinhole_px.reshape(-1, 2)).reshape(points.shape)
        height, width = source.values.shape[1:]
        placed = 2 * (px - px.new_tensor(source.corner_px)) / px.new_tensor([width - 1, height - 1]) - 1
        # In the camera's plane a lens has no end; what lies there must not spoil the rest of its tile.
        placed = placed.nan_to_num(_FAR_OUT).clamp(-_FAR_OUT, _FAR_OUT)
        nodes = torch.stack([*(placed * third[..., None]).unbind(-1), third])
        side = len(self._from_nodes.T)
        x, y, third = self._from_nodes @ nodes.reshape(3, len(tiles), side, side) @ self._from_nodes.T
        in_front = third > 0  # a tile may reach beyond the horizon, where no image shows the ground
        depth = third.where(in_front, third.new_tensor(1.0))
        density = float(np.linalg.det(pinhole_px_from_sheet)) / depth**3
        placed = torch.stack([x, y]) / depth
        x, y = placed.where(in_front, placed.new_tensor(_FAR_OUT))
        return Warped(x, y, density * in_front)
