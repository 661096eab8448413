"""GeoTIFFs from outside, which GDAL reads in a child, each file alone."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from v2hdm.errors import ConfigError, MapFileError, need, one_line
from v2hdm.records import FloatArray
from v2hdm.safe.child import Limits, in_child, next_step
from v2hdm.safe.pixels import check_raster

_log = logging.getLogger(__name__)

_WORLD_FILES = (".tfw", ".tifw", ".tiffw", ".wld", ".TFW", ".TIFW", ".TIFFW", ".WLD")
"""Endings of the small files that say where a picture lies, in the place of its own."""


def mosaic_points(mosaic: Path, spacing_m: float, most: int, piece_px: int) -> Iterator[FloatArray]:
    """Places in the map frame and grey values, (N, 3), of a mosaic's strips, of ``piece_px`` at most.

    They are ``spacing_m`` apart, and farther, which is logged, where that makes more than ``most`` of them.

    Raises MapFileError where the file is no mosaic of ours, ConfigError where rasterio is missing.
    """
    with TemporaryDirectory() as folder:
        ask(_write_points, mosaic, spacing_m, most, piece_px, Path(folder))
        for strip in sorted(Path(folder).glob("*.npy")):
            yield np.load(strip, allow_pickle=False)


def ask(work: Any, path: Path, *arguments: Any) -> None:
    """Run ``work`` on a raster, or on a folder of them, in a child; raises MapFileError if the child dies."""
    files = path.rglob("*") if path.is_dir() else [path]
    limits = Limits.of(files)
    in_child(
        work, path, *arguments, limits=limits, where=str(path), error=MapFileError, libraries=("rasterio",)
    )


@contextmanager
def geotiff(path: Path) -> Iterator[Any]:
    """A GeoTIFF, open in rasterio; MapFileError where it is none.

    GDAL opens overviews and masks that lie beside a picture by whatever driver fits, and many drivers open
    any file or URL that theirs names. Here the picture lies alone, with the small files that say where it is.
    """
    rasterio = need("rasterio", "gis", "a GeoTIFF", MapFileError)
    if not path.is_file():
        raise MapFileError(f"{path}: not a readable GeoTIFF (no such file); check the path")
    with TemporaryDirectory() as folder:
        alone = _alone(path, Path(folder))
        try:
            with rasterio.open(alone, driver="GTiff") as source:
                if source.tags(ns="OVERVIEWS"):
                    raise MapFileError(f"{path}: names another file for its overviews; save it as one file")
                check_raster(source, path, MapFileError)
                yield source
        except (rasterio.errors.RasterioError, rasterio.errors.CRSError) as failure:
            reason = one_line(str(failure.__cause__ or failure)).replace(f"'{alone}' ", "")
            raise MapFileError(f"{path}: not a readable GeoTIFF ({reason}); restore it") from None


def _alone(path: Path, folder: Path) -> Path:
    """A link to a picture in an empty folder, beside links to its georeference files."""
    picture = folder / "picture.tif"
    names = {path.name: picture.name, f"{path.name}.aux.xml": f"{picture.name}.aux.xml"}
    names |= {f"{path.stem}{ending}": f"{picture.stem}{ending}" for ending in _WORLD_FILES}
    for name, short_name in names.items():
        if (path.parent / name).is_file():
            (folder / short_name).symlink_to((path.parent / name).resolve())
    return picture


def _pieces(data: Any, factor: int, piece_px: int) -> Iterator[tuple[Any, tuple[int, int]]]:
    """Windows over a raster from its top, and their shapes when averaged by a factor."""
    windows = need("rasterio.windows", "gis", "the format pcd", ConfigError)
    columns = -(-data.width // factor)
    rows_at_once = factor * max(piece_px // columns, 1)
    for top in range(0, data.height, rows_at_once):
        rows = min(rows_at_once, data.height - top)
        yield windows.Window(0, top, data.width, rows), (-(-rows // factor), columns)


def _shown_cells(data: Any, factor: int, piece_px: int) -> int:
    """The number of cells, of so many pixels a side, that show ground."""
    shown = 0
    for window, shape in _pieces(data, factor, piece_px):
        next_step()
        shown += int(np.count_nonzero(data.dataset_mask(window=window, out_shape=shape)))
    return shown


def _write_points(mosaic: Path, spacing_m: float, most: int, piece_px: int, folder: Path) -> None:
    """Write a file of points (N, 3) into a folder for each strip of a mosaic that shows ground."""
    rasterio = need("rasterio", "gis", "the format pcd", ConfigError)
    with geotiff(mosaic) as data:
        if data.count != 3 or data.dtypes[0] != "uint8" or data.transform.b or data.transform.e >= 0:
            raise MapFileError(f"{mosaic}: not a mosaic that v2hdm wrote; give mosaic.tif of a result")
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
