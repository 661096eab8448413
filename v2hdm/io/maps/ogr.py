"""Writing an HD map in further formats of GDAL by ``pyogrio``: FlatGeobuf, Shapefiles, JSON-FG, PMTiles.

All features of a file have the columns of :data:`COLUMNS`, as short as Shapefile's ten letters allow.
Coordinates are those of GeoPackage: longitude, latitude and ellipsoidal height, a grid's, or local metres.
"""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np

from v2hdm.errors import ConfigError, need
from v2hdm.geometry.geodetic import Grid
from v2hdm.io.maps.features import POINTS, Feature, features_of, properties_of
from v2hdm.io.maps.geopackage import LOCAL_CRS, gdal_errors, shapes_of
from v2hdm.io.maps.reading import LAYERS
from v2hdm.records import HDMap
from v2hdm.store.files import whole_file

COLUMNS = {
    "id": "id",
    "class": "class",
    "sightings": "sightings",
    "sigma_m": "sigma_m",
    "rel_sig_m": "relative_sigma_m",
    "accuracy": "accuracy",
    "paint_left": "paint_left",
    "kind": "kind",
    "text": "text",
}
"""Columns of a file, and the properties of a feature that they hold."""

_JSON_FG = "JSONFG"  # GDAL's driver
_PMTILES = "PMTiles"  # GDAL's driver
_DECIMALS = {"COORDINATE_PRECISION_GEOMETRY": "11", "COORDINATE_PRECISION_PLACE": "5"}
"""Decimals of degrees and of a grid's metres, as in GeoJSON: GDAL's own are 1 cm."""

_LAYER = "map"  # the name of the layer in files of one layer

# Options of GDAL's vector tiles (drivers PMTiles and MVT):
_TILES = {
    "MINZOOM": "12",  # tiles are 10 km wide there: coarser ones would show nothing
    "MAXZOOM": "18",  # viewers enlarge these
    "EXTENT": "16384",  # units of a tile's side: 1 cm or less at the finest level
    "BUFFER": "256",  # units around a tile that lines are drawn on
    "MAX_SIZE": "5000000",  # bytes of a tile above which GDAL would leave features out
    "MAX_FEATURES": "1000000",  # number of features above which it would, too
    "NAME": "map",
}

_NUMBERS = ("sigma_m", "rel_sig_m", "paint_left")  # columns of numbers that may be unknown


def write_flatgeobuf(hd_map: HDMap, path: Path, grid: Grid | None = None) -> None:
    """Write ``hd_map`` as FlatGeobuf, each file atomically: ``path``, of markings, and beside it the others.

    A file holds one kind of geometry: GDAL drops heights from a file of several.
    """
    features = features_of(hd_map)
    for key, layer in LAYERS.items():
        chosen = [feature for feature in features if feature.key == key]
        place = path.with_name(f"{layer}.fgb")
        with (
            whole_file(place) as partial,
            TemporaryDirectory(".part", f".{place.name}.", path.parent) as folder,
        ):
            inner = Path(folder, place.name)  # the driver goes by the suffix
            _write(inner, chosen, hd_map, grid, place, "FlatGeobuf", _shape(key))
            inner.replace(partial)


def write_json_fg(hd_map: HDMap, path: Path, grid: Grid | None = None) -> None:
    """Write ``hd_map`` as JSON-FG, atomically: in a ``grid`` with its coordinates as ``place``."""
    with whole_file(path) as partial, TemporaryDirectory(".part", f".{path.name}.", path.parent) as folder:
        place = Path(folder, "map.json")
        _write(place, features_of(hd_map), hd_map, grid, path, _JSON_FG, "Unknown")
        place.replace(partial)


def write_pmtiles(hd_map: HDMap, path: Path) -> None:
    """Write ``hd_map`` as vector tiles in one PMTiles, atomically, a layer ``map``; positions to 1 cm.

    Raises ConfigError where the map has no origin on the earth.
    """
    if hd_map.origin is None:
        raise ConfigError(
            f"{path.name}: web tiles need a place on the earth, and the map has no origin; leave it out"
        )
    with whole_file(path) as partial, TemporaryDirectory(".part", f".{path.name}.", path.parent) as folder:
        place = Path(folder, "map.pmtiles")
        features = features_of(hd_map)
        if features:
            _write(place, features, hd_map, None, path, _PMTILES, "Unknown")
        else:
            _write_empty_tiles(place)
        place.replace(partial)


def _write_empty_tiles(place: Path) -> None:
    """Write PMTiles of the whole earth without a feature, which GDAL refuses to write."""
    writer_module = need("pmtiles.writer", "gis", "the format pmtiles", ConfigError)
    from pmtiles.tile import Compression, TileType

    with place.open("wb") as file:
        writer = writer_module.Writer(file)
        writer.write_tile(0, gzip.compress(b"", mtime=0))
        header = {"tile_type": TileType.MVT, "tile_compression": Compression.GZIP}
        writer.finalize(header, {"vector_layers": [{"id": _LAYER, "fields": {}}]})


def write_shapefiles(hd_map: HDMap, path: Path, grid: Grid | None = None) -> None:
    """Write ``hd_map`` as a zip of Shapefiles, atomically: one for each kind of geometry that it has."""
    features = features_of(hd_map)
    with whole_file(path) as partial, TemporaryDirectory(".part", f".{path.name}.", path.parent) as folder:
        for key, layer in LAYERS.items():
            chosen = [feature for feature in features if feature.key == key]
            _write(Path(folder, f"{layer}.shp"), chosen, hd_map, grid, path, "ESRI Shapefile", _shape(key))
        with ZipFile(partial, "w", ZIP_DEFLATED) as archive:
            for file in sorted(Path(folder).iterdir()):
                archive.write(file, file.name)


def _shape(key: str) -> str:
    """The kind of geometry of a layer, by the property that holds its coordinates."""
    return "LineString Z" if key == POINTS else "Polygon Z"


def _write(
    place: Path,
    features: Sequence[Feature],
    hd_map: HDMap,
    grid: Grid | None,
    path: Path,
    driver: str,
    shape: str,
) -> None:
    """Write features to ``place``, with errors that name the ``path`` that a user knows."""
    raw = need("pyogrio.raw", "gis", f"the format of {path.name}", ConfigError)
    crs = LOCAL_CRS if hd_map.origin is None else "EPSG:4326"
    if grid is not None:
        crs = LOCAL_CRS if grid.is_local else grid.crs
    rows = [properties_of(feature) for feature in features]
    values = [_column(name, [row.get(key) for row in rows]) for name, key in COLUMNS.items()]
    shapes = shapes_of(features, grid or hd_map.origin)
    options: dict[str, Any] = {"layer": _LAYER} if shape == "Unknown" else {}
    if driver == _JSON_FG:
        options |= _DECIMALS
    if driver == _PMTILES:
        options["dataset_options"] = _TILES
    with gdal_errors(path):
        raw.write(
            str(place), shapes, values, list(COLUMNS), driver=driver, geometry_type=shape, crs=crs, **options
        )


def _column(name: str, values: Sequence[Any]) -> Any:
    if name in ("id", "sightings"):
        return np.array(values, dtype=np.int64)
    if name in _NUMBERS:
        return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    return np.array(values, dtype=object)
