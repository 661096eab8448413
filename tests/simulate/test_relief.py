"""Ports on ground that is no plane: pixels show what they meet first, and the truth has heights."""

import numpy as np
import pytest

from tests.simulate.conftest import tiny_port
from tests.simulate.test_rendering import BARE, CAM_FROM_MAP, CLEAN, INFO, edge_offset_px
from v2hdm.errors import ConfigError
from v2hdm.executor import HERE
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.rigid import euler_from_rotation
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.records import DIAMOND
from v2hdm.report.metrics import driven_past
from v2hdm.simulate.port.build import build_port
from v2hdm.simulate.port.config import ReliefConfig
from v2hdm.simulate.port.drive import inside_image, placed_boxes, points_seen, render_drive
from v2hdm.simulate.port.route import stands
from v2hdm.simulate.render.ground import intersect_ground
from v2hdm.simulate.render.relief import Relief
from v2hdm.simulate.render.renderer import Renderer
from v2hdm.simulate.render.scene import Box, Paint, Scene, standing
from v2hdm.simulate.render.view import View, camera_rays


def relief_of(height, reach_m=60.0, step_m=0.25):
    """The relief of a function of x and y, around the origin."""
    at = np.arange(-reach_m, reach_m, step_m)
    return Relief(knots=height(*np.meshgrid(at, at)), origin_map=(-reach_m, -reach_m), step_m=step_m)


def waves(x, y):
    return 0.8 * np.sin(x / 4.0) + 0.05 * np.cos(y / 3.0)


def roof(x, y):
    return 0.04 * x - 0.05 * np.abs(y) + 0.0125


def test_pixels_show_the_ground_that_their_rays_meet_first():
    relief = relief_of(waves)
    view = View(camera_rays(INFO), CAM_FROM_MAP, relief)
    field = intersect_ground(view)
    is_near = field.below & (field.depth_m < 40.0)
    points = np.stack([field.x_m[is_near], field.y_m[is_near]], axis=1).astype(np.float64)
    seen_px = view.homogeneous_px(view.on_ground(points))
    pixels = np.dstack([view.rays.u_pinhole_px, view.rays.v_pinhole_px])[field.first_row :][is_near]
    assert np.abs(seen_px[:, :2] / seen_px[:, 2:] - pixels).max() < 0.01
    assert np.ptp(relief.height_m(points)) > 0.7
    # No ground before it reaches up to the ray: behind crests there is ground that no pixel shows.
    some = np.random.default_rng(0).permutation(len(points))[:2000]
    sight = np.linspace(0.02, 0.995, 300)[:, None, None] * (view.on_ground(points[some]) - view.centre_map)
    sight += view.centre_map
    assert (relief.height_m(sight[..., :2]) < sight[..., 2] + 1e-3).all()
    assert np.diff(np.sort(points[np.abs(points[:, 1]) < 0.5, 0])).max() > 2.0


@pytest.mark.parametrize("centre", [(6.0, -1.4), (8.0, 1.6)])
def test_a_painted_edge_lies_where_its_corners_on_the_ground_are_projected(centre):
    relief = relief_of(roof)
    diamond = np.array([[1.2, 0.0], [0.0, 0.9], [-1.2, 0.0], [0.0, -0.9]]) + centre
    paint = Paint(kind=DIAMOND, polygon_map=diamond, wear=0.0, dirt=0.0)
    scene = Scene(ground=BARE, paints=(paint,), relief=relief)
    rendered = Renderer(scene).render(INFO, CAM_FROM_MAP, np.random.default_rng(0), CLEAN)
    seen_px = View(camera_rays(INFO), CAM_FROM_MAP, relief).homogeneous_px(
        np.column_stack([diamond, relief.height_m(diamond)])
    )
    corners = seen_px[:, :2] / seen_px[:, 2:]
    assert max(abs(edge_offset_px(rendered, corners[k], corners[(k + 1) % 4])) for k in range(4)) < 0.05


