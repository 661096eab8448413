"""How often and how finely a drive has seen each piece of ground, by geometry alone.

An image sees the ground within its borders and within reach, as if nothing stood in the way: what lay hidden
behind a container is counted as seen. A pixel at depth z covers z / f of ground across the view and
z^2 / (f h) along it, with focal length f and the camera's height h; the larger is its ground sample distance.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.ipm import flat_motion, pinhole_px_from_ground, project_ground
from v2hdm.geometry.lens import undistort_points
from v2hdm.geometry.planar import clip_half
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import Camera, CameraInfo, Drive, FloatArray, IntArray
from v2hdm.safe.pixels import read_pixels
from v2hdm.store import names
from v2hdm.store.files import load_json, take_number, whole_file, write_json

REACH_M = 16.0  # from the camera's nadir, to which markings are mapped unless set (``mapping.max_range_m``)
_RING = 48  # corners of the polygon that stands for a circle of that radius
CELL_M = 0.25  # side of a cell of ground: finer than a marking, coarse enough for a port of kilometres
ENOUGH_VIEWS = 3  # images that a marking needs: two for its parallax, and one that may fail
_MOST_CELLS = 4_000_000  # of a site; larger ones get coarser cells, 16 MB of counts
SECTORS = 4  # number of directions of view: from the east, north, west and south
_QUARTER_RAD = np.pi / 2  # angle of a sector
_AHEAD_RAD = np.pi / 4  # half of it: the first sector lies about east


class Coverage(NamedTuple):
    """Cells of ground, north above: the first row is the northernmost."""

    west_m: float  # of the first cell's outer corner in the map
    north_m: float
    cell_m: float
    views: IntArray  # (rows, columns) number of images
    sample_m: FloatArray  # (rows, columns) finest ground sample distance of these, nan where there is none
    sectors: IntArray  # (rows, columns) number of the four directions, at most, that it was seen from

    @property
    def seen_m2(self) -> float:
        """Area that at least one image shows."""
        return float((self.views > 0).sum() * self.cell_m**2)

    @property
    def covered_m2(self) -> float:
        """Area that enough images show for a marking to be mapped."""
        return float((self.views >= ENOUGH_VIEWS).sum() * self.cell_m**2)

    def sample_of_covered_m(self) -> float:
        """Median of the ground sample distance where enough images show the ground; nan where none is."""
        covered_m = self.sample_m[(self.views >= ENOUGH_VIEWS) & np.isfinite(self.sample_m)]
        return float(np.median(covered_m)) if len(covered_m) else float("nan")

    def cells_of(self, points_map: FloatArray) -> tuple[IntArray, IntArray]:
        """Rows and columns (N,) of points (N, 2); those outside get those of the nearest cell."""
        rows, columns = self.views.shape
        column = np.floor((points_map[:, 0] - self.west_m) / self.cell_m).astype(np.int64)
        row = np.floor((self.north_m - points_map[:, 1]) / self.cell_m).astype(np.int64)
        return np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)


class _Footprint(NamedTuple):
    """The ground that a camera sees: cells' centres beside the vehicle and how finely they are seen."""

    outline_vehicle: FloatArray  # (N, 2) convex
    cam_from_vehicle: FloatArray
    focal_px: float
    foot_vehicle: FloatArray  # (2,) the camera's nadir
    height_m: float


