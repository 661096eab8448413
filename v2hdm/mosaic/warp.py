"""From images to the ground: which tiles of a canvas each shows, and where their pixels lie in it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from scipy.spatial import cKDTree

from v2hdm.detection.frames import read_bgr
from v2hdm.errors import DriveError, WorkerError
from v2hdm.executor import HERE, Executor
from v2hdm.geometry.ipm import apply_homography
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.planar import turned_left
from v2hdm.mosaic.views import Canvas, Lens, Shot
from v2hdm.progress import Progress, Steps
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.safe.pixels import read_pixels

TILE_PX = 64  # side of a tile, px of the canvas
_FAR_OUT_PX = 1e5  # a place outside of any image, px from its corner
_ROW_M = 6.0  # markings of a row are no farther apart than twice this, m; chosen
_FARTHEST_M = 14.0  # distance of paint from the way up to which the mosaic reaches, m; chosen
_FEW_SHEETS = 3  # most sheets that are done faster here than other processes start; chosen
_KEPT_BYTES = 500_000_000  # size of decoded images that neighbouring sheets share, 2 MB each; chosen

_Result = TypeVar("_Result")

Views = list[tuple[int, FloatArray]]
"""Images that show a sheet: the index of each and the (column, row) of the tiles (T, 2) that it shows."""


class SheetPlan(NamedTuple):
    """A sheet by its first pixel, and what shows it."""

    row: int
    column: int
    views: Views


def plan_sheets(
    canvas: Canvas, shots: Sequence[Shot], lenses: Mapping[str, Lens], area: Area | None, side_px: int
) -> list[SheetPlan]:
    """The sheets of ``side_px`` that any image shows, in the order of the first image.

    Tiles outside of the ``area`` are left out.
    """
    canvas_from_map = canvas.canvas_from_map
    limit = np.ceil([canvas.columns / TILE_PX, canvas.rows / TILE_PX]).astype(int)
    outlines = [shot.outline_map(lenses[shot.camera]) for shot in shots]
    by_shot = [
        tiles_under(outline @ canvas_from_map[:2, :2].T + canvas_from_map[:2, 2], limit)
        for outline in outlines
    ]
    tiles = np.concatenate([np.empty((0, 2), dtype=int), *by_shot])
    shot_of = np.repeat(np.arange(len(shots)), [len(shown) for shown in by_shot])
    if area is not None:
        # Each tile once, as many images show it.
        number, place = np.unique(tiles @ [1, limit[0]], return_inverse=True)
        is_meant = area.meets(canvas, np.column_stack([number % limit[0], number // limit[0]]))[place]
        tiles = tiles[is_meant]
        shot_of = shot_of[is_meant]
    in_sheet = side_px // TILE_PX
    sheet = tiles // in_sheet
    order = np.lexsort([shot_of, sheet[:, 1], sheet[:, 0]])
    plan = []
    for of_sheet in _runs(order, sheet):
        column, row = sheet[of_sheet[0]].tolist()
        views = [
            (int(shot_of[of_view[0]]), tiles[of_view] - [in_sheet * column, in_sheet * row])
            for of_view in _runs(of_sheet, shot_of[:, None])
        ]
        plan.append(SheetPlan(side_px * row, side_px * column, views))
    return sorted(plan, key=lambda sheet: sheet.views[0][0])


def _runs(order: IntArray, keys: np.ndarray) -> list[IntArray]:
    """The parts of an ``order`` in which rows of ``keys`` (N, ...) are the same; empty for an empty one."""
    if not len(order):
        return []
    is_new = (np.diff(keys[order], axis=0) != 0).any(axis=1)
    return np.split(order, np.flatnonzero(is_new) + 1)


def over_sheets(
    work: Callable[[SheetPlan, Progress], _Result],
    plan: Sequence[SheetPlan],
    progress: Steps | None,
    executor: Executor,
) -> Iterator[_Result]:
    """The results of work on sheets as they are done, few of them in this process.

    ``progress`` counts images put onto sheets. Raises errors of the work, or WorkerError if a process died.
    """
    total = sum(len(sheet.views) for sheet in plan)
    done = 0
    executor = executor if len(plan) > _FEW_SHEETS else HERE
    with closing(executor.side_by_side(work, plan)) as outcomes:
        for number, outcome in outcomes:
            if isinstance(outcome, WorkerError):
                raise outcome
            done += len(plan[number].views)
            if progress:
                progress(done, total)
            yield outcome


def tiles_under(polygon: FloatArray, limit: np.ndarray) -> np.ndarray:
    """The (column, row) of the tiles (T, 2) that share ground with a convex polygon (N, 2), in pixels."""
    low = np.maximum(np.floor((polygon.min(axis=0) - 1) / TILE_PX).astype(int), 0)
    high = np.minimum(np.floor((polygon.max(axis=0) + 1) / TILE_PX).astype(int) + 1, limit)
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    tiles = np.column_stack([columns.ravel(), rows.ravel()])
    normal = turned_left(np.roll(polygon, -1, axis=0) - polygon)
    normal *= np.sign(np.einsum("ni,ni->n", normal, polygon.mean(axis=0) - polygon))[:, None]
    # Of a tile's corners the same one reaches farthest across an edge, whichever tile it is.
    corners = TILE_PX * np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) - 0.5
    farthest = (normal @ corners.T).max(axis=1) - np.einsum("ni,ni->n", normal, polygon)
    reach = normal @ (TILE_PX * tiles.T.astype(np.float64)) + farthest[:, None]
    return np.asarray(tiles[(reach >= 0).all(axis=0)])


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


class Sources:
    """The images of shots, each cut to the rows and columns that are trusted."""

    def __init__(self, shots: Sequence[Shot], lenses: Mapping[str, Lens], is_grey: bool = False) -> None:
        self._shots = shots
        self._lenses = lenses
        self._is_grey = is_grey

    @cached_property  # not before the first image, as what is made then cannot go to another process
    def _decoded(self) -> Callable[[Path, str], np.ndarray]:
        channels = 1 if self._is_grey else 3
        largest_bytes = max(channels * lens.trusted_part.size for lens in self._lenses.values())
        return lru_cache(maxsize=max(_KEPT_BYTES // largest_bytes, 1))(self._decode)

    def _decode(self, path: Path, camera: str) -> np.ndarray:
        pixels = read_pixels(path, cv2.IMREAD_GRAYSCALE) if self._is_grey else read_bgr(path)
        lens = self._lenses[camera]
        if pixels.shape[:2] != lens.trust.shape:
            raise DriveError(
                f"{path}: the image is {pixels.shape[1]}x{pixels.shape[0]} but camera {camera!r} has "
                f"{lens.info.width}x{lens.info.height}; fix its camera_info or images"
            )
        return pixels[lens.trusted_box].copy()

    def in_order(self, order: Sequence[int]) -> Iterator[np.ndarray]:
        """Images, uint8, (height, width) or (height, width, 3) BGR; the next is decoded meanwhile.

        The last used stay decoded.
        """
        shots = [self._shots[index] for index in order]
        with ThreadPoolExecutor(1) as decoder:
            ahead = [decoder.submit(self._decoded, shot.path, shot.camera) for shot in shots[:1]]
            for number in range(len(shots)):
                pixels = ahead.pop().result()
                for shot in shots[number + 1 : number + 2]:
                    ahead.append(decoder.submit(self._decoded, shot.path, shot.camera))
                yield pixels


def sample(image: np.ndarray, x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
    """The values (T, side, side, ...) of an image at places (T, side, side), bilinear, and 0 outside."""
    # Flat, as OpenCV takes two dimensions.
    count = len(x_px)
    values = cv2.remap(image, x_px.reshape(count, -1), y_px.reshape(count, -1), cv2.INTER_LINEAR)
    return values.reshape(*x_px.shape, *image.shape[2:])


def _homogeneous(dst_from_src: FloatArray, x: FloatArray, y: FloatArray) -> list[FloatArray]:
    """The three coordinates of points, each in an array of its own, mapped by a homography (3, 3)."""
    return [(by_x * x + offset) + by_y * y for by_x, by_y, offset in dst_from_src]


class Nodes(NamedTuple):
    """Where nodes of tiles, each (T, side, side), lie in an image that is cut to what is trusted."""

    x_px: FloatArray
    y_px: FloatArray
    third: FloatArray  # coordinate of the mapped point, proportional to its depth
    volume: float  # of the density, times the third power of that

    @property
    def density(self) -> FloatArray:
        """Px of the image that a px of the canvas covers at each node; 0 behind the camera."""
        return self.volume / np.where(self.third > 0, self.third, np.inf) ** 3


class Pixels(NamedTuple):
    """Where pixels of tiles (T, side, side), float32, lie in such an image, and their density."""

    x_px: np.ndarray
    y_px: np.ndarray
    density: np.ndarray


class Warp:
    """The way from the tiles of a sheet into images: exact at nodes, interpolated between them."""

    def __init__(self, map_from_sheet: FloatArray, step_px: int) -> None:
        """Nodes are ``step_px`` of the canvas apart, which divides :data:`TILE_PX`."""
        self._map_from_sheet = map_from_sheet
        at_px = np.arange(0, TILE_PX + 1, step_px)
        self._at_px = at_px
        x, y = np.meshgrid(at_px / TILE_PX, at_px / TILE_PX)
        self._from_corners = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=-1)
        distance_px = np.abs(np.arange(TILE_PX)[:, None] - at_px)
        # Hat functions (TILE_PX, nodes of a side).
        self._from_nodes = (1 - distance_px / step_px).clip(min=0).astype(np.float32)

    def _nodes_of(self, tiles: np.ndarray) -> tuple[FloatArray, FloatArray]:
        """The nodes of tiles (T, 2) of (column, row), px of the sheet: x (T, 1, side) and y (T, side, 1)."""
        x, y = np.asarray(TILE_PX * tiles.T[..., None] + self._at_px, dtype=np.float64)
        return x[:, None], y[:, :, None]

    def nodes_map(self, tiles: np.ndarray) -> FloatArray:
        """The nodes (T, side, side, 2) of tiles (T, 2) of (column, row), m in the map."""
        x, y, third = _homogeneous(self._map_from_sheet, *self._nodes_of(tiles))
        return np.stack([x / third, y / third], axis=-1)

    def nodes(self, shot: Shot, lens: Lens, tiles: np.ndarray) -> Nodes:
        """Where the nodes of tiles (T, 2) of (column, row) lie in an image."""
        x, y = self._nodes_of(tiles)
        if shot.on_plane is not None:
            corners = TILE_PX * (tiles[:, None] + np.array([[0, 0], [1, 0], [0, 1], [1, 1]])).reshape(-1, 2)
            sheet_from_map = np.asarray(np.linalg.inv(self._map_from_sheet), dtype=np.float64)
            moved = shot.on_plane(apply_homography(self._map_from_sheet, corners.astype(np.float64)))
            moved_px = apply_homography(sheet_from_map, moved) - corners
            moves = np.moveaxis(self._from_corners @ moved_px.reshape(-1, 1, 4, 2), -1, 0)
            x = x + moves[0]
            y = y + moves[1]
        pinhole_px_from_sheet = shot.pinhole_px_from_map @ self._map_from_sheet
        across, down, third = _homogeneous(pinhole_px_from_sheet, x, y)
        with np.errstate(all="ignore"):  # in the camera's plane, where the lens has no end
            pinhole_px = np.stack([across / third, down / third], axis=-1)
            px = distort_points(lens.info, pinhole_px.reshape(-1, 2)).reshape(pinhole_px.shape)
        rows, columns = lens.trusted_box
        # What lies far out, or nowhere, must not spoil the rest of its tile.
        x_px, y_px = (
            np.fmax(np.fmin(px[..., axis] - first, _FAR_OUT_PX), -_FAR_OUT_PX)
            for axis, first in enumerate((columns.start, rows.start))
        )
        return Nodes(x_px, y_px, third, float(np.linalg.det(pinhole_px_from_sheet)))

    def between(self, values: np.ndarray) -> np.ndarray:
        """Values (..., side, side) of nodes at the pixels (..., TILE_PX, TILE_PX) of their tiles, float32."""
        return np.asarray(self._from_nodes @ (values.astype(np.float32) @ self._from_nodes.T))

    def pixels(self, nodes: Nodes) -> Pixels:
        """Where the pixels of the tiles lie.

        Times the third coordinate, where a pixel lies is linear on the ground but for the lens: interpolated
        so between nodes 4 px of 2 cm apart, it is at most 0.01 px off, or 0.1 px a metre from a fisheye.
        """
        x, y, third = self.between(
            np.stack([nodes.x_px * nodes.third, nodes.y_px * nodes.third, nodes.third])
        )
        # A tile may reach beyond the horizon, where no image shows the ground.
        is_behind = third <= 0 if (nodes.third <= 0).any() else None
        if is_behind is not None:
            third[is_behind] = np.inf
        nearness = 1 / third
        x *= nearness
        y *= nearness
        if is_behind is not None:
            x[is_behind] = _FAR_OUT_PX
            for place_px in (x, y):
                np.clip(place_px, -_FAR_OUT_PX, _FAR_OUT_PX, out=place_px)
        return Pixels(x, y, np.float32(nodes.volume) * nearness * nearness * nearness)
