"""The plane that texture shows of a curved ground, against the plane under the vehicle's wheels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import inside_convex
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import Camera, FloatArray
from v2hdm.surface.surface import Surface

_STRIP_M = 2.0  # half width of the strip about the path whose texture bare ground matches
_FAR_M = 10.0  # distance from the camera up to which its texture is fine enough to match
_FRAMES = 24  # frames at which the ground is looked at: about one for each metre of a short drive


class _MeanPlane(NamedTuple):
    """The mean of a curved ground above the vehicle's plane."""

    height_m: float  # at the vehicle's origin
    forwards: float  # slope
    sideways: float  # slope to the left


def with_planes_over(
    surface: Surface,
    cameras: Mapping[str, Camera],
    cam_from_vehicle: FloatArray,
    map_from_vehicle: FloatArray,
) -> dict[str, Camera]:
    """Cameras (C) whose texture shows ``surface``, with the plane under the wheels that it implies.

    ``cam_from_vehicle`` (C, 4, 4) are their present mountings, ``map_from_vehicle`` (F, 4, 4) the poses.
    """
    out = dict(cameras)
    for (name, camera), mounting in zip(cameras.items(), cam_from_vehicle, strict=True):
        plane = camera.ground_plane
        mean = _mean_plane(surface, camera, mounting, map_from_vehicle)
        if plane is None or mean is None:
            continue
        upwards = np.array([-mean.forwards, -mean.sideways, 1.0])
        upwards /= np.linalg.norm(upwards)
        centre = camera_centre(mounting)
        lower_m = upwards @ (centre - [0.0, 0.0, mean.height_m]) - centre[2]
        shift = np.append(mounting[:3, :3] @ (upwards - [0.0, 0.0, 1.0]), lower_m)
        out[name] = replace(camera, ground_plane=replace(plane, plane_cam=plane.plane_cam - shift))
    return out


def _mean_plane(
    surface: Surface, camera: Camera, cam_from_vehicle: FloatArray, map_from_vehicle: FloatArray
) -> _MeanPlane | None:
    """The mean ground in a camera's view; None where it sees none near its path."""
    centre = camera_centre(cam_from_vehicle)[:2]
    low = camera.roi_vehicle.min(axis=0)
    high = camera.roi_vehicle.max(axis=0)
    ahead_m = np.arange(low[0], high[0] + 0.5)
    left_m = np.linspace(max(low[1], -_STRIP_M), min(high[1], _STRIP_M), 5)
    grid = np.stack(np.meshgrid(ahead_m, left_m), axis=-1).reshape(-1, 2)
    is_near = np.linalg.norm(grid - centre, axis=1) < _FAR_M
    grid = grid[is_near & inside_convex(camera.roi_vehicle, grid)]
    if len(grid) < 3:
        return None
    frames = np.unique(np.linspace(0, len(map_from_vehicle) - 1, _FRAMES).round().astype(np.int64))
    poses = map_from_vehicle[frames]
    points_map = grid @ poses[:, :2, :2].swapaxes(1, 2) + poses[:, None, :2, 3]
    above_m = surface.seen_height_m(points_map.reshape(-1, 2), np.repeat(frames, len(grid)))
    columns = np.column_stack([np.ones(len(grid)), grid])
    mean_m = above_m.reshape(len(frames), -1).mean(axis=0)
    return _MeanPlane(*np.linalg.lstsq(columns, mean_m, rcond=None)[0].tolist())
