"""Ground that is no plane: pixels moved to the plane, the cross-section found, and maps of crowned roads."""

from dataclasses import replace

import numpy as np
import pytest

from tests.adjust.scene import make_scene
from tests.benchmarks.made.draw import draw
from tests.benchmarks.right_drives import Job, map_one
from tests.mapping.scene import SceneOptions
from tests.mapping.scene import make_scene as make_yard
from v2hdm.adjust import SolveOptions, height_step, solve
from v2hdm.association.cross_section import KNOTS_M, CrossSection, Paths
from v2hdm.association.sightings import Rig, collect_sightings
from v2hdm.geometry.rigid import apply, rotation_from_euler

FALLS = np.array([0.02, 0.03, -0.01, 0.01, 0.015, 0.02, -0.02])
INTRINSIC = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
SEED = 4
"""Of a drive on level ground, 43 markings."""
MOUNT = np.array([[0.0, -1, 0, 0], [-0.35, 0, -0.94, 1.6], [0.94, 0, -0.35, -0.9], [0, 0, 0, 1]])


def arc(frames=60, radius_m=40.0, step_m=0.6):
    """Poses along a bend to the left, level."""
    yaw = np.arange(frames) * step_m / radius_m
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = rotation_from_euler(0 * yaw, 0 * yaw, yaw)
    poses[:, :2, 3] = radius_m * np.column_stack([np.sin(yaw), 1 - np.cos(yaw)])
    return poses


def ground_of_arc(points_map, radius_m=40.0):
    """Heights by the distance from the circle itself, slope by slope."""
    left = radius_m - np.linalg.norm(points_map - [0.0, radius_m], axis=1)
    height = -FALLS[0] * np.abs(left)
    for fall, side, knot in zip(FALLS[1:], np.repeat([1, -1], len(KNOTS_M)), 2 * KNOTS_M, strict=True):
        height -= fall * np.maximum(side * left - knot, 0)
    return height


def projected(cam_from_map, points_map, height_m):
    """Pixels (K, 2) of points (K, 2) at heights (K,), each of a camera (K, 4, 4) of its own."""
    points = np.column_stack([points_map, height_m, np.ones(len(height_m))])
    cam = np.einsum("kij,kj->ki", cam_from_map, points)[:, :3]
    return (cam / cam[:, 2:] @ INTRINSIC.T)[:, :2]


def seen_from(poses, rng, count=400):
    """Cameras, frames and points (K, 2) some metres ahead of them, to both sides."""
    turn = np.linalg.qr(MOUNT[:3, :3])[0]
    mount = np.eye(4)
    mount[:3, :3] = turn * np.sign(np.sum(turn * MOUNT[:3, :3], axis=0))
    mount[:3, 3] = -mount[:3, :3] @ [1.2, 0.1, 1.7]
    frame = rng.integers(5, len(poses) - 25, count)
    ahead = np.column_stack([rng.uniform(4, 14, count), rng.uniform(-7, 7, count), 0 * frame])
    points = np.array([apply(poses[f], p[None])[0, :2] for f, p in zip(frame, ahead, strict=True)])
    return mount @ np.linalg.inv(poses[frame]), frame, points


def test_a_moved_pixel_is_the_plane_s_where_the_ground_s_point_is_projected():
    poses, rng = arc(), np.random.default_rng(1)
    cam_from_map, frame, points = seen_from(poses, rng)
    section = CrossSection(FALLS, Paths.of(poses, np.zeros(len(poses), dtype=np.int64)))
    height = ground_of_arc(points)
    assert np.abs(height).max() > 0.2
    # Between the places of the path a chord is up to 5 mm off the circle.
    assert np.abs(section.height_m(points, frame) - height).max() < 5e-4
    plane, intrinsic = projected(cam_from_map, points, 0 * height), np.tile(INTRINSIC, (len(frame), 1, 1))
    for z, most_px in ((section.height_m(points, frame), 1e-6), (height, 0.1)):
        moved = section.flattened_px(intrinsic, cam_from_map, frame, projected(cam_from_map, points, z))
        assert np.abs(moved - plane).max() < most_px


