"""Pinhole pixels to the ground of the map, many images at once, with covariances.

Two routes lead there. The *plain* one is the paper's: an IPM takes the pixel to the vehicle's
ground plane and the recorded pose, taken as planar, onwards to the map. The *posed* one intersects
the pixel's ray with z = 0 of the map under a full pose, roll, pitch and height included.
Both are homographies ``map_from_pinhole_px``, one per sighting.
"""

from __future__ import annotations

import numpy as np

from v2hdm.records import Camera, FloatArray


def forward_ipm(camera: Camera, ipm: FloatArray) -> FloatArray:
    """``ipm`` (3 x 3) scaled so that ground in front of the camera has a positive third coordinate.

    A homography has no sign of its own; the camera's region of interest, which lies in front of it
    by definition, gives it one, and pixels above the horizon can then be told from ground.
    """
    centre = np.append(np.mean(camera.roi_vehicle, axis=0), 1.0)
    pixel = np.linalg.solve(ipm, centre)
    # With ipm @ (u, v, 1) = w * ground, the solve returns (u, v, 1) / w.
    scaled = ipm / np.linalg.norm(ipm)
    return np.asarray(scaled if pixel[2] > 0 else -scaled)


def plain_homographies(ipm: FloatArray, map_from_vehicle: FloatArray) -> FloatArray:
    """``map_from_pinhole_px`` (S, 3, 3) of IPMs (S, 3, 3) under poses (S, 4, 4) taken as planar."""
    planar = np.zeros((len(map_from_vehicle), 3, 3))
    planar[:, :2] = map_from_vehicle[:, :2][:, :, [0, 1, 3]]
    planar[:, 2, 2] = 1.0
    return np.asarray(planar @ ipm)


def posed_homographies(
    intrinsic: FloatArray, cam_from_vehicle: FloatArray, map_from_vehicle: FloatArray
) -> FloatArray:
    """``map_from_pinhole_px`` (S, 3, 3) of cameras K (S, 3, 3) at ``cam_from_vehicle`` (S, 4, 4).

    The third coordinate of a mapped pixel is the inverse of its depth, hence positive for ground
    in front of the camera.
    """
    cam_from_map = cam_from_vehicle @ np.linalg.inv(map_from_vehicle)
    return np.asarray(np.linalg.inv(intrinsic @ cam_from_map[:, :3][:, :, [0, 1, 3]]), dtype=np.float64)


def apply_homographies(dst_from_src: FloatArray, points_src: FloatArray) -> FloatArray:
    """Map points (S, N, 2) by one homography (S, 3, 3) each; nan where they miss the ground."""
    ones = np.ones((*points_src.shape[:-1], 1))
    mapped = np.concatenate([points_src, ones], axis=-1) @ np.swapaxes(dst_from_src, -1, -2)
    third = mapped[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(third > 0, mapped[..., :2] / third, np.nan))


def homography_jacobians(dst_from_src: FloatArray, points_src: FloatArray) -> FloatArray:
    """Derivatives (S, N, 2, 2) of :func:`apply_homographies` with respect to the points."""
    ones = np.ones((*points_src.shape[:-1], 1))
    homogeneous = np.concatenate([points_src, ones], axis=-1)
    third = (homogeneous @ dst_from_src[:, 2, :, None])[..., None]
    mapped = apply_homographies(dst_from_src, points_src)[..., None]
    return np.asarray((dst_from_src[:, None, :2, :2] - mapped * dst_from_src[:, None, 2:, :2]) / third)


def camera_centres(cam_from_vehicle: FloatArray) -> FloatArray:
    """Camera centres (C, 3) in the vehicle frame of ``cam_from_vehicle`` (C, 4, 4)."""
    rotation = cam_from_vehicle[:, :3, :3]
    return np.asarray(-(np.swapaxes(rotation, 1, 2) @ cam_from_vehicle[:, :3, 3:])[..., 0])


def direction_covariance(ray_ground: FloatArray, height_m: FloatArray, sigma_rad: float) -> FloatArray:
    """What an uncertain viewing direction makes of a ground point: (..., 2, 2), m^2.

    ``ray_ground`` (..., 2) runs from below the camera to the point, at range r. A change of pitch
    by d moves the point along it by (r^2 + h^2) / h * d, one of yaw across it by r * d.
    """
    range_m = np.linalg.norm(ray_ground, axis=-1)
    along = ray_ground / np.maximum(range_m, 1e-9)[..., None]
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    sigma_along = (range_m**2 + height_m**2) / height_m * sigma_rad
    sigma_across = range_m * sigma_rad
    return np.asarray(
        sigma_along[..., None, None] ** 2 * along[..., :, None] * along[..., None, :]
        + sigma_across[..., None, None] ** 2 * across[..., :, None] * across[..., None, :]
    )
