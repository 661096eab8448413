"""Sightings and symbols on the ground under a rig, with covariances, and the images that show a marking."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from v2hdm.association.sightings import LEAST_HEIGHT_M, Rig, Sightings, Symbols, frames_of
from v2hdm.geometry.ipm import apply_homography, flat_motion, ground_from_pinhole_px, project_ground
from v2hdm.geometry.planar import cross, inside_convex
from v2hdm.geometry.rigid import camera_centre
from v2hdm.geometry.tensors import back_project, back_project_with_jacobian
from v2hdm.records import BOX, OUTLINE_SIGMA_PX, BoolArray, Camera, Drive, FloatArray, IntArray

_HORIZON_M2 = 1e4  # smaller variance of a ground point, m^2, from which it counts as on the horizon

_RUN_ON_M = 1.0  # length, m, beyond a dash without paint: gaps are at least as long as dashes
_SURE_M = 0.2  # largest sigma, m, of a point that identifies its line
_LONG = 2.0  # least ratio of length to width of a marking that may be a piece of a line
_PARALLEL = 0.9  # least cosine between such a marking and the line that continues it

BORDER_PX = 10.0  # width of the image's border, px, within which a marking may be cut


@dataclass(frozen=True)
class Located:
    """Ground positions of S sightings."""

    corners_map: FloatArray  # (S, 4, 2) m
    covariance_m2: FloatArray  # (S, 4, 2, 2) from the pixel noise alone
    ray_map: FloatArray  # (S, 4, 2) from the camera's nadir to the corner
    height_m: FloatArray  # (S,) of the camera
    valid: BoolArray  # (S, 4) corners that are points and meet the ground
    informs: BoolArray  # (S, 4) corners with information, see ``Sightings.informs``

    @property
    def range_m(self) -> FloatArray:
        """Horizontal distance (S, 4) of each corner from its camera."""
        return np.asarray(np.linalg.norm(self.ray_map, axis=-1))

    @property
    def depression_sine(self) -> FloatArray:
        """Sine (S, 4) of the angle of each corner's ray below the horizontal; nan above the horizon."""
        height_m = self.height_m[:, None]
        return np.asarray(height_m / np.hypot(self.range_m, height_m))


def ground_points(map_from_pinhole_px: FloatArray, pinhole_px: FloatArray) -> FloatArray:
    """Ground points (N, K, 2), m, of pixels (N, K, 2) under IPMs (N, 3, 3); nan on and above the horizon."""
    return np.asarray(back_project(torch.tensor(map_from_pinhole_px), torch.tensor(pinhole_px)).numpy())


