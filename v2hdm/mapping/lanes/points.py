"""Detected lane paint as one cloud of directed points on the ground of the map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from v2hdm.geometry.ipm import (
    apply_in_front,
    direction_covariance,
    facing_ipm,
    flat_motion,
    ground_from_pinhole_px,
    homography_jacobian,
)
from v2hdm.geometry.lens import undistort_points
from v2hdm.geometry.rigid import camera_centre
from v2hdm.mapping.sightings.rig import Rig
from v2hdm.mapping.sightings.table import frames_of
from v2hdm.records import LANE_BOUNDARY, LANE_DASH, BoolArray, Drive, FloatArray, ImageDetections, IntArray

_CENTRE_SIGMA_PX = 1.0
"""Noise of a detected centre point across its line: about a cell of the network's output."""

_TANGENT_REACH = 2
"""Points to either side whose difference gives a point's direction."""

_GUIDE_RANGE = 1.8
"""Whole lines are followed so many times farther than paint is mapped: they only say what is one line."""


@dataclass(frozen=True)
class Guides:
    """Whole lines as single images saw them, gaps of dashes included: which paint is one line.

    ``points_map`` (G, 2) m; ``line`` (G,) that a point is of, an index into ``image_of_line`` (L,).
    """

    points_map: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    line: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    image_of_line: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


@dataclass(frozen=True)
class LaneCloud:
    """P points on lane paint.

    ``points_map`` (P, 2) m, unit ``tangent`` (P, 2) of either sense, ``weight`` (P,) = 1 / variance
    across the line in 1 / m^2, ``image`` (P,) that a point was seen in, ``dash`` (P,) whether its
    detection was a dash; beside them the ``guides``.
    """

    points_map: FloatArray
    tangent: FloatArray
    weight: FloatArray
    image: IntArray
    dash: BoolArray
    guides: Guides = field(default_factory=Guides)


@dataclass(frozen=True)
class ImageGround:
    """How each image of a drive maps to the ground.

    ``map_from_pinhole_px`` (I, 3, 3) and ``centre_map`` (I, 3), the camera's position; nan for
    images of cameras that are not used.
    """

    map_from_pinhole_px: FloatArray
    centre_map: FloatArray


def ground_by_ipm(
    drive: Drive, ipm: Mapping[str, FloatArray], cam_from_vehicle: Mapping[str, FloatArray]
) -> ImageGround:
    """By an IPM per camera and the recorded poses; extrinsics only tell where the cameras are."""
    rows, names, poses = _rows(drive, list(ipm))
    forward = {
        name: facing_ipm(matrix, drive.cameras[name].roi_vehicle.mean(axis=0)) for name, matrix in ipm.items()
    }
    homographies = flat_motion(poses) @ np.stack([forward[name] for name in names])
    extrinsic = np.stack([cam_from_vehicle[name] for name in names])
    return _image_ground(len(drive.images), rows, homographies, extrinsic, poses)


def ground_by_rig(drive: Drive, cameras: Sequence[str], rig: Rig) -> ImageGround:
    """By optimised extrinsics and the adjusted pose of each frame; ``rig`` is over ``cameras``."""
    rows, names, _ = _rows(drive, cameras)
    camera = np.array([list(cameras).index(name) for name in names])
    poses = rig.map_from_vehicle[frames_of(drive).frame_of_image[rows]]
    extrinsic = rig.cam_from_vehicle[camera]
    homographies = ground_from_pinhole_px(rig.intrinsic[camera], extrinsic @ np.linalg.inv(poses))
    return _image_ground(len(drive.images), rows, homographies, extrinsic, poses)


