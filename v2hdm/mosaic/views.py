"""Cameras, their images, and the raster on the ground that a mosaic is made on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.ipm import (
    apply_homography,
    facing_ipm,
    flat_motion,
    pinhole_px_from_ground,
)
from v2hdm.geometry.lens import undistort_points
from v2hdm.geometry.rigid import camera_centre, interpolate, inverse
from v2hdm.records import BoolArray, Calibration, Camera, CameraInfo, Drive, FloatArray, Trajectory
from v2hdm.surface.surface import Surface


class Bounds(NamedTuple):
    """Edges of a canvas with north above, m in the map."""

    west: float
    south: float
    east: float
    north: float


@dataclass(frozen=True)
class Canvas:
    """Square pixels on the ground, seen from above; north is above where columns rise east."""

    corner_map: FloatArray  # (2,) m, outer corner of the first pixel
    cell_m: float
    rows: int
    columns: int
    right_map: tuple[float, float] = (1.0, 0.0)  # unit vector of rising columns

    @property
    def canvas_from_map(self) -> FloatArray:
        """The inverse of :attr:`map_from_canvas`."""
        return np.asarray(np.linalg.inv(self.map_from_canvas), dtype=np.float64)

    @property
    def map_from_canvas(self) -> FloatArray:
        """The homography (3, 3) to the map of (column, row); (0, 0) is the centre of the first pixel."""
        x, y = self.right_map
        axes = self.cell_m * np.array([[x, y], [y, -x]])
        out = np.eye(3)
        out[:2, :2] = axes
        out[:2, 2] = self.corner_map + axes @ [0.5, 0.5]
        return out

    def window(self, row: int, column: int, rows: int, columns: int) -> Canvas:
        """A part of the canvas."""
        x, y = self.right_map
        corner = self.corner_map + self.cell_m * (column * np.array([x, y]) + row * np.array([y, -x]))
        return Canvas(corner, self.cell_m, rows, columns, self.right_map)

    @classmethod
    def around(cls, points_map: FloatArray, cell_m: float, multiple_px: int = 1) -> Canvas:
        """The smallest one, north above, around points (N, 2) m, by ``multiple_px`` whole pixels."""
        low = np.floor(points_map.min(axis=0) / cell_m)
        high = np.ceil(points_map.max(axis=0) / cell_m)
        columns, rows = (np.ceil((high - low) / multiple_px) * multiple_px).astype(int).tolist()
        corner = np.array([low[0], high[1]]) * cell_m
        return cls(corner, cell_m, rows, columns)

    @property
    def bounds_m(self) -> Bounds:
        """The edges of a canvas with north above."""
        west, north = (float(value) for value in self.corner_map)
        south = north - self.rows * self.cell_m
        east = west + self.columns * self.cell_m
        return Bounds(west, south, east, north)


REACH_M = 18.0  # distance from a camera up to which it shows ground finely enough, m; chosen
FEATHER = 1 / 15  # band at the edge of what is trusted where the weight rises to 1, in heights of the image
_OUTLINE_STEP_PX = 16  # distance of the points by which the outline of what is trusted is laid on the ground


@dataclass(frozen=True)
class Lens:
    """One camera: its intrinsics, and how far each pixel is trusted to show the ground."""

    info: CameraInfo
    trust: np.ndarray  # (height, width) float32, 1 within, 0 outside of the ROI and on its own vehicle
    outline_pinhole_px: FloatArray  # (N, 2) convex hull of what is trusted

    @cached_property
    def trusted_box(self) -> tuple[slice, slice]:
        """The rows and columns that are trusted at all, and one around them."""
        trusted = (np.flatnonzero(self.trust.any(axis=axis)) for axis in (1, 0))
        rows, columns = (slice(max(int(index[0]) - 1, 0), int(index[-1]) + 2) for index in trusted)
        return rows, columns

    @cached_property
    def trusted_part(self) -> np.ndarray:
        """The trust of :attr:`trusted_box`."""
        return self.trust[self.trusted_box].copy()


@dataclass(frozen=True)
class Shot:
    """One image, and the homography of the map's ground plane, positive in front of the camera."""

    path: Path
    camera: str
    pinhole_px_from_map: FloatArray
    # points (K, 2) of that plane seen where the ground's are, None where it is the plane
    on_plane: Callable[[FloatArray], FloatArray] | None = None
    centre_map: FloatArray | None = None  # (3,) m, of the camera; None where only an IPM is known

    def outline_map(self, lens: Lens) -> FloatArray:
        """The ground (N, 2), m, that is trusted: a convex polygon."""
        map_from_pinhole_px = np.asarray(np.linalg.inv(self.pinhole_px_from_map), dtype=np.float64)
        return apply_homography(map_from_pinhole_px, lens.outline_pinhole_px)


