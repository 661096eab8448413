"""A made drive: where everything truly was, what was recorded of it, and the drive as the mapper gets it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from tests.benchmarks.made.draw import Recipe
from v2hdm.geometry.rigid import exp, interpolate, rotation_from_euler
from v2hdm.geometry.twists import vehicle_twists
from v2hdm.io.drive.road import lay_flat
from v2hdm.records import (
    Camera,
    CameraInfo,
    Drive,
    FloatArray,
    Image,
    PoseNoise,
    Trajectory,
    Truth,
    unstated_clock_drift_s,
)
from v2hdm.simulate.port.build import Port, build_port
from v2hdm.simulate.port.route import Route, correlated_noise

MAX_GAP_S = 0.5
"""As users read drives."""

WHEELBASE_M, HALF_TRACK_M = 2.8, 0.8
"""Dimensions of the vehicle, whose origin is under the rear axle."""

_TRUE, _RECORDED, _ROAD = 40, 41, 43  # streams of a seed
_GRID_M = 0.1


@dataclass(frozen=True)
class World:
    """The true world, F times two images long, and the recording of it.

    Attributes:
        recipe: what was drawn.
        port: its true map, route and what hides markings.
        lenses: true ones by camera.
        taken_s: (F,) when images were truly taken.
        map_from_vehicle: (F, 4, 4) where the vehicle truly was then.
        cam_from_vehicle: (F, 4, 4) by camera, where it truly sat then.
        corners_map: (J, 4, 3) of the true markings, with their heights.
        cameras: as the user describes them.
        stamp_s: (F,) by camera, as its images are stamped; nan where it took none.
        recorded: poses.
        pose_noise: as stated.
        read_out_s: time from the first row of every image to its last.
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
    read_out_s: float = 0.0
    elsewhere: tuple[World, range] | None = field(default=None, repr=False)

    @cached_property
    def station_m(self) -> FloatArray:
        """(F,) way along the route at the images."""
        return self.port.route.station_at(self.taken_s)

    @property
    def second_half(self) -> FloatArray:
        """(F,) whether an image was taken in the second half of the way."""
        return self.station_m > self.station_m.mean()

    @cached_property
    def twist_vehicle(self) -> FloatArray:
        """(F, 6) how the vehicle truly moves at the images, m/s and rad/s."""
        return vehicle_twists(self.map_from_vehicle, self.taken_s)

    def rolling(self, read_out_s: float, stated: bool) -> World:
        """The same, recorded by rolling shutters, of which the user knows or not."""
        cameras = {
            name: replace(camera, read_out_s=read_out_s * stated) for name, camera in self.cameras.items()
        }
        return replace(self, read_out_s=read_out_s, cameras=cameras)

    def cam_from_map(self, camera: str, frame: int, row_share: FloatArray) -> FloatArray:
        """True poses (N, 4, 4) of a camera when rows of an image, -1/2 to 1/2 (N,), were read."""
        moved = exp(self.twist_vehicle[frame] * self.read_out_s * row_share[:, None])
        vehicle_from_map = np.linalg.inv(self.map_from_vehicle[frame] @ moved)
        return np.asarray(self.cam_from_vehicle[camera][frame] @ vehicle_from_map)

    def frame_of(self, image: Image) -> int:
        """Which of the F frames an image of :func:`drive_of` is of."""
        return int(image.path.stem)


def make(recipe: Recipe) -> World:
    """The world of a right drive."""
    port = build_port(recipe.port)
    poses_s = port.driven.recorded.stamp_s
    taken_s = port.driven.stamp_s
    stamp_s = dict.fromkeys(port.cameras, taken_s)
    if recipe.apart_s:
        own_s = [taken_s + turn * recipe.apart_s for turn in range(len(port.cameras))]
        own_s = [times_s[times_s < poses_s[-1]] for times_s in own_s]
        taken_s = np.sort(np.concatenate(own_s))
        stamp_s = {
            name: np.where(np.isin(taken_s, times_s), taken_s, np.nan)
            for name, times_s in zip(port.cameras, own_s, strict=True)
        }
        port = replace(port, driven=replace(port.driven, stamp_s=taken_s))
    route = port.route
    ground = Ground.of(recipe, port)
    true = _driven(recipe, port, ground, np.concatenate([taken_s, poses_s]))
    corners = np.array([marking.corners_map for marking in port.hd_map.markings]).reshape(-1, 4, 2)
    height_m = ground.height_at(*beside(route, corners.reshape(-1, 2))).reshape(-1, 4, 1)
    return World(
        recipe=recipe,
        port=port,
        lenses={name: camera.info for name, camera in port.cameras.items()},
        taken_s=taken_s,
        map_from_vehicle=true[: len(taken_s)],
        cam_from_vehicle={
            name: np.tile(matrix, (len(taken_s), 1, 1)) for name, matrix in port.cam_from_vehicle.items()
        },
        corners_map=np.concatenate([corners, height_m], axis=2),
        cameras=port.cameras,
        stamp_s=stamp_s,
        recorded=Trajectory(poses_s, _recorded(recipe, port, poses_s, true[len(taken_s) :])),
        pose_noise=recipe.pose_noise,
    )


