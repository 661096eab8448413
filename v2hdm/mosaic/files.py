"""A mosaic on disk: the GeoTIFF at full resolution and the picture for a map's background."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from v2hdm.errors import ConfigError
from v2hdm.extras import need
from v2hdm.mosaic.blend import Sheet
from v2hdm.mosaic.canvas import Canvas
from v2hdm.records import GeodeticOrigin
from v2hdm.store.files import whole_file

LARGEST_PICTURE_PX = 8192
"""Of either side of the picture: what graphics cards of computers and phones alike can draw."""

MULTIPLE_PX = 256
"""Sides of a canvas are multiples of it, so that pictures reduced by up to that factor fit it exactly."""

_PICTURE_QUALITY = 80
_JPEG_QUALITY = 90
_SEEN_ALPHA = 128
"""A GeoTIFF's mask knows but seen and unseen."""

_BLOCK_PX = 512
_OVERVIEWS = (2, 4, 8, 16)
_AT_ONCE_BYTES = 1 << 24
_SEMI_MAJOR_M = 6378137.0

_ENGINEERING = (
    'LOCAL_CS["V2HDM map frame: east, north in metres from an origin that the drive does not state",'
    'LOCAL_DATUM["local",0],UNIT["metre",1],AXIS["East",EAST],AXIS["North",NORTH]]'
)


def crs_of(origin: GeodeticOrigin | None) -> str:
    """The coordinate system of the map frame, as PROJ or WKT text.

    With an origin it is a transverse Mercator projection about it, scaled to its height above the ellipsoid:
    it agrees with the frame's tangent plane to a millimetre within 2 km, and every GIS knows it. Without, the
    frame is an engineering system: metres that belong nowhere on the earth.
    """
    if origin is None:
        return _ENGINEERING
    scale = 1 + origin.altitude_m / _SEMI_MAJOR_M
    return (
        f"+proj=tmerc +lat_0={origin.latitude_deg!r} +lon_0={origin.longitude_deg!r} +k={scale!r} "
        "+x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
    )


class GeoTiff:
    """A GeoTIFF that takes sheets one by one."""

    def __init__(self, dataset: Any, rasterio: Any):
        self._dataset, self._rasterio = dataset, rasterio

    def put(self, sheet: Sheet) -> None:
        """Write one sheet."""
        rows, columns = sheet.rgba.shape[:2]
        window = self._rasterio.windows.Window(sheet.column, sheet.row, columns, rows)
        self._dataset.write(np.moveaxis(sheet.rgba[..., :3], 2, 0), window=window)
        self._dataset.write_mask(sheet.rgba[..., 3] >= _SEEN_ALPHA, window=window)


@contextmanager
def geotiff(path: Path, canvas: Canvas, origin: GeodeticOrigin | None) -> Iterator[GeoTiff]:
    """A GeoTIFF of a canvas, tiled, JPEG within, with overviews and a mask; whole or not at all.

    Raises:
        ConfigError: rasterio is not installed.
    """
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
            yield GeoTiff(dataset, rasterio)
        with rasterio.open(memory.name, "r+") as dataset:
            dataset.build_overviews(_OVERVIEWS, rasterio.enums.Resampling.average)
        memory.seek(0)
        with whole_file(path) as partial, partial.open("wb") as file:
            while data := memory.read(_AT_ONCE_BYTES):
                file.write(data)


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
        row, column = sheet.row // self.factor, sheet.column // self.factor
        alpha = sheet.rgba[..., 3:].astype(np.float32) / 255
        reduced = cv2.resize(
            np.concatenate([sheet.rgba[..., :3] * alpha, alpha], axis=2),
            (columns, rows),
            interpolation=cv2.INTER_AREA,
        )
        seen = reduced[..., 3:]
        colours = np.divide(reduced[..., :3], seen, out=np.zeros_like(reduced[..., :3]), where=seen > 0)
        self._rgba[row : row + rows, column : column + columns] = np.round(
            np.concatenate([colours, 255 * seen], axis=2)
        )

    def write(self, path: Path) -> None:
        """Write it as WebP, transparent where nothing was seen; whole or not at all."""
        bgra = cv2.cvtColor(self._rgba, cv2.COLOR_RGBA2BGRA)
        with whole_file(path) as partial:
            encoded = cv2.imencode(path.suffix, bgra, [cv2.IMWRITE_WEBP_QUALITY, _PICTURE_QUALITY])[1]
            partial.write_bytes(encoded.tobytes())
