"""From the folder of a run to the mosaic of its ground: GeoTIFF, picture and comparison beside the map."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from contextvars import copy_context
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from v2hdm.detection.batch import with_own_vehicle
from v2hdm.detection.detector import Detector
from v2hdm.errors import ConfigError, MapFileError, need
from v2hdm.executor import HERE, Executor
from v2hdm.geometry.geodetic import crs_of
from v2hdm.geometry.planar import densified
from v2hdm.io.maps.reading import read_geojson
from v2hdm.io.trajectory import read_tum
from v2hdm.mosaic.blend import Sheet, blend, whole
from v2hdm.mosaic.consensus import CELL_M, Consensus, find_consensus
from v2hdm.mosaic.views import Canvas, Lens, Shot, adjusted_shots, lens_of, recorded_shots
from v2hdm.mosaic.warp import Area
from v2hdm.progress import Steps
from v2hdm.records import Drive, FloatArray, GeodeticOrigin, HDMap
from v2hdm.report import style
from v2hdm.report.page.facts import read_cameras, read_surface
from v2hdm.store import names
from v2hdm.store.files import whole_file, write_json

# The comparison before and after.
AHEAD_M = 12.0  # length of the ground that is compared
ACROSS_M = 8.0  # width of the ground that is compared
_CELL_M = 0.01  # side of a pixel on that ground
_PANEL_IN = 5.2  # width of either picture
_BAR_M = 2.0  # length of the scale bar


def richest_place(drive: Drive, hd_map: HDMap) -> FloatArray:
    """The image's pose (4, 4) about which the most paint was found, counted by the images that show it."""
    painted = [(m.corners_map, m.sightings) for m in hd_map.markings]
    painted += [(s.outline_map, s.sightings) for s in hd_map.symbols]
    centres = np.array([outline.mean(axis=0) for outline, _ in painted]).reshape(-1, 2)
    sightings = np.array([count for _, count in painted])

    def worth(pose: FloatArray) -> float:
        offset = (centres - pose[:2, 3]) @ pose[:2, :2]
        return float(sightings[(np.abs(offset) <= [AHEAD_M / 2, ACROSS_M / 2]).all(axis=1)].sum())

    return max((image.map_from_vehicle for image in drive.images), key=worth)


def close_up_canvas(map_from_vehicle: FloatArray) -> Canvas:
    """The ground about a pose, the vehicle's way pointing up."""
    ahead = map_from_vehicle[:2, 0] / np.linalg.norm(map_from_vehicle[:2, 0])
    right = np.array([ahead[1], -ahead[0]])
    corner = map_from_vehicle[:2, 3] + ahead * AHEAD_M / 2 - right * ACROSS_M / 2
    rows = round(AHEAD_M / _CELL_M)
    columns = round(ACROSS_M / _CELL_M)
    return Canvas(corner, _CELL_M, rows, columns, (float(right[0]), float(right[1])))


