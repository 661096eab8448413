"""Writing an HD map as GeoParquet 1.1, through ``geopandas`` and ``pyarrow``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from v2hdm.errors import ConfigError, need
from v2hdm.geometry.geodetic import Grid
from v2hdm.io.maps.features import Feature, features_of, properties_of
from v2hdm.io.maps.geopackage import LOCAL_CRS, shapes_of
from v2hdm.records import HDMap
from v2hdm.store.files import whole_file

COLUMNS = {
    "id": "int64",
    "class": "string",
    "sightings": "int64",
    "sigma_m": "double",
    "relative_sigma_m": "double",
    "accuracy": "string",
    "kind": "string",
    "paint_left": "double",
    "paint_left_sigma": "double",
    "paint_left_change": "double",
    "paint_left_change_sigma": "double",
    "text": "string",
    "text_confidence": "double",
    "text_alternative": "string",
    "text_alternative_confidence": "double",
    "apart_m": "double",
    "parts": "json",
    "lines": "json",
    "covariance_m2": "json",
}
"""Columns and their types: Arrow's, or JSON in a string, as in a GeoPackage. What is not known is null."""


def write_geoparquet(hd_map: HDMap, path: Path, grid: Grid | None = None) -> None:
    """Write ``hd_map`` as GeoParquet, atomically: a row per feature, with bounding boxes to read parts by.

    Coordinates are those of GeoPackage. Raises ConfigError without ``pyarrow``.
    """
    need("pyarrow", "parquet", f"the format of {path.name}", ConfigError)
    geopandas = need("geopandas", "gis", f"the format of {path.name}", ConfigError)
    crs = LOCAL_CRS if hd_map.origin is None else "EPSG:4326"
    if grid is not None:
        crs = LOCAL_CRS if grid.is_local else grid.crs
    features = features_of(hd_map)
    shapes = geopandas.GeoSeries.from_wkb(shapes_of(features, grid or hd_map.origin), crs=crs)
    frame = geopandas.GeoDataFrame(_columns(features), geometry=shapes)
    with whole_file(path) as partial, partial.open("wb") as file:
        frame.to_parquet(
            file, index=False, compression="zstd", schema_version="1.1.0", write_covering_bbox=True
        )


def _columns(features: Sequence[Feature]) -> dict[str, Any]:
    """Columns of the types of :data:`COLUMNS`, also where nothing in them is known."""
    pandas = need("pandas", "gis", "GeoParquet", ConfigError)
    arrow = need("pyarrow", "parquet", "GeoParquet", ConfigError)
    types = {"int64": arrow.int64(), "double": arrow.float64()}
    rows = [properties_of(feature) for feature in features]
    columns = {}
    for name, kind in COLUMNS.items():
        values = [row.get(name) for row in rows]
        if kind == "json":
            values = [None if value is None else json.dumps(value) for value in values]
        typed = arrow.array(values, type=types.get(kind, arrow.string()))
        columns[name] = pandas.Series(pandas.arrays.ArrowExtensionArray(typed))
    return columns
