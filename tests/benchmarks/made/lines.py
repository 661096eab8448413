"""Solid lines of a made port: as a drive has mapped them, and what a detector finds of them in an image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.benchmarks.made.detect import _covered, project
from tests.benchmarks.made.world import World, smooth_noise
from v2hdm.geometry.planar import length_along, points_along
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import LANE_LINE, FloatArray, Lane, LaneDetection

_STEP_M = 0.5  # distance, m, of a detection's points, as of the detector
_RANGE_M = (3.0, 25.0)  # distances, m, at which lines are found
_LEAST_POINTS = 3
# Errors of pieces, as the detector's on renders of port 2 with words (150 pieces):
_ALIKE_PX, _ALIKE_M = 0.3, 2.0  # of points across, px (one sigma), and over which way they are alike
_ALONE_PX = 0.1  # of each point alone, px
_WEAR_M, _WEAR_OVER_M = 0.003, 10.0  # shift of a line's paint in all images, m, and over which way it changes
_MISSED = 0.25  # share of pieces that are not found
_CUT = 0.3  # share of pieces that are found in two parts
_BENT, _BENT_RAD = (
    0.03,
    0.1,
)  # share of short pieces that turn aside, and by how much: caps, joints, crossings
_MAPPED_M, _MAPPED_OVER_M = 0.005, 6.0  # error of a mapped line across beside the drift, and over which way


def mapped_line(lane: Lane, drift_map: FloatArray, drift_m: float, rng: np.random.Generator) -> Lane:
    """A lane's line with the drift (N, 2) of its map at its vertices, and an error across."""
    way_m = length_along(lane.points_map)
    ahead = np.gradient(lane.points_map, axis=0)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1)[:, None]
    across_m = smooth_noise(way_m, _MAPPED_M, _MAPPED_OVER_M, rng)
    sigma_m = np.full(len(way_m), np.hypot(drift_m, _MAPPED_M))
    return replace(lane, points_map=lane.points_map + drift_map + across_m * left, sigma_m=sigma_m)


def pieces_in_image(
    world: World, camera: str, frame: int, seed: int, rng: np.random.Generator
) -> tuple[LaneDetection, ...]:
    """The pieces of solid lines that a detector finds in an image."""
    cam_from_map = world.cam_from_vehicle[camera][frame] @ np.linalg.inv(world.map_from_vehicle[frame])
    centre = camera_centre(cam_from_map)
    pieces = []
    for number, lane in enumerate(world.port.hd_map.lanes):
        if lane.kind != LANE_LINE:
            continue
        way_m = np.arange(0.0, length_along(lane.points_map)[-1], _STEP_M)
        points = points_along(lane.points_map, way_m)
        wear_m = smooth_noise(way_m, _WEAR_M, _WEAR_OVER_M, np.random.default_rng([seed, number]))
        ahead = np.gradient(points, axis=0)
        left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1)[:, None]
        points_map = np.column_stack([points + wear_m * left, np.zeros(len(points))])
        distance_m = np.linalg.norm(points_map[:, :2] - centre[:2], axis=1)
        shown = project(world.lenses[camera], cam_from_map, points_map[:, None])
        is_shown = shown.inside[:, 0] & (distance_m > _RANGE_M[0]) & (distance_m < _RANGE_M[1])
        is_shown[is_shown] &= ~_covered(world, frame, centre, points_map[is_shown][:, None])[:, 0]
        rows = np.flatnonzero(is_shown)
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
            cut = [len(run)] if rng.random() > _CUT else [int(rng.integers(len(run) + 1)), len(run)]
            for part in np.split(run, cut[:-1]):
                if rng.random() > _MISSED and len(part) >= _LEAST_POINTS:
                    pieces.append(_piece(shown.px[part, 0], distance_m[part], rng))
    return tuple(pieces)


def _piece(px: FloatArray, distance_m: FloatArray, rng: np.random.Generator) -> LaneDetection:
    """The points of a piece with their errors across it, near to far."""
    order = np.argsort(distance_m)
    px = px[order]
    ahead = np.gradient(px, axis=0)
    across = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1)[:, None]
    way_m = _STEP_M * np.arange(len(px))
    apart_m = np.abs(way_m[:, None] - way_m)
    root = np.linalg.cholesky(np.exp(-apart_m / _ALIKE_M) + 1e-9 * np.eye(len(px)))
    off_px = _ALIKE_PX * root @ rng.standard_normal(len(px)) + _ALONE_PX * rng.standard_normal(len(px))
    if rng.random() < _BENT:
        px, off_px = px[:7], off_px[:7]
        across = across[:7]
        off_px = off_px + _BENT_RAD * np.linalg.norm(px - px[0], axis=1)
    return LaneDetection(LANE_LINE, 0.9, px + off_px[:, None] * across)