def save_comparison(
    path: Path,
    map_from_vehicle: FloatArray,
    panels: Mapping[str, Sequence[Shot]],
    lenses: Mapping[str, Lens],
) -> None:
    """Draw the ground about a pose (4, 4) as several sets of shots, by title, show it, side by side."""
    canvas = close_up_canvas(map_from_vehicle)
    pictures = [whole(canvas, shots, lenses) for shots in panels.values()]
    last = pictures[-1]
    grey = cv2.cvtColor(np.ascontiguousarray(last[..., :3]), cv2.COLOR_RGB2GRAY)[last[..., 3] > 0]
    low, high = np.percentile(grey, (0.2, 99.8)) if grey.size else (0.0, 255.0)
    height_in = _PANEL_IN * AHEAD_M / ACROSS_M + 0.4
    with style.figure(path, _PANEL_IN * len(panels) + 0.1, height_in) as fig:
        every = np.atleast_1d(fig.subplots(1, len(panels)))
        for axes, title, rgba in zip(every, panels, pictures, strict=True):
            bgr = rgba[..., :3].astype(np.float32)
            stretched = np.clip((bgr - 0.5 * low) / (max(high, low + 1) - 0.5 * low), 0, 1)
            alpha = rgba[..., 3:].astype(np.float32) / 255
            shown = 1 - alpha * (1 - stretched)  # white where nothing was seen
            axes.imshow(shown, extent=(0, ACROSS_M, 0, AHEAD_M), interpolation="antialiased")
            axes.set(title=title, xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
            axes.plot([0.4, 0.4 + _BAR_M], [0.4, 0.4], color="white", lw=3, solid_capstyle="butt")
            axes.text(0.4 + _BAR_M / 2, 0.52, f"{_BAR_M:g} m", color="white", ha="center", va="bottom")


LARGEST_PICTURE_PX = 8192  # of either side of the picture: graphics cards of computers and phones draw that
MULTIPLE_PX = 256  # divides sides of a canvas, so that pictures reduced by up to that factor fit it exactly
_FINEST_M = 1e-3  # least side of a pixel: no camera on a vehicle shows finer ground
_PICTURE_QUALITY = 80  # quality of the WebP, of 100
_JPEG_QUALITY = 90  # quality of the JPEG in the GeoTIFF, of 100
SEEN_ALPHA = 128  # least alpha of a pixel that the GeoTIFF's mask shows as seen: it knows no half
_BLOCK_PX = 512  # side of a block of the GeoTIFF
_AT_ONCE_BYTES = 1 << 24  # size of the pieces in which the GeoTIFF is written to the disk


@contextmanager
def geotiff(path: Path, canvas: Canvas, origin: GeodeticOrigin | None) -> Iterator[Callable[[Sheet], None]]:
    """Put sheets into a cloud-optimised GeoTIFF, JPEG within, with a mask; ConfigError without rasterio."""
    rasterio = need("rasterio", "gis", path.name, ConfigError)
    west, _, _, north = canvas.bounds_m
    profile = {
        "driver": "GTiff", "width": canvas.columns, "height": canvas.rows, "count": 3, "dtype": "uint8",
        "crs": rasterio.crs.CRS.from_user_input(crs_of(origin)),
        "transform": rasterio.Affine(canvas.cell_m, 0, west, 0, -canvas.cell_m, north),
        "tiled": True, "blockxsize": _BLOCK_PX, "blockysize": _BLOCK_PX, "compress": "jpeg",
        "photometric": "ycbcr", "jpeg_quality": _JPEG_QUALITY, "bigtiff": "if_safer", "sparse_ok": True,
    }  # fmt: skip
    # In memory first, compressed: on a disk, GDAL goes on after a call that fails and says nothing.
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True, GDAL_CACHEMAX=64),
        rasterio.MemoryFile(ext=".tif") as memory,
    ):
        with memory.open(**profile) as dataset:

            def put(sheet: Sheet) -> None:
                rows, columns = sheet.rgba.shape[:2]
                window = rasterio.windows.Window(sheet.column, sheet.row, columns, rows)
                dataset.write(np.moveaxis(sheet.rgba[..., :3], 2, 0), window=window)
                dataset.write_mask(sheet.rgba[..., 3] >= SEEN_ALPHA, window=window)

            yield put
        with rasterio.MemoryFile(ext=".tif") as ordered:
            need("rasterio.shutil", "gis", path.name, ConfigError).copy(
                memory.name, ordered.name, driver="COG", compress="JPEG", quality=_JPEG_QUALITY,
                blocksize=_BLOCK_PX, overview_resampling="average", overview_count=4, bigtiff="IF_SAFER",
            )  # fmt: skip
            ordered.seek(0)
            with whole_file(path) as partial, partial.open("wb") as file:
                while data := ordered.read(_AT_ONCE_BYTES):
                    file.write(data)


def _shown_blocks(sheet: Sheet) -> Iterator[Sheet]:
    """The blocks of a sheet of which anything is shown: of a road most of it is empty."""
    rows, columns = sheet.rgba.shape[:2]
    for row in range(0, rows, _BLOCK_PX):
        for column in range(0, columns, _BLOCK_PX):
            rgba = sheet.rgba[row : row + _BLOCK_PX, column : column + _BLOCK_PX]
            if rgba[..., 3].any():
                yield Sheet(sheet.row + row, sheet.column + column, rgba)


