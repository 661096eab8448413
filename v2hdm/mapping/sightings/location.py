"""Where sightings lie on the ground under given extrinsics and poses, and how certainly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.geometry.ipm import (
    apply_in_front,
    direction_covariance,
    ground_from_pinhole_px,
    homography_jacobian,
)
from v2hdm.geometry.rigid import camera_centre
from v2hdm.mapping.sightings.rig import Rig
from v2hdm.mapping.sightings.table import Sightings
from v2hdm.records import BoolArray, FloatArray

# Variance of a ground point, in its better direction, beyond which it is as good as on the horizon, m^2.
_HORIZON_M2 = 1e4


@dataclass(frozen=True)
class Located:
    """Ground positions of S sightings.

    ``corners_map`` (S, 4, 2) m with the covariance ``covariance_m2`` (S, 4, 2, 2) that the pixel
    noise alone gives them; ``ray_map`` (S, 4, 2) from below the camera to the corner; ``height_m``
    (S,) of the camera. ``valid`` (S, 4) are points and ``informs`` (S, 4) all corners that say something,
    as :class:`~v2hdm.mapping.sightings.table.Sightings` has them, without those that miss the ground.
    """

    corners_map: FloatArray
    covariance_m2: FloatArray
    ray_map: FloatArray
    height_m: FloatArray
    valid: BoolArray
    informs: BoolArray

    @property
    def range_m(self) -> FloatArray:
        """Horizontal distance (S, 4) of each corner from its camera."""
        return np.asarray(np.linalg.norm(self.ray_map, axis=-1))

    @property
    def sine_depression(self) -> FloatArray:
        """Sine (S, 4) of the angle by which each corner's ray points below the horizon."""
        return np.asarray(self.height_m[:, None] / np.hypot(self.range_m, self.height_m[:, None]))

    def direction_covariance_m2(self, sigma_rad: float) -> FloatArray:
        """What an uncertain viewing direction adds to ``covariance_m2``: (S, 4, 2, 2)."""
        return direction_covariance(self.ray_map, self.height_m[:, None], sigma_rad)


def locate(sightings: Sightings, rig: Rig) -> Located:
    """Back-project every corner of ``sightings`` to z = 0 of the map under ``rig``."""
    camera, frame = sightings.camera, sightings.frame
    cam_from_map = rig.cam_from_vehicle[camera] @ np.linalg.inv(rig.map_from_vehicle[frame])
    homographies = ground_from_pinhole_px(rig.intrinsic[camera], cam_from_map)
    corners_map = apply_in_front(homographies, sightings.corners_pinhole_px)
    jacobian = homography_jacobian(homographies, sightings.corners_pinhole_px)
    covariance = jacobian @ sightings.covariance_px @ np.swapaxes(jacobian, -1, -2)
    centre_vehicle = camera_centre(rig.cam_from_vehicle)[camera]
    poses = rig.map_from_vehicle[frame]
    centre_map = (poses[:, :3, :3] @ centre_vehicle[..., None])[..., 0] + poses[:, :3, 3]
    finite = np.asarray(np.isfinite(corners_map).all(axis=-1) & np.isfinite(covariance).all(axis=(-1, -2)))
    smallest = np.linalg.eigvalsh(np.where(finite[..., None, None], covariance, np.eye(2)))[..., 0]
    informs = sightings.informs & finite & (smallest < _HORIZON_M2)
    return Located(
        corners_map=corners_map,
        covariance_m2=covariance,
        ray_map=corners_map - centre_map[:, None, :2],
        height_m=np.maximum(centre_map[:, 2], 0.1),
        valid=sightings.valid & informs,
        informs=informs,
    )
