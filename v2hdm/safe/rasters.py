"""Rasters from outside, which GDAL reads in a child: pictures of a site, and mosaics."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from v2hdm.errors import ConfigError, MapFileError, need
from v2hdm.records import FloatArray
from v2hdm.safe.child import Limits, in_child, next_step
from v2hdm.safe.pixels import check_raster, read_header

_log = logging.getLogger(__name__)

_HALF_WORLD_M = 20037508.342789244  # half a side of Web Mercator's square (EPSG:3857)
_TILES = """<GDAL_WMS><Service name="TMS"><ServerUrl>{url}/${{z}}/${{x}}/${{y}}{ending}</ServerUrl></Service>
<DataWindow><UpperLeftX>-{half}</UpperLeftX><UpperLeftY>{half}</UpperLeftY><LowerRightX>{half}</LowerRightX>
<LowerRightY>-{half}</LowerRightY><TileLevel>{finest}</TileLevel><TileCountX>1</TileCountX>
<TileCountY>1</TileCountY><YOrigin>top</YOrigin></DataWindow><Projection>EPSG:3857</Projection>
<BlockSizeX>{px}</BlockSizeX><BlockSizeY>{px}</BlockSizeY><BandsCount>4</BandsCount>
<OverviewCount>{coarser}</OverviewCount></GDAL_WMS>"""  # GDAL's description of tiles, here in a folder
_PIXELS = "pixels.npy"  # what a child leaves of a picture


@dataclass(frozen=True)
class Window:
    """A rectangle of the ground, in the metres of a projection, and its pixels."""

    crs: str
    west_m: float
    north_m: float
    step_m: float  # side of a pixel
    width: int
    height: int


def check_background(path: Path) -> None:
    """Raise MapFileError where the user's GeoTIFF or XYZ tiles cannot be used."""
    _ask(_probe, path)


def background_pixels(path: Path, window: Window) -> np.ndarray:
    """The user's GeoTIFF or XYZ tiles in a window, (H, W, 4) uint8 BGR and mask; MapFileError if unusable."""
    with TemporaryDirectory() as folder:
        _ask(_warp, path, window, Path(folder))
        return np.asarray(np.load(Path(folder) / _PIXELS, allow_pickle=False))


def mosaic_points(mosaic: Path, spacing_m: float, most: int, piece_px: int) -> Iterator[FloatArray]:
    """Places in the map frame and grey values, (N, 3), of a mosaic's strips, of ``piece_px`` at most.

    They are ``spacing_m`` apart, and farther, which is logged, where that makes more than ``most`` of them.

    Raises MapFileError where the file is no mosaic of ours, ConfigError where rasterio is missing.
    """
    with TemporaryDirectory() as folder:
        _ask(_write_points, mosaic, spacing_m, most, piece_px, Path(folder))
        for strip in sorted(Path(folder).glob("*.npy")):
            yield np.load(strip, allow_pickle=False)


def _ask(work: Any, path: Path, *arguments: Any) -> None:
    files = path.rglob("*") if path.is_dir() else [path]
    in_child(work, path, *arguments, limits=Limits.of(files), where=str(path), error=MapFileError)


def _source(path: Path) -> dict[str, Any]:
    """Source for rasterio: a GeoTIFF, or a folder ``z/x/y.png`` of XYZ tiles as one picture."""
    levels = sorted(int(level.name) for level in path.glob("*") if level.name.isdecimal())
    tile = next((path / str(levels[-1])).glob("*/*.*"), None) if levels else None
    if tile is None:
        if not path.is_file():
            raise MapFileError(f"{path}: not a readable GeoTIFF or folder of XYZ tiles; check the path")
        return {"fp": path, "driver": "GTiff"}
    tiles = {"url": escape(path.resolve().as_uri()), "ending": tile.suffix, "half": _HALF_WORLD_M}
    tiles |= {"px": read_header(tile).width, "finest": levels[-1], "coarser": levels[-1] - levels[0]}
    return {"fp": _TILES.format(**tiles), "driver": "WMS"}


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The user's GeoTIFF or XYZ tiles, open in rasterio; MapFileError if unusable."""
    rasterio = need("rasterio", "gis", "a background", MapFileError)
    try:
        with rasterio.open(**_source(path)) as source:
            if source.crs is None:
                raise MapFileError(f"{path}: states no coordinate system; give a GeoTIFF that has one")
            if not (source.crs.is_geographic or source.crs.is_projected):
                raise MapFileError(
                    f"{path}: its coordinate system is a local one, without a place on the earth; give a "
                    "picture in a system such as EPSG:25832"
                )
            if any(kind.startswith("complex") for kind in source.dtypes):
                raise MapFileError(f"{path}: its pixels are complex numbers; give a picture of real ones")
            if path.is_file():
                check_raster(source, path, MapFileError)
            yield source
    except (rasterio.errors.RasterioError, rasterio.errors.CRSError) as failure:
        raise MapFileError(f"{path}: not a readable GeoTIFF or folder of XYZ tiles ({failure})") from None


