"""Ports: their paint, stencils and disturbances, and the one call that renders one."""

from dataclasses import replace

import numpy as np
import pytest

from tests.simulate.conftest import FRONT, tiny_port
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.errors import ConfigError
from v2hdm.executor import HERE
from v2hdm.geometry.ipm import apply_homography, ipm_from_extrinsic, project_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.planar import signed_area
from v2hdm.geometry.rigid import interpolate
from v2hdm.library import simulate_port
from v2hdm.records import DIAMOND, LANE_DASH, LANE_LINE
from v2hdm.simulate.port import drive
from v2hdm.simulate.port.build import build_port, calibrate, cam_from_vehicle, camera_info
from v2hdm.simulate.port.config import (
    CalibrationConfig,
    DisturbanceConfig,
    PaintConfig,
    PortConfig,
    RouteConfig,
    StencilConfig,
)
from v2hdm.simulate.port.drive import hidden_by, inside_image, placed_boxes, points_seen
from v2hdm.simulate.port.paint import build_layout
from v2hdm.simulate.port.route import build_route, correlated_noise, drive_along, pose_noise
from v2hdm.simulate.render.renderer import Renderer
from v2hdm.simulate.render.scene import Box, Ground, Scene


@pytest.fixture(scope="module")
def full():
    return PortConfig()


@pytest.fixture(scope="module")
def port(full):
    return build_port(full)


def info_of(config, name):
    return camera_info(name, config.cameras[name])


@pytest.mark.parametrize("name", ["front", "rear"])
def test_exact_points_give_the_homography_of_the_extrinsic(full, name):
    exact = CalibrationConfig(survey_sigma_m=0.0, click_sigma_px=0.0)
    mount = full.cameras[name].mount
    ipm, _ = calibrate(info_of(full, name), mount, exact, np.random.default_rng(0))
    expected = ipm_from_extrinsic(info_of(full, name), cam_from_vehicle(mount))
    assert np.allclose(ipm / ipm[2, 2], expected / expected[2, 2], rtol=1e-5, atol=1e-7)


def test_a_camera_pitched_down_looks_at_the_ground_ahead():
    """From 2.45 m up, 16 degrees down, the axis meets the ground 8.54 m ahead of the camera."""
    extrinsic = cam_from_vehicle(FRONT)
    centre = -extrinsic[:3, :3].T @ extrinsic[:3, 3]
    assert np.allclose(centre, (FRONT.x_m, FRONT.y_m, FRONT.z_m))
    axis = extrinsic[2, :3]
    hit = centre - axis * centre[2] / axis[2]
    assert hit[0] == pytest.approx(3.6 + 8.54 * np.cos(np.deg2rad(0.6)), abs=0.01)


@pytest.mark.parametrize("name", ["front", "rear"])
def test_the_borrowed_ipm_is_decimetres_wrong_and_the_own_one_is_not(port, name):
    camera = port.cameras[name]
    inner = camera.roi_vehicle.mean(axis=0) + 0.95 * (camera.roi_vehicle - camera.roi_vehicle.mean(axis=0))
    pinhole, _ = project_ground(camera.info.intrinsic, port.cam_from_vehicle[name], inner)
    error = {k: np.linalg.norm(apply_homography(m, pinhole) - inner, axis=1) for k, m in camera.ipm.items()}
    assert np.sqrt((error["estimated"] ** 2).mean()) > 0.2
    assert np.sqrt((error["calibrated"] ** 2).mean()) < 0.06


@pytest.mark.parametrize("name", ["front", "rear"])
def test_the_region_of_interest_is_in_view(port, name):
    cam_from_map = port.cam_from_vehicle[name]
    assert inside_image(port.cameras[name].info, cam_from_map, port.cameras[name].roi_vehicle).all()


def test_a_port_has_hundreds_of_markings_and_scores_along_the_route(port):
    diamonds = np.array([m.corners_map for m in port.hd_map.markings if m.kind == DIAMOND])
    assert len(diamonds) >= 250
    assert (port.route.distance_to(diamonds.mean(axis=1)) < 3.8).sum() >= 120
    turned = np.rad2deg(np.ptp(port.route.yaw_rad))
    assert turned >= 170
    assert 350 <= port.route.length_m <= 450


def test_markings_run_counter_clockwise_and_keep_apart():
    route = build_route(RouteConfig())
    layout = build_layout(PaintConfig(), route, np.random.default_rng(1))
    corners = np.array([m.corners_map for m in layout.markings])
    following = np.roll(corners, -1, axis=1)
    area = 0.5 * (corners[..., 0] * following[..., 1] - following[..., 0] * corners[..., 1]).sum(axis=1)
    assert (area > 0).all()
    diamonds = np.array([m.corners_map.mean(axis=0) for m in layout.markings if m.kind == DIAMOND])
    gaps = np.linalg.norm(diamonds[:, None] - diamonds[None], axis=2) + 99 * np.eye(len(diamonds))
    assert gaps.min() > 1.6