@dataclass(frozen=True)
class Ground:
    """The ground along the route: ``height_m``, ``grade``, ``fall`` (N,) to the right, at ``station_m``."""

    station_m: FloatArray
    height_m: FloatArray
    grade: FloatArray
    fall: FloatArray

    @classmethod
    def of(cls, recipe: Recipe, port: Port) -> Ground:
        """Level where no shape of the road was drawn."""
        station = port.route.station_m
        level = np.zeros(len(station))
        if recipe.road is None:
            return cls(station, level, level, level)
        rng = np.random.default_rng([recipe.seed, _ROAD])
        grade, fall = smooth_noise(station, recipe.road.slope, recipe.road.slope_over_m, rng, 2).T
        share = (station - station[0]) / (station[-1] - station[0])
        if recipe.relief == "grade":
            grade = grade + 0.05
        elif recipe.relief == "ramp":  # up by 6 % and leaning by 5 %, over 12 m each way, in the middle
            edge_m = 12.0 / (station[-1] - station[0])
            up = np.clip(np.minimum(share - 0.3, 0.7 - share) / edge_m, 0.0, 1.0)
            up = up * up * (3 - 2 * up)
            grade, fall = grade + 0.06 * up, fall + 0.05 * up
        elif recipe.relief == "crest":  # of 300 m radius and then a dip, each 20 m long
            wave = 2 * np.pi * (station - station[0]) / 40.0
            grade = grade + (20.0 / np.pi / 300.0) * np.sin(wave)
        rise = 0.5 * (grade[1:] + grade[:-1]) * np.diff(station)
        return cls(station, np.concatenate([[0.0], np.cumsum(rise)]), grade, fall)

    def height_at(self, station_m: FloatArray, left_m: FloatArray) -> FloatArray:
        """Height (K,) at stations, ``left_m`` (K,) to the left of the route."""
        height, fall = (
            np.interp(station_m, self.station_m, profile) for profile in (self.height_m, self.fall)
        )
        return np.asarray(height + fall * left_m)


