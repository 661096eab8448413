"""Ground that is no plane: pixels moved to the plane, the surface found, and maps of roads with relief."""

from dataclasses import replace

import numpy as np
import pyopencrg
import pytest
import rasterio
from scipy.sparse import csr_array

from tests.adjust.scene import make_scene
from tests.benchmarks.made.draw import draw
from tests.benchmarks.right_drives import Job, map_one
from tests.cameras import apply, level
from tests.ports import small_port
from v2hdm.adjust import SolveOptions, solve
from v2hdm.detection.batch import detect_all
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import MapFileError
from v2hdm.faults.sensitivity import height_information, moves_with_heights
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.io.maps.formats import write_map
from v2hdm.mapping.methods import run_methods
from v2hdm.records import HDMap, PoseNoise, Road
from v2hdm.report.metrics import driven_past, map_figures
from v2hdm.simulate.port.config import PortConfig, ReliefConfig
from v2hdm.store.files import load_json, write_json
from v2hdm.surface.basis import KNOTS_M
from v2hdm.surface.paths import Paths
from v2hdm.surface.prior import Recorded, Smoothness
from v2hdm.surface.surface import Surface

FALLS = np.array([0.02, 0.03, -0.01, 0.01, 0.015, 0.02, -0.02])
SHAPE = np.array([0.0, 0.0, *FALLS])  # with the grade
INTRINSIC = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
SEED = 4
"""The seed of a drive on level ground with 43 markings."""
MOUNT = np.array([[0.0, -1, 0, 0], [-0.35, 0, -0.94, 1.6], [0.94, 0, -0.35, -0.9], [0, 0, 0, 1]])


def arc(frames=60, radius_m=40.0, step_m=0.6):
    """Poses along a bend to the left, level."""
    yaw = np.arange(frames) * step_m / radius_m
    return level(radius_m * np.sin(yaw), radius_m * (1 - np.cos(yaw)), yaw)


def ground_of_arc(points_map, radius_m=40.0):
    """Heights by the distance from the circle itself, slope by slope."""
    left = radius_m - np.linalg.norm(points_map - [0.0, radius_m], axis=1)
    height = -FALLS[0] * np.abs(left)
    for fall, side, knot in zip(FALLS[1:], np.repeat([1, -1], len(KNOTS_M)), 2 * KNOTS_M, strict=True):
        height -= fall * np.maximum(side * left - knot, 0)
    return height


def apply_inverse(poses, points_map):
    """Points (K, 2) of the map ahead and to the left of poses (K, 4, 4)."""
    return np.einsum("kji,kj->ki", poses[:, :2, :2], points_map - poses[:, :2, 3])


def stood(poses):
    """Height and slopes ahead and to the left (K,) of a vehicle's plane, by the ground beneath its wheels."""
    rear, front = (
        np.stack([
            ground_of_arc(poses[:, :2, 3] + ahead * poses[:, :2, 0] + side * poses[:, :2, 1])
            for side in (-0.8, 0.8)
        ])
        for ahead in (0.0, 2.8)
    )  # fmt: skip
    by_left = (np.diff(rear, axis=0) + np.diff(front, axis=0))[0] / 3.2
    return rear.mean(axis=0), (front.mean(axis=0) - rear.mean(axis=0)) / 2.8, by_left


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
    flat = Surface.level(way(poses))
    section = replace(flat, parameters=np.pad(SHAPE, (0, len(flat.parameters) - len(SHAPE))))
    # Above the plane of the wheels, the front ones of which stand beside the circle.
    away, (height_m, by_ahead, by_left) = apply_inverse(poses[frame], points), stood(poses[frame])
    height = ground_of_arc(points) - height_m - by_ahead * away[:, 0] - by_left * away[:, 1]
    assert np.abs(height).max() > 0.2
    # Between the places of the path a chord is up to 5 mm off the circle.
    assert np.abs(section.seen_height_m(points, frame) - height).max() < 1e-3
    plane, intrinsic = projected(cam_from_map, points, 0 * height), np.tile(INTRINSIC, (len(frame), 1, 1))
    # What rises over a plane that leans leans with it, by .1 mm here.
    moved = section.flattened_px(intrinsic, cam_from_map, frame, projected(cam_from_map, points, height))
    assert np.abs(moved - plane).max() < 0.2