def collect_lane_points(
    drive: Drive,
    detections: Sequence[ImageDetections],
    ground: ImageGround,
    *,
    max_range_m: float,
    jitter_rad: float,
) -> LaneCloud:
    """Back-project all lane detections of the images that ``ground`` covers.

    Points farther than ``max_range_m`` from their camera are left out; ``jitter_rad`` of viewing
    direction goes into the weights, so that near points count for more.
    """
    guides = _guides(drive, detections, ground, _GUIDE_RANGE * max_range_m)
    covered = np.isfinite(ground.centre_map[:, 0])
    pieces = [
        (found.image, lane.kind == LANE_DASH, lane.points_px)
        for found in detections
        if covered[found.image]
        for lane in found.lanes
        if lane.kind != LANE_BOUNDARY and len(lane.points_px) >= 2
    ]
    if not pieces:
        empty = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, int), np.zeros(0, bool)
        return LaneCloud(*empty, guides)
    length = np.array([len(points) for _, _, points in pieces])
    piece = np.repeat(np.arange(len(pieces)), length)
    image = np.array([i for i, _, _ in pieces])[piece]
    points_px = _undistort(drive, image, np.concatenate([points for _, _, points in pieces]))
    homographies = ground.map_from_pinhole_px[image]
    points_map = apply_in_front(homographies, points_px[:, None])[:, 0]
    tangent = _tangents(points_map, piece, length)
    jacobian = homography_jacobian(homographies, points_px[:, None])[:, 0]
    centre = ground.centre_map[image]
    ray = points_map - centre[:, :2]
    covariance = _CENTRE_SIGMA_PX**2 * jacobian @ np.swapaxes(jacobian, 1, 2)
    covariance += direction_covariance(ray, np.maximum(centre[:, 2], 0.1), jitter_rad)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    variance = np.einsum("pi,pij,pj->p", normal, covariance, normal)
    with np.errstate(invalid="ignore"):
        keep = (np.linalg.norm(ray, axis=1) <= max_range_m) & np.isfinite(tangent).all(axis=1)
        keep &= np.isfinite(variance)
    dash = np.array([is_dash for _, is_dash, _ in pieces])[piece]
    # A centimetre of its own keeps the nearest image from outvoting all others.
    weight = 1.0 / (variance[keep] + 0.01**2)
    return LaneCloud(
        points_map[keep], tangent[keep], weight, image[keep].astype(np.int64), dash[keep], guides
    )


def _guides(
    drive: Drive, detections: Sequence[ImageDetections], ground: ImageGround, max_range_m: float
) -> Guides:
    """The whole lines of the images that ``ground`` covers, as far as ``max_range_m``."""
    covered = np.isfinite(ground.centre_map[:, 0])
    lines = [
        (found.image, lane.points_px)
        for found in detections
        if covered[found.image]
        for lane in found.lanes
        if lane.kind == LANE_BOUNDARY
    ]
    if not lines:
        return Guides()
    image_of_line = np.array([image for image, _ in lines], dtype=np.int64)
    line = np.repeat(np.arange(len(lines)), [len(points_px) for _, points_px in lines])
    image = image_of_line[line]
    points_px = _undistort(drive, image, np.concatenate([points_px for _, points_px in lines]))
    points_map = apply_in_front(ground.map_from_pinhole_px[image], points_px[:, None])[:, 0]
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(points_map - ground.centre_map[image, :2], axis=1) <= max_range_m
    return Guides(points_map[near], line[near].astype(np.int64), image_of_line)


def _rows(drive: Drive, cameras: Sequence[str]) -> tuple[IntArray, list[str], FloatArray]:
    """Images of ``cameras``: their indices, camera names and recorded poses."""
    rows = [i for i, image in enumerate(drive.images) if image.camera in cameras]
    names = [drive.images[i].camera for i in rows]
    return np.array(rows), names, np.stack([drive.images[i].map_from_vehicle for i in rows])


def _image_ground(
    count: int, rows: IntArray, homographies: FloatArray, extrinsic: FloatArray, poses: FloatArray
) -> ImageGround:
    centre = (poses[:, :3, :3] @ camera_centre(extrinsic)[..., None])[..., 0] + poses[:, :3, 3]
    all_homographies = np.full((count, 3, 3), np.nan)
    all_centres = np.full((count, 3), np.nan)
    all_homographies[rows], all_centres[rows] = homographies, centre
    return ImageGround(all_homographies, all_centres)


def _undistort(drive: Drive, image: IntArray, points_px: FloatArray) -> FloatArray:
    """Recorded pixels (P, 2) of images (P,) to pinhole pixels."""
    camera = np.array([one.camera for one in drive.images])[image]
    out = np.empty_like(points_px, dtype=np.float64)
    for name in np.unique(camera):
        own = camera == name
        out[own] = undistort_points(drive.cameras[str(name)].info, points_px[own])
    return out


def _tangents(points: FloatArray, piece: IntArray, length: IntArray) -> FloatArray:
    """Unit direction (P, 2) at each point of its piece, from the points up to two places away."""
    first = (np.cumsum(length) - length)[piece]
    last = first + length[piece] - 1
    here = np.arange(len(points))
    difference = (
        points[np.minimum(here + _TANGENT_REACH, last)] - points[np.maximum(here - _TANGENT_REACH, first)]
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(difference / np.linalg.norm(difference, axis=1, keepdims=True))
