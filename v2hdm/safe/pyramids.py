"""The pictures of a mosaic's web tiles, ``z/x/y`` in Web Mercator, which a child cuts out of the GeoTIFF."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import cv2
import numpy as np

from v2hdm.errors import MapFileError, need
from v2hdm.safe.child import next_step
from v2hdm.safe.rasters import ask, geotiff
from v2hdm.safe.tiles import HALF_WORLD_M

SIDE_PX = 256  # side of a tile: what every viewer takes for granted
_COARSEST_SIDE_M = 300.0  # side of the tiles of the coarsest level, m: a site is seen on a few; chosen
_AT_ONCE = 8  # tiles a side that are projected in one step; chosen
_QUALITY = 85  # quality of WebP, of 100; chosen


class Tile(NamedTuple):
    """Where a tile lies, and its encoded picture."""

    level: int
    column: int
    row: int
    file: Path


@contextmanager
def tiles_of(mosaic: Path, ending: str) -> Iterator[list[Tile]]:
    """Within, all tiles of a mosaic that show ground, as files of that ``ending``: ``.png`` or ``.webp``.

    The finest level is the one nearest to the mosaic's own pixels, each coarser one the mean of four tiles.
    Raises MapFileError where the file is no GeoTIFF on the earth, ConfigError where rasterio is missing.
    """
    with TemporaryDirectory() as folder:
        ask(_write_tiles, mosaic, ending, Path(folder))
        tiles = []
        for file in sorted(Path(folder).rglob(f"*{ending}")):
            level, column, row = file.relative_to(folder).with_suffix("").parts
            tiles.append(Tile(int(level), int(column), int(row), file))
        yield tiles


def _write_tiles(mosaic: Path, ending: str, folder: Path) -> None:
    """Write the tiles of all levels into a folder."""
    finest = _write_finest(mosaic, ending, folder)
    level = finest
    while 2 * HALF_WORLD_M / 2**level < _COARSEST_SIDE_M:
        _write_coarser(folder / str(level), folder / str(level - 1), ending)
        level -= 1


def _write_finest(mosaic: Path, ending: str, folder: Path) -> int:
    """Write the tiles of the finest level; returns it."""
    warp = need("rasterio.warp", "gis", "tiles", MapFileError)
    rasterio = need("rasterio", "gis", "tiles", MapFileError)
    with geotiff(mosaic) as source:
        if source.crs is None or not source.crs.is_projected:
            raise MapFileError(
                f"{mosaic}: lies nowhere on the earth, so it has no web tiles; state the origin in drive.yaml"
            )
        mercator = rasterio.crs.CRS.from_epsg(3857)
        west, south, east, north = warp.transform_bounds(source.crs, mercator, *source.bounds)
        place_from_px, _, _ = warp.calculate_default_transform(
            source.crs, mercator, source.width, source.height, *source.bounds
        )
        level = round(float(np.log2(2 * HALF_WORLD_M / SIDE_PX / place_from_px.a)))
        step_m = 2 * HALF_WORLD_M / SIDE_PX / 2**level
        side_m = SIDE_PX * step_m
        first_column, last_column = (int((edge + HALF_WORLD_M) // side_m) for edge in (west, east))
        first_row, last_row = (int((HALF_WORLD_M - edge) // side_m) for edge in (north, south))
        options: dict[str, Any] = {"crs": mercator, "resampling": rasterio.enums.Resampling.bilinear}
        for row in range(first_row, last_row + 1, _AT_ONCE):
            for column in range(first_column, last_column + 1, _AT_ONCE):
                next_step()
                corner = (column * side_m - HALF_WORLD_M, HALF_WORLD_M - row * side_m)
                options["transform"] = rasterio.Affine(step_m, 0, corner[0], 0, -step_m, corner[1])
                sides_px = {"width": _AT_ONCE * SIDE_PX, "height": _AT_ONCE * SIDE_PX}
                with rasterio.vrt.WarpedVRT(source, add_alpha=True, **options, **sides_px) as warped:
                    pixels = np.moveaxis(warped.read([3, 2, 1, 4]), 0, 2)
                _write_block(pixels, folder / str(level), column, row, ending)
    return level


def _write_block(pixels: np.ndarray, folder: Path, column: int, row: int, ending: str) -> None:
    """Write the tiles of pixels (H, W, 4) BGR and mask whose first is in that column and row."""
    for down in range(_AT_ONCE):
        for across in range(_AT_ONCE):
            top = down * SIDE_PX
            left = across * SIDE_PX
            tile = pixels[top : top + SIDE_PX, left : left + SIDE_PX]
            _write_tile(tile, folder / str(column + across) / f"{row + down}{ending}")


def _write_tile(pixels: np.ndarray, path: Path) -> None:
    """Write a tile where it shows any ground."""
    if not pixels[..., 3].any():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    quality = [cv2.IMWRITE_WEBP_QUALITY, _QUALITY] if path.suffix == ".webp" else []
    path.write_bytes(cv2.imencode(path.suffix, np.ascontiguousarray(pixels), quality)[1].tobytes())


def _write_coarser(finer: Path, folder: Path, ending: str) -> None:
    """Write the tiles of a level from those of the next finer one."""
    places = {(int(file.parent.name) // 2, int(file.stem) // 2) for file in finer.rglob(f"*{ending}")}
    for column, row in sorted(places):
        next_step()
        four = np.zeros((2 * SIDE_PX, 2 * SIDE_PX, 4), dtype=np.float32)
        for down in (0, 1):
            for across in (0, 1):
                file = finer / str(2 * column + across) / f"{2 * row + down}{ending}"
                if file.is_file():
                    tile = cv2.imdecode(np.frombuffer(file.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
                    assert tile is not None, "encoded here"
                    top = down * SIDE_PX
                    left = across * SIDE_PX
                    four[top : top + SIDE_PX, left : left + SIDE_PX] = _with_alpha(tile)
        alpha = four[..., 3:] / 255
        weighed = np.concatenate([four[..., :3] * alpha, alpha], axis=2)
        mean = cv2.resize(weighed, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA)
        opacity = mean[..., 3:]
        colours = np.divide(mean[..., :3], opacity, out=np.zeros_like(mean[..., :3]), where=opacity > 0)
        drawn = np.round(np.concatenate([colours, 255 * opacity], axis=2)).astype(np.uint8)
        _write_tile(drawn, folder / str(column) / f"{row}{ending}")


def _with_alpha(tile: np.ndarray) -> np.ndarray:
    """A decoded tile with its mask, which an encoder leaves out where all of it is seen."""
    return tile if tile.shape[2] == 4 else np.dstack([tile, np.full(tile.shape[:2], 255, np.uint8)])
