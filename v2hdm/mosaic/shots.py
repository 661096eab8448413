"""The images of a drive as views of the ground, under the initial and under the adjusted calibration."""

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

FEATHER = 1 / 15
"""Band at the edge of what is trusted over which the weight rises from 0 to 1, in heights of the image."""

_OUTLINE_STEP_PX = 16
"""Distance of the points by which the outline of what is trusted is laid on the ground."""


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
        return apply_homography(
            np.asarray(np.linalg.inv(self.pinhole_px_from_map), dtype=np.float64), lens.outline_pinhole_px
        )


def lens_of(camera: Camera, cam_from_vehicle: FloatArray) -> Lens:
    """What an image of a camera shows of the ground within its ROI, feathered to its edges.

    Args:
        camera: with its ROI and, where known, the mask of its own vehicle.
        cam_from_vehicle: where it sits (4, 4).
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
    edge = np.concatenate(
        [
            c[::_OUTLINE_STEP_PX, 0]
            for c in cv2.findContours(inside[1:-1, 1:-1], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        ]
    )
    hull = cv2.convexHull(undistort_points(info, edge.astype(np.float64)).astype(np.float32))[:, 0]
    return Lens(info, trust, hull.astype(np.float64))


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
) -> list[Shot]:
    """The images of calibrated cameras under adjusted extrinsics and poses.

    Args:
        drive: the images; where its road was not flat, its poses have been laid flat.
        calibrations: by camera.
        clock_s: by camera, how much later than stamped its images were taken.
        adjusted: the poses that a run has written, in the frame of the recorded ones.
    """
    images = [image for image in drive.images if image.camera in calibrations]
    taken_s = np.array([image.stamp_s + clock_s[image.camera] for image in images])
    poses, _ = interpolate(adjusted, taken_s, np.inf)
    if drive.recorded is not None and drive.trajectory is not None:
        recorded, flat = (interpolate(one, taken_s, np.inf)[0] for one in (drive.recorded, drive.trajectory))
        poses = flat @ np.linalg.inv(recorded) @ poses
    return [
        Shot(
            image.path,
            image.camera,
            pinhole_px_from_ground(
                calibrations[image.camera].info.intrinsic,
                calibrations[image.camera].cam_from_vehicle @ inverse(pose),
            ),
        )
        for image, pose in zip(images, poses, strict=True)
    ]


def _densely(polygon: FloatArray, pieces: int = 16) -> FloatArray:
    """A polygon (N, 2) with every side cut into pieces, as lenses bend straight lines."""
    part = np.arange(pieces)[:, None] / pieces
    ahead = np.roll(polygon, -1, axis=0)
    return np.concatenate([a + part * (b - a) for a, b in zip(polygon, ahead, strict=True)])
