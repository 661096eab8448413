"""Random cameras for training: any lens and mounting a vehicle may carry, seen through a small window.

A network reads local detail, so it is trained on small crops at full resolution. A crop is itself a
pinhole camera, one whose principal point lies anywhere, even outside: no large image is rendered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.detection.camera import ASIDE_RAD
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import CameraInfo, FloatArray
from v2hdm.simulate.render.renderer import Motion, Optics

_LENS_TOLERANCE_PX = 0.1  # largest error of a lens model's inverse, px
_BORDER_POINTS = 17  # points of each border of an image at which a lens is checked
_FARTHEST_PASSED_M = 12.0  # largest distance, m, of a place that a camera on the vehicle's side passes
_UNUSUAL_HEIGHTS_M = ((0.5, 1.1), (3.6, 5.0))
"""Heights, m, of cameras in bumpers and small robots, or on masts, cranes and straddle carriers."""


@dataclass(frozen=True)
class TrainingView:
    """A camera, its place (``cam_from_map``, 4 x 4) and what its sensor does."""

    info: CameraInfo
    cam_from_map: FloatArray
    optics: Optics
    motion: Motion


def random_view(rng: np.random.Generator, width: int, height: int) -> TrainingView:
    """A camera near the map's origin, looking roughly along x, whose image is ``width`` x ``height``.

    Focal lengths from 300 to 1500 px, heights from 1.1 to 3.6 m, pitch from level to 28 degrees down, with
    two in five like the usual camera of a car (level, low, 600 to 1000 px).
    """
    if rng.random() < 0.4:
        focal_px = _log_uniform(rng, 600, 1000)
        height_m = rng.uniform(1.2, 1.9)
        pitch = rng.uniform(-1.5, 3)
    else:
        focal_px = _log_uniform(rng, 300, 1500)
        height_m = rng.uniform(1.1, 3.6)
        pitch = rng.uniform(0, 28 if rng.random() < 0.6 else 8)
    pitch = np.deg2rad(pitch)
    yaw = np.deg2rad(rng.normal(0, 4) if rng.random() < 0.75 else rng.uniform(-60, 60))
    roll = np.deg2rad(rng.normal(0, 1.2))
    info = _crop_camera(rng, width, height, focal_px, pitch)
    while not _sees_all(info):
        info = _crop_camera(rng, width, height, focal_px, pitch)
    cam_from_map = looking(np.array([0.0, rng.normal(0, 0.6), height_m]), yaw, float(pitch), roll)
    return TrainingView(info, cam_from_map, _random_optics(rng), _random_motion(rng))


def mounted_otherwise(rng: np.random.Generator, view: TrainingView, share: float) -> TrainingView:
    """The view or, in a ``share`` of cases, that from a height of 0.5 to 1.1 m or of 3.6 to 5 m."""
    if rng.random() >= share:
        return view
    low, high = _UNUSUAL_HEIGHTS_M[int(rng.integers(len(_UNUSUAL_HEIGHTS_M)))]
    x, y, _ = camera_centre(view.cam_from_map)
    cam_from_map = view.cam_from_map.copy()
    cam_from_map[:3, 3] = -cam_from_map[:3, :3] @ np.array([x, y, rng.uniform(low, high)])
    return replace(view, cam_from_map=cam_from_map)


def turned_aside(
    rng: np.random.Generator, view: TrainingView, places_map: Sequence[FloatArray], share: float
) -> TrainingView:
    """The view or, in a ``share`` of cases, that of a camera on the vehicle's side that passes a place.

    It looks across the way, at :data:`ASIDE_RAD` to it or more, at one of the places (2,), while the vehicle
    drives along it, so that what moves during the exposure moves sideways.
    """
    if rng.random() >= share or not len(places_map):
        return view
    yaw = rng.choice([-1.0, 1.0]) * rng.uniform(ASIDE_RAD, np.pi - ASIDE_RAD)
    right, _, forward = view.cam_from_map[:3, :3]
    pitch = -np.arcsin(forward[2])
    roll = np.arcsin(np.clip(-right[2] / np.hypot(*forward[:2]), -1, 1))
    height_m = -view.cam_from_map[:3, 2] @ view.cam_from_map[:3, 3]
    (fx, _, cx), (_, fy, cy), _ = view.info.intrinsic
    bearing = yaw - np.arctan((view.info.width / 2 - cx) / fx) + rng.normal(0, 0.15)
    below = pitch + np.arctan((view.info.height * np.array([0.95, 0.15]) - cy) / fy)
    near_m, far_m = height_m / np.tan(np.clip(below, np.arctan(height_m / _FARTHEST_PASSED_M), np.pi / 3))
    away = rng.uniform(near_m, far_m) * np.array([np.cos(bearing), np.sin(bearing)])
    centre = np.append(places_map[int(rng.integers(len(places_map)))] - away, height_m)
    cam_from_map = looking(centre, float(yaw), float(pitch), float(roll))
    ahead = cam_from_map[:3, 0] * np.linalg.norm(view.motion.velocity_cam)
    motion = replace(view.motion, velocity_cam=(float(ahead[0]), float(ahead[1]), float(ahead[2])))
    return TrainingView(view.info, cam_from_map, view.optics, motion)


def looking(centre_map: FloatArray, yaw_rad: float, pitch_rad: float, roll_rad: float) -> FloatArray:
    """``cam_from_map`` (4 x 4) of a camera at ``centre_map`` (3,).

    It looks along +x, turned left by yaw, then tilted down by pitch, then rolled about its axis.
    """
    cos = np.cos
    sin = np.sin
    forward = np.array([cos(yaw_rad) * cos(pitch_rad), sin(yaw_rad) * cos(pitch_rad), -sin(pitch_rad)])
    right = np.array([sin(yaw_rad), -cos(yaw_rad), 0.0])
    down = np.cross(forward, right)
    rotation = np.stack(
        [cos(roll_rad) * right + sin(roll_rad) * down, cos(roll_rad) * down - sin(roll_rad) * right, forward]
    )
    cam_from_map = np.eye(4)
    cam_from_map[:3, :3] = rotation
    cam_from_map[:3, 3] = -rotation @ centre_map
    return cam_from_map


def _crop_camera(
    rng: np.random.Generator, width: int, height: int, focal_px: float, pitch: float
) -> CameraInfo:
    """A window of a larger camera, placed so that its ground, near the horizon more often, is in it."""
    full_width = focal_px * rng.uniform(1.3, 2.1)
    left = rng.uniform(0, max(full_width - width, 1))
    horizon_row = rng.uniform(-0.35, 0.45) * height
    above_px = focal_px * np.tan(pitch)
    intrinsic = np.array(
        [[focal_px, 0, full_width / 2 - left], [0, focal_px, horizon_row + above_px], [0, 0, 1]]
    )
    kind = rng.random()
    if kind < 0.5:
        return CameraInfo("training", width, height, intrinsic)
    if kind < 0.9:
        k1 = rng.uniform(-0.16, 0.04)
        tangential = rng.normal(0, 5e-4, 2)
        return CameraInfo(
            "training", width, height, intrinsic, "plumb_bob", (k1, -0.15 * k1, *tangential, 0.0)
        )
    return CameraInfo(
        "training", width, height, intrinsic, "equidistant", (*rng.normal(0, 0.01, 2), 0.0, 0.0)
    )


def _sees_all(info: CameraInfo) -> bool:
    """Whether every pixel has a ray of its own before the camera.

    Beyond some radius the polynomial of a lens may turn back, and a fisheye's rays lie behind the image
    plane: no maker sells such an image, and a ray that is looked up there is any.
    """
    u = np.linspace(-0.5, info.width - 0.5, _BORDER_POINTS)
    v = np.linspace(-0.5, info.height - 0.5, _BORDER_POINTS)
    points = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    there_and_back = distort_points(info, undistort_points(info, points))
    return bool(np.all(np.abs(there_and_back - points) < _LENS_TOLERANCE_PX))


def _random_optics(rng: np.random.Generator) -> Optics:
    return Optics(
        psf_sigma_px=float(rng.uniform(0.35, 1.1) if rng.random() < 0.85 else rng.uniform(1.1, 1.9)),
        vignetting=float(rng.uniform(0, 0.35)),
        mean_level=_log_uniform(rng, 0.1, 0.36),
        full_well_electrons=_log_uniform(rng, 1200, 20000),
        read_noise=_log_uniform(rng, 0.0005, 0.006),
        white_balance_bgr=tuple(float(g) for g in np.exp(rng.normal(0, 0.07, 3))),  # type: ignore[arg-type]
        grey=bool(rng.random() < 0.12),
    )


def _random_motion(rng: np.random.Generator) -> Motion:
    if rng.random() < 0.5:
        return Motion()
    turn = tuple(float(w) for w in rng.normal(0, 0.08, 3))
    return Motion(
        velocity_cam=(0.0, 0.0, float(rng.uniform(1, 14))),
        angular_velocity_cam=turn,  # type: ignore[arg-type]
        exposure_s=_log_uniform(rng, 0.001, 0.015),
    )


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
