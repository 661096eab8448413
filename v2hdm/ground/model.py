"""Intersection of a mounted camera's rays with the ground, and Jacobians by everything that may be wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from v2hdm.geometry.ipm import initial_extrinsic, project_ground
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.rigid import rotation_from_vector
from v2hdm.records import BoolArray, Camera, CameraInfo, FloatArray

_LENS_STEP = 1e-5  # step of finite differences: of the focal length, relative, and of k1


@dataclass(frozen=True)
class Mount:
    """A camera with its lens: ``vehicle_from_cam_rotation`` (3, 3) and ``centre_vehicle`` (3,) m."""

    info: CameraInfo
    vehicle_from_cam_rotation: FloatArray
    centre_vehicle: FloatArray

    @classmethod
    def at(cls, info: CameraInfo, cam_from_vehicle: FloatArray) -> Mount:
        """A camera at an extrinsic (4, 4)."""
        turn = cam_from_vehicle[:3, :3].T
        return cls(info, turn, -turn @ cam_from_vehicle[:3, 3])

    @property
    def cam_from_vehicle(self) -> FloatArray:
        """The extrinsic (4, 4)."""
        out = np.eye(4)
        out[:3, :3] = self.vehicle_from_cam_rotation.T
        out[:3, 3] = -self.vehicle_from_cam_rotation.T @ self.centre_vehicle
        return out

    @property
    def depression_rad(self) -> float:
        """Angle of the optical axis below the horizon."""
        return float(np.arcsin(-self.vehicle_from_cam_rotation[2, 2]))

    def moved(self, turn_rad: FloatArray, shift_m: FloatArray) -> Mount:
        """The mount turned about its centre by a rotation vector (3,), vehicle axes, and shifted (3,), m."""
        return replace(
            self,
            vehicle_from_cam_rotation=rotation_from_vector(turn_rad) @ self.vehicle_from_cam_rotation,
            centre_vehicle=self.centre_vehicle + shift_m,
        )

    def turned_around(self) -> Mount:
        """The same camera at the vehicle's other end, looking the other way."""
        half = np.diag([-1.0, -1.0, 1.0])
        turn = half @ self.vehicle_from_cam_rotation
        return replace(self, vehicle_from_cam_rotation=turn, centre_vehicle=half @ self.centre_vehicle)

    def with_focal_scale(self, scale: float) -> Mount:
        """The mount with focal lengths longer by the fraction ``scale``."""
        intrinsic = self.info.intrinsic.copy()
        intrinsic[0, :2] *= 1 + scale
        intrinsic[1, 1] *= 1 + scale
        return replace(self, info=replace(self.info, intrinsic=intrinsic))

    def with_k1(self, change: float) -> Mount:
        """The mount with ``change`` added to k1."""
        k1, *others = self.info.distortion
        return replace(self, info=replace(self.info, distortion=(k1 + change, *others)))

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
            # Far outside the image a lens model folds points back into it.
            hidden = (depth_m <= 0) | _outside(pinhole, -0.5 * size, 1.5 * size)
            pinhole[hidden] = size / 2
            px = distort_points(self.info, pinhole)
            outside = _outside(px, 0 * size, size - 1)
        px[hidden | outside] = np.nan
        return px


def _outside(px: FloatArray, low: FloatArray, high: FloatArray) -> BoolArray:
    """Which pixels (N, 2) lie outside a rectangle, given by two corners (2,)."""
    u, v = px.T  # numpy reduces pairs slowly
    return np.asarray((u < low[0]) | (u > high[0]) | (v < low[1]) | (v > high[1]))


def guessed_mount(camera: Camera) -> Mount:
    """The mounting of a camera's initial IPM."""
    return Mount.at(camera.info, initial_extrinsic(camera))


