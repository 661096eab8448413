"""A camera on a vehicle and its manual calibration, with the errors that one makes with tape and mouse."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from v2hdm.errors import ConfigError
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.records import Camera, CameraInfo, CentrePrior, FloatArray
from v2hdm.simulate.port.config import CalibrationConfig, CameraConfig, MountConfig
from v2hdm.simulate.render.scene import convex_hull

# Columns: the camera's x, y and z axes (right, down, forward) in a frame with x forward, y left, z up.
_FORWARD_LEFT_UP_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def camera_info(name: str, config: CameraConfig) -> CameraInfo:
    """The intrinsics of a configured camera."""
    focal = config.focal_px
    du, dv = config.principal_offset_px
    intrinsic = np.array(
        [
            [focal, 0.0, (config.width - 1) / 2 + du],
            [0.0, focal, (config.height - 1) / 2 + dv],
            [0.0, 0.0, 1.0],
        ]
    )
    return CameraInfo(
        name, config.width, config.height, intrinsic, "plumb_bob", tuple(float(d) for d in config.distortion)
    )


def cam_from_vehicle(mount: MountConfig) -> FloatArray:
    """The extrinsic (4 x 4) of a mount: the camera looks along x, then turns by yaw, pitch and roll."""
    angles = (np.deg2rad([a]) for a in (mount.roll_deg, mount.pitch_deg, mount.yaw_deg))
    vehicle_from_cam = rotation_from_euler(*angles)[0] @ _FORWARD_LEFT_UP_FROM_OPTICAL
    out = np.eye(4)
    out[:3, :3] = vehicle_from_cam.T
    out[:3, 3] = -vehicle_from_cam.T @ (mount.x_m, mount.y_m, mount.z_m)
    return out


def ground_points(mount: MountConfig, config: CalibrationConfig) -> FloatArray:
    """The true calibration points (N, 2) on the ground in the vehicle frame, laid out before the camera."""
    yaw = np.deg2rad(mount.yaw_deg)
    ahead, left = np.array(config.points_ahead_m, dtype=np.float64).T
    return np.column_stack(
        [
            mount.x_m + ahead * np.cos(yaw) - left * np.sin(yaw),
            mount.y_m + ahead * np.sin(yaw) + left * np.cos(yaw),
        ]
    )


@dataclass(frozen=True)
class ManualCalibration:
    """What a manual calibration rests on, and what comes of it.

    Attributes:
        surveyed_vehicle: (N, 2) m, the points on the ground as they were measured.
        clicked_px: (N, 2) px, the same points as they were clicked in the recorded image.
        ipm: ``vehicle_from_pinhole_px`` (3 x 3).
        roi_vehicle: (M, 2) m, the region that it was made for, the convex hull of the surveyed points.
    """

    surveyed_vehicle: FloatArray
    clicked_px: FloatArray
    ipm: FloatArray
    roi_vehicle: FloatArray


def calibrate(
    info: CameraInfo, mount: MountConfig, config: CalibrationConfig, rng: np.random.Generator
) -> ManualCalibration:
    """Calibrate a camera by hand: survey points on the ground, click them in the image, solve.

    Raises:
        ConfigError: when a point lies outside the image, or the points do not determine a homography.
    """
    points = ground_points(mount, config)
    pinhole_px, _ = project_ground(info.intrinsic, cam_from_vehicle(mount), points)
    clicked_px = distort_points(info, pinhole_px)
    clicked_px = clicked_px + rng.normal(0.0, config.click_sigma_px, points.shape)
    surveyed = points + rng.normal(0.0, config.survey_sigma_m, points.shape)
    outside = (clicked_px < 0).any(axis=1) | (clicked_px > (info.width - 1, info.height - 1)).any(axis=1)
    if outside.any():
        ahead, left = config.points_ahead_m[int(np.argmax(outside))]
        raise ConfigError(
            f"calibration.points_ahead_m: [{ahead:g}, {left:g}] is outside camera "
            f"'{info.name}'; move it or the mount"
        )
    # Solved towards pixels, where the larger and equal errors are.
    pinhole_from_vehicle, _ = cv2.findHomography(surveyed, undistort_points(info, clicked_px), 0)
    if pinhole_from_vehicle is None:
        raise ConfigError("calibration.points_ahead_m: these points do not fix a homography; spread them out")
    ipm = np.linalg.inv(pinhole_from_vehicle)
    return ManualCalibration(
        surveyed, clicked_px, np.asarray(ipm / np.linalg.norm(ipm)), convex_hull(surveyed)
    )


def survey_camera(
    name: str,
    config: CameraConfig,
    calibration: CalibrationConfig,
    initial_ipm: str,
    rng: np.random.Generator,
) -> tuple[Camera, ManualCalibration]:
    """What the mapper gets to know of a camera: two IPMs, a region, a surveyed centre.

    Beside it the vehicle's own manual calibration, of which the mapper knows no more than the IPM.
    """
    info = camera_info(name, config)
    own = calibrate(info, config.mount, calibration, rng)
    borrowed = calibrate(info, config.borrowed_mount, calibration, rng)
    centre = np.array([config.mount.x_m, config.mount.y_m, config.mount.z_m])
    sigma = np.full(3, calibration.centre_sigma_m)
    camera = Camera(
        info=info,
        ipm={"calibrated": own.ipm, "estimated": borrowed.ipm},
        initial_ipm=initial_ipm,
        roi_vehicle=own.roi_vehicle if initial_ipm == "calibrated" else borrowed.roi_vehicle,
        centre_prior=CentrePrior(centre + rng.normal(0.0, sigma), sigma),
    )
    return camera, own
