"""A drive over a flat, rough floor, small enough for a test: every pixel is looked up where its ray lands."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from tests.cameras import level, mounted
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.lens import undistort_points
from v2hdm.geometry.rigid import interpolate
from v2hdm.records import Camera, CameraInfo, CentrePrior, Drive, FloatArray, Image, PoseNoise, Trajectory

INFO = CameraInfo(
    "front", 480, 320, np.array([[340.0, 0, 239.5], [0, 340.0, 159.5], [0, 0, 1]]), "plumb_bob",
    (-0.1, 0.03, 0.0, 0.0, 0.0),
)  # fmt: skip
CENTRE = np.array([1.0, 0.1, 2.2])
NOISE = PoseNoise(position_m=0.005, heading_rad=0.0005, roll_pitch_rad=0.0005)
ROI = np.array([[4.0, -2.5], [11.0, -2.5], [11.0, 2.5], [4.0, 2.5]])

Heights = Callable[[FloatArray], FloatArray]
"""Heights (N,) of points (N, 2)."""

_TEXEL_M = 0.03
_HEIGHT_TEXEL_M = 0.06
_FLOOR_M = (-8.0, 46.0, -12.0, 30.0)
_SPEED_MPS = 5.0
_EVERY_M = 0.8


def extrinsic(roll_deg: float = 0.0, pitch_deg: float = 20.0, yaw_deg: float = 0.0) -> FloatArray:
    """``cam_from_vehicle`` of a camera at :data:`CENTRE` that looks ahead and down."""
    return mounted(CENTRE, pitch_deg, yaw_deg, roll_deg)


def path(turn_deg: float, length_m: float = 30.0) -> Trajectory:
    """At constant speed: a third straight, a third that turns, a third straight; 20 poses a second."""
    at = np.arange(0.0, length_m / _SPEED_MPS, 0.05)
    third = length_m / 3
    fine = np.linspace(0.0, length_m, 2000)
    ramp = np.clip((fine - third) / third, 0, 1)
    yaw = np.deg2rad(turn_deg) * ramp * ramp * (3 - 2 * ramp)
    steps = np.diff(fine, prepend=0.0)
    x, y = np.cumsum(steps * np.cos(yaw)), np.cumsum(steps * np.sin(yaw))
    along = at * _SPEED_MPS
    return Trajectory(at, level(*(np.interp(along, fine, coordinate) for coordinate in (x, y, yaw))))


def make_drive(
    folder: Path,
    turn_deg: float,
    true: FloatArray,
    contrast: float = 30.0,
    grain: float = 0.0,
    crown: float = 0.0,
) -> Drive:
    """Render a drive into ``folder``; its guess is the truth, its poses are exact.

    ``contrast`` of the floor and ``grain`` of the sensor are standard deviations in grey levels; ``crown`` is
    the floor's fall to both sides of the path, on which the wheels stand at z = 0.
    """
    rng = np.random.default_rng(11)
    trajectory = path(turn_deg)
    stamps = np.arange(0.2, trajectory.stamp_s[-1] - 0.2, _EVERY_M / _SPEED_MPS)
    poses, _ = interpolate(trajectory, stamps, np.inf)
    floor = _floor(contrast)
    rays = _rays(true)
    height_m = _crowned(trajectory, crown) if crown else None
    (folder / "front").mkdir(parents=True, exist_ok=True)
    images = []
    for k, (stamp, pose) in enumerate(zip(stamps, poses, strict=True)):
        file = folder / "front" / f"{k:03d}.png"
        grey = _look(floor, rays, pose, height_m)
        noisy = np.clip(grey + rng.normal(0.0, grain, grey.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(file), noisy, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        images.append(Image("front", float(stamp), file, pose))
    camera = Camera(
        INFO,
        {"estimated": ipm_from_extrinsic(INFO, true)},
        "estimated",
        ROI,
        CentrePrior(CENTRE, np.full(3, 0.02)),
    )
    return Drive("floor", folder, {"front": camera}, tuple(images), NOISE, trajectory=trajectory)


def with_guess(drive: Drive, guess: FloatArray) -> Drive:
    """The drive with another guess of its mounting."""
    ipm = {"estimated": ipm_from_extrinsic(INFO, guess)}
    return replace(drive, cameras={"front": replace(drive.cameras["front"], ipm=ipm)})


def with_trajectory(drive: Drive, trajectory: Trajectory) -> Drive:
    """The drive with other poses."""
    poses, _ = interpolate(trajectory, np.array([i.stamp_s for i in drive.images]), np.inf)
    images = tuple(replace(i, map_from_vehicle=p) for i, p in zip(drive.images, poses, strict=True))
    return replace(drive, trajectory=trajectory, images=images)


@cache
def _texture() -> FloatArray:
    west, east, south, north = _FLOOR_M
    shape = (round((north - south) / _TEXEL_M), round((east - west) / _TEXEL_M))
    noise = np.random.default_rng(5).standard_normal(shape).astype(np.float32)
    return np.asarray(sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.5, 3.0)))


def _floor(contrast: float) -> FloatArray:
    noise = _texture()
    return np.asarray(np.clip(128 + contrast * noise / noise.std(), 0, 255), dtype=np.float32)


@cache
def _pinhole_rays() -> FloatArray:
    """The ray (N, 3) of each pixel in the camera's coordinates, at depth 1."""
    u, v = np.meshgrid(np.arange(INFO.width, dtype=np.float64), np.arange(INFO.height, dtype=np.float64))
    pinhole = undistort_points(INFO, np.column_stack([u.ravel(), v.ravel()]))
    return np.asarray(np.column_stack([pinhole, np.ones(len(pinhole))]) @ np.linalg.inv(INFO.intrinsic).T)