def beside(route: Route, points_map: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Stations (K,) of the route nearest to points (K, 2), and how far (K,) these lie to the left of it."""
    _, nearest = cKDTree(route.points_map).query(points_map)
    off, yaw = points_map - route.points_map[nearest], route.yaw_rad[nearest]
    return route.station_m[nearest], off[:, 1] * np.cos(yaw) - off[:, 0] * np.sin(yaw)


def _driven(recipe: Recipe, port: Port, ground: Ground, stamp_s: FloatArray) -> FloatArray:
    """Where the vehicle (N, 4, 4) truly was at times (N,)."""
    errors, station = recipe.poses, port.route.station_at(stamp_s)
    rng = np.random.default_rng([recipe.seed, _TRUE])
    noise = smooth_noise if errors.smooth else _rough_noise
    sway = noise(station, errors.roll_pitch_rad, errors.roll_pitch_over_m, rng, 2)
    heave = noise(station, errors.heave_m, errors.heave_over_m, rng, 1)[:, 0]
    sides = HALF_TRACK_M * np.array([[1.0], [-1.0]])
    rear, front = (ground.height_at(station + ahead_m, sides) for ahead_m in (0.0, WHEELBASE_M))
    grade = (front - rear).mean(axis=0) / WHEELBASE_M
    fall = (rear + front)[0] / (4 * HALF_TRACK_M) - (rear + front)[1] / (4 * HALF_TRACK_M)
    position = np.column_stack([port.route.points_at(station), rear.mean(axis=0) + heave])
    return poses_of(
        position, np.arctan(fall) + sway[:, 0], sway[:, 1] - np.arctan(grade), port.route.yaw_at(station)
    )


def _recorded(recipe: Recipe, port: Port, stamp_s: FloatArray, true: FloatArray) -> FloatArray:
    """Poses (P, 4, 4) as a receiver measures the ``true`` ones, at times (P,)."""
    errors, station = recipe.poses, port.route.station_at(stamp_s)
    rng = np.random.default_rng([recipe.seed, _RECORDED])
    off = correlated_noise(station, errors.position_drift_m, errors.position_over_m, rng, 2)
    off += rng.normal(0.0, errors.position_white_m, off.shape)
    yaw = port.route.yaw_at(station)
    yaw += correlated_noise(station, errors.heading_drift_rad, errors.heading_over_m, rng)[:, 0]
    yaw += rng.normal(0.0, errors.heading_white_rad, yaw.shape)
    height_m, tilt = np.zeros(len(stamp_s)), np.zeros((len(stamp_s), 2))
    road = recipe.road
    if road is not None:
        height_m = (
            true[:, 2, 3] + correlated_noise(station, road.height_drift_m, errors.position_over_m, rng)[:, 0]
        )
        pitch, roll = -np.arcsin(true[:, 2, 0]), np.arctan2(true[:, 2, 1], true[:, 2, 2])
        tilt = np.column_stack([roll, pitch]) + road.mount_rad
        tilt += correlated_noise(station, errors.roll_pitch_rad, errors.roll_pitch_over_m, rng, 2)
    points = port.route.points_at(station) + off
    return poses_of(np.column_stack([points, height_m]), *tilt.T, yaw)


def smooth_noise(
    at_m: FloatArray, sigma: float, over_m: float, rng: np.random.Generator, columns: int = 1
) -> FloatArray:
    """A smooth stationary process (N, columns) at places (N,), correlated by exp(-d^2 / (2 over_m^2))."""
    grid_m = np.arange(at_m.min(), at_m.max() + 2 * _GRID_M, _GRID_M)
    # A Gaussian filter of width w makes white noise a process that is correlated over sqrt(2) w.
    width = over_m / np.sqrt(2.0) / _GRID_M
    margin = int(4 * width) + 1
    white = rng.standard_normal((len(grid_m) + 2 * margin, columns))
    smooth = gaussian_filter1d(white, width, axis=0, truncate=4.0)[margin : margin + len(grid_m)]
    smooth *= sigma * np.sqrt(2.0 * np.sqrt(np.pi) * width)
    return np.column_stack([np.interp(at_m, grid_m, column) for column in smooth.T])


def _rough_noise(
    at_m: FloatArray, sigma: float, over_m: float, rng: np.random.Generator, columns: int
) -> FloatArray:
    """A Gauss-Markov process (N, columns) at places (N,) in any order."""
    order, out = np.argsort(at_m), np.empty((len(at_m), columns))
    out[order] = correlated_noise(at_m[order], sigma, over_m, rng, columns)
    return out


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
        frames = np.flatnonzero(np.isfinite(stamp_s))
        poses, inside = interpolate(laid.trajectory, stamp_s[frames], MAX_GAP_S)
        unposed[name] = int((~inside).sum())
        images += [
            Image(name, float(stamp_s[frame]), root / name / f"{frame:06d}.jpg", pose)
            for frame, pose in zip(frames[inside].tolist(), poses[inside], strict=True)
        ]
    return Drive(
        name=world.recipe.name,
        root=root,
        cameras=world.cameras,
        images=tuple(sorted(images, key=lambda image: (image.stamp_s, image.camera))),
        pose_noise=_noise_as_read(world),
        unposed=unposed,
        trajectory=laid.trajectory,
        recorded=world.recorded,
        road=laid.road,
    )


def _noise_as_read(world: World) -> PoseNoise:
    """The stated noise, with the drift of unstated clocks as the stamps show it."""
    if world.recipe.clock_s is not None:
        return world.pose_noise
    stamp_s = [stamps[np.isfinite(stamps)] for stamps in world.stamp_s.values()]
    return replace(world.pose_noise, clock_drift_s=unstated_clock_drift_s(stamp_s))


def truth_of(world: World, drive: Drive, visibility: FloatArray) -> Truth:
    """The truth of a drive, given the share of each marking (I, J) that each of its images shows."""
    frames = [world.frame_of(image) for image in drive.images]
    return Truth(
        map=world.port.hd_map,
        cam_from_vehicle={name: poses[0] for name, poses in world.cam_from_vehicle.items()},
        map_from_vehicle=world.map_from_vehicle[frames],
        visibility=visibility,
        lane_visible=tuple(np.zeros(len(lane.points_map), dtype=bool) for lane in world.port.hd_map.lanes),
        disturbances={},
    )
