"""A live drive made without pictures: a map with its errors, another day's drive, and what it measures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from omegaconf import OmegaConf

from tests.benchmarks.made.detect import _in_image
from tests.benchmarks.made.draw import Recipe, draw, draw_detector_errors
from tests.benchmarks.made.lines import mapped_line, pieces_in_image
from tests.benchmarks.made.world import World, make, poses_of, smooth_noise
from v2hdm.cli.compose import conf_dir
from v2hdm.geometry.rigid import exp
from v2hdm.localization.motion import Motion
from v2hdm.localization.seeing import Look
from v2hdm.records import Calibration, CameraInfo, FloatArray, HDMap, Lane, Marking
from v2hdm.simulate.port.config import PortConfig

RATE_HZ = 10.0
ODOMETRY_HZ = 50.0

_MAP, _DRIVE, _MOVED, _LINES = 71, 72, 73, 74  # streams of a seed
_DRIFT_M, _RELATIVE_M, _CORNER_M = (
    0.008,
    0.004,
    0.004,
)  # sigma of a map's errors: shared, of a centre, of a corner
_DRIFT_OVER_M = 30.0
_KNOT = 8  # vertices of a lane between those at which the drift is drawn
_MOUNT_M, _MOUNT_RAD = 0.005, np.deg2rad(0.03)  # sigma of a calibration's errors
_SCALE, _BIAS_RAD_S = 0.01, np.deg2rad(0.01)  # sigma of an odometry's errors
_SPEED_M_SQRT_S, _YAW_RAD_SQRT_S = 0.01, 2e-4  # and their noise
_ASIDE_M, _ASIDE_OVER_M = 0.3, 12.0  # how far from its route the vehicle drives, and over which way


@dataclass(frozen=True)
class LiveDrive:
    """A drive of F moments: the truth, and what the localiser gets of it."""

    world: World
    hd_map: HDMap
    calibrations: dict[str, Calibration]
    stamp_s: FloatArray  # (F,)
    map_from_vehicle: FloatArray  # (F, 4, 4)
    looks: list[list[Look]]  # of each moment
    motion: list[list[Motion]]  # up to each moment
    shift_map: FloatArray  # (2,) of the map's frame against the truth's: its mean error, which nobody can see


def port_recipe(name: str, seed: int) -> Recipe:
    """A recipe on a whole shipped port, with its own layout."""
    recipe = draw(seed, "straight")
    return replace(recipe, port=port_config(name), road=None, relief="", apart_s=0.0)


def port_config(name: str) -> PortConfig:
    """The configuration of a shipped port."""
    shipped = OmegaConf.load(conf_dir() / "run" / f"{name}.yaml").simulate
    port = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(PortConfig), shipped))
    assert isinstance(port, PortConfig)
    return port


def surveyed(true: HDMap, heights_m: FloatArray, seed: int) -> HDMap:
    """A true map, with corners at heights (J, 4), with errors as a drive's map has and states them."""
    rng = np.random.default_rng([seed, _MAP])
    corners = np.array([marking.corners_map for marking in true.markings])
    centres = corners.mean(axis=1)
    apart_m = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    kernel = np.exp(-apart_m / _DRIFT_OVER_M) + 1e-9 * np.eye(len(centres))
    drift = _DRIFT_M * np.linalg.cholesky(kernel) @ rng.standard_normal((len(centres), 2))
    off = drift + _RELATIVE_M * rng.standard_normal(centres.shape)
    corners = corners + off[:, None] + _CORNER_M * rng.standard_normal(corners.shape)
    shared = (_DRIFT_M**2 + _RELATIVE_M**2) * np.tile(np.eye(2), (4, 4)) + _CORNER_M**2 * np.eye(8)
    relative_m = float(np.hypot(_RELATIVE_M, _CORNER_M / 2))
    markings = tuple(
        Marking(marking.kind, corners[j], 20, shared, relative_m, heights_m[j], id=j + 1)
        for j, marking in enumerate(true.markings)
    )
    lanes = _mapped_lanes(true, centres, drift, seed)
    return HDMap(markings, lanes, true.origin, drift_over_m=_DRIFT_OVER_M)


