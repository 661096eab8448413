"""A map to files and back."""

from v2hdm.io.maps.features import ground_height_m, with_heights
from v2hdm.io.maps.formats import FORMATS, check_formats, write_map
from v2hdm.io.maps.geojson import geojson_feature, geojson_positions, write_features, write_geojson
from v2hdm.io.maps.geopackage import write_geopackage
from v2hdm.io.maps.reading import (
    read_geojson,
    read_geopackage,
    read_map,
    read_verdict,
)

__all__ = [
    "FORMATS", "check_formats", "geojson_feature", "geojson_positions", "ground_height_m", "read_geojson",
    "read_geopackage", "read_map", "read_verdict", "with_heights",
    "write_features", "write_geojson", "write_geopackage", "write_map",
]  # fmt: skip
