"""Intrinsics as a ROS ``camera_info`` calibration file (``camera_calibration_parsers``' YAML)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from v2hdm.errors import DriveError
from v2hdm.io.calibration.formats import camera_info_content
from v2hdm.io.safe.fields import check_camera, take_size_px
from v2hdm.records import DISTORTION_COEFFICIENTS, CameraInfo, FloatArray
from v2hdm.store.files import (
    check_keys,
    dump_yaml,
    load_yaml,
    replace_text,
    take_array,
    take_mapping,
    take_text,
)

_REQUIRED = (
    "image_width",
    "image_height",
    "camera_name",
    "camera_matrix",
    "distortion_model",
    "distortion_coefficients",
)
# Stereo rectification, which does not concern images as recorded.
_IGNORED = ("rectification_matrix", "projection_matrix")
# What OpenCV adds to its matrices; numbers tell their type themselves.
_OF_OPENCV = ("dt", "type_id")


def read_camera_info(path: Path) -> CameraInfo:
    """Read the intrinsics at ``path``; errors as in :func:`take_camera_info`."""
    return take_camera_info(load_yaml(path, DriveError), str(path))


def take_camera_info(content: Mapping[str, Any], where: str) -> CameraInfo:
    """The intrinsics that the entries of such a file hold.

    Raises:
        DriveError: when an entry is missing or damaged, the distortion model is unknown or has
            another number of coefficients, the camera matrix is none, or the lens cannot be undone.
    """
    check_keys(content, _REQUIRED, _IGNORED, where, DriveError)
    model = take_text(content["distortion_model"], f"{where}: distortion_model", DriveError)
    if model not in DISTORTION_COEFFICIENTS:
        raise DriveError(
            f"{where}: unknown distortion_model '{model}'; "
            f"convert the calibration to one of: {', '.join(DISTORTION_COEFFICIENTS)}"
        )
    distortion = take_matrix(content["distortion_coefficients"], f"{where}: distortion_coefficients").ravel()
    expected = DISTORTION_COEFFICIENTS[model]
    if len(distortion) != expected:
        raise DriveError(
            f"{where}: distortion_coefficients: {model} has {expected} coefficients, got {len(distortion)}; "
            "complete them (zeros where unused) or name the right model"
        )
    info = CameraInfo(
        name=take_text(content["camera_name"], f"{where}: camera_name", DriveError),
        width=take_size_px(content["image_width"], f"{where}: image_width", DriveError),
        height=take_size_px(content["image_height"], f"{where}: image_height", DriveError),
        intrinsic=_take_intrinsic(content["camera_matrix"], f"{where}: camera_matrix"),
        distortion_model=model,
        distortion=tuple(distortion.tolist()),
    )
    check_camera(info, where, DriveError)
    return info


def write_camera_info(info: CameraInfo, path: Path) -> None:
    """Write ``info`` to ``path``, atomically, with the identity as rectification for ROS' sake."""
    replace_text(path, dump_yaml(camera_info_content(info)))


def take_matrix(content: object, where: str) -> FloatArray:
    """A matrix of ``rows``, ``cols`` and ``data``, as ROS and OpenCV write it.

    Raises:
        DriveError: an entry is missing, or they do not fit.
    """
    entry = take_mapping(content, where, DriveError)
    check_keys(entry, ("rows", "cols", "data"), _OF_OPENCV, where, DriveError)
    rows, cols = (take_size_px(entry[key], f"{where}, {key}", DriveError) for key in ("rows", "cols"))
    data = take_array(entry["data"], (-1,), f"{where}, data", DriveError)
    if len(data) != rows * cols:
        raise DriveError(
            f"{where}: {rows} x {cols} does not fit its {len(data)} numbers; mend rows, cols or data"
        )
    return data.reshape(rows, cols)


def _take_intrinsic(content: object, where: str) -> FloatArray:
    intrinsic = take_matrix(content, where)
    if intrinsic.shape != (3, 3):
        raise DriveError(f"{where}: expected 3 x 3, got {intrinsic.shape[0]} x {intrinsic.shape[1]}; mend it")
    zeros = intrinsic[[0, 1, 2, 2], [1, 0, 0, 1]]
    if intrinsic[0, 0] <= 0 or intrinsic[1, 1] <= 0 or zeros.any() or intrinsic[2, 2] != 1:
        raise DriveError(f"{where}: not of the form fx 0 cx, 0 fy cy, 0 0 1 with positive fx, fy; mend it")
    return intrinsic