def coverage_of(
    drive: Drive, cam_from_vehicle: Mapping[str, FloatArray], reach_m: float = REACH_M, cell_m: float = CELL_M
) -> Coverage:
    """The coverage by the images of the cameras in ``cam_from_vehicle`` (4, 4), under the recorded poses.

    Ground counts that is within ``reach_m`` of the camera's nadir, to which markings are mapped.
    """
    footprints = {
        name: _footprint(drive.cameras[name], mounting, reach_m)
        for name, mounting in cam_from_vehicle.items()
        if name in drive.cameras
    }
    footprints = {name: footprint for name, footprint in footprints.items() if len(footprint.outline_vehicle)}
    images = [image for image in drive.images if image.camera in footprints]
    outlines = [_on_map(image.map_from_vehicle, footprints[image.camera].outline_vehicle) for image in images]
    every_corner = np.concatenate([np.zeros((0, 2)), *outlines])
    if not len(every_corner):
        nothing = np.zeros((0, 0))
        return Coverage(0.0, 0.0, cell_m, nothing.astype(np.int64), nothing, nothing.astype(np.int64))
    low = every_corner.min(axis=0)
    high = every_corner.max(axis=0)
    cell_m = max(cell_m, float(np.sqrt(np.prod(high - low) / _MOST_CELLS)))
    columns, rows = (np.ceil((high - low) / cell_m).astype(int) + 1).tolist()
    west_m = float(low[0])
    north_m = float(high[1])
    views = np.zeros((rows, columns), dtype=np.int64)
    sample_m = np.full((rows, columns), np.inf)
    sides = np.zeros((rows, columns), dtype=np.uint8)
    for image, outline in zip(images, outlines, strict=True):
        footprint = footprints[image.camera]
        row, column = _cells_in(outline, west_m, north_m, cell_m)
        centre_map = np.column_stack([west_m + (column + 0.5) * cell_m, north_m - (row + 0.5) * cell_m])
        foot_map = _on_map(image.map_from_vehicle, footprint.foot_vehicle[None])[0]
        views[row, column] += 1
        seen_m = _sample_m(footprint, image.map_from_vehicle, centre_map)
        sample_m[row, column] = np.fmin(sample_m[row, column], seen_m)
        sides[row, column] |= _side_of(foot_map - centre_map)
    sample_m[~np.isfinite(sample_m)] = np.nan
    sectors = np.unpackbits(sides[..., None], axis=-1).sum(axis=-1).astype(np.int64)
    return Coverage(west_m, north_m, cell_m, views, sample_m, sectors)


def _footprint(camera: Camera, cam_from_vehicle: FloatArray, reach_m: float) -> _Footprint:
    centre_vehicle = camera_centre(cam_from_vehicle)
    focal_px = float(np.sqrt(camera.info.intrinsic[0, 0] * camera.info.intrinsic[1, 1]))
    height_m = max(float(centre_vehicle[2]), 1e-3)
    outline = _outline(camera.info, cam_from_vehicle, centre_vehicle[:2], reach_m)
    return _Footprint(outline, cam_from_vehicle, focal_px, centre_vehicle[:2], height_m)


def _outline(
    info: CameraInfo, cam_from_vehicle: FloatArray, foot_vehicle: FloatArray, reach_m: float
) -> FloatArray:
    """The ground (N, 2) within reach and the borders of an image: a convex polygon, empty if it sees none."""
    angle_rad = np.linspace(0.0, 2 * np.pi, _RING, endpoint=False)
    outline = foot_vehicle + reach_m * np.column_stack([np.cos(angle_rad), np.sin(angle_rad)])
    low, high = _pinhole_box(info)
    px_from_ground = pinhole_px_from_ground(info.intrinsic, cam_from_vehicle)
    u, v, w = px_from_ground  # rows; w is the depth
    borders = (w, u - low[0] * w, high[0] * w - u, v - low[1] * w, high[1] * w - v)
    for border in borders:
        outline = clip_half(outline, outline @ border[:2] + border[2])
        if len(outline) < 3:
            return np.zeros((0, 2))
    return outline


def _pinhole_box(info: CameraInfo) -> tuple[FloatArray, FloatArray]:
    """The largest rectangle within the image's borders once its distortion is taken off: low, high (2,)."""
    across = np.linspace(0.0, info.width - 1.0, _BORDER)
    down = np.linspace(0.0, info.height - 1.0, _BORDER)
    zeros = np.zeros(_BORDER)
    right_px = zeros + info.width - 1.0
    bottom_px = zeros + info.height - 1.0
    recorded = ((zeros, down), (right_px, down), (across, zeros), (across, bottom_px))
    sides = [undistort_points(info, np.column_stack(side)) for side in recorded]
    left, right, top, bottom = (side[np.isfinite(side).all(axis=1)] for side in sides)
    low = np.array([left[:, 0].max(), top[:, 1].max()])
    high = np.array([right[:, 0].min(), bottom[:, 1].min()])
    return low, high


_BORDER = 9  # points of a border at which the lens is evaluated


def _on_map(map_from_vehicle: FloatArray, points_vehicle: FloatArray) -> FloatArray:
    """Ground points (N, 2) beside a vehicle in the map."""
    motion = flat_motion(map_from_vehicle)
    return np.asarray(points_vehicle @ motion[:2, :2].T + motion[:2, 2])


