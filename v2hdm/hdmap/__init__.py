"""A map or a calibration to files and back: one format a file."""

from v2hdm.hdmap.calibration import read_calibration, write_calibration
from v2hdm.hdmap.geojson import read_geojson, write_geojson

__all__ = ["read_calibration", "read_geojson", "write_calibration", "write_geojson"]