def test_a_dashed_lane_bends_between_its_dashes_as_its_road_does():
    """Bent as sharply as yards are, a straight line across a gap would cut the bend by decimetres."""
    config = PaintConfig()
    route = build_route(RouteConfig(pieces=[[20.0, 0.0], [25.0, 120.0], [20.0, 0.0]]))
    layout = build_layout(config, route, np.random.default_rng(1))
    lanes = [lane.points_map for lane in layout.lanes if lane.kind == LANE_DASH]
    stations = np.arange(0.0, route.length_m, 0.01)
    for lane, offset_m in zip(lanes, config.dashed_offsets_m, strict=True):
        painted = route.points_at(stations, offset_m)
        beside = np.linalg.norm(lane[:, None] - painted, axis=2).min(axis=1)
        assert beside.max() < 0.12, "no more than a straight dash cuts"
        assert np.linalg.norm(np.diff(lane, axis=0), axis=1).max() <= 0.5 + 1e-3


def test_solid_lines_are_painted_where_their_truth_is_without_gaps():
    """The renderer fills convex outlines only, so that bends are painted in straight pieces."""
    route = build_route(RouteConfig(pieces=[[20.0, 0.0], [25.0, 120.0], [20.0, 0.0]]))
    layout = build_layout(PaintConfig(solid_offsets_m=[5.3]), route, np.random.default_rng(1))
    (line,) = (lane.points_map for lane in layout.lanes if lane.kind == LANE_LINE)
    quads = np.array([paint.polygon_map for paint in layout.paints if paint.kind == LANE_LINE])
    tails, heads = quads[:, [0, 3]].mean(axis=1), quads[:, [1, 2]].mean(axis=1)
    painted = tails[:, None] + np.linspace(0.0, 1.0, 40)[:, None] * (heads - tails)[:, None]
    true = route.points_at(np.arange(0.0, route.length_m, 0.005), 5.3)
    beside_m = np.linalg.norm(painted.reshape(-1, 1, 2) - true, axis=2).min(axis=1)
    assert beside_m.max() < 0.008
    assert np.median(beside_m) < 0.003  # true points lie 5 mm apart
    assert np.linalg.norm(line[:, None] - true, axis=2).min(axis=1).max() < 0.003
    for outer in (0, 3):
        last, first = quads[:-1, 1 if outer == 0 else 2], quads[1:, outer]
        assert (((last - first) * (heads - tails)[1:]).sum(axis=1) >= 0).all()


def test_the_route_turns_by_what_its_pieces_say():
    route = build_route(RouteConfig(pieces=[[30.0, 0.0], [20.0, 90.0], [30.0, 0.0]]))
    assert route.length_m == pytest.approx(80.0)
    assert np.rad2deg(route.yaw_rad[-1]) == pytest.approx(90.0, abs=0.5)
    assert route.points_map[-1][0] == pytest.approx(30 + 20 / (np.pi / 2), abs=0.1)


def test_correlated_noise_keeps_its_sigma_and_its_length():
    at = np.arange(0.0, 40000.0, 1.0)
    noise = correlated_noise(at, 2.0, 30.0, np.random.default_rng(0))[:, 0]
    assert noise.std() == pytest.approx(2.0, rel=0.1)
    assert np.corrcoef(noise[:-30], noise[30:])[0, 1] == pytest.approx(np.exp(-1), abs=0.08)


def test_disturbances_are_as_large_as_configured():
    config = RouteConfig(pieces=[[3000.0, 0.0]])
    configured = DisturbanceConfig()
    driven = drive_along(build_route(config), config, configured, np.random.default_rng(2))
    recorded, inside = interpolate(driven.recorded, driven.stamp_s, 0.5)
    assert inside.all()
    tilt = np.rad2deg(driven.map_from_vehicle[:, 2, :2])
    assert tilt.std(axis=0) == pytest.approx([configured.roll_pitch_deg] * 2, rel=0.08)
    error = (recorded - driven.map_from_vehicle)[:, :2, 3]
    assert np.sqrt((error**2).mean()) > 0.009
    assert not np.isin(driven.stamp_s, driven.recorded.stamp_s).any()


