"""Where the map's markings should be in an image, and how that depends on every state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from v2hdm.geometry.lens import has_distortion, undistort_points
from v2hdm.geometry.rigid import exp
from v2hdm.localization.belief import (
    CAMERA,
    HEADING,
    HEIGHT,
    PITCH,
    ROLL,
    SLOW_PITCH,
    SLOW_ROLL,
    VEHICLE,
    Belief,
    Plane,
)
from v2hdm.native import kernels
from v2hdm.records import (
    CROSSWALK,
    LANE_LINE,
    BoolArray,
    Calibration,
    FloatArray,
    IntArray,
    LaneDetection,
    MarkingDetection,
)

if TYPE_CHECKING:
    from v2hdm.detection.road import Road

_NEAREST_M = 0.3  # least depth, m, at which a corner can be seen
_LARGEST_PX = 1e4  # standard deviation, px, from which a corner says nothing
_STEP_PX = 0.5  # step, px, of the lens's differences


@dataclass(frozen=True)
class Look:
    """One image's content: the camera's name, the time of exposure, and the detections.

    ``is_whole`` tells whether all of the image was searched, ``is_second`` whether that was done after a look
    at parts of the same image: such a look is held against the map, and changes no pose.
    """

    camera: str
    stamp_s: float
    markings: Sequence[MarkingDetection] = ()
    lanes: Sequence[LaneDetection] = ()
    is_whole: bool = True
    is_second: bool = False

    @classmethod
    def of(cls, camera: str, stamp_s: float, road: Road) -> Look:
        """The look that a :class:`~v2hdm.detection.road.RoadDetector` has had at an image."""
        markings = tuple(marking.image for marking in road.markings)
        return cls(camera, stamp_s, markings, tuple(lane.image for lane in road.lanes), road.is_whole)


class Sighted(NamedTuple):
    """The quadrilaterals (D) of a look without lens distortion."""

    kinds: tuple[str, ...]
    corners_px: FloatArray  # (D, 4, 2) pinhole px
    covariance_px2: FloatArray  # (D, 8, 8), large where ``informs`` is not set
    informs: BoolArray  # (D, 4) corners that say anything
    valid: BoolArray  # (D, 4) corners that are points

    def subset(self, rows: IntArray) -> Sighted:
        """Some of them."""
        return Sighted(
            tuple(self.kinds[row] for row in rows.tolist()),
            self.corners_px[rows],
            self.covariance_px2[rows],
            self.informs[rows],
            self.valid[rows],
        )


def sighted(look: Look, calibration: Calibration) -> Sighted:
    """The quadrilaterals of a look with two or more informative corners."""
    quads = [marking for marking in look.markings if not len(marking.outline_px)]
    corners = np.array([quad.corners_px for quad in quads], dtype=np.float64).reshape(-1, 4, 2)
    covariance = np.array([quad.covariance_px for quad in quads], dtype=np.float64).reshape(-1, 8, 8)
    valid = np.array([quad.corner_valid for quad in quads], dtype=bool).reshape(-1, 4)
    info = calibration.info
    if len(quads) and has_distortion(info):
        flat = corners.reshape(-1, 2)
        steps = np.array([[0.0, 0.0], [_STEP_PX, 0.0], [-_STEP_PX, 0.0], [0.0, _STEP_PX], [0.0, -_STEP_PX]])
        moved = undistort_points(info, (flat[:, None] + steps).reshape(-1, 2)).reshape(-1, 5, 2)
        by_px = np.stack([moved[:, 1] - moved[:, 2], moved[:, 3] - moved[:, 4]], axis=2) / (2 * _STEP_PX)
        corners = moved[:, 0].reshape(-1, 4, 2)
        blocks = by_px.reshape(-1, 4, 2, 2)
        spread = np.zeros((len(quads), 8, 8))
        for corner in range(4):
            spread[:, 2 * corner : 2 * corner + 2, 2 * corner : 2 * corner + 2] = blocks[:, corner]
        covariance = spread @ covariance @ spread.swapaxes(1, 2)
    variance = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 4, 2)
    informs: BoolArray = np.asarray(np.isfinite(corners).all(axis=2) & np.isfinite(variance).all(axis=2))
    informs &= (variance > 0).all(axis=2) & (variance < _LARGEST_PX**2).all(axis=2)
    silent = ~np.repeat(informs, 2, axis=1)
    covariance = np.where(silent[:, :, None] | silent[:, None, :], 0.0, np.nan_to_num(covariance))
    covariance += silent[:, :, None] * (_LARGEST_PX**2 * np.eye(8))
    corners = np.where(informs[..., None], corners, 0.0)
    kinds = tuple(quad.kind for quad in quads)
    finding = Sighted(kinds, corners, covariance, informs, valid & informs)
    return finding.subset(np.flatnonzero(informs.sum(axis=1) >= 2))


def pieces_of_lines(look: Look, calibration: Calibration) -> list[FloatArray]:
    """The pieces (N, 2) of solid lines in a look, pinhole px; dashes are among its quadrilaterals."""
    pieces = [lane.points_px for lane in look.lanes if lane.kind == LANE_LINE and len(lane.points_px) > 1]
    return [undistort_points(calibration.info, points_px) for points_px in pieces]


class Hull(NamedTuple):
    """The outline of a symbol or area in an image, if nothing hides any of it."""

    kind: str
    points_px: FloatArray  # (N, 2) pinhole px


def hulls_of_areas(look: Look, calibration: Calibration) -> list[Hull]:
    """The symbols and areas of a look that it shows whole.

    A crosswalk is left out: nobody knows how many of its bars an image lacks, and each bar is a marking.
    """
    outlined = [marking for marking in look.markings if len(marking.outline_px) and marking.kind != CROSSWALK]
    return [
        Hull(marking.kind, undistort_points(calibration.info, marking.outline_px))
        for marking in outlined
        if len(marking.outline_seen) and marking.outline_seen.all()
    ]


class Expected(NamedTuple):
    """Markings (M) as a camera should see them at a belief's mean."""

    px: FloatArray  # (M, 4, 2) pinhole px, nan behind the camera
    depth_m: FloatArray  # (M, 4)
    by_states: FloatArray  # (M, 8, 17) by the states of the vehicle and, after these, of the camera
    by_place: FloatArray  # (M, 4, 2, 2) by each corner's place in the map