def test_a_vehicle_that_stands_backs_up_or_comes_again_keeps_its_left():
    way = arc()
    rng = np.random.default_rng(3)
    waits = way[[19] * 15]
    waits[:, :2, 3] += rng.normal(0.0, 0.01, (15, 2))
    poses = np.concatenate([way[:20], waits, way[19:5:-1], way[5:], way])
    session = np.repeat([0, 1], [len(poses) - len(way), len(way)])
    paths = Paths.of(poses, session)
    frame = rng.integers(0, len(poses), 300)
    off = rng.uniform(-6, 6, 300)
    beside = poses[frame, :2, 3] + off[:, None] * poses[frame, :2, 1]
    _, left = paths.beside(beside, frame)
    np.testing.assert_allclose(left, off, atol=0.1)  # where it backs up the path has a tip


def way(poses):
    return Paths.of(poses, np.zeros(len(poses), dtype=np.int64))


def test_a_pixel_of_any_surface_is_moved_to_where_the_plane_would_show_its_place():
    poses, rng = arc(), np.random.default_rng(5)
    cam_from_map, frame, points = seen_from(poses, rng)
    flat = Surface.level(way(poses))
    surface = replace(flat, parameters=rng.normal(0.0, 0.05, len(flat.parameters)))
    height, intrinsic = surface.seen_height_m(points, frame), np.tile(INTRINSIC, (len(frame), 1, 1))
    assert np.std(height) > 0.1
    on_plane = np.array([
        surface.on_plane(p[None], cam, f)[0] for p, cam, f in zip(points, cam_from_map, frame, strict=True)
    ])  # fmt: skip
    seen_px, plane = (projected(cam_from_map, at, 0 * height) for at in (on_plane, points))
    moved = surface.flattened_px(intrinsic, cam_from_map, frame, seen_px)
    is_low = height < 0.85  # half as high as the camera; what is higher stays where it is
    # Behind a ridge a ray meets the ground before it gets there.
    assert np.quantile(np.abs(moved - plane)[is_low].max(axis=1), 0.95) < 1e-5
    columns = surface.seen_columns(points, frame)
    np.testing.assert_allclose(columns @ surface.parameters, height, atol=1e-12)


def test_a_surface_read_back_shows_from_any_pose_what_the_plane_would(tmp_path):
    way, rng = arc(), np.random.default_rng(8)
    # The way back on the same road: each place was passed in two directions.
    back = way[::-1] @ np.diag([-1.0, -1.0, 1.0, 1.0])
    paths = Paths.of(np.concatenate([way, back]), np.repeat([0, 1], len(way)))
    flat = Surface.level(paths)
    surface = replace(flat, parameters=rng.normal(0.0, 0.01, len(flat.parameters)), datum_m=80.0)
    write_json(tmp_path / "ground.json", surface.stored())
    between = way.copy()  # poses that the surface was not made at
    between[:, :2, 3] += 0.3 * way[:, :2, 0]
    read = Surface.from_stored(load_json(tmp_path / "ground.json", MapFileError), between)
    cam_from_map, frame, points = seen_from(between, rng, count=60)
    points_map = np.array([
        read.on_plane(p[None], cam, f)[0] for p, cam, f in zip(points, cam_from_map, frame, strict=True)
    ])  # fmt: skip
    height = read.seen_height_m(points, frame)
    assert np.std(height) > 0.03
    pixels, intrinsic = (
        projected(cam_from_map, points_map, 0 * height),
        np.tile(INTRINSIC, (len(frame), 1, 1)),
    )
    flat = read.flattened_px(intrinsic, cam_from_map, frame, pixels)
    np.testing.assert_allclose(flat, projected(cam_from_map, points, 0 * height), atol=1e-4)


@pytest.mark.parametrize(
    "damage",
    [
        {"knots": [0.0, 6.0, 9]},
        {"knots": ["0", None]},
        {"knots": [0.0, 0.0, 13]},
        {"points_map": "far"},
        {"parameters": [np.nan]},
        {"ahead": None},
        {"session_ends": [[0.0, 1.0]]},
    ],
)
def test_a_damaged_ground_is_named(damage):
    stored = Surface.level(way(arc())).stored() | damage
    with pytest.raises(ValueError, match="not a ground"):
        Surface.from_stored(stored, arc())


