"""Where a camera sits, as the ground's adjustment varies it: rotation and centre in the vehicle frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from v2hdm.geometry.ipm import extrinsic_from_ipm, project_ground
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.rigid import rotation_from_vector
from v2hdm.records import Camera, CameraInfo, FloatArray


@dataclass(frozen=True)
class Mount:
    """A camera with its lens: ``vehicle_from_cam_rotation`` (3, 3) and ``centre_vehicle`` (3,) m."""

    info: CameraInfo
    vehicle_from_cam_rotation: FloatArray
    centre_vehicle: FloatArray

    @property
    def cam_from_vehicle(self) -> FloatArray:
        """The extrinsic (4, 4)."""
        out = np.eye(4)
        out[:3, :3] = self.vehicle_from_cam_rotation.T
        out[:3, 3] = -self.vehicle_from_cam_rotation.T @ self.centre_vehicle
        return out

    def moved(self, turn_rad: FloatArray, shift_m: FloatArray) -> Mount:
        """Turned about its centre by a rotation vector (3,) in vehicle axes, and shifted (3,) m."""
        return replace(
            self,
            vehicle_from_cam_rotation=rotation_from_vector(turn_rad) @ self.vehicle_from_cam_rotation,
            centre_vehicle=self.centre_vehicle + shift_m,
        )

    def with_focal_scale(self, scale: float) -> Mount:
        """With focal lengths larger by the fraction ``scale``."""
        intrinsic = self.info.intrinsic.copy()
        intrinsic[0, :2] *= 1 + scale
        intrinsic[1, 1] *= 1 + scale
        return replace(self, info=replace(self.info, intrinsic=intrinsic))

    def with_k1(self, change: float) -> Mount:
        """With ``change`` added to the first coefficient of its distortion."""
        first, *rest = self.info.distortion
        return replace(self, info=replace(self.info, distortion=(first + change, *rest)))

    def rays(self, points_px: FloatArray) -> FloatArray:
        """Viewing directions (N, 3) in the vehicle frame of recorded pixels (N, 2)."""
        pinhole = undistort_points(self.info, points_px)
        cam = np.column_stack([pinhole, np.ones(len(pinhole))]) @ np.linalg.inv(self.info.intrinsic).T
        return np.asarray(cam @ self.vehicle_from_cam_rotation.T)

    def project_ground(self, ground_map: FloatArray, map_from_vehicle: FloatArray) -> FloatArray:
        """Recorded pixels (N, 2) of ground points (N, 2) of the map; nan where they are out of view."""
        cam_from_map = self.cam_from_vehicle @ np.linalg.inv(map_from_vehicle)
        pinhole, depth_m = project_ground(self.info.intrinsic, cam_from_map, ground_map)
        size = np.array([self.info.width, self.info.height])
        with np.errstate(invalid="ignore"):
            # A lens model bends back what lies far outside the view.
            low, high = -0.5 * size, 1.5 * size
            far = (pinhole < low) | (pinhole > high)
            hidden = (depth_m <= 0) | far[:, 0] | far[:, 1]
            pinhole[hidden] = size / 2
            px = distort_points(self.info, pinhole)
            outside = (px < 0) | (px > size - 1)
        px[hidden | outside[:, 0] | outside[:, 1]] = np.nan
        return px

    @property
    def depression_rad(self) -> float:
        """How far the optical axis points below the horizon."""
        return float(np.arcsin(-self.vehicle_from_cam_rotation[2, 2]))


def guessed_mount(camera: Camera) -> Mount:
    """The mounting that a camera's initial IPM stands for."""
    matrix = extrinsic_from_ipm(camera.info, camera.ipm[camera.initial_ipm])
    turn = matrix[:3, :3].T
    return Mount(camera.info, turn, -turn @ matrix[:3, 3])
