"""Our own ``calibration_<camera>.yaml``, for its intrinsics."""

from __future__ import annotations

from v2hdm.errors import DriveError, MapFileError
from v2hdm.io.calibration.document import read_calibration
from v2hdm.io.calibration.intrinsics.document import Document
from v2hdm.records import DISTORTION_COEFFICIENTS, CameraInfo


def is_own(document: Document) -> bool:
    """Whether the file is one that :func:`v2hdm.io.maps.write_calibration` wrote."""
    return isinstance(document.entries.get("camera_matrix"), list)


def names_of_own(document: Document) -> list[str]:
    """Its only camera."""
    return [str(document.entries.get("camera_name", document.path.stem))]


def read_own(document: Document, name: str) -> CameraInfo:
    """The intrinsics of our calibration."""
    try:
        info = read_calibration(document.path).info
    except MapFileError as error:
        raise DriveError(str(error)) from None
    if len(info.distortion) != DISTORTION_COEFFICIENTS.get(info.distortion_model):
        raise DriveError(
            f"{document.path}: {info.distortion_model} with {len(info.distortion)} coefficients is no lens "
            f"of ours; known are {', '.join(DISTORTION_COEFFICIENTS)}"
        )
    return info