def _rays(true: FloatArray) -> FloatArray:
    return np.asarray(_pinhole_rays() @ true[:3, :3])


def _crowned(trajectory: Trajectory, fall: float) -> Heights:
    """Heights of a floor that falls to both sides of the path, looked up in a grid."""
    west, east, south, north = _FLOOR_M
    at = np.linspace(*trajectory.stamp_s[[0, -1]], 1000)
    middle = cKDTree(interpolate(trajectory, at, np.inf)[0][:, :2, 3])
    x, y = np.meshgrid(np.arange(west, east, _HEIGHT_TEXEL_M), np.arange(south, north, _HEIGHT_TEXEL_M))
    aside_m, _ = middle.query(np.column_stack([x.ravel(), y.ravel()]))
    height_m = (fall * (0.8 - aside_m)).reshape(x.shape).astype(np.float32)

    def of(points: FloatArray) -> FloatArray:
        column, row = ((points - (west, south)) / _HEIGHT_TEXEL_M).astype(np.float32).T
        shape = (INFO.height, INFO.width)
        maps = column.reshape(shape), row.reshape(shape)
        return cv2.remap(height_m, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()

    return of


def _look(
    floor: FloatArray, rays_vehicle: FloatArray, pose: FloatArray, height_m: Heights | None
) -> FloatArray:
    """The floor as the camera sees it; level at z = 0 without ``height_m``."""
    rays = rays_vehicle @ pose[:3, :3].T
    centre = pose[:3, :3] @ CENTRE + pose[:3, 3]
    down = np.maximum(-rays[:, 2], 1e-3)
    ground = centre[:2] + (centre[2] / down)[:, None] * rays[:, :2]
    for _ in range(3 if height_m else 0):
        above = centre[2] - height_m(ground)
        ground = centre[:2] + (above / down)[:, None] * rays[:, :2]
    x, y = ground.T
    columns = ((x - _FLOOR_M[0]) / _TEXEL_M).astype(np.float32).reshape(INFO.height, INFO.width)
    rows = ((y - _FLOOR_M[2]) / _TEXEL_M).astype(np.float32).reshape(INFO.height, INFO.width)
    return np.asarray(cv2.remap(floor, columns, rows, cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8))
