"""OpenCV: what its calibration programs write through ``cv2.FileStorage``, as YAML, JSON or XML."""

from __future__ import annotations

from typing import Any

from v2hdm.errors import DriveError
from v2hdm.io.calibration.camera_info import take_matrix
from v2hdm.io.calibration.intrinsics.document import Document
from v2hdm.io.calibration.intrinsics.lenses import brown_conrady, checked, complete
from v2hdm.io.fields import take_size_px
from v2hdm.records import CameraInfo


def is_opencv(document: Document) -> bool:
    """Whether the camera matrix in the file is one of OpenCV's."""
    entry = _lower(document).get("camera_matrix")
    return isinstance(entry, dict) and "dt" in entry


def opencv_names(document: Document) -> list[str]:
    """Its only camera; OpenCV names none, so that the file's name is taken."""
    return [str(document.entries.get("camera_name", document.path.stem))]


def read_opencv(document: Document, name: str) -> CameraInfo:
    """The intrinsics in the file.

    Raises:
        DriveError: an entry is missing or damaged, or the lens is none of ours.
    """
    where, entries = str(document.path), _lower(document)
    if "xi" in entries:
        raise DriveError(
            f"{where}: its lens is omnidirectional (xi), which is beyond our models; calibrate with "
            "cv2.calibrateCamera or cv2.fisheye.calibrate"
        )
    if "distortion_coefficients" not in entries:
        raise DriveError(
            f"{where}: missing key 'distortion_coefficients'; add it, zeros for a pinhole camera"
        )
    for key in ("image_width", "image_height"):
        if key not in entries:
            raise DriveError(f"{where}: missing key '{key}'; add the size of the images it was made from")
    intrinsic = take_matrix(entries["camera_matrix"], f"{where}: camera_matrix")
    if intrinsic.shape != (3, 3):
        raise DriveError(f"{where}: camera_matrix: expected 3 x 3; restore the file")
    at = f"{where}: distortion_coefficients"
    values = take_matrix(entries["distortion_coefficients"], at).ravel().tolist()
    if entries.get("fisheye_model") or entries.get("distortion_model") == "equidistant":
        if len(values) != 4:
            raise DriveError(
                f"{at}: OpenCV's fisheye has 4 coefficients, got {len(values)}; restore the file"
            )
        lens = ("equidistant", complete("equidistant", values))
    else:
        lens = brown_conrady(values, at)
    width, height = (
        take_size_px(entries[key], f"{where}: {key}", DriveError) for key in ("image_width", "image_height")
    )
    return checked(CameraInfo(name, width, height, intrinsic, *lens), where)


def _lower(document: Document) -> dict[str, Any]:
    """The entries by their names in small letters: OpenCV 2 wrote Camera_Matrix and image_Width."""
    return {str(key).lower(): value for key, value in document.entries.items()}
