"""Short drives past three dashes and the running boards of parked cars, whose bare ground has been measured.

A running board looks like a dash in some images, and stands 35 cm above the ground. On so short a way they
turn a camera, unless its bare ground holds it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tests.benchmarks.made.detect import _detection, detect, project
from tests.benchmarks.made.draw import Recipe
from tests.benchmarks.made.world import World, drive_of, make, truth_of
from v2hdm.geometry.ground_plane import plane_in
from v2hdm.geometry.rigid import exp
from v2hdm.ground.planes import plane_of
from v2hdm.records import (
    LANE_DASH,
    Calibration,
    Camera,
    Drive,
    FloatArray,
    ImageDetections,
    MarkingDetection,
    Truth,
)

CAMERA = "front"
_WAY_M = 22.0  # length of the drive
_DASHES = 3  # number of dashes
_FIRST_M = 6.0  # least distance ahead of the start of a dash
_BOARD_M = np.array([[1.8, 0.12], [0.0, 0.12], [0.0, 0.0], [1.8, 0.0]])  # ahead and to the right
_ABOVE_M = 0.35  # height of the boards
_BESIDE_M = 3.0  # distance of the boards to the right of the path
_PLACES_M = (9.0, 16.0)  # of the boards along the way
_SEEN_M = (5.0, 12.0)  # distances ahead at which they look like dashes
_TILT_RAD = np.deg2rad(0.13)  # sigma of the measured ground's roll and pitch, as on PandaSet 002
_HEIGHT_M = 0.007  # the same of its height, beside what plane_of adds
_HEIGHT_SHARE = 0.015  # true sigma of its height, relative to it
_GROUND, _BOARDS = 51, 52  # streams of a seed


class ShortDrive(NamedTuple):
    """A short drive with one camera, what is found in its images, and what is true."""

    drive: Drive
    found: list[ImageDetections]
    truth: Truth


def make_short(recipe: Recipe) -> ShortDrive:
    """The first metres of a made drive past dashes and boards, its ground measured as well as is stated."""
    world = _with_few(make(recipe))
    whole = drive_of(world)
    station_m = world.station_m - world.station_m[0]
    images = [
        image
        for image in whole.images
        if image.camera == CAMERA and station_m[world.frame_of(image)] <= _WAY_M
    ]
    cameras = {CAMERA: replace(world.cameras[CAMERA], ground_plane=None)}
    drive = replace(whole, images=tuple(images), cameras=cameras, unposed={CAMERA: 0})
    drive = replace(drive, cameras={CAMERA: _measured(world, drive.cameras[CAMERA])})
    detections, visibility = detect(world, drive)
    boards_map = _boards(world)
    with_boards = [
        replace(in_image, markings=(*in_image.markings, *_seen(world, drive, in_image, boards_map)))
        for in_image in detections
    ]
    return ShortDrive(drive, with_boards, truth_of(world, drive, visibility))


def _with_few(world: World) -> World:
    """The world with the first dashes of the way, and nothing else painted."""
    start = world.map_from_vehicle[0]
    ahead_m = (world.corners_map.mean(axis=1) - start[:3, 3]) @ start[:3, 0]
    painted = world.port.hd_map.markings
    is_dash = np.array([marking.kind == LANE_DASH for marking in painted])
    dashes = np.flatnonzero(is_dash & (ahead_m > _FIRST_M))
    chosen = dashes[np.argsort(ahead_m[dashes])][:_DASHES]
    hd_map = replace(world.port.hd_map, markings=tuple(painted[k] for k in chosen.tolist()))
    port = replace(world.port, hd_map=hd_map)
    return replace(world, port=port, corners_map=world.corners_map[chosen])


def _measured(world: World, camera: Camera) -> Camera:
    """The camera with the plane that its bare ground shows, of errors as they are stated."""
    rng = np.random.default_rng([world.recipe.seed, _GROUND])
    mounting = world.cam_from_vehicle[CAMERA][0]
    tangent = np.zeros(6)
    tangent[3:] = rng.normal(0.0, _TILT_RAD, 3)
    tilted = exp(tangent) @ mounting
    sigma_m = np.hypot(_HEIGHT_M, _HEIGHT_SHARE * plane_in(mounting)[3])
    tilted[:3, 3] += tilted[:3, 2] * rng.normal(0.0, sigma_m)
    covariance = np.diag([_HEIGHT_M**2] * 3 + [_TILT_RAD**2] * 3)
    plane = plane_of(Calibration(camera.info, tilted, covariance), np.zeros((2, 6)))
    return replace(camera, ground_plane=plane)


def _boards(world: World) -> FloatArray:
    """The corners (B, 4, 3) of the running boards."""
    start = world.map_from_vehicle[0]
    boards = []
    for ahead_m in _PLACES_M:
        ahead, right = _BOARD_M.T
        corners = np.column_stack([ahead_m + ahead, -_BESIDE_M - right, np.full(4, _ABOVE_M), np.ones(4)])
        boards.append((corners @ start.T)[:, :3])
    return np.array(boards)


def _seen(
    world: World, drive: Drive, in_image: ImageDetections, boards_map: FloatArray
) -> list[MarkingDetection]:
    """The boards that one image takes for dashes."""
    image = drive.images[in_image.image]
    frame = world.frame_of(image)
    lens = world.lenses[CAMERA]
    rng = np.random.default_rng([world.recipe.seed, _BOARDS, frame])
    pose = world.cam_from_vehicle[CAMERA][frame] @ np.linalg.inv(world.map_from_vehicle[frame])
    projected = project(lens, pose, boards_map)
    sigma_px = 2 * world.recipe.detector.sigma_px
    covariance = np.tile(sigma_px**2 * np.eye(2), (4, 1, 1))
    nearest_m, far = _SEEN_M
    out = []
    for px, is_inside, distance_m in zip(projected.px, projected.inside, projected.distance_m, strict=True):
        if is_inside.all() and nearest_m < distance_m.min() and distance_m.max() < far:
            noisy_px = px + rng.normal(0.0, sigma_px, (4, 2))
            out.append(_detection(LANE_DASH, noisy_px, covariance, is_inside, lens))
    return out
