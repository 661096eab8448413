"""ROS: ``camera_info`` files, and messages as ``ros2 topic echo`` writes them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.calibration.camera_info import take_camera_info
from v2hdm.io.calibration.intrinsics.document import Document
from v2hdm.io.fields import take_size_px
from v2hdm.records import CameraInfo
from v2hdm.store.files import take_array, take_text


def is_message(document: Document) -> bool:
    """Whether the file holds a ``CameraInfo`` message."""
    return {"height", "width", "distortion_model"} <= set(document.entries)


def names_of_message(document: Document) -> list[str]:
    """Its only camera, by the frame of its header."""
    header = document.entries.get("header")
    frame = header.get("frame_id") if isinstance(header, dict) else None
    return [str(frame or document.path.stem)]


def read_message(document: Document, name: str) -> CameraInfo:
    """The intrinsics of a ``CameraInfo`` message."""
    from v2hdm.io.importers.bag.streams import info_of  # whose package imports this one

    where, content = str(document.path), document.entries
    lower = {key.lower(): value for key, value in content.items() if isinstance(key, str)}
    for key in ("k", "d"):
        if key not in lower:
            raise DriveError(f"{where}: missing key '{key}'; write the message to the file again")
    region = lower.get("roi")
    fields = SimpleNamespace(
        k=take_array(lower["k"], (9,), f"{where}: k", DriveError),
        d=take_array(lower["d"], (-1,), f"{where}: d", DriveError) if lower["d"] else np.empty(0),
        distortion_model=take_text(lower["distortion_model"], f"{where}: distortion_model", DriveError),
        width=take_size_px(lower["width"], f"{where}: width", DriveError),
        height=take_size_px(lower["height"], f"{where}: height", DriveError),
        binning_x=lower.get("binning_x") or 0,
        binning_y=lower.get("binning_y") or 0,
        roi=SimpleNamespace(
            **{key: region.get(key, 0) if isinstance(region, dict) else 0 for key in ("width", "height")}
        ),
    )
    return info_of(fields, name, where)


def is_camera_info(document: Document) -> bool:
    """Whether the file is one of ``camera_calibration_parsers``."""
    return bool({"camera_name", "distortion_model", "camera_matrix"} & set(document.entries))


def names_of_camera_info(document: Document) -> list[str]:
    """Its only camera."""
    return [str(document.entries.get("camera_name", document.path.stem))]


def read_camera_info_file(document: Document, name: str) -> CameraInfo:
    """The intrinsics of a ``camera_info`` file."""
    return take_camera_info(document.entries, str(document.path))