def test_ground_that_is_a_plane_is_seen_as_one_however_it_leans():
    poses = level(0.6 * np.arange(60))
    surface = Surface.level(way(poses))
    along, across = np.meshgrid(np.arange(surface.knots[2]) - 1, np.arange(8) - 3.5, indexing="ij")
    spline = 0.05 * surface.knots[1] * along + 0.03 * 5.0 * across  # a cubic spline's own grade and bank
    surface = replace(surface, parameters=np.concatenate([0 * SHAPE, spline.ravel()]))
    rng = np.random.default_rng(6)
    frame = rng.integers(0, 60, 200)
    points = poses[frame, :2, 3] + np.column_stack([rng.uniform(2, 15, 200), rng.uniform(-8, 8, 200)])
    assert np.abs(surface.seen_height_m(points, frame)).max() < 1e-9
    # The vehicle that stands on it, and the same on the plane: pixels are moved from one's to the other's.
    z, slope = 0.05 * poses[frame, 0, 3], np.arctan([0.05, 0.03 * np.cos(np.arctan(0.05))])
    leaning = poses[frame].copy()
    leaning[:, :3, :3] = rotation_from_euler(slope[[1]], -slope[[0]], np.zeros(1))
    leaning[:, 2, 3] = z
    mount = np.array([[0.0, -1, 0, 0.2], [-0.3, 0, -0.95, 1.7], [0.95, 0, -0.3, -0.9], [0, 0, 0, 1]])
    mount[:3, :3] = np.linalg.qr(mount[:3, :3])[0] * [-1.0, -1.0, -1.0]
    on_hill = projected(mount @ np.linalg.inv(leaning), points, points @ [0.05, 0.03])
    intrinsic, cam_from_map = np.tile(INTRINSIC, (200, 1, 1)), mount @ np.linalg.inv(poses[frame])
    flat = projected(cam_from_map, points, 0 * z)
    moved, shown = (
        surface.flattened_px(intrinsic, cam_from_map, frame, on_hill),
        np.abs(flat).max(axis=1) < 1300,
    )
    assert np.abs(on_hill - flat)[shown].max() > 0.5
    assert np.abs(moved - flat)[shown].max() < 0.02
    height, _ = surface.height_m(points)
    rise = 0.05 * (points[:, 0] - points[0, 0]) + 0.03 * (points[:, 1] - points[0, 1])
    np.testing.assert_allclose(height - height[0], rise, atol=1e-9)


@pytest.mark.parametrize("shape", ["plane", "crest", "bank"])
def test_heights_are_estimated_with_their_sigmas_and_a_plane_is_none_the_better_for_it(shape):
    poses = level(0.6 * np.arange(200))

    def ground(points):
        if shape == "crest":
            return 0.3 * np.cos(points[:, 0] / 12.0)
        return np.clip((points[:, 0] - 30.0) / 40.0, 0, 1) * 0.05 * points[:, 1] * (shape == "bank")

    rng, sigma_m = np.random.default_rng(7), 0.01
    line = np.column_stack([poses[:, 0, 3], np.zeros(200)])
    left, right = ([ground(line + np.array([ahead, side])) for ahead in (0.0, 2.8)] for side in (0.8, -0.8))
    rear, front = (np.add(left, right)) / 2
    slope = np.column_stack([(front - rear) / 2.8, np.subtract(left, right).mean(axis=0) / 1.6])
    # Receivers err alike over a while.
    distances_m = np.abs(line[:, :1] - line[:, 0])
    long, short = (
        np.linalg.cholesky(np.exp(-distances_m / over_m) + 1e-9 * np.eye(200)) for over_m in (30.0, 10.0)
    )
    height = rear + 0.015 * long @ rng.normal(size=200)
    road = Road(line, height, slope + 0.004 * short @ rng.normal(size=(200, 2)))
    frame = rng.integers(0, 175, 3000)
    points = line[frame] + np.column_stack([rng.uniform(2, 15, 3000), rng.uniform(-8, 8, 3000)])
    flat = Surface.level(way(poses))
    plane = rear[frame] + np.einsum("ki,ki->k", slope[frame], points - line[frame])
    measured_m = ground(points) - plane + rng.normal(0.0, sigma_m, 3000)
    columns = flat.seen_columns(points, frame)
    noise = PoseNoise(position_m=0.01, position_drift_m=0.01, position_drift_over_m=30.0)
    information, score = (columns.T @ columns).toarray() / sigma_m**2, -columns.T @ measured_m / sigma_m**2
    surface, gain = flat.estimated(information, score, Recorded.of(road, noise))
    height, stated = surface.height_m(points)
    off = height - ground(points)
    # No image shows the height, grade and bank of the whole, which err as the receiver does.
    whole = np.column_stack([np.ones(3000), points])
    shape_off = off - whole @ np.linalg.lstsq(whole, off, rcond=None)[0]
    assert np.sqrt(np.mean(shape_off**2)) < 0.01
    # Nearly all of the error is these three: 99 % of their chi-square.
    assert 0.07 / 3 < np.mean((off / stated) ** 2) < 12.8 / 3
    assert (gain < 8.0) if shape == "plane" else (gain > 100.0)