class Picture:
    """A mosaic reduced by a power of two so that no side is above :data:`LARGEST_PICTURE_PX`."""

    def __init__(self, canvas: Canvas):
        self.factor = 1
        while max(canvas.rows, canvas.columns) > LARGEST_PICTURE_PX * self.factor:
            self.factor *= 2
        self.resolution_m = canvas.cell_m * self.factor
        self._rgba = np.zeros((canvas.rows // self.factor, canvas.columns // self.factor, 4), dtype=np.uint8)

    def put(self, sheet: Sheet) -> None:
        """Draw one sheet: the mean over the pixels that are seen."""
        rows, columns = (side // self.factor for side in sheet.rgba.shape[:2])
        row = sheet.row // self.factor
        column = sheet.column // self.factor
        *colours, alpha = (plane.astype(np.float32) for plane in cv2.split(sheet.rgba))
        alpha /= 255
        opacity, *weighed = (
            cv2.resize(plane, (columns, rows), interpolation=cv2.INTER_AREA)
            for plane in (alpha, *(colour * alpha for colour in colours))
        )
        visible = np.where(opacity > 0, opacity, 1)
        drawn = cv2.merge([*(colour / visible for colour in weighed), 255 * opacity])
        self._rgba[row : row + rows, column : column + columns] = np.rint(drawn)

    def write(self, path: Path) -> None:
        """Write it as WebP, transparent where nothing was seen; whole or not at all."""
        bgra = cv2.cvtColor(self._rgba, cv2.COLOR_RGBA2BGRA)
        with whole_file(path) as partial:
            encoded = cv2.imencode(path.suffix, bgra, [cv2.IMWRITE_WEBP_QUALITY, _PICTURE_QUALITY])[1]
            partial.write_bytes(encoded.tobytes())


_log = logging.getLogger(__name__)

_BESIDE_WAY_M = 6.0  # distance from the cameras' way up to which the ground is shown, m; chosen
_BESIDE_PAINT_M = 1.6  # distance beyond paint up to which the ground is shown, m: a metre, and two blocks
_DENSE = 4  # points to which a side of an outline is divided: the longest stop line has one in 6 m
RESOLUTION_M = 0.02  # side of a pixel of the mosaic unless another is asked for


@dataclass(frozen=True)
class Ground:
    """Cameras, images under the adjusted and under the initial calibration, and the canvas for both."""

    lenses: Mapping[str, Lens]
    after: Sequence[Shot]
    before: Sequence[Shot]
    canvas: Canvas
    area: Area  # that is shown

    def consensus(self, progress: Steps | None = None, executor: Executor = HERE) -> Consensus | None:
        """Which images show the ground, place by place; None where that cannot be told."""
        west, south, east, north = self.canvas.bounds_m
        canvas = Canvas.around(np.array([[west, south], [east, north]]), CELL_M)
        return find_consensus(self.after, self.lenses, canvas, self.area, progress, executor)


def write_mosaic(
    folder: Path,
    drive: Drive,
    resolution_m: float = RESOLUTION_M,
    progress: Steps | None = None,
    executor: Executor = HERE,
) -> dict[str, Any]:
    """Write the mosaic of a run's ground into its folder; returns what stands in ``mosaic.json``.

    ``folder`` holds the run's map, calibrations and adjusted trajectory, ``drive`` is what it has mapped.
    ``resolution_m`` is the side of a pixel on the ground; ``progress`` counts images put onto the ground.
    Raises MapFileError where the folder is no result, or not one of this drive, DriveError where an image is
    missing or damaged, ConfigError where the resolution makes no mosaic.
    """
    if not _FINEST_M <= resolution_m < np.inf:
        raise ConfigError(
            f"a resolution of {resolution_m:g} m per pixel is too fine for a mosaic; give {_FINEST_M} or more"
        )
    hd_map = read_geojson(folder / names.MAP)
    ground = ground_of(folder, drive, resolution_m, hd_map)
    picture = Picture(ground.canvas)

    def draw() -> None:
        picture.write(folder / names.MOSAIC_PICTURE)
        panels = {
            "before: initial calibration, recorded poses": ground.before,
            "after: optimised calibration, adjusted poses": ground.after,
        }
        save_comparison(folder / names.COMPARISON, richest_place(drive, hd_map), panels, ground.lenses)

    with ThreadPoolExecutor(1) as beside:
        with ExitStack() as stack:
            try:
                put = stack.enter_context(geotiff(folder / names.MOSAIC, ground.canvas, drive.origin))
            except ConfigError as missing:
                _log.warning("no GeoTIFF was written: %s", missing)
                put = None
            consensus = ground.consensus(progress, executor)
            for sheet in blend(
                ground.canvas, ground.after, ground.lenses, progress, consensus, ground.area, executor
            ):
                for block in _shown_blocks(sheet):
                    if put is not None:
                        put(block)
                    picture.put(block)
            # GDAL puts the GeoTIFF in order, on one core, as its block ends.
            drawn = beside.submit(copy_context().run, draw)
        drawn.result()
    content = {
        "image": names.MOSAIC_PICTURE,
        "bounds_m": ground.canvas.bounds_m,
        "resolution_m": picture.resolution_m,
        "geotiff": None if put is None else names.MOSAIC,
        "geotiff_resolution_m": resolution_m,
        "crs": crs_of(drive.origin),
    }
    write_json(folder / names.MOSAIC_EXTENT, content)
    return content


def ground_of(folder: Path, drive: Drive, resolution_m: float, hd_map: HDMap) -> Ground:
    """The ground that a run's images show, and the canvas around it; errors as :func:`write_mosaic`."""
    cameras = read_cameras(folder)
    if not cameras:
        raise MapFileError(f"{folder}: no {names.CALIBRATIONS} in it; give the result folder of v2hdm map")
    calibrations = {name: camera.calibration for name, camera in cameras.items()}
    clock_s = {name: camera.clock_offset_s or 0.0 for name, camera in cameras.items()}
    missing = [name for name in drive.cameras if name not in calibrations]
    if len(missing) == len(drive.cameras):
        raise MapFileError(
            f"{folder} is calibrated for {', '.join(calibrations)}, drive {drive.name} has "
            f"{', '.join(missing)}: give the drive that this result is of"
        )
    for name in missing:
        _log.warning("camera %s has no calibration in %s: its images are left out", name, folder)
    adjusted = read_tum(folder / names.TRAJECTORY)
    taken_s = np.array([image.taken_s for image in drive.images])
    if adjusted.stamp_s[0] > taken_s.max() or adjusted.stamp_s[-1] < taken_s.min():
        raise MapFileError(
            f"{folder / names.TRAJECTORY} and drive {drive.name} share no time: give the drive of this result"
        )
    drive = with_own_vehicle(drive, Detector.load())
    lenses = {
        name: lens_of(drive.cameras[name], calibration.cam_from_vehicle)
        for name, calibration in calibrations.items()
        if name in drive.cameras
    }
    after = adjusted_shots(drive, calibrations, clock_s, adjusted, partial(read_surface, folder))
    before = [shot for shot in recorded_shots(drive) if shot.camera in lenses]
    area = area_of(hd_map, after)
    return Ground(lenses, after, before, Canvas.around(area.corners_map, resolution_m, MULTIPLE_PX), area)


def area_of(hd_map: HDMap, shots: Sequence[Shot]) -> Area:
    """The ground beside the cameras' way, and as far as the paint reaches and a metre more."""
    way_map = np.array([shot.centre_map[:2] for shot in shots if shot.centre_map is not None])
    outlines = [marking.corners_map for marking in hd_map.markings]
    outlines += [symbol.outline_map for symbol in hd_map.symbols]
    paint_map = [densified(outline, _DENSE) for outline in outlines]
    paint_map += [lane.points_map for lane in hd_map.lanes]
    listed = np.concatenate(paint_map) if paint_map else np.empty((0, 2))
    return Area.along(way_map, listed, _BESIDE_WAY_M, _BESIDE_PAINT_M)
