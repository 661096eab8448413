"""Reading the calibration of one camera: our own YAML, and ROS' ``camera_info`` as a file or message."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError, MapFileError
from v2hdm.io.safe.fields import check_camera, take_covariance, take_size_px
from v2hdm.io.safe.texts import take_camera_name
from v2hdm.records import DISTORTION_COEFFICIENTS, Calibration, CameraInfo, FloatArray
from v2hdm.store.files import check_keys, load_yaml, take_array, take_mapping, take_text

_SIZE = ("image_width", "image_height")
_INFO = ("camera_name", *_SIZE, "camera_matrix", "distortion_model", "distortion_coefficients")
_OPTIONAL = (
    "vehicle_from_pinhole_px", "translation_sigma_m", "rotation_sigma_deg", "covariance", "clock_offset_s",
    "clock_sigma_s", "read_out_s", "read_out_sigma_s", "drive", "date", "verdict",
)  # fmt: skip
_IGNORED = ("rectification_matrix", "projection_matrix")  # of stereo rectification, not of recorded images
_OF_OPENCV = ("dt", "type_id")  # OpenCV adds these to its matrices; numbers tell their type themselves
_MODELS = {"": "plumb_bob", "radtan": "plumb_bob", "fisheye": "equidistant"}  # other names in messages


@dataclass(frozen=True)
class Provenance:
    """The source of a calibration: the drive's name, an ISO date, the status of the run's verdict."""

    drive: str | None = None
    date: str | None = None
    verdict: str | None = None

    @classmethod
    def today(cls, drive: str, verdict: Mapping[str, Any]) -> Provenance:
        """The provenance of a run of today (UTC) over ``drive``, with its verdict as JSON."""
        return cls(drive, datetime.now(UTC).date().isoformat(), str(verdict["status"]))


def read_calibration(path: Path) -> Calibration:
    """Read our own calibration; raises MapFileError when it is missing, damaged or of another format."""
    content = load_yaml(path, MapFileError)
    check_keys(content, (*_INFO, "cam_from_vehicle"), _OPTIONAL, str(path), MapFileError)

    def array(key: str, *shape: int) -> Any:
        return take_array(content[key], shape, f"{path}: {key}", MapFileError)

    name = take_camera_name(content["camera_name"], f"{path}: camera_name", MapFileError)
    width, height = (take_size_px(content[key], f"{path}: {key}", MapFileError) for key in _SIZE)
    model = take_text(content["distortion_model"], f"{path}: distortion_model", MapFileError)
    distortion = tuple(array("distortion_coefficients", -1).tolist())
    info = CameraInfo(name, width, height, array("camera_matrix", 3, 3), model, distortion)
    if len(info.distortion) == DISTORTION_COEFFICIENTS.get(info.distortion_model):
        check_camera(info, str(path), MapFileError)
    covariance = None
    if "covariance" in content:
        covariance = take_covariance(content["covariance"], 6, f"{path}: covariance", MapFileError)
    return Calibration(info=info, cam_from_vehicle=array("cam_from_vehicle", 4, 4), covariance=covariance)


def read_provenance(path: Path) -> Provenance:
    """The provenance that stands in our own calibration; errors as :func:`read_calibration`."""
    content = load_yaml(path, MapFileError)
    verdict = content.get("verdict")
    found = {key: content.get(key) for key in ("drive", "date")}
    found["verdict"] = verdict.get("status") if isinstance(verdict, dict) else None
    return Provenance(**{
        key: None if value is None else take_text(value, f"{path}: {key}", MapFileError)
        for key, value in found.items()
    })  # fmt: skip


def trusted_calibrations(path: Path) -> dict[str, Calibration]:
    """The calibrations in a result folder, or of a file, by camera; MapFileError where none, or FAIL."""
    files = sorted(path.glob("calibration_*.yaml")) if path.is_dir() else [path]
    if not files:
        raise MapFileError(f"{path}: no calibration_*.yaml in it; give a result of map or calibrate ground")
    found = {}
    for file in files:
        calibration = read_calibration(file)
        found[calibration.info.name] = calibration
        if read_provenance(file).verdict == "FAIL":
            raise MapFileError(
                f"{file}: the verdict on its drive is FAIL, so that it cannot be relied on: docs/verdict.md"
            )
    return found


def read_camera_info(path: Path) -> CameraInfo:
    """Read the ``camera_info`` file of ROS at ``path``; errors as in :func:`take_camera_info`."""
    return take_camera_info(load_yaml(path, DriveError), str(path))


def take_camera_info(content: Mapping[str, Any], where: str) -> CameraInfo:
    """The intrinsics in the entries of a ``camera_info`` file; raises DriveError where one is wrong."""
    check_keys(content, _INFO, _IGNORED, where, DriveError)
    model = take_text(content["distortion_model"], f"{where}: distortion_model", DriveError)
    expected = _coefficients_of(model, where, "convert the calibration to")
    distortion = take_matrix(content["distortion_coefficients"], f"{where}: distortion_coefficients").ravel()
    if len(distortion) != expected:
        raise DriveError(
            f"{where}: distortion_coefficients: {model} has {expected} coefficients, got {len(distortion)}; "
            "complete them (zeros where unused) or name the right model"
        )
    name = take_text(content["camera_name"], f"{where}: camera_name", DriveError)
    width, height = (take_size_px(content[key], f"{where}: {key}", DriveError) for key in _SIZE)
    at = f"{where}: camera_matrix"
    intrinsic = take_matrix(content["camera_matrix"], at)
    if intrinsic.shape != (3, 3):
        raise DriveError(f"{at}: expected 3 x 3, got {intrinsic.shape[0]} x {intrinsic.shape[1]}; mend it")
    zeros = intrinsic[[0, 1, 2, 2], [1, 0, 0, 1]]
    if intrinsic[0, 0] <= 0 or intrinsic[1, 1] <= 0 or zeros.any() or intrinsic[2, 2] != 1:
        raise DriveError(f"{at}: not of the form fx 0 cx, 0 fy cy, 0 0 1 with positive fx, fy; mend it")
    info = CameraInfo(name, width, height, intrinsic, model, tuple(distortion.tolist()))
    return check_camera(info, where, DriveError)


def _coefficients_of(model: str, where: str, advice: str) -> int:
    """The number of coefficients of a distortion model of ours; else DriveError with ``advice``."""
    if model not in DISTORTION_COEFFICIENTS:
        known = ", ".join(DISTORTION_COEFFICIENTS)
        raise DriveError(f"{where}: unknown distortion_model '{model}'; {advice} one of: {known}")
    return DISTORTION_COEFFICIENTS[model]


def take_matrix(content: object, where: str) -> FloatArray:
    """A matrix of ``rows``, ``cols`` and ``data``, as ROS and OpenCV write it; raises DriveError."""
    entry = take_mapping(content, where, DriveError)
    check_keys(entry, ("rows", "cols", "data"), _OF_OPENCV, where, DriveError)
    rows, cols = (take_size_px(entry[key], f"{where}, {key}", DriveError) for key in ("rows", "cols"))
    data = take_array(entry["data"], (-1,), f"{where}, data", DriveError)
    if len(data) != rows * cols:
        raise DriveError(f"{where}: {rows} x {cols} does not fit its {len(data)} numbers; mend one of them")
    return data.reshape(rows, cols)


def info_of(fields: Any, name: str, where: str) -> CameraInfo:
    """The intrinsics of a ``CameraInfo`` message; DriveError if not calibrated, cut, or an unknown model."""
    intrinsic = np.array(getattr(fields, "k", getattr(fields, "K", None)), dtype=np.float64).reshape(3, 3)
    distortion = np.array(getattr(fields, "d", getattr(fields, "D", None)), dtype=np.float64).ravel()
    model = _MODELS.get(fields.distortion_model, fields.distortion_model)
    if not intrinsic.any():
        raise DriveError(f"{where}: the camera is not calibrated (K is zero); give camera_info as a file")
    if max(fields.binning_x, fields.binning_y) > 1 or fields.roi.width or fields.roi.height:
        raise DriveError(f"{where}: its images are binned or cut to a region; give camera_info as a file")
    count = _coefficients_of(model, where, "give camera_info as a file with")
    if distortion[count:].any():
        raise DriveError(f"{where}: {model} has {count} coefficients, got {len(distortion)}; give a file")
    # k3 and those after it are zero where they are not given.
    padded = (*distortion[:count].tolist(), *(0.0,) * (count - len(distortion)))
    info = CameraInfo(name, int(fields.width), int(fields.height), intrinsic, model, padded)
    return check_camera(info, where, DriveError)