def lens_of(camera: Camera, cam_from_vehicle: FloatArray) -> Lens:
    """The part of an image that shows ground near enough, feathered, less the vehicle where known."""
    info = camera.info
    inside = np.zeros((info.height + 2, info.width + 2), dtype=np.uint8)
    inside[1:-1, 1:-1] = _near_ground(info, cam_from_vehicle)
    if camera.own_vehicle is not None:
        inside[1:-1, 1:-1][camera.own_vehicle] = 0
    # The frame of zeros makes the image's border an edge, too.
    depth_px = cv2.distanceTransform(inside, cv2.DIST_L2, 5)[1:-1, 1:-1]
    trust = np.clip(depth_px / (FEATHER * info.height), 0, 1).astype(np.float32)
    contours, _ = cv2.findContours(inside[1:-1, 1:-1], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        raise DriveError(f"camera {info.name}: shows no ground within {REACH_M:g} m; check its mounting")
    edge = np.concatenate([contour[::_OUTLINE_STEP_PX, 0] for contour in contours])
    hull = cv2.convexHull(undistort_points(info, edge.astype(np.float64)).astype(np.float32))[:, 0]
    return Lens(info, trust, hull.astype(np.float64))


def _near_ground(info: CameraInfo, cam_from_vehicle: FloatArray) -> BoolArray:
    """The pixels (height, width) that show ground within :data:`REACH_M`."""
    v, u = np.mgrid[: info.height, : info.width]
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
    pinhole = np.column_stack([undistort_points(info, pixels), np.ones(len(pixels))])
    rays = pinhole @ np.linalg.inv(info.intrinsic).T @ cam_from_vehicle[:3, :3]
    height_m = camera_centre(cam_from_vehicle)[2]
    aside = np.hypot(rays[:, 0], rays[:, 1])
    is_near = (rays[:, 2] < 0) & (height_m * aside < -rays[:, 2] * REACH_M)
    return np.asarray(is_near.reshape(info.height, info.width))


def recorded_shots(drive: Drive) -> list[Shot]:
    """All images under the initial IPM of their cameras and the recorded poses."""
    px_from_vehicle = {
        name: np.linalg.inv(facing_ipm(camera.ipm[camera.initial_ipm], camera.roi_vehicle.mean(axis=0)))
        for name, camera in drive.cameras.items()
    }
    return [
        Shot(
            image.path,
            image.camera,
            px_from_vehicle[image.camera] @ flat_motion(inverse(image.map_from_vehicle)),
        )
        for image in drive.images
    ]


def adjusted_shots(
    drive: Drive,
    calibrations: Mapping[str, Calibration],
    clock_s: Mapping[str, float],
    adjusted: Trajectory,
    surface_at: Callable[[FloatArray], Surface | None] = lambda poses: None,
) -> list[Shot]:
    """The images of calibrated cameras under adjusted extrinsics and poses, in the recorded poses' frame.

    ``clock_s`` is by camera how much later than stamped its images were taken; ``surface_at`` gives the
    ground under vehicles at poses (F, 4, 4).
    """
    images = [image for image in drive.images if image.camera in calibrations]
    taken_s = np.array([image.stamp_s + clock_s[image.camera] for image in images])
    poses, _ = interpolate(adjusted, taken_s, np.inf)
    if drive.recorded is not None and drive.trajectory is not None:
        recorded, flat = (
            interpolate(trajectory, taken_s, np.inf)[0] for trajectory in (drive.recorded, drive.trajectory)
        )
        poses = flat @ np.linalg.inv(recorded) @ poses
    shots = []
    surface = surface_at(poses)
    for frame, (image, pose) in enumerate(zip(images, poses, strict=True)):
        calibration = calibrations[image.camera]
        cam_from_map = calibration.cam_from_vehicle @ inverse(pose)
        px_from_map = pinhole_px_from_ground(calibration.info.intrinsic, cam_from_map)
        on_plane = None
        if surface is not None:
            on_plane = partial(surface.on_plane, cam_from_map=cam_from_map, frame=frame)
        centre_map = camera_centre(cam_from_map)
        shots.append(Shot(image.path, image.camera, px_from_map, on_plane, centre_map))
    return shots