def _probe(path: Path) -> None:
    with _opened(path):
        pass


def _warp(path: Path, window: Window, folder: Path) -> None:
    """Write the pixels of a background in a window into a folder."""
    rasterio = need("rasterio", "gis", "a background", MapFileError)
    warped = need("rasterio.vrt", "gis", "a background", MapFileError)
    with _opened(path) as source:
        look = {
            "crs": rasterio.crs.CRS.from_user_input(window.crs),
            "transform": rasterio.Affine(window.step_m, 0, window.west_m, 0, -window.step_m, window.north_m),
            "width": window.width,
            "height": window.height,
            "add_alpha": rasterio.enums.ColorInterp.alpha not in source.colorinterp,
            "resampling": rasterio.enums.Resampling.bilinear,
        }
        with warped.WarpedVRT(source, **look) as raster:
            bands = raster.read([3, 2, 1] if source.count >= 3 else [1, 1, 1])
            mask = raster.dataset_mask()
    if not mask.any():
        raise MapFileError(f"{path}: does not cover this map; give a picture of its site")
    if bands.dtype != np.uint8:
        low, high = np.percentile(bands[:, mask > 0], (1, 99))
        bands = np.clip((bands - low) * 255.0 / max(high - low, 1e-9), 0, 255).astype(np.uint8)
    pixels = np.ascontiguousarray(np.moveaxis(np.concatenate([bands, mask[None]]), 0, 2))
    np.save(folder / _PIXELS, pixels)


def _pieces(data: Any, factor: int, piece_px: int) -> Iterator[tuple[Any, tuple[int, int]]]:
    """Windows over a raster from its top, and their shapes when averaged by a factor."""
    windows = need("rasterio.windows", "gis", "the format pcd", ConfigError)
    columns = -(-data.width // factor)
    rows_at_once = factor * max(piece_px // columns, 1)
    for top in range(0, data.height, rows_at_once):
        rows = min(rows_at_once, data.height - top)
        yield windows.Window(0, top, data.width, rows), (-(-rows // factor), columns)


def _shown_cells(data: Any, factor: int, piece_px: int) -> int:
    """How many cells of so many pixels a side show ground."""
    shown = 0
    for window, shape in _pieces(data, factor, piece_px):
        next_step()
        shown += int(np.count_nonzero(data.dataset_mask(window=window, out_shape=shape)))
    return shown


def _write_points(mosaic: Path, spacing_m: float, most: int, piece_px: int, folder: Path) -> None:
    """Write a file of points (N, 3) into a folder for each strip of a mosaic that shows ground."""
    rasterio = need("rasterio", "gis", "the format pcd", ConfigError)
    if not mosaic.is_file():
        raise MapFileError(f"{mosaic}: cannot be read as a GeoTIFF (no such file); restore it")
    try:
        with rasterio.open(mosaic, driver="GTiff") as data:
            if data.count != 3 or data.dtypes[0] != "uint8" or data.transform.b or data.transform.e >= 0:
                raise MapFileError(f"{mosaic}: not a mosaic that v2hdm wrote; give mosaic.tif of a result")
            check_raster(data, mosaic, MapFileError)
            scale = [data.transform.a, data.transform.e]
            corner = [data.transform.c, data.transform.f]
            factor = max(round(spacing_m / data.transform.a), 1)
            average = rasterio.enums.Resampling.average
            wider = 1 + int(np.sqrt(_shown_cells(data, factor, piece_px) / most))
            if wider > 1:
                factor *= wider
                apart_m = factor * data.transform.a
                _log.warning("%s: so large that the points are %.2f m apart", mosaic.name, apart_m)
            for number, (window, shape) in enumerate(_pieces(data, factor, piece_px)):
                next_step()
                is_shown = data.dataset_mask(window=window, out_shape=shape) > 0
                if not is_shown.any():
                    continue
                top = window.row_off
                rows = window.height
                pixels = data.read(window=window, out_shape=(3, *shape), resampling=average)
                row, column = np.nonzero(is_shown)
                step = np.array([data.width / shape[1], rows / shape[0]])
                cells_px = (np.column_stack([column, row]) + 0.5) * step + [0, top]
                places = cells_px * scale + corner
                grey = pixels.mean(axis=0)[is_shown]
                np.save(folder / f"{number:08d}.npy", np.column_stack([places, grey]))
    except rasterio.errors.RasterioError as failure:
        first = str(failure).splitlines()[0]
        raise MapFileError(f"{mosaic}: cannot be read as a GeoTIFF ({first}); restore it") from None
