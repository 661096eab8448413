"""All images of a drive on one canvas: the mean of what they show, weighted by how finely they show it.

An image counts with the number of its pixels that a pixel of the canvas covers: ``det(H) / w^3``, H the
homography from canvas to image and ``w`` the third coordinate of the mapped point, which is proportional to
its depth. What the image is trusted for is warped with its colours, in one pass. The canvas is done in
sheets, so that memory does not grow with the drive, and each in tiles of which an image touches only those
that it shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from kornia.geometry.linalg import transform_points
from kornia.geometry.transform import remap
from torch import Tensor

from v2hdm.detection.frames import read_bgr
from v2hdm.errors import DriveError
from v2hdm.geometry import tensors
from v2hdm.geometry.ipm import (
    apply_homography,
    facing_ipm,
    flat_motion,
    pinhole_px_from_ground,
    project_ground,
)
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.planar import densified, turned_left
from v2hdm.geometry.rigid import interpolate, inverse
from v2hdm.progress import Steps
from v2hdm.records import Calibration, Camera, CameraInfo, Drive, FloatArray, Trajectory
from v2hdm.surface.surface import Surface


class Bounds(NamedTuple):
    """Edges of a canvas with north above, m in the map."""

    west: float
    south: float
    east: float
    north: float


@dataclass(frozen=True)
class Canvas:
    """Square pixels on the ground, seen from above; north is above where columns rise east."""

    corner_map: FloatArray  # (2,) m, outer corner of the first pixel
    cell_m: float
    rows: int
    columns: int
    right_map: tuple[float, float] = (1.0, 0.0)  # unit vector of rising columns

    @property
    def canvas_from_map(self) -> FloatArray:
        """The inverse of :attr:`map_from_canvas`."""
        return np.asarray(np.linalg.inv(self.map_from_canvas), dtype=np.float64)

    @property
    def map_from_canvas(self) -> FloatArray:
        """The homography (3, 3) to the map of (column, row); (0, 0) is the centre of the first pixel."""
        x, y = self.right_map
        axes = self.cell_m * np.array([[x, y], [y, -x]])
        out = np.eye(3)
        out[:2, :2] = axes
        out[:2, 2] = self.corner_map + axes @ [0.5, 0.5]
        return out

    def window(self, row: int, column: int, rows: int, columns: int) -> Canvas:
        """A part of the canvas."""
        x, y = self.right_map
        corner = self.corner_map + self.cell_m * (column * np.array([x, y]) + row * np.array([y, -x]))
        return Canvas(corner, self.cell_m, rows, columns, self.right_map)

    @classmethod
    def around(cls, points_map: FloatArray, cell_m: float, multiple_px: int = 1) -> Canvas:
        """The smallest one, north above, around points (N, 2) m, by ``multiple_px`` whole pixels."""
        low = np.floor(points_map.min(axis=0) / cell_m)
        high = np.ceil(points_map.max(axis=0) / cell_m)
        columns, rows = (np.ceil((high - low) / multiple_px) * multiple_px).astype(int).tolist()
        corner = np.array([low[0], high[1]]) * cell_m
        return cls(corner, cell_m, rows, columns)

    @property
    def bounds_m(self) -> Bounds:
        """The edges of a canvas with north above."""
        west, north = (float(value) for value in self.corner_map)
        south = north - self.rows * self.cell_m
        east = west + self.columns * self.cell_m
        return Bounds(west, south, east, north)


FEATHER = 1 / 15  # band at the edge of what is trusted where the weight rises to 1, in heights of the image
_OUTLINE_STEP_PX = 16  # distance of the points by which the outline of what is trusted is laid on the ground


@dataclass(frozen=True)
class Lens:
    """One camera: its intrinsics, and how far each pixel is trusted to show the ground."""

    info: CameraInfo
    trust: np.ndarray  # (height, width) float32, 1 within, 0 outside of the ROI and on its own vehicle
    outline_pinhole_px: FloatArray  # (N, 2) convex hull of what is trusted


@dataclass(frozen=True)
class Shot:
    """One image, and the homography of the map's ground plane, positive in front of the camera."""

    path: Path
    camera: str
    pinhole_px_from_map: FloatArray
    # points (K, 2) of that plane seen where the ground's are, None where it is the plane
    on_plane: Callable[[FloatArray], FloatArray] | None = None

    def outline_map(self, lens: Lens) -> FloatArray:
        """The ground (N, 2), m, that is trusted: a convex polygon."""
        map_from_pinhole_px = np.asarray(np.linalg.inv(self.pinhole_px_from_map), dtype=np.float64)
        return apply_homography(map_from_pinhole_px, lens.outline_pinhole_px)