def _cells_in(
    outline_map: FloatArray, west_m: float, north_m: float, cell_m: float
) -> tuple[IntArray, IntArray]:
    """Rows and columns of the cells whose centres lie in a convex outline (N, 2)."""
    corners = np.column_stack([outline_map[:, 0] - west_m, north_m - outline_map[:, 1]]) / cell_m
    first = np.floor(corners.min(axis=0)).astype(np.int64)
    width, height = (np.ceil(corners.max(axis=0)).astype(np.int64) - first + 1).tolist()
    mask = np.zeros((height, width), dtype=np.uint8)
    # A cell's centre is at half a cell, and a pixel's at a whole number.
    cv2.fillConvexPoly(mask, np.round((corners - first - 0.5) * 16).astype(np.int32), 1, shift=4)
    row, column = np.nonzero(mask)
    return np.maximum(row + first[1], 0), np.maximum(column + first[0], 0)


def _sample_m(footprint: _Footprint, map_from_vehicle: FloatArray, points_map: FloatArray) -> FloatArray:
    """Ground sample distance (N,), m, of ground (N, 2) in one image; nan behind the camera."""
    cam_from_map = footprint.cam_from_vehicle @ np.linalg.inv(map_from_vehicle)
    _, depth_m = project_ground(np.eye(3), cam_from_map, points_map)
    depth_m = np.where(depth_m > 0, depth_m, np.nan)
    across_m = depth_m / footprint.focal_px
    along_m = depth_m**2 / (footprint.focal_px * footprint.height_m)
    return np.fmax(across_m, along_m)


def _side_of(towards_camera: FloatArray) -> np.ndarray:
    """The bit (N,) of the direction in which a camera stands from ground, by vectors (N, 2) to it."""
    angle_rad = np.arctan2(towards_camera[:, 1], towards_camera[:, 0]) + _AHEAD_RAD
    sector = np.floor(angle_rad / _QUARTER_RAD).astype(np.int64) % SECTORS
    return np.asarray(1 << sector, dtype=np.uint8)


def write_coverage(folder: Path, coverage: Coverage) -> None:
    """Write ``coverage.json`` and its cells, ``coverage_cells.png`` (16 bits: directions, 0.1 mm, images).

    Nothing is written where no image shows ground.
    """
    if not coverage.views.any():
        return
    sample = np.nan_to_num(coverage.sample_m, nan=0.0) / _STORED_M
    layers = np.stack([coverage.sectors, np.round(sample), coverage.views], axis=-1)
    cells = np.clip(layers, 0, np.iinfo(np.uint16).max).astype(np.uint16)
    with whole_file(folder / names.COVERAGE_CELLS) as partial:
        partial.write_bytes(cv2.imencode(".png", cells)[1].tobytes())
    sample_m = coverage.sample_of_covered_m()
    content = {
        "west_m": coverage.west_m,
        "north_m": coverage.north_m,
        "cell_m": coverage.cell_m,
        "seen_m2": round(coverage.seen_m2, 1),
        "covered_m2": round(coverage.covered_m2, 1),
        "ground_sample_distance_m": round(sample_m, 5) if np.isfinite(sample_m) else None,
    }
    write_json(folder / names.COVERAGE, content)


def read_coverage(folder: Path) -> Coverage | None:
    """The coverage in a folder, None where there is none; MapFileError where it is damaged."""
    path = folder / names.COVERAGE
    if not path.is_file() or not (folder / names.COVERAGE_CELLS).is_file():
        return None
    content = load_json(path, MapFileError)
    place = [take_number(content.get(key), f"{path}: {key}", MapFileError) for key in _PLACE]
    cells = read_pixels(folder / names.COVERAGE_CELLS, cv2.IMREAD_UNCHANGED)
    if cells.ndim != 3 or cells.dtype != np.uint16 or place[2] <= 0:
        raise MapFileError(f"{folder / names.COVERAGE_CELLS}: holds no cells; make the report again")
    sectors, sample, views = np.moveaxis(cells.astype(np.int64), -1, 0)
    sample_m = np.where(sample > 0, _STORED_M * sample, np.nan)
    return Coverage(place[0], place[1], place[2], views, sample_m, sectors)


_STORED_M = 1e-4  # unit of a stored ground sample distance, m
_PLACE = ("west_m", "north_m", "cell_m")