def test_the_ground_of_a_map_is_the_same_in_files(tmp_path):
    flat = Surface.level(way(arc()))
    along, across = np.meshgrid(np.arange(flat.knots[2]), np.arange(8), indexing="ij")
    smooth = np.concatenate([0 * SHAPE, (0.3 * np.sin(along / 2) + 0.1 * np.cos(across / 2)).ravel()])
    surface = replace(flat, parameters=smooth, covariance=1e-4 * np.eye(len(smooth)), datum_m=80.0)
    strips = surface.strips()
    paths = write_map(HDMap((), ground=strips), tmp_path, "map", ["geotiff", "opencrg"])
    spots = np.concatenate([strips[0].points(d)[5:-5:4] for d in (-6.1, 0.2, 5.3)])
    true, sigma = surface.height_m(spots)
    assert np.ptp(true) > 0.3
    with rasterio.open(paths[0]) as raster:
        height, stated = np.array(list(raster.sample(spots))).T
    np.testing.assert_allclose(height, true, atol=0.05)  # of the nearest of cells of 25 cm
    assert np.median(np.abs(height - true)) < 0.01
    np.testing.assert_allclose(stated, sigma, rtol=0.2)
    road = pyopencrg.read(str(paths[1]))
    np.testing.assert_allclose([road.xy_to_z(x, y) for x, y in spots], true, atol=0.01)


def test_a_map_over_a_plane_gets_no_file_of_its_ground_and_is_told_so(tmp_path, caplog):
    assert write_map(HDMap(()), tmp_path, "map", ["opencrg"]) == []
    assert "map_ground.crg is not written: the map holds no ground surface" in caplog.text
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("engine", ["native", "torch"])
def test_a_step_of_heights_is_that_to_the_least_cost_of_everything_anew(engine):
    scene = make_scene(3, frames=40, start_error_deg=0.1, start_error_m=0.01)
    options, observations = SolveOptions(loss="none", engine=engine, coarse=False), scene.problem.observations
    corners = scene.corners_map[observations.corner]
    away = corners - scene.map_from_vehicle[observations.frame][:, :2, 3]
    heights = -0.5 * np.abs(np.sum(away * scene.map_from_vehicle[observations.frame][:, :2, 1], axis=1))
    pose = scene.cam_from_vehicle[observations.camera] @ np.linalg.inv(
        scene.map_from_vehicle[observations.frame]
    )
    camera = scene.problem.intrinsic[observations.camera]

    def pixels(z):
        cam = np.einsum("kij,kj->ki", pose, np.column_stack([corners, z, np.ones(len(z))]))[:, :3]
        return camera[:, :2] * cam[:, :2] / cam[:, 2:] + camera[:, 2:]

    def cost(share):
        moved = observations.pinhole_px - pixels(share * heights) + pixels(0 * heights)
        return solve(replace(scene.problem, observations=replace(observations, pinhole_px=moved)), options)

    low, middle, high = (cost(share) for share in (-0.01, 0.0, 0.01))
    slope, bend = (high.cost - low.cost) / 0.02, (high.cost - 2 * middle.cost + low.cost) / 1e-4
    information, gradient = height_information(middle, csr_array(heights[:, None]))
    sigma = information[0, 0] ** -0.5
    assert sigma == pytest.approx(bend**-0.5, rel=0.05)
    assert -gradient[0] / information[0, 0] == pytest.approx(-slope / bend, abs=0.05 * sigma)
    held = moves_with_heights(middle, heights[:, None])
    moved = (high.corners_map - low.corners_map) / 0.02
    np.testing.assert_allclose(held.corners[..., 0], moved, atol=0.05 * np.abs(moved).max())
    turned = high.cam_from_vehicle @ np.linalg.inv(low.cam_from_vehicle) / 0.02
    np.testing.assert_allclose(
        held.extrinsic[:, :3, 0], turned[:, :3, 3], atol=0.05 * np.abs(turned[:, :3, 3]).max()
    )
    wider = replace(middle.covariance, held=held)
    more = wider.corners(np.array([[0, 1]])) - middle.covariance.corners(np.array([[0, 1]]))
    np.testing.assert_allclose(more[0], np.outer(*2 * [held.corners[:2].ravel()]), atol=1e-12)