def test_hidden_points_are_those_the_picture_hides():
    """The slab test against the renderer: a box 1.5 m high, 8 m ahead of a camera 2.4 m up."""
    box = Box(centre_map=(8.0, 0.4), size_m=(1.0, 2.0, 1.5), yaw_rad=0.4)
    mount = FRONT
    cam_from_map = cam_from_vehicle(mount)
    info = info_of(PortConfig(), "front")
    rendered = Renderer(Scene(ground=Ground(), boxes=(box,))).render(
        info, cam_from_map, np.random.default_rng(0)
    )
    points = np.random.default_rng(1).uniform((5, -4), (25, 4), (800, 2))
    points = points[inside_image(info, cam_from_map, points)]
    centre = np.array([mount.x_m, mount.y_m, mount.z_m])
    px = distort_points(info, project_ground(info.intrinsic, cam_from_map, points)[0]).round().astype(int)
    agree = rendered.hidden[px[:, 1], px[:, 0]] == hidden_by([box], centre, points)
    assert agree.mean() > 0.985
    assert not hidden_by([box], centre, points).all()
    is_seen = points_seen(info, cam_from_map, points, placed_boxes([box]))
    assert is_seen.sum() == (~hidden_by([box], centre, points)).sum()


def _crosses(box, eye_map, points_map):
    """Which lines from an eye to points (N, 3) pass through a box on level ground, by numpy."""
    turn = np.array([[np.cos(box.yaw_rad), -np.sin(box.yaw_rad)], [np.sin(box.yaw_rad), np.cos(box.yaw_rad)]])
    ends = np.vstack([eye_map, points_map])
    eye, *ground = np.column_stack([(ends[:, :2] - box.centre_map) @ turn, ends[:, 2] - box.base_m])
    half_length, half_width = box.size_m[0] / 2, box.size_m[1] / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (np.array([-half_length, -half_width, 0.0]) - eye) / (ground - eye)
        second = (np.array([half_length, half_width, box.size_m[2]]) - eye) / (ground - eye)
    enter = np.fmin(first, second).max(axis=1)
    leave = np.fmax(first, second).min(axis=1)
    return (enter < np.minimum(leave, 1.0)) & (leave > 0)


def test_lines_through_boxes_are_those_that_numpy_names():
    rng = np.random.default_rng(3)
    eye_map = np.array([0.5, -0.25, 2.5])
    points_map = np.column_stack([rng.uniform(-20, 20, (4000, 2)), np.zeros(4000)])
    points_map[:500, 0] = eye_map[0]  # straight ahead of the eye: a line along two sides of an unturned box
    boxes = [
        Box(centre_map=tuple(rng.uniform(-9, 9, 2)), size_m=(3.0, 2.0, 2.0), yaw_rad=yaw, base_m=base)
        for yaw, base in ((0.0, 0.0), (0.7, 0.0), (2.0, 1.2), (0.0, 1.0))
    ]
    expected = np.any([_crosses(box, eye_map, points_map) for box in boxes], axis=0)
    assert 0.05 < expected.mean() < 0.95
    assert np.array_equal(hidden_by(boxes, eye_map, points_map), expected)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"cameras": {}}, "cameras"),
        ({"initial_ipm": "guess"}, "initial_ipm"),
        ({"route": RouteConfig(pieces=[])}, "route.pieces"),
        ({"route": RouteConfig(pieces=[[20.0, 0.0]])}, "route.pieces: 20 m in total; give 25 m"),
        ({"calibration": CalibrationConfig(points_ahead_m=[[4, 0], [6, 0], [8, 0]])}, "points_ahead_m"),
        (
            {"calibration": CalibrationConfig(points_ahead_m=[[1, 9], [4, 1], [8, 1], [9, -2]])},
            "outside camera",
        ),
    ],
)
def test_a_port_that_cannot_be_is_refused_by_name(changes, word):
    with pytest.raises(ConfigError, match=word):
        build_port(tiny_port(**changes))


def test_the_stated_drift_is_that_of_the_recorded_positions():
    """Over many short drives, errors 5 m apart covary as the drift alone and errors at one place as all."""
    config = RouteConfig(pieces=[[12.0, 0.0]], pose_rate_hz=20.0)
    disturbance = DisturbanceConfig(rtk_white_m=0.006, rtk_correlated_m=0.01, rtk_correlation_m=10.0)
    stated = pose_noise(disturbance, config.speed_mps)
    route = build_route(config)
    errors = []
    for seed in range(400):
        driven = drive_along(route, config, disturbance, np.random.default_rng(seed))
        station = route.station_at(driven.recorded.stamp_s)
        errors.append(driven.recorded.map_from_vehicle[:, :2, 3] - route.points_at(station))
    error = np.stack(errors)
    later = int(np.searchsorted(station, station[0] + 5.0))
    apart_m = station[later] - station[0]
    same, across = np.mean(error[:, 0] ** 2), np.mean(error[:, 0] * error[:, later])
    fade = np.exp(-apart_m / stated.position_drift_over_m)
    assert same == pytest.approx(stated.position_m**2, rel=0.2)
    assert across == pytest.approx(stated.position_drift_m**2 * fade, rel=0.3)
    assert stated.heading_drift_over_m == config.speed_mps * disturbance.heading_correlation_s