def _mapped_lanes(true: HDMap, centres: FloatArray, drift_map: FloatArray, seed: int) -> tuple[Lane, ...]:
    """The lanes of a true map with the drift (J, 2) that it has at ``centres`` (J, 2), and their errors."""
    rng = np.random.default_rng([seed, _LINES])
    knots = np.concatenate([lane.points_map[::_KNOT] for lane in true.lanes])

    def alike(first: FloatArray, second: FloatArray) -> FloatArray:
        apart_m = np.linalg.norm(first[:, None] - second[None], axis=2)
        return np.asarray(np.exp(-apart_m / _DRIFT_OVER_M))

    # The drift at the lanes' knots, given that of the markings.
    gain = np.linalg.solve(alike(centres, centres) + 1e-9 * np.eye(len(centres)), alike(centres, knots)).T
    left = alike(knots, knots) - gain @ alike(centres, knots) + 1e-9 * np.eye(len(knots))
    at_knots = gain @ drift_map
    at_knots += _DRIFT_M * np.linalg.cholesky(left) @ rng.standard_normal((len(knots), 2))
    lanes = []
    for lane in true.lanes:
        count = len(lane.points_map)
        of_lane = at_knots[: len(range(0, count, _KNOT))]
        at_knots = at_knots[len(of_lane) :]
        rows = np.arange(0, count, _KNOT)
        drift = np.column_stack([np.interp(np.arange(count), rows, axis) for axis in of_lane.T])
        lanes.append(mapped_line(lane, drift, _DRIFT_M, rng))
    return tuple(lanes)


def calibrated(
    lenses: Mapping[str, CameraInfo], cam_from_vehicle: Mapping[str, FloatArray], rng: np.random.Generator
) -> dict[str, Calibration]:
    """Calibrations of cameras with errors as they state them."""
    mounts = {
        name: np.concatenate([rng.normal(0, _MOUNT_M, 3), rng.normal(0, _MOUNT_RAD, 3)]) for name in lenses
    }
    covariance = np.diag(np.repeat(np.square([_MOUNT_M, _MOUNT_RAD]), 3))
    return {
        name: Calibration(lens, exp(mounts[name]) @ cam_from_vehicle[name], covariance)
        for name, lens in lenses.items()
    }


def moved(hd_map: HDMap, share: float, by_m: float, seed: int) -> HDMap:
    """The map of a day before a share of the markings was repainted elsewhere."""
    rng = np.random.default_rng([seed, _MOVED])
    markings = []
    for marking in hd_map.markings:
        angle = rng.uniform(0, 2 * np.pi)
        off = by_m * np.array([np.cos(angle), np.sin(angle)]) * (rng.random() < share)
        markings.append(replace(marking, corners_map=marking.corners_map + off))
    return replace(hd_map, markings=tuple(markings))


