"""The images of a drive as views of the ground, and the raster on the ground that takes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from v2hdm.geometry.ipm import (
    apply_homography,
    facing_ipm,
    flat_motion,
    pinhole_px_from_ground,
    project_ground,
)
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.rigid import inverse
from v2hdm.geometry.trajectory import interpolate
from v2hdm.records import Calibration, Camera, CameraInfo, Drive, FloatArray, Trajectory


@dataclass(frozen=True)
class Canvas:
    """``rows`` x ``columns`` square pixels of ``cell_m`` on the ground, seen from above.

    ``corner_map`` (2,) m is the outer corner of the first pixel, ``right_map`` (2,) the unit vector along
    which columns rise; rows rise at a right angle to it, clockwise. North is above where columns rise east.
    """

    corner_map: FloatArray
    cell_m: float
    rows: int
    columns: int
    right_map: tuple[float, float] = (1.0, 0.0)

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
        """The smallest one, north above, around points (N, 2) m; its edges are multiples of its pixels.

        Rows and columns are filled up to a multiple of ``multiple_px``.
        """
        low = np.floor(points_map.min(axis=0) / cell_m)
        high = np.ceil(points_map.max(axis=0) / cell_m)
        columns, rows = (np.ceil((high - low) / multiple_px) * multiple_px).astype(int).tolist()
        corner = np.array([low[0], high[1]]) * cell_m
        return cls(corner, cell_m, rows, columns)

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """West, south, east and north edge, m, of a canvas with north above."""
        west, north = (float(value) for value in self.corner_map)
        return west, north - self.rows * self.cell_m, west + self.columns * self.cell_m, north


FEATHER = 1 / 15  # band at the edge of what is trusted where the weight rises to 1, in heights of the image
_OUTLINE_STEP_PX = 16  # distance of the points by which the outline of what is trusted is laid on the ground


@dataclass(frozen=True)
class Lens:
    """One camera: its intrinsics, and how far each pixel is trusted to show the ground.

    ``trust`` (height, width) float32 is 1 within, 0 outside of the camera's ROI and on its own vehicle.
    ``outline_pinhole_px`` (N, 2) is the convex hull of what is trusted.
    """

    info: CameraInfo
    trust: np.ndarray
    outline_pinhole_px: FloatArray


@dataclass(frozen=True)
class Shot:
    """One image: its file, its camera, and the homography (3, 3) of the ground plane of the map.

    The homography's third coordinate is positive in front of the camera.
    """

    path: Path
    camera: str
    pinhole_px_from_map: FloatArray

    def outline_map(self, lens: Lens) -> FloatArray:
        """The ground (N, 2), m, that is trusted: a convex polygon."""
        map_from_pinhole_px = np.asarray(np.linalg.inv(self.pinhole_px_from_map), dtype=np.float64)
        return apply_homography(map_from_pinhole_px, lens.outline_pinhole_px)


def lens_of(camera: Camera, cam_from_vehicle: FloatArray) -> Lens:
    """The part of a camera's image that shows the ground within its ROI, feathered to its edges.

    The camera sits at ``cam_from_vehicle`` (4, 4); the mask of its own vehicle is left out where it is known.
    """
    info = camera.info
    pinhole_px, _ = project_ground(info.intrinsic, cam_from_vehicle, _densely(camera.roi_vehicle))
    inside = np.zeros((info.height + 2, info.width + 2), dtype=np.uint8)
    roi_px = np.round(distort_points(info, pinhole_px)).astype(np.int32)
    cv2.fillPoly(inside, [roi_px + 1], 1)
    if camera.own_vehicle is not None:
        inside[1:-1, 1:-1][camera.own_vehicle] = 0
    # The frame of zeros makes the image's border an edge, too.
    inside[[0, -1]] = inside[:, [0, -1]] = 0
    depth_px = cv2.distanceTransform(inside, cv2.DIST_L2, 5)[1:-1, 1:-1]
    trust = np.clip(depth_px / (FEATHER * info.height), 0, 1).astype(np.float32)
    contours, _ = cv2.findContours(inside[1:-1, 1:-1], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    edge = np.concatenate([contour[::_OUTLINE_STEP_PX, 0] for contour in contours])
    hull = cv2.convexHull(undistort_points(info, edge.astype(np.float64)).astype(np.float32))[:, 0]
    return Lens(info, trust, hull.astype(np.float64))


def recorded_shots(drive: Drive) -> list[Shot]:
    """All images under the initial IPM of their cameras and the recorded poses."""
    px_from_vehicle = {
        name: np.linalg.inv(facing_ipm(camera.ipm[camera.initial_ipm], camera.roi_vehicle.mean(axis=0)))
        for name, camera in drive.cameras.items()
    }
    return [
        Shot(one.path, one.camera, px_from_vehicle[one.camera] @ flat_motion(inverse(one.map_from_vehicle)))
        for one in drive.images
    ]


def adjusted_shots(
    drive: Drive,
    calibrations: Mapping[str, Calibration],
    clock_s: Mapping[str, float],
    adjusted: Trajectory,
) -> list[Shot]:
    """The images of calibrated cameras under adjusted extrinsics and poses.

    ``clock_s`` is by camera how much later than stamped its images were taken. ``adjusted`` is in the frame
    of the recorded poses; where the drive's road was not flat, its own have been laid flat.
    """
    images = [image for image in drive.images if image.camera in calibrations]
    taken_s = np.array([image.stamp_s + clock_s[image.camera] for image in images])
    poses, _ = interpolate(adjusted, taken_s, np.inf)
    if drive.recorded is not None and drive.trajectory is not None:
        recorded, flat = (interpolate(one, taken_s, np.inf)[0] for one in (drive.recorded, drive.trajectory))
        poses = flat @ np.linalg.inv(recorded) @ poses
    shots = []
    for image, pose in zip(images, poses, strict=True):
        own = calibrations[image.camera]
        px_from_map = pinhole_px_from_ground(own.info.intrinsic, own.cam_from_vehicle @ inverse(pose))
        shots.append(Shot(image.path, image.camera, px_from_map))
    return shots


def _densely(polygon: FloatArray, pieces: int = 16) -> FloatArray:
    """A polygon (N, 2) with every side cut into pieces, as lenses bend straight lines."""
    part = np.arange(pieces)[:, None] / pieces
    ahead = np.roll(polygon, -1, axis=0)
    return np.concatenate([a + part * (b - a) for a, b in zip(polygon, ahead, strict=True)])