def lens_of(camera: Camera, cam_from_vehicle: FloatArray) -> Lens:
    """The part of an image that shows ground within the ROI, feathered, less the vehicle where known."""
    info = camera.info
    pinhole_px, _ = project_ground(info.intrinsic, cam_from_vehicle, densified(camera.roi_vehicle, 16))
    inside = np.zeros((info.height + 2, info.width + 2), dtype=np.uint8)
    roi_px = np.round(distort_points(info, pinhole_px)).astype(np.int32)
    cv2.fillPoly(inside, [roi_px + 1], 1)
    if camera.own_vehicle is not None:
        inside[1:-1, 1:-1][camera.own_vehicle] = 0
    # The frame of zeros makes the image's border an edge, too.
    inside[[0, -1]] = inside[:, [0, -1]] = 0
    depth_px = cv2.distanceTransform(inside, cv2.DIST_L2, 5)[1:-1, 1:-1]
    trust = np.clip(depth_px / (FEATHER * info.height), 0, 1).astype(np.float32)
    contours, _ = cv2.findContours(inside[1:-1, 1:-1], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    edge = np.concatenate([contour[::_OUTLINE_STEP_PX, 0] for contour in contours])
    hull = cv2.convexHull(undistort_points(info, edge.astype(np.float64)).astype(np.float32))[:, 0]
    return Lens(info, trust, hull.astype(np.float64))


def recorded_shots(drive: Drive) -> list[Shot]:
    """All images under the initial IPM of their cameras and the recorded poses."""
    px_from_vehicle = {
        name: np.linalg.inv(facing_ipm(camera.ipm[camera.initial_ipm], camera.roi_vehicle.mean(axis=0)))
        for name, camera in drive.cameras.items()
    }
    return [
        Shot(
            image.path,
            image.camera,
            px_from_vehicle[image.camera] @ flat_motion(inverse(image.map_from_vehicle)),
        )
        for image in drive.images
    ]


def adjusted_shots(
    drive: Drive,
    calibrations: Mapping[str, Calibration],
    clock_s: Mapping[str, float],
    adjusted: Trajectory,
    surface_at: Callable[[FloatArray], Surface | None] = lambda poses: None,
) -> list[Shot]:
    """The images of calibrated cameras under adjusted extrinsics and poses, in the recorded poses' frame.

    ``clock_s`` is by camera how much later than stamped its images were taken; ``surface_at`` gives the
    ground under vehicles at poses (F, 4, 4).
    """
    images = [image for image in drive.images if image.camera in calibrations]
    taken_s = np.array([image.stamp_s + clock_s[image.camera] for image in images])
    poses, _ = interpolate(adjusted, taken_s, np.inf)
    if drive.recorded is not None and drive.trajectory is not None:
        recorded, flat = (
            interpolate(trajectory, taken_s, np.inf)[0] for trajectory in (drive.recorded, drive.trajectory)
        )
        poses = flat @ np.linalg.inv(recorded) @ poses
    shots = []
    surface = surface_at(poses)
    for frame, (image, pose) in enumerate(zip(images, poses, strict=True)):
        calibration = calibrations[image.camera]
        cam_from_map = calibration.cam_from_vehicle @ inverse(pose)
        px_from_map = pinhole_px_from_ground(calibration.info.intrinsic, cam_from_map)
        on_plane = None
        if surface is not None:
            on_plane = partial(surface.on_plane, cam_from_map=cam_from_map, frame=frame)
        shots.append(Shot(image.path, image.camera, px_from_map, on_plane))
    return shots


TILE_PX = 64  # side of a tile, px of the canvas
_NODE_PX = 4  # distance of the points of a tile at which the lens is evaluated, px of the canvas
_FAR_OUT = 99.0  # a place outside of any image, in halves of its size from its middle
SHEET_PX = 2048  # side of a sheet, px of the canvas: 70 MB of weighted sums where all of it is seen
_KEPT_IMAGES = 96  # decoded images that neighbouring sheets share, 1.5 MB each


@dataclass(frozen=True)
class Sheet:
    """A finished part of a canvas, its first pixel at (``row``, ``column``)."""

    row: int
    column: int
    # (rows, columns, 4) uint8; alpha 255 where ground is shown as finely as any is trusted for
    rgba: np.ndarray


def whole(
    canvas: Canvas, shots: Sequence[Shot], lenses: Mapping[str, Lens], device: str = "cpu"
) -> np.ndarray:
    """A canvas in one piece: (rows, columns, 4) uint8 RGBA."""
    out = np.zeros((canvas.rows, canvas.columns, 4), dtype=np.uint8)
    for sheet in blend(canvas, shots, lenses, device):
        rows, columns = sheet.rgba.shape[:2]
        out[sheet.row : sheet.row + rows, sheet.column : sheet.column + columns] = sheet.rgba
    return out


def blend(
    canvas: Canvas,
    shots: Sequence[Shot],
    lenses: Mapping[str, Lens],
    device: str = "cpu",
    progress: Steps | None = None,
) -> Iterator[Sheet]:
    """The sheets of a canvas that any image shows, in driving order; DriveError where one cannot be read."""
    plan = _plan(canvas, shots, lenses)
    full_weight = _full_weight(canvas, shots, lenses)
    order = [index for _, views in plan for index, _ in views]
    sources = _sources(shots, lenses, device, order)
    done = 0
    for (row, column), views in plan:
        rows = min(SHEET_PX, canvas.rows - row)
        columns = min(SHEET_PX, canvas.columns - column)
        sums = _Sums((rows, columns), views, device)
        map_from_sheet = canvas.window(row, column, rows, columns).map_from_canvas
        for index, tiles in views:
            sums.add(next(sources), shots[index], map_from_sheet, tiles)
            done += 1
            if progress:
                progress(done, len(order))
        yield Sheet(row, column, sums.mean(full_weight))


_Views = list[tuple[int, FloatArray]]
"""Images that show a sheet: the index of each and the (column, row) of the tiles (T, 2) that it shows."""


def _plan(
    canvas: Canvas, shots: Sequence[Shot], lenses: Mapping[str, Lens]
) -> list[tuple[tuple[int, int], _Views]]:
    """By the first pixel (row, column) of each sheet, in the order of the first image: its views."""
    canvas_from_map = canvas.canvas_from_map
    in_sheet = SHEET_PX // TILE_PX
    limit = np.ceil([canvas.columns / TILE_PX, canvas.rows / TILE_PX]).astype(int)
    plan: dict[tuple[int, int], _Views] = {}
    for index, shot in enumerate(shots):
        outline = shot.outline_map(lenses[shot.camera])
        tiles = _tiles_under(outline @ canvas_from_map[:2, :2].T + canvas_from_map[:2, 2], limit)
        for sheet in np.unique(tiles // in_sheet, axis=0):
            mine = tiles[(tiles // in_sheet == sheet).all(axis=1)] - sheet * in_sheet
            key = (int(sheet[1]) * SHEET_PX, int(sheet[0]) * SHEET_PX)
            plan.setdefault(key, []).append((index, mine))
    return list(plan.items())


def _full_weight(canvas: Canvas, shots: Sequence[Shot], lenses: Mapping[str, Lens]) -> float:
    """The least weight of ground that an image is trusted for: in px of the image a px of the canvas."""
    least = []
    for shot in {shot.camera: shot for shot in shots}.values():
        px_from_canvas = shot.pinhole_px_from_map @ canvas.map_from_canvas
        outline = apply_homography(canvas.canvas_from_map, shot.outline_map(lenses[shot.camera]))
        third = outline @ px_from_canvas[2, :2] + px_from_canvas[2, 2]
        least.append(float((np.linalg.det(px_from_canvas) / third**3).min()))
    return min(least, default=1.0)


def _tiles_under(polygon: FloatArray, limit: np.ndarray) -> np.ndarray:
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
class _Source:
    """An image cut to the rows and columns that are trusted: (4, height, width), B, G, R and trust."""

    values: Tensor
    corner_px: tuple[int, int]
    lens: Lens


def _sources(
    shots: Sequence[Shot], lenses: Mapping[str, Lens], device: str, order: Sequence[int]
) -> Iterator[_Source]:
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
            yield _Source(values, (box[1].start, box[0].start), lenses[shot.camera])


class _Sums:
    """The weighted sums (tiles, 4, side, side) of colours and weights on one sheet."""

    def __init__(self, shape: tuple[int, int], views: _Views, device: str):
        self._shape = shape
        self._device = device
        self._tiles = np.unique(np.concatenate([tiles for _, tiles in views]), axis=0)
        self._at = {(int(c), int(r)): k for k, (c, r) in enumerate(self._tiles)}
        self._sums = torch.zeros((len(self._tiles), 4, TILE_PX, TILE_PX), device=device)
        at = torch.arange(0, TILE_PX + 1, _NODE_PX, device=device).float()
        self._nodes = torch.cartesian_prod(at, at).flip(1)
        x, y = (self._nodes / TILE_PX).T
        self._from_corners = torch.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], dim=1)
        distance_px = (torch.arange(TILE_PX, device=device)[:, None] - at).abs()
        self._from_nodes = (1 - distance_px / _NODE_PX).clamp(min=0)  # hat functions (TILE_PX, nodes)

    def add(self, source: _Source, shot: Shot, map_from_sheet: FloatArray, tiles: np.ndarray) -> None:
        """Add an image to the tiles (T, 2) of (column, row) that it shows."""
        x, y, density = self._warp(source, shot, map_from_sheet, tiles)
        image = source.values.expand(len(tiles), -1, -1, -1)
        values: Tensor = remap(image, x, y, align_corners=True, normalized_coordinates=True)
        weight = values[:, 3] * density
        values[:, :3] *= weight[:, None]
        values[:, 3] = weight
        at = torch.tensor([self._at[int(c), int(r)] for c, r in tiles], device=self._device)
        self._sums.index_add_(0, at, values)

    def _warp(self, source: _Source, shot: Shot, map_from_sheet: FloatArray, tiles: np.ndarray) -> Tensor:
        """Where tiles' pixels lie in an image, as ``grid_sample`` has it, and their density (3, T, ...).

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
        return torch.cat([placed.where(in_front, x.new_tensor(_FAR_OUT)), (density * in_front)[None]])

    def mean(self, full_weight: float) -> np.ndarray:
        """The sheet as (rows, columns, 4) uint8 RGBA, opaque from ``full_weight`` on."""
        weight = self._sums[:, 3:]
        colours = self._sums[:, [2, 1, 0]] / weight.where(weight > 0, torch.ones_like(weight))
        alpha = (255 / full_weight * weight).clamp(max=255)
        rgba = torch.cat([colours, alpha], dim=1).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()
        (rows, columns) = self._shape
        side = TILE_PX
        down = -(-rows // side)
        across = -(-columns // side)
        out = np.zeros((down, side, across, side, 4), dtype=np.uint8)
        out[self._tiles[:, 1], :, self._tiles[:, 0]] = rgba
        return out.reshape(down * side, -1, 4)[:rows, :columns]


def _box(trust: np.ndarray) -> tuple[slice, slice]:
    """The rows and columns that are trusted at all, and one around them."""
    trusted = (np.flatnonzero(trust.any(axis=axis)) for axis in (1, 0))
    rows, columns = (slice(max(int(index[0]) - 1, 0), int(index[-1]) + 2) for index in trusted)
    return rows, columns