class ExpectedPoints(NamedTuple):
    """Points (..., 3) of the map as a camera should see them at a belief's mean."""

    px: FloatArray  # (..., 2) pinhole px, nan behind the camera
    depth_m: FloatArray  # (...)
    by_states: FloatArray  # (..., 2, 17) by the states of the vehicle and, after these, of the camera
    by_place: FloatArray  # (..., 2, 2) by the point's place in the map


def expect(
    belief: Belief, plane: Plane, camera: int, calibration: Calibration, corners_map: FloatArray
) -> Expected:
    """Where corners (M, 4, 3) should be in an image of a camera, and the derivatives."""
    points = expect_points(belief, plane, camera, calibration, corners_map)
    by_states = points.by_states.reshape(len(corners_map), 8, VEHICLE + CAMERA)
    return Expected(points.px, points.depth_m, by_states, points.by_place)


def expect_points(
    belief: Belief, plane: Plane, camera: int, calibration: Calibration, points_map: FloatArray
) -> ExpectedPoints:
    """Where points (..., 3) of the map should be in an image of a camera, and the derivatives."""
    pose = belief.map_from_vehicle(plane)
    begin = VEHICLE + CAMERA * camera
    tangent = belief.mean[begin : begin + CAMERA]
    compiled = kernels()
    if compiled is not None:
        calibrated = (calibration.cam_from_vehicle, tangent, calibration.info.intrinsic)
        flat = compiled.expect_points(points_map.reshape(-1, 3), pose, *calibrated, _NEAREST_M)
        shape = points_map.shape[:-1]
        return ExpectedPoints(*(array.reshape(*shape, *array.shape[1:]) for array in flat))
    cam_from_vehicle = exp(tangent) @ calibration.cam_from_vehicle
    rotation = pose[:3, :3]
    turn = cam_from_vehicle[:3, :3]
    vehicle = (points_map - pose[:3, 3]) @ rotation
    cam = vehicle @ turn.T + cam_from_vehicle[:3, 3]
    depth_m = cam[..., 2]
    intrinsic = calibration.info.intrinsic
    safe = np.where(depth_m > _NEAREST_M, depth_m, np.nan)
    px = (cam @ intrinsic[:2].T) / safe[..., None]
    by_cam = (intrinsic[:2] - px[..., None] * np.array([0.0, 0.0, 1.0])) / safe[..., None, None]
    by_vehicle_point = by_cam @ turn
    by_map = by_vehicle_point @ rotation.T
    by_states = np.zeros((*px.shape, VEHICLE + CAMERA))
    by_states[..., :2] = -by_map[..., :2]
    by_states[..., HEIGHT] = -by_map[..., 2]
    # About the axis up in the map, the vehicle's own axis ahead, and its axis to the left before it rolls.
    up = rotation[2]
    left = np.array([0.0, up[2], -up[1]]) / max(float(np.hypot(up[1], up[2])), 1e-9)
    axes = np.array([up, [1.0, 0.0, 0.0], left])
    turned = _cross(vehicle[..., None, :], axes)
    by_turn = by_vehicle_point @ turned.swapaxes(-1, -2)
    by_states[..., [HEADING, ROLL, PITCH]] = by_turn
    by_states[..., [SLOW_ROLL, SLOW_PITCH]] = by_turn[..., 1:]
    by_states[..., VEHICLE:] = np.concatenate([by_cam, _cross(cam[..., None, :], by_cam)], axis=-1)
    return ExpectedPoints(px, depth_m, by_states, by_map[..., :2])


def _cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """The cross product (..., 3): of many short arrays in a fifth of numpy's time."""
    x, y, z = first[..., 0], first[..., 1], first[..., 2]
    a, b, c = second[..., 0], second[..., 1], second[..., 2]
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=-1)


def ground_points(
    corners_px: FloatArray, map_from_vehicle: FloatArray, plane: Plane, calibration: Calibration
) -> FloatArray:
    """Where pinhole pixels (..., 2) meet the map's ground (..., 2); nan on and above the horizon."""
    map_from_cam = map_from_vehicle @ np.linalg.inv(calibration.cam_from_vehicle)
    homogeneous = np.concatenate([corners_px, np.ones((*corners_px.shape[:-1], 1))], axis=-1)
    rays = homogeneous @ np.linalg.inv(calibration.info.intrinsic).T @ map_from_cam[:3, :3].T
    centre = map_from_cam[:3, 3]
    normal = np.array([-plane.slope[0], -plane.slope[1], 1.0])
    place = np.array([map_from_vehicle[0, 3], map_from_vehicle[1, 3], plane.height_m])
    down = rays @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        far = ((place - centre) @ normal) / np.where(down < 0, down, np.nan)
        return np.asarray((centre + far[..., None] * rays)[..., :2])


def index_of(calibrations: Mapping[str, Calibration]) -> dict[str, int]:
    """The cameras' numbers."""
    return {name: number for number, name in enumerate(calibrations)}
