"""Behind a lorry: a made drive whose vehicle queues, and what of the lorry a detector takes for paint."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from tests.benchmarks.made.detect import _detection, detect, project
from tests.benchmarks.made.draw import Recipe
from tests.benchmarks.made.world import Ground, World, _driven, _recorded, make
from v2hdm.records import (
    CROSSWALK_BAR,
    DIAMOND,
    LANE_DASH,
    STOP_LINE,
    Drive,
    FloatArray,
    ImageDetections,
    Trajectory,
)
from v2hdm.simulate.port.build import Port
from v2hdm.simulate.render.scene import Box

_QUEUE, _SIGHTINGS = 51, 52  # streams of a seed
_POSE_HZ = 10.0
_QUEUE_M = 32.0  # way before the route's end on which the vehicle meets the lorry
_SIZE_M = (8.0, 2.4, 3.0)
_LEAST_DEPTH_M = 1.0
_RANGE_M = 22.0  # as the detector's max_range_m


def _upright(left_m: float, up_m: float, width_m: float, height_m: float, slant_m: float = 0.0) -> FloatArray:
    """A quadrilateral (4, 2) on a rear, by how far left and up its corners are, m."""
    half = 0.5 * np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]]) * (width_m, height_m)
    half[2:, 0] += slant_m
    return np.asarray(half + np.array([left_m, up_m]))


REAR: tuple[tuple[str, FloatArray], ...] = (
    *((CROSSWALK_BAR, _upright(left, 0.75, 0.2, 0.4, 0.2)) for left in (-1.0, -0.6, -0.2, 0.2, 0.6, 1.0)),
    (STOP_LINE, _upright(0.0, 0.45, 2.2, 0.1)),
    (LANE_DASH, _upright(-1.1, 0.6, 0.1, 1.0)),
    (LANE_DASH, _upright(1.1, 0.6, 0.1, 1.0)),
    (DIAMOND, _upright(0.0, 1.2, 0.6, 0.5)),
    *((DIAMOND, _upright(left, 0.3, 0.4, 0.5)) for left in (-0.9, 0.9)),
)
"""Stripes, bumper, edges, window and wheels of a rear, each with the class that it is taken for."""


@dataclass(frozen=True)
class Behind(Port):
    """A port with a lorry ahead, whose rear is at the stations ``lorry_m`` (F,)."""

    lorry_m: FloatArray = field(kw_only=True)

    def moving_boxes(self, frame: int) -> tuple[Box, ...]:
        """The lorry alone."""
        centre, yaw = self.route.pose_at(float(self.lorry_m[frame]) + _SIZE_M[0] / 2)
        return (Box(centre_map=centre, size_m=_SIZE_M, yaw_rad=yaw),)


def make_queue(recipe: Recipe) -> World:
    """The world of a drive that ends in a queue: it closes up to a lorry, stands, and follows it."""
    world, rng = make(recipe), np.random.default_rng([recipe.seed, _QUEUE])
    route = world.port.route
    stamp_s, station, lorry_m = _schedule(route.length_m, route.speed_mps, rng)
    grid = np.arange(0.0, 2 * route.length_m / route.speed_mps, 0.05)
    poses_s = np.arange(0.0, stamp_s[-1] + 1.0, 1 / _POSE_HZ)

    def on_route(at_m: FloatArray) -> FloatArray:
        """When the vehicle would have been there, had it driven on."""
        return np.interp(at_m, route.station_at(grid), grid)

    taken_s, poses_there_s = on_route(station), on_route(np.interp(poses_s, stamp_s, station))
    true = _driven(
        recipe, world.port, Ground.of(recipe, world.port), np.concatenate([taken_s, poses_there_s])
    )
    fields = {name: value for name, value in vars(world.port).items() if name != "driven"}
    driven = replace(world.port.driven, stamp_s=taken_s, map_from_vehicle=true[: len(taken_s)])
    recorded = _recorded(recipe, world.port, poses_there_s, true[len(taken_s) :])
    return replace(
        world,
        port=Behind(**fields, driven=driven, lorry_m=lorry_m),
        taken_s=taken_s,
        map_from_vehicle=true[: len(taken_s)],
        cam_from_vehicle={
            name: np.tile(poses[0], (len(taken_s), 1, 1)) for name, poses in world.cam_from_vehicle.items()
        },
        stamp_s=dict.fromkeys(world.cameras, stamp_s),
        recorded=Trajectory(poses_s, recorded),
    )


def _schedule(
    length_m: float, speed_mps: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (F,) of the images, stations of the vehicle and of the lorry's rear then."""
    lorry, gap_m = length_m - _QUEUE_M + 20.0, float(rng.uniform(7.0, 12.0))
    cruise = np.arange(3.0, lorry - gap_m, 1.5)
    station, ahead = [cruise], [np.full(len(cruise), lorry)]
    step_s = [np.full(len(cruise), 1.5 / speed_mps)]
    at = float(cruise[-1])
    for _ in range(int(rng.integers(1, 4))):
        stood = int(rng.integers(10, 40))
        moved, steps, lag = float(rng.uniform(0.5, 4.0)), int(rng.integers(8, 20)), int(rng.integers(0, 6))
        way = moved * np.linspace(0.0, 1.0, steps)
        station += [np.full(stood, at), at + np.append(np.zeros(lag), way)]
        ahead += [np.full(stood, lorry), lorry + np.append(way, np.full(lag, moved))]
        step_s += [np.full(stood + lag + steps, 0.4)]
        at, lorry = at + moved, lorry + moved
    return np.cumsum(np.concatenate(step_s)), np.concatenate(station), np.concatenate(ahead)


def detect_queue(world: World, drive: Drive) -> tuple[list[ImageDetections], FloatArray]:
    """The detections of :func:`detect`, and those on the lorry's rear; the share of each marking shown."""
    detections, visibility = detect(world, drive)
    out, errors = [], world.recipe.detector
    for in_image in detections:
        image = drive.images[in_image.image]
        frame, lens = world.frame_of(image), world.lenses[image.camera]
        rng = np.random.default_rng([world.recipe.seed, _SIGHTINGS, len(image.camera), frame])
        pose = world.cam_from_vehicle[image.camera][frame] @ np.linalg.inv(world.map_from_vehicle[frame])
        projected = project(lens, pose, rear_map(world, frame))
        sigma = errors.sigma_px * (1 + (projected.distance_m / errors.doubled_at_m) ** 2)
        px = projected.px + rng.standard_normal(projected.px.shape) * sigma[..., None]
        missed = rng.random(len(px)) < errors.missed
        covariance = errors.stated_factor * sigma[..., None, None] ** 2 * np.eye(2)
        shown = projected.inside.all(axis=1) & (projected.distance_m.max(axis=1) < _RANGE_M) & ~missed
        on_rear = [
            _detection(REAR[j][0], px[j], covariance[j], projected.inside[j], lens)
            for j in np.flatnonzero(shown)
        ]
        out.append(replace(in_image, markings=(*in_image.markings, *on_rear)))
    return out, visibility


def rear_map(world: World, frame: int) -> FloatArray:
    """Where the corners (J, 4, 3) of :data:`REAR` are in an image, in the map."""
    assert isinstance(world.port, Behind)
    centre, yaw = world.port.route.pose_at(float(world.port.lorry_m[frame]))
    corners = np.array([corners for _, corners in REAR])
    left = np.array([-np.sin(yaw), np.cos(yaw)])
    return np.concatenate([centre + corners[..., :1] * left, corners[..., 1:]], axis=2)