def test_ground_without_slopes_changes_no_pixel():
    scene = make_yard(SceneOptions(length_m=40.0))
    seen = collect_sightings(scene.drive, scene.detections, ("front",))
    extrinsic = scene.cam_from_vehicle["front"][None]
    rig = Rig(scene.drive.cameras["front"].info.intrinsic[None], extrinsic, seen.map_from_vehicle)
    flat = CrossSection(0 * FALLS, Paths.of(seen.map_from_vehicle, seen.visit)).flattened(seen, rig)
    known = seen.informs
    np.testing.assert_allclose(flat.corners_pinhole_px[known], seen.corners_pinhole_px[known], atol=1e-7)
    np.testing.assert_allclose(flat.covariance_px[known], seen.covariance_px[known], rtol=1e-6, atol=1e-9)


def test_a_vehicle_that_stands_backs_up_or_comes_again_keeps_its_left():
    there = arc()
    rng = np.random.default_rng(3)
    waits = there[[19] * 15]
    waits[:, :2, 3] += rng.normal(0.0, 0.01, (15, 2))
    poses = np.concatenate([there[:20], waits, there[19:5:-1], there[5:], there])
    visit = np.repeat([0, 1], [len(poses) - len(there), len(there)])
    paths = Paths.of(poses, visit)
    frame = rng.integers(0, len(poses), 300)
    off = rng.uniform(-6, 6, 300)
    beside = poses[frame, :2, 3] + off[:, None] * poses[frame, :2, 1]
    left, normal = paths.beside(beside, frame)
    np.testing.assert_allclose(left, off, atol=0.1)  # where it backs up the path has a tip
    assert np.sum(normal * poses[frame, :2, 1], axis=1).min() > 0.99


@pytest.mark.parametrize("engine", ["numba", "torch"])
def test_a_height_step_is_that_to_the_least_cost_of_everything_anew(engine):
    scene = make_scene(3, frames=40, start_error_deg=0.1, start_error_m=0.01)
    options, seen = SolveOptions(loss="none", engine=engine, coarse=False), scene.problem.observations
    corners = scene.corners_map[seen.corner]
    away = corners - scene.map_from_vehicle[seen.frame][:, :2, 3]
    heights = -0.5 * np.abs(np.sum(away * scene.map_from_vehicle[seen.frame][:, :2, 1], axis=1))
    pose = scene.cam_from_vehicle[seen.camera] @ np.linalg.inv(scene.map_from_vehicle[seen.frame])
    camera = scene.problem.intrinsic[seen.camera]

    def pixels(z):
        cam = np.einsum("kij,kj->ki", pose, np.column_stack([corners, z, np.ones(len(z))]))[:, :3]
        return camera[:, :2] * cam[:, :2] / cam[:, 2:] + camera[:, 2:]

    def cost(share):
        moved = seen.pinhole_px - pixels(share * heights) + pixels(0 * heights)
        return solve(replace(scene.problem, observations=replace(seen, pinhole_px=moved)), options)

    low, middle, high = (cost(share) for share in (-0.01, 0.0, 0.01))
    slope, bend = (high.cost - low.cost) / 0.02, (high.cost - 2 * middle.cost + low.cost) / 1e-4
    step, covariance = height_step(middle, heights[:, None], np.zeros(1), 1e3)
    sigma = covariance[0, 0] ** 0.5
    assert sigma == pytest.approx(bend**-0.5, rel=0.05)
    assert step[0] == pytest.approx(-slope / bend, abs=0.05 * sigma)


@pytest.fixture(scope="module")
def plane():
    assert draw(SEED).road is None
    return map_one(Job(SEED))


@pytest.mark.parametrize("spoil", ["crown", "crown beside"])
def test_a_road_with_a_crown_is_mapped_as_well_as_a_plane(plane, spoil):
    crowned = map_one(Job(SEED, spoil=spoil, ground="auto"))
    assert crowned.status == plane.status == "PASS"
    assert crowned.rmse_m <= 1.2 * plane.rmse_m
    assert crowned.markings >= plane.markings
    assert crowned.height_rmse_m <= 0.02


def test_a_plane_stays_one_to_the_last_bit(plane):
    auto = map_one(Job(SEED, ground="auto"))
    assert np.isnan(auto.height_rmse_m)
    assert (auto.rmse_m, auto.errors) == (plane.rmse_m, plane.errors)
