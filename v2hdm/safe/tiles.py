"""Folders of XYZ tiles, ``z/x/y.png`` in Web Mercator, whose pixels are decoded as all images are.

No library of maps is given such a folder: a tile may be a file of any kind, which names any other.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.errors import DriveError, MapFileError
from v2hdm.records import FloatArray
from v2hdm.safe.child import next_step
from v2hdm.safe.pixels import read_header, read_pixels

HALF_WORLD_M = 20037508.342789244  # half a side of Web Mercator's square (EPSG:3857)
_USUAL_PX = 256  # side of a tile; some have twice as many, and are chosen a level too fine
_FINEST = 30  # level of tiles: there they are 4 cm wide
_NUMBER = re.compile(r"[0-9]{1,10}")  # a name of a level, column or row
_ENDINGS = (".png", ".jpg", ".jpeg", ".webp")  # of tiles


class Tiles(NamedTuple):
    """Tiles side by side: pixels (4, H, W) uint8 BGR and mask, and the place of the first one's corner."""

    pixels: np.ndarray
    west_m: float  # in Web Mercator, as the next two
    north_m: float
    step_m: float  # side of a pixel


def check_tiles(folder: Path) -> None:
    """Raise MapFileError where a folder has no XYZ tiles, or one of them is no image."""
    for level in _levels(folder).values():
        for _, _, tile in _tiles(level):
            next_step()
            with _as_tile():
                read_header(tile)


def read_tiles(folder: Path, low_m: FloatArray, high_m: FloatArray, step_m: float) -> Tiles | None:
    """The tiles of a rectangle in Web Mercator; None where there are none, MapFileError as check_tiles.

    They are of the coarsest level whose pixels are ``step_m`` or less, else of the finest that has any, and
    scaled down to half a ``step_m`` where they are finer than that.
    """
    levels = _levels(folder)
    by_fitness = sorted(levels, key=lambda level: _fitness(level, step_m))
    for level in by_fitness:
        side_m = _side_m(level)
        west, east = (int((edge + HALF_WORLD_M) // side_m) for edge in (low_m[0], high_m[0]))
        north, south = (int((HALF_WORLD_M - edge) // side_m) for edge in (high_m[1], low_m[1]))
        tiles = {
            (column, row): tile
            for column, row, tile in _tiles(levels[level], west, east)
            if north <= row <= south
        }
        if tiles:
            return _side_by_side(tiles, side_m, step_m)
    return None


def _fitness(level: int, step_m: float) -> tuple[bool, int]:
    is_coarse = _side_m(level) > _USUAL_PX * step_m
    return is_coarse, -level if is_coarse else level


def _side_m(level: int) -> float:
    return float(2 * HALF_WORLD_M / 2**level)


def _side_by_side(tiles: dict[tuple[int, int], Path], side_m: float, step_m: float) -> Tiles:
    columns, rows = (np.unique([place[axis] for place in tiles]) for axis in (0, 1))
    with _as_tile():
        own_px = read_header(next(iter(tiles.values()))).width
    side_px = max(min(own_px, int(np.ceil(2 * side_m / step_m))), 1)
    across, down = (int(np.ptp(numbers)) + 1 for numbers in (columns, rows))
    pixels = np.zeros((down * side_px, across * side_px, 4), np.uint8)
    for (column, row), tile in tiles.items():
        next_step()
        top = (row - rows[0]) * side_px
        left = (column - columns[0]) * side_px
        pixels[top : top + side_px, left : left + side_px] = _scaled(_pixels(tile), side_px)
    west_m = columns[0] * side_m - HALF_WORLD_M
    north_m = HALF_WORLD_M - rows[0] * side_m
    return Tiles(np.ascontiguousarray(np.moveaxis(pixels, 2, 0)), west_m, north_m, side_m / side_px)


def _pixels(tile: Path) -> np.ndarray:
    """A tile's pixels (H, W, 4) uint8, BGR and mask."""
    with _as_tile():
        pixels = read_pixels(tile, cv2.IMREAD_UNCHANGED)
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise MapFileError(f"{tile}: has pixels of type {pixels.dtype}; cut the tiles again, with 8 bits")
    if pixels.ndim == 2:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGRA))
    return pixels if pixels.shape[2] == 4 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2BGRA))


def _scaled(pixels: np.ndarray, side_px: int) -> np.ndarray:
    if pixels.shape[:2] == (side_px, side_px):
        return pixels
    return np.asarray(cv2.resize(pixels, (side_px, side_px), interpolation=cv2.INTER_AREA))


def _levels(folder: Path) -> dict[int, Path]:
    """The folders of tiles by their level, of those that have any; MapFileError where there is none."""
    numbered = {int(level.name): level for level in folder.glob("*") if _NUMBER.fullmatch(level.name)}
    levels = {
        number: level
        for number, level in numbered.items()
        if number <= _FINEST and level.is_dir() and next(_tiles(level), None)
    }
    if not levels:
        raise MapFileError(f"{folder}: not a readable GeoTIFF or folder of XYZ tiles; check the path")
    return levels


def _tiles(level: Path, first: int = 0, last: int = 1 << _FINEST) -> Iterator[tuple[int, int, Path]]:
    """Column, row and file of each tile of some columns of a level, by their names."""
    for column in level.iterdir():
        is_column = _NUMBER.fullmatch(column.name) and column.is_dir()
        if not is_column or not first <= int(column.name) <= last:
            continue
        for tile in column.iterdir():
            if _NUMBER.fullmatch(tile.stem) and tile.suffix.lower() in _ENDINGS:
                yield int(column.name), int(tile.stem), tile


@contextmanager
def _as_tile() -> Iterator[None]:
    """Errors of images within as those of tiles."""
    try:
        yield
    except DriveError as failure:
        raise MapFileError(f"{str(failure).partition('; ')[0]}; cut the tiles again") from None
