"""The calibration of one camera as YAML: intrinsics, where it sits, its IPM and their sigmas."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.io.fields import check_camera, take_covariance, take_size_px
from v2hdm.io.texts import take_camera_name
from v2hdm.records import DISTORTION_COEFFICIENTS, Calibration, CameraInfo
from v2hdm.store.files import check_keys, dump_yaml, load_yaml, replace_text, take_array, take_text

_REQUIRED = (
    "camera_name",
    "image_width",
    "image_height",
    "camera_matrix",
    "distortion_model",
    "distortion_coefficients",
    "cam_from_vehicle",
)
_OPTIONAL = (
    "vehicle_from_pinhole_px",
    "translation_sigma_m",
    "rotation_sigma_deg",
    "covariance",
    "clock_offset_s",
    "clock_sigma_s",
    "drive",
    "date",
    "verdict",
)


@dataclass(frozen=True)
class Provenance:
    """Where a calibration comes from: name of the drive, ISO date, and the status of the verdict on the run.

    Of each None where it is not known.
    """

    drive: str | None = None
    date: str | None = None
    verdict: str | None = None

    @classmethod
    def today(cls, drive: str, verdict: Mapping[str, Any]) -> Provenance:
        """That of a run of today (UTC) over ``drive``, with its verdict as JSON."""
        return cls(drive, datetime.now(UTC).date().isoformat(), str(verdict["status"]))


def write_calibration(
    calibration: Calibration,
    path: Path,
    *,
    clock_s: tuple[float, float] | None = None,
    verdict: Mapping[str, Any] | None = None,
    about: Provenance | None = None,
) -> None:
    """Write ``calibration`` to ``path``, atomically.

    The sigmas are those of the left-perturbation tangent of ``cam_from_vehicle``, so both are along
    the camera's own axes (right, down, forward); they are left out where there is no covariance.

    Args:
        calibration: what is written.
        path: where to.
        clock_s: how much later than stamped the camera's images were taken, and the sigma of that (infinite
            where it is not known; it is then left out).
        verdict: that on the run which found it, as JSON.
        about: its drive and date.
    """
    info = calibration.info
    content: dict[str, Any] = {
        "camera_name": info.name,
        "image_width": info.width,
        "image_height": info.height,
        "camera_matrix": info.intrinsic.tolist(),
        "distortion_model": info.distortion_model,
        "distortion_coefficients": list(info.distortion),
        "cam_from_vehicle": calibration.cam_from_vehicle.tolist(),
        "vehicle_from_pinhole_px": ipm_from_extrinsic(
            calibration.info, calibration.cam_from_vehicle
        ).tolist(),
    }
    if calibration.covariance is not None:
        sigma = np.sqrt(np.diag(calibration.covariance))
        content["translation_sigma_m"] = sigma[:3].tolist()
        content["rotation_sigma_deg"] = np.degrees(sigma[3:]).tolist()
        content["covariance"] = calibration.covariance.tolist()
    if clock_s is not None:
        content["clock_offset_s"] = float(clock_s[0])
        if np.isfinite(clock_s[1]):
            content["clock_sigma_s"] = float(clock_s[1])
    for key in ("drive", "date"):
        if about is not None and getattr(about, key) is not None:
            content[key] = getattr(about, key)
    if verdict is not None:
        content["verdict"] = dict(verdict)
    replace_text(path, dump_yaml(content))


def read_calibration(path: Path) -> Calibration:
    """Read what :func:`write_calibration` wrote.

    Raises:
        MapFileError: when the file is missing, damaged or not of this format.
    """
    content = load_yaml(path, MapFileError)
    check_keys(content, _REQUIRED, _OPTIONAL, str(path), MapFileError)

    def array(key: str, *shape: int) -> Any:
        return take_array(content[key], shape, f"{path}: {key}", MapFileError)

    info = CameraInfo(
        name=take_camera_name(content["camera_name"], f"{path}: camera_name", MapFileError),
        width=take_size_px(content["image_width"], f"{path}: image_width", MapFileError),
        height=take_size_px(content["image_height"], f"{path}: image_height", MapFileError),
        intrinsic=array("camera_matrix", 3, 3),
        distortion_model=take_text(content["distortion_model"], f"{path}: distortion_model", MapFileError),
        distortion=tuple(array("distortion_coefficients", -1).tolist()),
    )
    if len(info.distortion) == DISTORTION_COEFFICIENTS.get(info.distortion_model):
        check_camera(info, str(path), MapFileError)
    covariance = None
    if "covariance" in content:
        covariance = take_covariance(content["covariance"], 6, f"{path}: covariance", MapFileError)
    return Calibration(info=info, cam_from_vehicle=array("cam_from_vehicle", 4, 4), covariance=covariance)


def trusted_calibrations(path: Path) -> dict[str, Calibration]:
    """The calibrations in a result folder, or the one of a file, by camera.

    Raises:
        MapFileError: when there is none, one is damaged, or the verdict on its drive is FAIL.
    """
    files = sorted(path.glob("calibration_*.yaml")) if path.is_dir() else [path]
    if not files:
        raise MapFileError(
            f"{path}: no calibration_*.yaml in it; give what v2hdm map or v2hdm calibrate ground wrote"
        )
    out = {}
    for file in files:
        calibration = read_calibration(file)
        if read_provenance(file).verdict == "FAIL":
            raise MapFileError(
                f"{file}: the verdict on its drive is FAIL, so that it cannot be relied on; mend that drive "
                "first (docs/verdict.md)"
            )
        out[calibration.info.name] = calibration
    return out


def read_provenance(path: Path) -> Provenance:
    """Where the calibration that :func:`write_calibration` wrote comes from.

    Raises:
        MapFileError: when the file is missing, damaged or not of this format.
    """
    content = load_yaml(path, MapFileError)
    verdict = content.get("verdict")
    status = verdict.get("status") if isinstance(verdict, dict) else None
    texts = {}
    for key, value in (("drive", content.get("drive")), ("date", content.get("date")), ("verdict", status)):
        texts[key] = None if value is None else take_text(value, f"{path}: {key}", MapFileError)
    return Provenance(**texts)
