"""A map or a calibration to files and back: one format a file."""

from v2hdm.io.maps.features import ground_height_m, with_heights
from v2hdm.io.maps.formats import FORMATS, check_formats, read_map, write_map
from v2hdm.io.maps.geojson import read_geojson, write_geojson

__all__ = [
    "FORMATS",
    "check_formats",
    "ground_height_m",
    "read_geojson",
    "read_map",
    "with_heights",
    "write_geojson",
    "write_map",
]