def ground_points_with_jacobian(
    map_from_pinhole_px: FloatArray, pinhole_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """:func:`ground_points` and their Jacobians (N, K, 2, 2), m/px, by the pixels; nan together."""
    points, jacobian = back_project_with_jacobian(torch.tensor(map_from_pinhole_px), torch.tensor(pinhole_px))
    return points.numpy(), jacobian.numpy()


def _on_ground(
    rig: Rig, camera: IntArray, frame: IntArray, pinhole_px: FloatArray, row_share: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """:func:`ground_points_with_jacobian` of pixels (N, K, 2), each under the pose at its row's read-out."""
    if rig.read_out_s is None:
        # Each image holds dozens of sightings.
        frames = len(rig.map_from_vehicle)
        images, image = np.unique(camera * frames + frame, return_inverse=True)
        camera, frame = np.divmod(images, frames)
        ipms = ground_from_pinhole_px(rig.intrinsic[camera], rig.cam_from_map(camera, frame))
        return ground_points_with_jacobian(ipms[image], pinhole_px)
    camera, frame = (np.broadcast_to(index[:, None], row_share.shape).ravel() for index in (camera, frame))
    cam_from_map = rig.cam_from_map(camera, frame, row_share.ravel())
    ipms = ground_from_pinhole_px(rig.intrinsic[camera], cam_from_map)
    points, jacobian = ground_points_with_jacobian(ipms, pinhole_px.reshape(-1, 1, 2))
    return points.reshape(pinhole_px.shape), jacobian.reshape((*pinhole_px.shape, 2))


def locate(sightings: Sightings, rig: Rig) -> Located:
    """Back-project every corner of ``sightings`` to z = 0 of the map under ``rig``."""
    camera = sightings.camera
    frame = sightings.frame
    corners_map, jacobian = _on_ground(rig, camera, frame, sightings.corners_pinhole_px, sightings.row_share)
    covariance = jacobian @ sightings.covariance_px @ np.swapaxes(jacobian, -1, -2)
    centre_vehicle = camera_centre(rig.cam_from_vehicle)[camera]
    poses = rig.map_from_vehicle[frame]
    centre_map = (poses[:, :3, :3] @ centre_vehicle[..., None])[..., 0] + poses[:, :3, 3]
    finite = np.asarray(np.isfinite(corners_map).all(axis=-1) & np.isfinite(covariance).all(axis=(-1, -2)))
    informs = sightings.informs & finite & (_least_variance(covariance) < _HORIZON_M2)
    return Located(
        corners_map=corners_map,
        covariance_m2=covariance,
        ray_map=corners_map - centre_map[:, None, :2],
        height_m=np.maximum(centre_map[:, 2], LEAST_HEIGHT_M),
        valid=sightings.valid & informs,
        informs=informs,
    )


def _least_variance(covariance: FloatArray) -> FloatArray:
    """Smaller eigenvalues (...) of covariances (..., 2, 2)."""
    of_x = covariance[..., 0, 0]
    of_y = covariance[..., 1, 1]
    return np.asarray((of_x + of_y) / 2 - np.hypot((of_x - of_y) / 2, covariance[..., 0, 1]))


def images_with_symbol(symbols: Symbols, rig: Rig, corners_map: FloatArray) -> IntArray:
    """Number (G,) of images in which a symbol covers most of the middle line of quadrilaterals (G, 4, 2).

    The visible shaft of an arrow looks like a dash in some images; others show the whole arrow.
    """
    count = np.zeros(len(corners_map), dtype=np.int64)
    complete = np.flatnonzero(np.isfinite(corners_map).all(axis=(1, 2)))
    centre = corners_map.mean(axis=1)
    way = _middle_lines(corners_map).way
    points = centre[:, None] + np.linspace(-0.4, 0.4, 5)[:, None] * way[:, None]
    for ground, kind in zip(outlines_on_ground(symbols, rig), symbols.kinds, strict=True):
        if ground is None or kind == BOX:  # which may hold other markings
            continue
        middle = ground.mean(axis=0)
        size_m = float(np.ptp(ground, axis=0).max())
        polygon = (ground - middle).astype(np.float32)
        for group in complete[np.linalg.norm(centre[complete] - middle, axis=1) < size_m]:
            offsets_m = (points[group] - middle).tolist()
            inside = [cv2.pointPolygonTest(polygon, offset_m, False) >= 0 for offset_m in offsets_m]
            count[group] += 2 * sum(inside) > len(inside)
    return count


def images_with_line(lines: Symbols, rig: Rig, corners_map: FloatArray) -> IntArray:
    """Number (G,) of images with a solid line within a metre of an end of long quadrilaterals (G, 4, 2).

    The worn start of such a line looks like a dash.
    """
    pieces = _pieces_on_ground(lines, rig)
    if not pieces:
        return np.zeros(len(corners_map), dtype=np.int64)
    points = np.concatenate([piece for piece, _ in pieces])
    sigma_m = np.concatenate([sigma_of_piece_m for _, sigma_of_piece_m in pieces])
    course = np.concatenate([np.gradient(piece, axis=0) for piece, _ in pieces])
    course /= np.maximum(np.linalg.norm(course, axis=1, keepdims=True), 1e-9)
    image = lines.frame * len(rig.intrinsic) + lines.camera
    image = np.repeat(image, [len(piece) for piece, _ in pieces])
    sure = sigma_m < _SURE_M
    points = points[sure]
    course = course[sure]
    image = image[sure]
    centre = corners_map.mean(axis=1)
    way, breadth_m = _middle_lines(corners_map)
    long_m = np.linalg.norm(way, axis=1)
    long = np.flatnonzero(np.isfinite(long_m) & (long_m > _LONG * breadth_m))
    in_reach = cKDTree(points).query_ball_point(centre[long], long_m[long] / 2 + _RUN_ON_M)
    group = np.repeat(long, [len(points_in_reach) for points_in_reach in in_reach])
    point = np.array(list(chain.from_iterable(in_reach)), dtype=np.int64)
    ahead = way[group] / long_m[group, None]
    off = points[point] - centre[group]
    goes_on = np.abs(np.sum(off * ahead, axis=1)) > (long_m + breadth_m)[group] / 2
    goes_on &= np.abs(cross(ahead, off)) < breadth_m[group]
    goes_on &= np.abs(np.sum(course[point] * ahead, axis=1)) > _PARALLEL
    image_of_marking = np.unique(np.stack([group, image[point]])[:, goes_on], axis=1)
    return np.bincount(image_of_marking[0], minlength=len(corners_map))


class _MiddleLines(NamedTuple):
    """The longer middle lines of G quadrilaterals, through their centres."""

    way: FloatArray  # (G, 2) m, from one end to the other
    breadth_m: FloatArray  # (G,) length of the other middle line


def _middle_lines(corners_map: FloatArray) -> _MiddleLines:
    """The middle lines of quadrilaterals (G, 4, 2)."""
    sides = (corners_map + np.roll(corners_map, -1, axis=1)) / 2
    across = sides[:, 2:] - sides[:, :2]
    length_m = np.linalg.norm(across, axis=2)
    way = across[np.arange(len(across)), np.argmax(length_m, axis=1)]
    return _MiddleLines(way, length_m.min(axis=1))


def outlines_on_ground(symbols: Symbols, rig: Rig) -> list[FloatArray | None]:
    """Outline (K, 2) of each symbol in the map, None if too uncertain for the symbol's length."""
    return [
        outline if np.isfinite(outline).all() and 2 * sigma_m.max() < np.ptp(outline, axis=0).max() else None
        for outline, sigma_m in _pieces_on_ground(symbols, rig)
    ]


def _pieces_on_ground(symbols: Symbols, rig: Rig) -> list[tuple[FloatArray, FloatArray]]:
    """Outline (K, 2) of each symbol in the map, and standard deviations (K,) of its points, m."""
    if not len(symbols.camera):
        return []
    of_point = symbols.symbol_of_point
    points_px = np.concatenate(symbols.outlines_pinhole_px)
    row_share = np.concatenate(symbols.row_shares)
    ground, by_px = _on_ground(
        rig, symbols.camera[of_point], symbols.frame[of_point], points_px[:, None], row_share[:, None]
    )
    sigma_m = OUTLINE_SIGMA_PX * np.linalg.norm(by_px[:, 0], axis=(1, 2))
    return list(zip(symbols.by_symbol(ground[:, 0]), symbols.by_symbol(sigma_m), strict=True))


@dataclass(frozen=True)
class Views:
    """Images of the mapped cameras: ``image``, ``camera`` and ``frame``, (V,) each."""

    image: IntArray
    camera: IntArray
    frame: IntArray


def views_of(drive: Drive, cameras: Sequence[str]) -> Views:
    """All images of ``cameras``, with or without detections."""
    index = {name: c for c, name in enumerate(cameras)}
    rows = [i for i, image in enumerate(drive.images) if image.camera in index]
    return Views(
        image=np.array(rows, dtype=np.int64),
        camera=np.array([index[drive.images[i].camera] for i in rows], dtype=np.int64),
        frame=frames_of(drive).frame_of_image[rows],
    )


def easy_views(
    views: Views, rig: Rig, cameras: Sequence[Camera], corners_map: FloatArray, within_m: float | None = None
) -> tuple[IntArray, IntArray]:
    """Pairs (group, image) with a whole marking (G, 4, 2) inside the region of interest and the image.

    ``within_m``, a distance from the camera, replaces the region of interest of ``cameras``, which are the
    rig's.
    """
    whole = np.flatnonzero(np.isfinite(corners_map).all(axis=(1, 2)))
    groups = []
    images = []
    for c, camera in enumerate(cameras):
        is_of_camera = views.camera == c
        if not is_of_camera.any() or not len(whole):
            continue
        centre = camera_centre(rig.cam_from_vehicle[c])[:2]
        reach_m = float(np.max(np.linalg.norm(camera.roi_vehicle, axis=1)))
        if within_m is not None:
            reach_m = within_m + float(np.linalg.norm(centre))
        positions = rig.map_from_vehicle[views.frame[is_of_camera]][:, :2, 3]
        views_of_marking = cKDTree(positions).query_ball_point(corners_map[whole].mean(axis=1), reach_m)
        group = np.repeat(whole, [len(views_in_reach) for views_in_reach in views_of_marking])
        view_of_camera = np.array(list(chain.from_iterable(views_of_marking)), dtype=np.int64)
        view = np.flatnonzero(is_of_camera)[view_of_camera]
        vehicle_from_map = rig.vehicle_from_map[views.frame[view]]
        cam_from_vehicle = rig.cam_from_vehicle[c]
        corners = corners_map[group]
        corners_vehicle = apply_homography(flat_motion(vehicle_from_map), corners)
        if within_m is None:
            is_in_view = inside_convex(camera.roi_vehicle, corners_vehicle).all(axis=1)
        else:
            is_in_view = (np.linalg.norm(corners_vehicle - centre, axis=2) <= within_m).all(axis=1)
        pixel, depth = project_ground(camera.info.intrinsic, cam_from_vehicle @ vehicle_from_map, corners)
        limit = np.array([camera.info.width, camera.info.height]) - BORDER_PX
        with np.errstate(invalid="ignore"):
            is_in_view &= ((pixel > BORDER_PX) & (pixel < limit)).all(axis=(1, 2)) & (depth > 0).all(axis=1)
        groups.append(group[is_in_view])
        images.append(views.image[view[is_in_view]])
    empty = [np.zeros(0, dtype=np.int64)]
    return np.concatenate(groups or empty), np.concatenate(images or empty)
