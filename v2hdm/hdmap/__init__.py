"""A map or a calibration to files and back: one format a file."""

from v2hdm.hdmap.calibration import read_calibration, write_calibration
from v2hdm.hdmap.geojson import read_geojson, write_geojson
from v2hdm.hdmap.heights import ground_height_m, with_heights

__all__ = [
    "ground_height_m",
    "read_calibration",
    "read_geojson",
    "with_heights",
    "write_calibration",
    "write_geojson",
]
