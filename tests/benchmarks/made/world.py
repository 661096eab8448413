"""A made drive: where everything truly was, what was recorded of it, and the drive as the mapper gets it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from tests.benchmarks.made.draw import PoseErrors, Recipe
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.geometry.trajectory import interpolate
from v2hdm.io.drive.road import lay_flat
from v2hdm.records import Camera, CameraInfo, Drive, FloatArray, Image, PoseNoise, Trajectory, Truth
from v2hdm.simulate.port.build import Port, build_port
from v2hdm.simulate.port.route import correlated_noise

MAX_GAP_S = 0.5
"""As users read drives."""

_TRUE, _RECORDED = 40, 41  # streams of a seed
_GRID_M = 0.1


@dataclass(frozen=True)
class World:
    """What truly was, F times two images long, and what was recorded of it.

    Attributes:
        recipe: what was drawn.
        port: its true map, route and what hides markings.
        lenses: true ones by camera.
        taken_s: (F,) when images were truly taken.
        map_from_vehicle: (F, 4, 4) where the vehicle truly was then.
        cam_from_vehicle: (F, 4, 4) by camera, where it truly sat then.
        corners_map: (J, 4, 3) of the true markings, with their heights.
        cameras: as the user describes them.
        stamp_s: (F,) by camera, as its images are stamped.
        recorded: poses.
        pose_noise: as stated.
        elsewhere: another world, and the frames in which its images were put in place of those of this.
    """

    recipe: Recipe
    port: Port
    lenses: Mapping[str, CameraInfo]
    taken_s: FloatArray
    map_from_vehicle: FloatArray
    cam_from_vehicle: Mapping[str, FloatArray]
    corners_map: FloatArray
    cameras: Mapping[str, Camera]
    stamp_s: Mapping[str, FloatArray]
    recorded: Trajectory
    pose_noise: PoseNoise
    elsewhere: tuple[World, range] | None = field(default=None, repr=False)

    @cached_property
    def station_m(self) -> FloatArray:
        """(F,) way along the route at the images."""
        return self.port.route.station_at(self.taken_s)

    @property
    def second_half(self) -> FloatArray:
        """(F,) whether an image was taken in the second half of the way."""
        return self.station_m > self.station_m.mean()

    def frame_of(self, image: Image) -> int:
        """Which of the F frames an image of :func:`drive_of` is of."""
        return int(image.path.stem)


def make(recipe: Recipe) -> World:
    """The world of a right drive."""
    port = build_port(recipe.port)
    route, taken_s = port.route, port.driven.stamp_s
    poses_s = port.driven.recorded.stamp_s
    station = route.station_at(taken_s)
    rng = np.random.default_rng([recipe.seed, _TRUE])
    errors, level = recipe.poses, np.zeros(len(poses_s))
    sway = smooth_noise(station, errors.roll_pitch_rad, errors.roll_pitch_over_m, rng, 2)
    heave = smooth_noise(station, errors.heave_m, errors.heave_over_m, rng)[:, 0]
    true = poses_of(np.column_stack([route.points_at(station), heave]), *sway.T, route.yaw_at(station))
    points, yaw = _recorded(port, poses_s, errors, np.random.default_rng([recipe.seed, _RECORDED]))
    recorded = poses_of(np.column_stack([points, level]), level, level, yaw)
    corners = np.array([marking.corners_map for marking in port.hd_map.markings]).reshape(-1, 4, 2)
    return World(
        recipe=recipe,
        port=port,
        lenses={name: camera.info for name, camera in port.cameras.items()},
        taken_s=taken_s,
        map_from_vehicle=true,
        cam_from_vehicle={
            name: np.tile(matrix, (len(taken_s), 1, 1)) for name, matrix in port.cam_from_vehicle.items()
        },
        corners_map=np.concatenate([corners, np.zeros((*corners.shape[:2], 1))], axis=2),
        cameras=port.cameras,
        stamp_s=dict.fromkeys(port.cameras, taken_s),
        recorded=Trajectory(poses_s, recorded),
        pose_noise=PoseNoise.as_far_as_stated() if recipe.default_noise else errors.as_stated(),
    )


def _recorded(
    port: Port, stamp_s: FloatArray, errors: PoseErrors, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Points (P, 2) and headings (P,) as a receiver measures them."""
    station = port.route.station_at(stamp_s)
    off = correlated_noise(station, errors.position_drift_m, errors.position_over_m, rng, 2)
    off += rng.normal(0.0, errors.position_white_m, off.shape)
    turn = correlated_noise(station, errors.heading_drift_rad, errors.heading_over_m, rng)[:, 0]
    turn += rng.normal(0.0, errors.heading_white_rad, turn.shape)
    return port.route.points_at(station) + off, port.route.yaw_at(station) + turn


