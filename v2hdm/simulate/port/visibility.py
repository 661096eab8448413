"""What of a marking an image truly shows: sample points on it, the image's border, the boxes before it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import BoolArray, CameraInfo, FloatArray
from v2hdm.simulate.render.scene import Box

_SAMPLES = 5
_FARTHEST_M = 40.0
_NEAR_M = 0.3


def quad_samples(corners: FloatArray) -> FloatArray:
    """A grid of points (J, 25, 2), each standing for an equal share of quadrilaterals (J, 4, 2)."""
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    s, t = (g.ravel()[None, :, None] for g in np.meshgrid(steps, steps))
    a, b, c, d = (corners[:, k, None, :] for k in range(4))
    return np.asarray((1 - s) * (1 - t) * a + s * (1 - t) * b + s * t * c + (1 - s) * t * d)


def points_seen(
    info: CameraInfo, cam_from_map: FloatArray, points_map: FloatArray, boxes: Sequence[Box]
) -> BoolArray:
    """Which ground points (N, 2) an image shows: inside its border, within 40 m, not behind a box."""
    centre = camera_centre(cam_from_map)
    seen = np.hypot(*(points_map - centre[:2]).T) < _FARTHEST_M
    seen[seen] = inside_image(info, cam_from_map, points_map[seen])
    near = [b for b in boxes if _may_hide(b, cam_from_map, float(centre[2]))]
    if seen.any() and near:
        seen[seen] = ~hidden_by(near, centre, points_map[seen])
    return np.asarray(seen)


def _may_hide(box: Box, cam_from_map: FloatArray, height_m: float) -> bool:
    """Whether a box lies before the camera, near enough, and not above all its sight lines to the ground."""
    reach = float(np.hypot(box.size_m[0], box.size_m[1])) / 2
    depth = float(cam_from_map[2, :2] @ np.array(box.centre_map) + cam_from_map[2, 3])
    return box.base_m < height_m and -reach < depth < _FARTHEST_M + reach


def inside_image(info: CameraInfo, cam_from_map: FloatArray, points_map: FloatArray) -> BoolArray:
    """Which ground points (N, 2) fall between the image's borders."""
    pinhole, depth_m = project_ground(info.intrinsic, cam_from_map, points_map)
    inside = depth_m > _NEAR_M
    # Far outside the image the lens polynomial folds back; only near it are its values meaningful.
    margin = np.array([info.width, info.height]) * 0.25
    inside &= ((pinhole > -margin) & (pinhole < 5.0 * margin)).all(axis=1)
    recorded = distort_points(info, pinhole[inside])
    inside[inside] = ((recorded >= 0) & (recorded <= (info.width - 1, info.height - 1))).all(axis=1)
    return np.asarray(inside)


def hidden_by(boxes: Sequence[Box], centre_map: FloatArray, points_map: FloatArray) -> BoolArray:
    """Which sight lines from ``centre_map`` (3,) to ground points (N, 2) pass through a box.

    The slab test (Kay and Kajiya 1986) in the frame of every box.
    """
    hidden = np.zeros(len(points_map), dtype=np.bool_)
    for box in boxes:
        cos, sin = np.cos(box.yaw_rad), np.sin(box.yaw_rad)
        turn = np.array([[cos, -sin], [sin, cos]])
        eye = np.append((centre_map[:2] - box.centre_map) @ turn, centre_map[2] - box.base_m)
        ground = np.column_stack(
            [(points_map - box.centre_map) @ turn, np.full(len(points_map), -box.base_m)]
        )
        ray = ground - eye
        half = np.array([box.size_m[0] / 2, box.size_m[1] / 2])
        low, high = np.append(-half, 0.0), np.append(half, box.size_m[2])
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = (low - eye) / ray, (high - eye) / ray
        enter = np.fmin(first, second).max(axis=1)
        leave = np.fmax(first, second).min(axis=1)
        hidden |= (enter < np.minimum(leave, 1.0)) & (leave > 0)
    return hidden