@pytest.fixture(scope="module")
def plane():
    assert draw(SEED).road is None
    return map_one(Job(SEED))


@pytest.mark.parametrize(("relief", "height_m"), [("crown beside", 0.01), ("crest", 0.04)])
def test_a_road_with_a_crown_or_crests_is_mapped_as_well_as_a_plane(plane, relief, height_m):
    # A roll of the recording sensor by 2 mrad, which a straight road does not show, leans recorded ground.
    curved = map_one(Job(SEED, spoil=relief, ground="auto"))
    # Both are straight, and nothing is stated of their clocks.
    assert {finding["check"] for row in (plane, curved) for finding in row.findings} == {"clock"}
    assert curved.rmse_m <= 1.2 * plane.rmse_m
    assert curved.markings >= plane.markings
    assert curved.height_rmse_m <= height_m


def test_a_plane_stays_one_to_the_last_bit(plane):
    auto = map_one(Job(SEED, ground="auto"))
    assert np.isnan(auto.height_rmse_m)
    assert (auto.rmse_m, auto.errors) == (plane.rmse_m, plane.errors)


def test_a_port_rendered_on_a_grade_with_a_crown_is_mapped_as_well_as_the_flat_one(rendered):
    lenses = {"width": 640, "height": 360, "focal_px": 450.0}
    cameras = {name: replace(camera, **lenses) for name, camera in PortConfig().cameras.items()}
    port = small_port(relief=ReliefConfig(grade=0.05, crown=0.03), cameras=cameras)
    drive = read_drive(rendered(replace(port, route=replace(port.route, image_spacing_m=1.5))))
    detections = detect_all(drive, DetectorOptions.for_mapping())
    optimum = run_methods(drive, detections, tuple(cameras))["Opt"]
    truth = read_truth(drive)
    figures = map_figures(optimum.hd_map, truth, driven_past(drive, truth, tuple(cameras)))
    assert optimum.surface is not None
    assert (figures["recall"], figures["false_markings"]) == (1.0, 0)
    assert figures["corner_rmse_m"] < 1.2 * 0.0211  # of the flat one; the plane is 17 cm off
    assert figures["height_rmse_m"] < 0.02
    assert figures["heights_inside_95"] > 0.9


def test_the_prior_s_determinant_by_its_bands_is_that_of_the_matrix():
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, 0, 3] = np.arange(40)
    paths = Paths.of(poses, np.zeros(40, dtype=np.int64))
    smoothness = Smoothness.of(Surface.level(paths).knots)
    for sizes in np.random.default_rng(0).uniform(-12.0, -4.0, (5, 3)):
        _, logarithm = np.linalg.slogdet(smoothness.prior(sizes))
        assert smoothness.log_root(sizes) == pytest.approx(logarithm / 2, abs=1e-4)