def test_another_session_finds_the_same_paint_under_other_noise():
    first, second = build_port(tiny_port()), build_port(tiny_port(session=1))
    for marking, other in zip(first.hd_map.markings, second.hd_map.markings, strict=True):
        np.testing.assert_array_equal(marking.corners_map, other.corners_map)
    assert not np.allclose(first.driven.map_from_vehicle, second.driven.map_from_vehicle, atol=1e-6)
    camera = next(iter(first.cameras))
    assert (first.picture(camera, 0).image != second.picture(camera, 0).image).any()


PAD = [[-0.6, -0.3], [-0.6, 0.3], [0.6, 0.3], [0.6, -0.3]]
"""Clockwise on purpose."""

T = [
    [[0.35, -0.5], [0.5, -0.5], [0.5, 0.5], [0.35, 0.5]],
    [[-0.5, -0.075], [0.36, -0.075], [0.36, 0.075], [-0.5, 0.075]],
]
STENCILS = {"pad": StencilConfig(shapes_m=[PAD], spacing_m=8.0), "parking_t": StencilConfig(shapes_m=T)}


def test_own_quadrilaterals_are_true_markings_and_symbols_are_paint():
    port = build_port(PortConfig(paint=PaintConfig(stencils=STENCILS)))
    paints = [paint.kind for paint in port.renderer.scene.paints]
    pads = [marking.corners_map for marking in port.hd_map.markings if marking.kind == "pad"]
    assert len(pads) == paints.count("pad") > 40
    assert paints.count("parking_t") > 60
    assert paints.count("parking_t") % 2 == 0
    assert "parking_t" not in {marking.kind for marking in port.hd_map.markings}
    assert all(signed_area(corners) == pytest.approx(0.72) for corners in pads)
    centres = np.array([corners.mean(axis=0) for corners in pads])
    others = np.array([m.corners_map.mean(axis=0) for m in port.hd_map.markings if m.kind == "diamond"])
    assert np.linalg.norm(centres[:, None] - others, axis=2).min() > 1.6


def test_a_port_with_stencils_is_otherwise_the_same():
    plain, stencilled = build_port(tiny_port()), build_port(tiny_port(paint=PaintConfig(stencils=STENCILS)))
    before, after = plain.renderer.scene.paints, stencilled.renderer.scene.paints
    assert len(after) > len(before)
    for paint, other in zip(before, after, strict=False):
        assert replace(paint, polygon_map=0) == replace(other, polygon_map=0)  # type: ignore[arg-type]
        np.testing.assert_array_equal(paint.polygon_map, other.polygon_map)


def test_own_paint_has_labels_after_those_of_the_shipped_classes():
    port = build_port(tiny_port(paint=PaintConfig(stencils=STENCILS)))
    shown = np.unique([port.picture("front", frame).labels for frame in range(3)])
    assert 1 + len(PAINT_CLASSES) in shown
    assert shown.max() <= len(PAINT_CLASSES) + 2


@pytest.mark.parametrize(
    ("stencils", "words"),
    [
        ({"diamond": StencilConfig(shapes_m=[PAD])}, "stencils.diamond: a class of this name"),
        ({"pad": StencilConfig(shapes_m=[])}, "stencils.pad.shapes_m"),
        ({"pad": StencilConfig(shapes_m=[PAD[:2]])}, "stencils.pad.shapes_m"),
        ({"pad": StencilConfig(shapes_m=[[*PAD[:3], [0.0, 0.2]]])}, "convex"),
        ({"pad": StencilConfig(shapes_m=[[*PAD[:3], [float("nan"), 0.2]]])}, "convex"),
        ({"pad": StencilConfig(shapes_m=[PAD], spacing_m=0.5)}, "stencils.pad.spacing_m"),
    ],
)
def test_stencils_that_cannot_be_painted_are_refused(stencils, words):
    with pytest.raises(ConfigError, match=words):
        build_port(tiny_port(paint=PaintConfig(stencils=stencils)))


def test_ports_without_stencils_keep_their_folder_in_the_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(drive, "render_drive", lambda *_: None)
    plain = drive.rendered_drive(PortConfig(), tmp_path, HERE, lambda done, total: None)
    stencilled = PortConfig(paint=PaintConfig(stencils=STENCILS))
    assert plain.name == "port1-5152c55c71"
    assert drive.rendered_drive(stencilled, tmp_path, HERE, lambda done, total: None) != plain


def test_a_port_is_rendered_once_per_seed_and_has_its_truth(tmp_path):
    first, again = (simulate_port(tmp_path, tiny_port()) for _ in range(2))
    other = simulate_port(tmp_path, replace(tiny_port(), seed=5))
    assert first.root == again.root != other.root
    assert first.truth_dir is not None
    assert len(first.images) == 22
