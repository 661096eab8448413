"""Calibrations of cameras as files: our own, and the formats of other tools."""

from v2hdm.io.calibration.reading import (
    Provenance,
    read_calibration,
    read_camera_info,
    read_provenance,
    trusted_calibrations,
)
from v2hdm.io.calibration.writing import (
    CALIBRATION_FORMATS,
    write_calibration,
    write_calibration_as,
    write_camera_info,
)

__all__ = [
    "CALIBRATION_FORMATS", "Provenance", "read_calibration", "read_camera_info", "read_provenance",
    "trusted_calibrations", "write_calibration", "write_calibration_as", "write_camera_info",
]  # fmt: skip