def test_truth_calls_points_hidden_that_lie_behind_a_box_on_a_slope_or_behind_a_crest():
    relief = relief_of(waves)
    box = standing(Box(centre_map=(7.0, 0.4), size_m=(1.0, 2.0, 1.0), yaw_rad=0.4), relief)
    scene = Scene(ground=BARE, boxes=(box,), relief=relief)
    hidden = Renderer(scene).render(INFO, CAM_FROM_MAP, np.random.default_rng(0), CLEAN).hidden
    view = View(camera_rays(INFO), CAM_FROM_MAP, relief)
    field = intersect_ground(view)
    points = np.random.default_rng(1).uniform((5, -3), (25, 3), (2000, 2))
    points = points[inside_image(INFO, CAM_FROM_MAP, points, relief)]
    px = view.homogeneous_px(view.on_ground(points))
    column, row = distort_points(INFO, px[:, :2] / px[:, 2:]).round().astype(int).T
    at = row - field.first_row
    shows = np.hypot(field.x_m[at, column] - points[:, 0], field.y_m[at, column] - points[:, 1])
    shown = (shows < 3 * field.footprint_m[at, column]) & ~hidden[row, column]
    is_seen = points_seen(INFO, CAM_FROM_MAP, points, placed_boxes([box]), relief)
    # Beside a crest a pixel shows metres, and points differ by its rounding.
    assert (is_seen == shown).mean() > 0.95
    assert (~is_seen).sum() > 300
    assert (~points_seen(INFO, CAM_FROM_MAP, points, placed_boxes([]), relief)).sum() > 200


def test_a_vehicle_stands_on_its_wheels():
    at, yaw = np.array([[10.0, 0.0], [10.0, 4.0]]), np.array([0.0, np.pi / 2])
    ahead, across = stands(relief_of(lambda x, y: 0.04 * x - 0.05 * np.abs(y)), at, yaw)
    # Its wheels straddle the ridge, and beside it the vehicle drives down.
    np.testing.assert_allclose(ahead, [0.4 - 0.05 * 0.8, 0.0, -np.arctan(0.04)], atol=1e-9)
    np.testing.assert_allclose(across, [0.4 - 0.05 * 4.0, -np.arctan(0.04), np.arctan(0.05)], atol=5e-5)


@pytest.fixture(scope="module")
def hill(tmp_path_factory):
    folder = tmp_path_factory.mktemp("relief") / "tiny"
    render_drive(HILL, folder, HERE, lambda done, total: None)
    return folder


HILL = tiny_port(relief=ReliefConfig(grade=0.05, crown=0.03))


def test_a_port_on_a_relief_is_the_flat_one_with_heights(hill):
    flat, port, drive = build_port(tiny_port()), build_port(HILL), read_drive(hill)
    truth, relief = read_truth(drive), port.renderer.scene.relief
    for marking, other in zip(truth.map.markings, flat.hd_map.markings, strict=True):
        np.testing.assert_allclose(marking.corners_map, other.corners_map, atol=1e-6)
        np.testing.assert_allclose(marking.heights_m, relief.height_m(marking.corners_map), atol=1e-4)
    assert all(lane.heights_m is not None for lane in truth.map.lanes)
    z = np.unique(truth.map_from_vehicle[:, 2, 3])
    assert np.ptp(z) > 0.5
    pitch = [euler_from_rotation(pose[:3, :3])[1] for pose in truth.map_from_vehicle[:4]]
    np.testing.assert_allclose(pitch, -np.arctan(0.05), atol=0.008)
    # As many are driven past as on the plane, and the recorded heights are the receiver's.
    assert driven_past(drive, truth, ("front", "rear")).sum() > 5
    off = (
        drive.recorded.map_from_vehicle[:, 2, 3]
        - port.route.points_at(port.route.station_at(drive.recorded.stamp_s))[:, 0] * 0.05
    )
    assert 0.0 < np.std(off) < 0.05
    shown = np.array([disturbance for name, disturbance in truth.disturbances.items() if "actual" in name])
    assert (shown < 0.2).all()


@pytest.mark.parametrize("relief", [{"ramp": 0.05, "ramp_at_m": 10.0}, {"bank": 0.05, "ramp_length_m": 90.0}])
def test_a_ramp_beyond_the_route_is_refused(relief):
    with pytest.raises(ConfigError, match=r"simulate.relief: the ramp ends \d+ m along a route of 30 m"):
        build_port(tiny_port(relief=ReliefConfig(**relief)))
