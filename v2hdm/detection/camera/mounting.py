"""A camera on a vehicle as the detector takes it, from a finished calibration or from a rough description."""

from __future__ import annotations

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.ipm import apply_in_front, ground_from_pinhole_px, ipm_from_extrinsic
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import DISTORTION_COEFFICIENTS, Calibration, Camera, CameraInfo, FloatArray

_ROTATION_TOLERANCE = 1e-6
_BELOW_M = 0.1
_FARTHEST_M = 100.0


def camera_from_calibration(calibration: Calibration, linear_response: bool = False) -> Camera:
    """A camera whose IPM is the one of a finished calibration.

    Raises:
        MapFileError: the calibration cannot be that of a camera that looks at the ground.
    """
    _check(calibration)
    ipm = ipm_from_extrinsic(calibration.info, calibration.cam_from_vehicle)
    roi_vehicle = _seen_ground(calibration)
    return Camera(
        calibration.info, {"calibrated": ipm}, "calibrated", roi_vehicle, linear_response=linear_response
    )


def rough_calibration(
    name: str, width: int, height: int, height_m: float, pitch_deg: float, fov_deg: float
) -> Calibration:
    """A pinhole camera that looks straight ahead, for images of which nothing better is known.

    Good enough to tell markings by their rough size, not to measure with.

    Args:
        name: the camera's name.
        width: image width, px.
        height: image height, px.
        height_m: its height above the ground.
        pitch_deg: how far its axis points below the horizon.
        fov_deg: horizontal field of view.
    """
    focal_px = width / 2 / np.tan(np.deg2rad(fov_deg) / 2)
    intrinsic = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    c, s = np.cos(np.deg2rad(pitch_deg)), np.sin(np.deg2rad(pitch_deg))
    cam_from_vehicle = np.eye(4)
    cam_from_vehicle[:3, :3] = [[0, -1, 0], [-s, 0, -c], [c, 0, -s]]
    cam_from_vehicle[:3, 3] = -cam_from_vehicle[:3, :3] @ [0, 0, height_m]
    return Calibration(CameraInfo(name, width, height, intrinsic), cam_from_vehicle)


def _seen_ground(calibration: Calibration) -> FloatArray:
    """A small square on the ground that the camera sees: around what the image's lowest row shows."""
    info = calibration.info
    below_px = np.array([[info.intrinsic[0, 2], info.height - 1.0]])
    ground = ground_from_pinhole_px(info.intrinsic, calibration.cam_from_vehicle)
    seen_vehicle = apply_in_front(ground, below_px)[0]
    if not np.isfinite(seen_vehicle).all():
        raise MapFileError(
            f"calibration of camera '{info.name}': the image's lowest row is above the horizon; "
            "mend cam_from_vehicle"
        )
    return np.asarray(seen_vehicle + _BELOW_M * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))


def _check(calibration: Calibration) -> None:
    info, cam_from_vehicle = calibration.info, calibration.cam_from_vehicle
    rotation = cam_from_vehicle[:3, :3]
    focal_px = info.intrinsic[0, 0], info.intrinsic[1, 1]
    problem = None
    if info.distortion_model not in DISTORTION_COEFFICIENTS:
        known = ", ".join(DISTORTION_COEFFICIENTS)
        problem = f"unknown distortion_model '{info.distortion_model}'; known are {known}"
    elif len(info.distortion) != DISTORTION_COEFFICIENTS[info.distortion_model]:
        count = DISTORTION_COEFFICIENTS[info.distortion_model]
        problem = f"{info.distortion_model} has {count} coefficients, not {len(info.distortion)}; mend them"
    elif info.width < 1 or info.height < 1 or min(focal_px) <= 0:
        problem = "image size and focal lengths must be positive; mend them"
    elif np.abs(cam_from_vehicle).max() > _FARTHEST_M:
        problem = f"cam_from_vehicle puts the camera beyond {_FARTHEST_M:g} m from the vehicle; mend it"
    elif (
        np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION_TOLERANCE
        or np.linalg.det(rotation) < 0
        or not np.array_equal(cam_from_vehicle[3], [0, 0, 0, 1])
    ):
        problem = "cam_from_vehicle is no rotation and translation; write it again with `v2hdm map`"
    elif camera_centre(cam_from_vehicle)[2] <= 0:
        problem = "cam_from_vehicle puts the camera on or under the ground; mend it"
    if problem:
        raise MapFileError(f"calibration of camera '{info.name}': {problem}")