def smooth_noise(
    at_m: FloatArray, sigma: float, over_m: float, rng: np.random.Generator, columns: int = 1
) -> FloatArray:
    """A smooth stationary process (N, columns) at places (N,): its correlation is exp(-d^2 / (2 over_m^2))."""
    grid_m = np.arange(at_m.min(), at_m.max() + 2 * _GRID_M, _GRID_M)
    # A Gaussian filter of width w makes white noise a process that is correlated over sqrt(2) w.
    width = over_m / np.sqrt(2.0) / _GRID_M
    margin = int(4 * width) + 1
    white = rng.standard_normal((len(grid_m) + 2 * margin, columns))
    smooth = gaussian_filter1d(white, width, axis=0, truncate=4.0)[margin : margin + len(grid_m)]
    smooth *= sigma * np.sqrt(2.0 * np.sqrt(np.pi) * width)
    return np.column_stack([np.interp(at_m, grid_m, column) for column in smooth.T])


def poses_of(position: FloatArray, roll: FloatArray, pitch: FloatArray, yaw: FloatArray) -> FloatArray:
    """Transforms (N, 4, 4) of positions (N, 3) and angles (N,), rad."""
    poses = np.tile(np.eye(4), (len(position), 1, 1))
    poses[:, :3, :3] = rotation_from_euler(roll, pitch, yaw)
    poses[:, :3, 3] = position
    return poses


def drive_of(world: World) -> Drive:
    """The drive that a user would give to the mapping; its images do not exist."""
    laid = lay_flat(world.recorded, world.pose_noise.position_m)
    root, images, unposed = Path(world.recipe.name.replace(" ", "_")), [], {}
    for name in world.cameras:
        stamp_s = world.stamp_s[name]
        poses, inside = interpolate(laid.trajectory, stamp_s, MAX_GAP_S)
        unposed[name] = int((~inside).sum())
        images += [
            Image(name, float(stamp_s[f]), root / name / f"{f:06d}.jpg", poses[f])
            for f in np.flatnonzero(inside).tolist()
        ]
    return Drive(
        name=world.recipe.name,
        root=root,
        cameras=world.cameras,
        images=tuple(sorted(images, key=lambda image: (image.stamp_s, image.camera))),
        pose_noise=world.pose_noise,
        unposed=unposed,
        trajectory=laid.trajectory,
        recorded=world.recorded,
        road=laid.road,
    )


def truth_of(world: World, drive: Drive, visibility: FloatArray) -> Truth:
    """The truth of a drive, given the share of each marking (I, J) that each of its images shows."""
    frames = [world.frame_of(image) for image in drive.images]
    return Truth(
        map=world.port.hd_map,
        cam_from_vehicle={name: own[0] for name, own in world.cam_from_vehicle.items()},
        map_from_vehicle=world.map_from_vehicle[frames],
        visibility=visibility,
        lane_visible=tuple(np.zeros(len(lane.points_map), dtype=bool) for lane in world.port.hd_map.lanes),
        disturbances={},
    )
