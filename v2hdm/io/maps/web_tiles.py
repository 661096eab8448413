"""Writing the tiles of a mosaic: PMTiles, one file that web maps read in pieces, and XYZ folders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from v2hdm.errors import ConfigError, need
from v2hdm.safe.pyramids import Tile, tiles_of
from v2hdm.safe.tiles import HALF_WORLD_M
from v2hdm.store.files import whole_file

_E7 = 10**7  # units of PMTiles' coordinates in a degree


def write_mosaic_pmtiles(mosaic: Path, path: Path) -> list[Path]:
    """Write a mosaic's tiles as PMTiles of WebP, atomically; returns the file.

    Raises MapFileError where the mosaic is no GeoTIFF on the earth, ConfigError without ``pmtiles``.
    """
    writer_module = need("pmtiles.writer", "gis", "the format pmtiles", ConfigError)
    from pmtiles.tile import Compression, TileType, zxy_to_tileid

    with tiles_of(mosaic, ".webp") as tiles, whole_file(path) as partial, partial.open("wb") as file:
        writer = writer_module.Writer(file)
        by_number = {zxy_to_tileid(tile.level, tile.column, tile.row): tile for tile in tiles}
        for number in sorted(by_number):
            writer.write_tile(number, by_number[number].file.read_bytes())
        header: dict[str, Any] = {"tile_type": TileType.WEBP, "tile_compression": Compression.NONE}
        writer.finalize(header | _extent(tiles), {"name": path.stem, "type": "baselayer", "format": "webp"})
    return [path]


def write_mosaic_xyz(mosaic: Path, path: Path) -> list[Path]:
    """Write a mosaic's tiles as PNG into ``path/z/x/y.png``, each atomically; returns the folder.

    Raises MapFileError where the mosaic is no GeoTIFF on the earth.
    """
    with tiles_of(mosaic, ".png") as tiles:
        for tile in tiles:
            place = path / str(tile.level) / str(tile.column) / f"{tile.row}.png"
            place.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(place) as partial:
                partial.write_bytes(tile.file.read_bytes())
    return [path]


def _extent(tiles: list[Tile]) -> dict[str, int]:
    """Levels and edges of the tiles, as a header of PMTiles states them."""
    pyproj = need("pyproj", "map", "the format pmtiles", ConfigError)
    level = max(tile.level for tile in tiles)
    finest = [tile for tile in tiles if tile.level == level]
    side_m = 2 * HALF_WORLD_M / 2**level
    west = min(tile.column for tile in finest) * side_m - HALF_WORLD_M
    east = (max(tile.column for tile in finest) + 1) * side_m - HALF_WORLD_M
    north = HALF_WORLD_M - min(tile.row for tile in finest) * side_m
    south = HALF_WORLD_M - (max(tile.row for tile in finest) + 1) * side_m
    to_earth = pyproj.Transformer.from_crs("EPSG:3857", "EPSG:4326", always_xy=True)
    low = to_earth.transform(west, south)
    high = to_earth.transform(east, north)
    edges = {"min_lon": low[0], "min_lat": low[1], "max_lon": high[0], "max_lat": high[1]}
    edges |= {"center_lon": (low[0] + high[0]) / 2, "center_lat": (low[1] + high[1]) / 2}
    return {f"{name}_e7": round(degrees * _E7) for name, degrees in edges.items()} | {"center_zoom": level}