@dataclass(frozen=True)
class GroundHits:
    """Intersections of rays with the ground z = 0 of the map.

    ``points_map`` (N, 2), m; ``plane`` (N, 2, 3) is their Jacobian by motion of the ground point in vehicle
    axes, ``arm`` (N, 3), m, leads from the camera centre to the ground point in vehicle axes, and
    ``point_vehicle`` (N, 3), m, is that point in the vehicle frame.
    """

    points_map: FloatArray
    plane: FloatArray
    arm: FloatArray
    point_vehicle: FloatArray

    def by_mount(self) -> FloatArray:
        """Derivative (N, 2, 6) by the mount's turn (3, rad) and its centre (3, m), in vehicle axes."""
        return np.concatenate([np.cross(self.arm[:, None], self.plane), self.plane], axis=2)

    def by_pose(self) -> FloatArray:
        """Derivative (N, 2, 6) by the vehicle's turn (3, rad) and shift (3, m), in vehicle axes."""
        return np.concatenate([np.cross(self.point_vehicle[:, None], self.plane), self.plane], axis=2)

    def by_fall(self, lower_m: FloatArray) -> FloatArray:
        """First-order shift (N, 2) of the points for ground ``lower_m`` (N,) below the plane."""
        return np.asarray(self.plane[:, :, 2] * lower_m[:, None])

    def by_motion(self, velocity: FloatArray) -> FloatArray:
        """Derivative (N, 2) by time for ``velocity`` (N, 3) of the vehicle: m/s, m/s, rad/s."""
        moved = np.zeros((len(velocity), 3))
        moved[:, 0] = velocity[:, 0] - velocity[:, 2] * self.point_vehicle[:, 1]
        moved[:, 1] = velocity[:, 1] + velocity[:, 2] * self.point_vehicle[:, 0]
        return np.asarray((self.plane @ moved[:, :, None])[..., 0])


def hit_ground(mount: Mount, points_px: FloatArray, poses: FloatArray) -> GroundHits:
    """Ground points at pixels (N, 2), from vehicle ``poses`` (N, 4, 4)."""
    rays_vehicle = mount.rays(points_px)
    turn = poses[:, :3, :3]
    position = poses[:, :3, 3]
    rays_map = (turn @ rays_vehicle[:, :, None])[..., 0]
    centre_map = turn @ mount.centre_vehicle + position
    down = np.where(rays_map[:, 2] < -1e-3, rays_map[:, 2], np.nan)
    far = -centre_map[:, 2] / down
    points_map = centre_map[:, :2] + far[:, None] * rays_map[:, :2]
    # Ground below the vehicle's slides along the ray.
    plane = turn[:, :2] - (rays_map[:, :2] / down[:, None])[:, :, None] * turn[:, 2:]
    arm = far[:, None] * rays_vehicle
    return GroundHits(points_map, plane, arm, mount.centre_vehicle + arm)


def by_lens(mount: Mount, points_px: FloatArray, poses: FloatArray, name: str) -> FloatArray:
    """Derivative (N, 2) of ground points by ``focal_scale`` or ``distortion_k1``, by finite differences."""
    change = mount.with_focal_scale if name == "focal_scale" else mount.with_k1
    low, high = (hit_ground(change(step), points_px, poses) for step in (-_LENS_STEP, _LENS_STEP))
    return np.asarray((high.points_map - low.points_map) / (2 * _LENS_STEP))


def by_pixel(mount: Mount, hits: GroundHits) -> FloatArray:
    """Jacobian (N, 2, 2) of the ground points by their pinhole pixels.

    Neglects the lens: it scales pixels by a few per cent at most where the ground is.
    """
    depth = np.linalg.norm(hits.arm @ mount.vehicle_from_cam_rotation[:, 2:], axis=1)
    across = mount.vehicle_from_cam_rotation @ np.linalg.inv(mount.info.intrinsic)[:, :2]
    return np.asarray(depth[:, None, None] * (hits.plane.reshape(-1, 3) @ across).reshape(-1, 2, 2))