def drive(recipe: Recipe, seed: int, seconds: float, begin_m: float = 3.0) -> LiveDrive:
    """Another day's drive on a port at about 4 m/s from a station on; ``seed`` draws all of it."""
    rng = np.random.default_rng([seed, _DRIVE])
    world = make(recipe)
    route = world.port.route
    stamp_s = np.arange(0.0, seconds, 1.0 / ODOMETRY_HZ)
    speed = 4.0 * (1 + 0.15 * np.sin(0.4 * stamp_s + rng.uniform(0, 6)))
    station = begin_m + np.concatenate([[0.0], np.cumsum(speed[:-1]) / ODOMETRY_HZ])
    stamp_s = stamp_s[station < route.length_m - 3.0]
    station = station[: len(stamp_s)]
    aside = smooth_noise(station, _ASIDE_M, _ASIDE_OVER_M, rng)[:, 0]
    points = route.points_at(station) + aside[:, None] * _left(route.yaw_at(station))
    step = np.gradient(points, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    sway = smooth_noise(station, 0.002, 2.0, rng, 2) + smooth_noise(station, 0.002, 12.0, rng, 2)
    heave = smooth_noise(station, 0.006, 3.0, rng)[:, 0]
    poses = poses_of(np.column_stack([points, heave]), *sway.T, heading)
    every = int(ODOMETRY_HZ / RATE_HZ)
    frames = np.arange(every, len(stamp_s), every)
    motion = _odometry(stamp_s, points, heading, rng)
    calibrations = calibrated(world.lenses, world.port.cam_from_vehicle, rng)
    driven = replace(world.port.driven, stamp_s=stamp_s[frames])
    detector = draw_detector_errors(rng)
    world = replace(
        world,
        recipe=replace(recipe, seed=seed, detector=detector),
        port=replace(world.port, driven=driven),
        taken_s=stamp_s[frames],
        map_from_vehicle=poses[frames],
        cam_from_vehicle={
            name: np.tile(cam_from_vehicle, (len(frames), 1, 1))
            for name, cam_from_vehicle in world.port.cam_from_vehicle.items()
        },
    )
    hd_map = surveyed(world.port.hd_map, world.corners_map[..., 2], seed)
    return LiveDrive(
        world=world,
        hd_map=hd_map,
        calibrations=calibrations,
        stamp_s=stamp_s[frames],
        map_from_vehicle=poses[frames],
        looks=list(looks_of(world, seed)),
        motion=[motion[max(frame - every + 1, 0) : frame + 1] for frame in frames.tolist()],
        shift_map=np.zeros(2),
    )


def looks_of(world: World, seed: int, frames: Sequence[int] | None = None) -> Iterator[list[Look]]:
    """The looks of all cameras at each moment."""
    names = sorted(world.cameras)
    for frame in range(len(world.taken_s)) if frames is None else frames:
        moment = []
        for number, name in enumerate(names):
            rng = np.random.default_rng([seed, _DRIVE, number, frame])
            markings, _ = _in_image(world, name, frame, rng)
            lines_rng = np.random.default_rng([seed, _LINES, number, frame])
            lanes = pieces_in_image(world, name, frame, seed, lines_rng)
            moment.append(Look(name, float(world.taken_s[frame]), tuple(markings), lanes))
        yield moment


def bumped(world: World, camera: str, frame: int, turn_rad: FloatArray) -> World:
    """The world in which a camera is turned from a moment on."""
    poses = world.cam_from_vehicle[camera].copy()
    poses[frame:] = exp(np.concatenate([np.zeros(3), turn_rad])) @ poses[frame:]
    return replace(world, cam_from_vehicle={**world.cam_from_vehicle, camera: poses})


def turning(world: World, camera: str, frame: int, turn_rad: FloatArray, lasts_s: float) -> World:
    """The world in which a camera turns slowly from a moment on, by ``turn_rad`` (3,) in the end."""
    poses = world.cam_from_vehicle[camera].copy()
    shares = np.clip((world.taken_s - world.taken_s[frame]) / lasts_s, 0.0, 1.0)
    for number in np.flatnonzero(shares > 0).tolist():
        poses[number] = exp(np.concatenate([np.zeros(3), shares[number] * turn_rad])) @ poses[number]
    return replace(world, cam_from_vehicle={**world.cam_from_vehicle, camera: poses})


def _odometry(
    stamp_s: FloatArray, points: FloatArray, heading: FloatArray, rng: np.random.Generator
) -> list[Motion]:
    step_s = 1.0 / ODOMETRY_HZ
    velocity = np.gradient(points, step_s, axis=0)
    speed = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
    rate = np.gradient(heading, step_s)
    speed = speed * (1 + rng.normal(0, _SCALE)) + rng.normal(0, _SPEED_M_SQRT_S / np.sqrt(step_s), len(speed))
    rate = rate + rng.normal(0, _BIAS_RAD_S) + rng.normal(0, _YAW_RAD_SQRT_S / np.sqrt(step_s), len(rate))
    return [Motion(*row) for row in zip(stamp_s.tolist(), speed.tolist(), rate.tolist(), strict=True)]


def _left(yaw: FloatArray) -> FloatArray:
    return np.column_stack([-np.sin(yaw), np.cos(yaw)])
