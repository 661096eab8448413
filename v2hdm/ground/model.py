"""Where matched pixels meet the ground, and how that changes with everything that may be wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.ground.mount import Mount
from v2hdm.records import FloatArray

_FOCAL_STEP = 1e-5
_K1_STEP = 1e-5


@dataclass(frozen=True)
class GroundHits:
    """Where rays meet the ground z = 0 of the map.

    Attributes:
        points_map: (N, 2) m.
        plane: (N, 2, 3): how the hit moves when the point that it shows is moved in vehicle axes.
        arm: (N, 3) from the camera's centre to the ground point, vehicle axes, m.
        point_vehicle: (N, 3) the ground point in the vehicle frame, m.
    """

    points_map: FloatArray
    plane: FloatArray
    arm: FloatArray
    point_vehicle: FloatArray

    def by_mount(self) -> FloatArray:
        """Derivative (N, 2, 6) by the mount's turn (3, rad) and its centre (3, m), in vehicle axes."""
        return np.concatenate([self.plane @ _cross(self.arm), self.plane], axis=2)

    def by_pose(self) -> FloatArray:
        """Derivative (N, 2, 6) by the vehicle's turn (3, rad) and shift (3, m), in vehicle axes."""
        return np.concatenate([self.plane @ _cross(self.point_vehicle), self.plane], axis=2)

    def by_motion(self, velocity: FloatArray) -> FloatArray:
        """Derivative (N, 2) by time, the vehicle moving at ``velocity`` (N, 3): m/s, m/s, rad/s."""
        moved = np.zeros((len(velocity), 3))
        moved[:, 0] = velocity[:, 0] - velocity[:, 2] * self.point_vehicle[:, 1]
        moved[:, 1] = velocity[:, 1] + velocity[:, 2] * self.point_vehicle[:, 0]
        return np.asarray((self.plane @ moved[:, :, None])[..., 0])


def hit_ground(mount: Mount, points_px: FloatArray, poses: FloatArray) -> GroundHits:
    """The ground that pixels (N, 2) show, the vehicle being at ``poses`` (N, 4, 4)."""
    return _hit(mount, mount.rays(points_px), poses)


def _hit(mount: Mount, rays_vehicle: FloatArray, poses: FloatArray) -> GroundHits:
    turn, position = poses[:, :3, :3], poses[:, :3, 3]
    rays_map = (turn @ rays_vehicle[:, :, None])[..., 0]
    centre_map = turn @ mount.centre_vehicle + position
    down = np.where(rays_map[:, 2] < -1e-3, rays_map[:, 2], np.nan)
    far = -centre_map[:, 2] / down
    points_map = centre_map[:, :2] + far[:, None] * rays_map[:, :2]
    slide = np.zeros((len(far), 2, 3))
    slide[:, 0, 0] = slide[:, 1, 1] = 1.0
    slide[:, :, 2] = -rays_map[:, :2] / down[:, None]
    arm = far[:, None] * rays_vehicle
    return GroundHits(points_map, slide @ turn, arm, mount.centre_vehicle + arm)


def by_lens(mount: Mount, points_px: FloatArray, poses: FloatArray, name: str) -> FloatArray:
    """Derivative (N, 2) of the ground points by ``focal_scale`` or ``distortion_k1``, by differences."""
    if name == "focal_scale":
        step, low, high = (
            _FOCAL_STEP,
            mount.with_focal_scale(-_FOCAL_STEP),
            mount.with_focal_scale(_FOCAL_STEP),
        )
    else:
        step, low, high = _K1_STEP, mount.with_k1(-_K1_STEP), mount.with_k1(_K1_STEP)
    ends = [hit_ground(each, points_px, poses).points_map for each in (low, high)]
    return np.asarray((ends[1] - ends[0]) / (2 * step))


def by_pixel(mount: Mount, hits: GroundHits) -> FloatArray:
    """Derivative (N, 2, 2) of the ground points by the pinhole pixels that show them.

    The lens stretches pixels by a few per cent at the most where the ground is; that is left out.
    """
    depth = np.linalg.norm(hits.arm @ mount.vehicle_from_cam_rotation[:, 2:], axis=1)
    across = mount.vehicle_from_cam_rotation @ np.linalg.inv(mount.info.intrinsic)[:, :2]
    return np.asarray(hits.plane @ (depth[:, None, None] * across))


def _cross(points: FloatArray) -> FloatArray:
    """Matrices (N, 3, 3) that take a rotation vector to how it moves ``points`` (N, 3)."""
    x, y, z = points.T
    out = np.zeros((len(points), 3, 3))
    out[:, 0, 1], out[:, 0, 2] = z, -y
    out[:, 1, 0], out[:, 1, 2] = -z, x
    out[:, 2, 0], out[:, 2, 1] = y, -x
    return out
