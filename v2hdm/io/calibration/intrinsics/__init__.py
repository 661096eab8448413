"""Intrinsics of a camera from the files of the tools that calibrate: one registry, one reader a format."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from v2hdm.errors import DriveError
from v2hdm.io.calibration.intrinsics.colmap import COLMAP_MODELS, colmap_names, is_colmap, read_colmap
from v2hdm.io.calibration.intrinsics.document import Document, read_document
from v2hdm.io.calibration.intrinsics.kalibr import is_kalibr, kalibr_names, read_kalibr
from v2hdm.io.calibration.intrinsics.opencv import is_opencv, opencv_names, read_opencv
from v2hdm.io.calibration.intrinsics.own import is_own, names_of_own, read_own
from v2hdm.io.calibration.intrinsics.ros import (
    is_camera_info,
    is_message,
    names_of_camera_info,
    names_of_message,
    read_camera_info_file,
    read_message,
)
from v2hdm.records import CameraInfo

__all__ = ["COLMAP_MODELS", "INTRINSICS", "IntrinsicsFormat", "is_calibration", "read_intrinsics"]


@dataclass(frozen=True)
class IntrinsicsFormat:
    """One format: ``accepts`` a file by a look at it, ``names`` its cameras, ``read`` one of them."""

    accepts: Callable[[Document], bool]
    names: Callable[[Document], list[str]]
    read: Callable[[Document, str], CameraInfo]


INTRINSICS: Mapping[str, IntrinsicsFormat] = {
    "COLMAP cameras.txt": IntrinsicsFormat(is_colmap, colmap_names, read_colmap),
    "Kalibr camchain": IntrinsicsFormat(is_kalibr, kalibr_names, read_kalibr),
    "V2HDM calibration": IntrinsicsFormat(is_own, names_of_own, read_own),
    "OpenCV": IntrinsicsFormat(is_opencv, opencv_names, read_opencv),
    "ROS CameraInfo message": IntrinsicsFormat(is_message, names_of_message, read_message),
    "ROS camera_info": IntrinsicsFormat(is_camera_info, names_of_camera_info, read_camera_info_file),
}
"""The formats, by name; the first that accepts a file reads it."""


def read_intrinsics(path: Path, camera: str | None = None, name_by: str = "its name") -> CameraInfo:
    """The intrinsics of one camera, from a file of any format of :data:`INTRINSICS`.

    Args:
        path: the file.
        camera: which of its cameras; needed where it holds several.
        name_by: how the user names it, for errors.

    Raises:
        DriveError: the file is missing, damaged or of no known format, the camera is not in it or is not
            named among several, or its lens is beyond ours.
    """
    if path.suffix.lower() == ".bin":
        raise DriveError(
            f"{path}: is binary; write COLMAP's model as text (model_converter --output_type TXT)"
        )
    document = read_document(path)
    chosen = next((one for one in INTRINSICS.values() if one.accepts(document)), None)
    if chosen is None:
        raise DriveError(f"{path}: no intrinsics of a known format ({', '.join(INTRINSICS)}) in this file")
    names = chosen.names(document)
    if camera is None and len(names) > 1:
        raise DriveError(f"{path}: holds the cameras {', '.join(names)}; name one by {name_by}")
    if camera is not None and camera not in names:
        raise DriveError(f"{path}: no camera '{camera}' in this file; it holds: {', '.join(names)}")
    return chosen.read(document, names[0] if camera is None else camera)


def is_calibration(path: Path) -> bool:
    """Whether the file is a calibration of ours, which says where the camera sits, too.

    Raises:
        DriveError: the file is missing or damaged.
    """
    return is_own(read_document(path))
