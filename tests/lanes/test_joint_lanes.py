"""Lanes that take part in the adjustment: knots on splines, seen as lines that pass them."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from tests.benchmarks.highway import LINES, few_dashes, mounting_of
from tests.mapping.scene import SceneOptions, make_scene
from v2hdm.adjust import ControlPoints
from v2hdm.io.maps.features import features_of, map_of
from v2hdm.lanes.knots import _catmull_rom, draw_lanes, find_knots
from v2hdm.mapping.inputs import Inputs
from v2hdm.mapping.optimise import Optimiser
from v2hdm.mapping.options import MappingOptions
from v2hdm.records import HDMap
from v2hdm.site.options import JOINT, LaneOptions

JOINTLY = MappingOptions(lanes=LaneOptions(model=JOINT))


@pytest.fixture(scope="module")
def highway():
    """A straight road between two solid lines, with few dashes, and one camera."""
    options = SceneOptions(seed=5, length_m=120.0, turns=False, dashes_only=True, lines=LINES)
    return make_scene(replace(options, cameras=("front",)), few_dashes)


@pytest.fixture(scope="module")
def inputs(highway):
    return Inputs(highway.drive, highway.detections, ("front",), JOINTLY)


@pytest.fixture(scope="module")
def solved(inputs):
    """The same settled drive, concluded without lanes and with them."""
    optimiser: Optimiser = inputs.optimiser
    settled = optimiser.settle(inputs.tracks)
    return optimiser.finish(settled), optimiser.finish(settled, find_knots=inputs.find_knots)


def test_on_a_highway_lanes_make_yaw_and_pitch_much_surer(highway, solved):
    (_, without), (error, joint) = (mounting_of(optimum, highway) for optimum in solved)
    pitch, yaw = joint[1:3] / without[1:3]
    assert yaw <= 0.6
    assert pitch <= 0.6
    assert (joint <= without).all()
    assert (np.abs(error) < 3 * joint).all()


def test_lanes_leave_the_markings_and_what_is_said_of_them_as_they_were(solved):
    without, joint = solved
    assert len(joint.markings) == len(without.markings)
    bundle = joint.bundle
    assert len(bundle.solution.residual_px) == len(bundle.row) == len(bundle.solution.verdict)
    assert bundle.corners_map.shape == without.bundle.corners_map.shape
    assert 0.7 < bundle.solution.chi2_per_dof < 1.3


def test_points_of_a_line_show_their_own_errors(highway, solved):
    """Lines are about as far off in images as stated; this scene's have no error in common along a line."""
    knots, bundle = solved[1].bundle.knots, solved[1].bundle
    corner = bundle.solution.corners_map[-knots.count :][knots.knot]
    ground = np.column_stack([corner, np.zeros(len(corner)), np.ones(len(corner))])
    cam_from_map = bundle.rig.cam_from_map(knots.camera, knots.frame)[:, :3]
    pinhole = (cam_from_map @ ground[..., None])[..., 0] @ bundle.rig.intrinsic[0].T
    off_px = pinhole[:, :2] / pinhole[:, 2:] - knots.pinhole_px
    across = off_px[:, 0] * knots.line[:, 1] - off_px[:, 1] * knots.line[:, 0]
    assert 0.25 < np.median(across**2 / knots.variance_px2) / chi2.median(1) < 1


def test_the_direction_of_a_line_is_its_knot_s_and_not_its_points(solved):
    """Otherwise errors of an image and of its Jacobian were correlated, which turned the camera by roll."""
    knots, rig = solved[1].bundle.knots, solved[0].bundle.rig
    rows = np.flatnonzero(knots.unknown >= 0)[knots.knot]
    ends_map = knots.points_map[rows] + np.array([[[-1e-4]], [[1e-4]]]) * knots.along[rows]
    ground = np.dstack([ends_map, np.zeros(ends_map.shape[:2]), np.ones(ends_map.shape[:2])])
    cam = np.einsum("kij,ekj->eki", rig.cam_from_map(knots.camera, knots.frame)[:, :3], ground)
    behind, ahead = (cam @ rig.intrinsic[0].T)[..., :2] / cam[..., 2:]
    line = (ahead - behind) / np.linalg.norm(ahead - behind, axis=1, keepdims=True)
    np.testing.assert_allclose(line, knots.line, atol=1e-6)


def test_lane_vertices_are_as_far_off_as_their_sigmas_say(highway, solved):
    bundle = solved[1].bundle
    lanes = draw_lanes(bundle.knots, bundle.solution, 0.5)
    heading, off = 0.3, []
    for lane in lanes:
        assert lane.sigma_m is not None
        assert lane.sigma_m.shape == (len(lane.points_map),)
        if lane.kind == "lane_line":
            lateral = lane.points_map @ [-np.sin(heading), np.cos(heading)]
            off.append((lateral - LINES[int(lateral.mean() > 0)]) / lane.sigma_m)
    assert len(off) == 2
    assert np.abs(np.concatenate(off)).max() < 3


def test_a_vertex_states_what_extrinsics_and_poses_leave_open(solved):
    """All vertices of a line share the camera's own uncertainty: no sigma is below what is common to them."""
    bundle = solved[1].bundle
    camera_m = np.sqrt(bundle.solution.extrinsic_covariance[0, 0, 0])
    sigmas = np.concatenate([lane.sigma_m for lane in draw_lanes(bundle.knots, bundle.solution, 0.5)])
    assert sigmas.min() > 0.3 * camera_m


def test_knots_move_across_their_line_only(solved):
    knots, solution = solved[1].bundle.knots, solved[1].bundle.solution
    is_free = knots.unknown >= 0
    moved = solution.corners_map[-knots.count :] - knots.points_map[is_free]
    assert np.abs((moved * knots.along[is_free]).sum(axis=1)).max() < 1e-3
    assert np.abs(moved).max() > 2e-3


@pytest.mark.parametrize("count", [2, 3, 6])
def test_a_spline_runs_through_its_knots_and_follows_lines_and_bends(count):
    knots, stations = 2.0 * np.arange(count), np.linspace(0, 2.0 * (count - 1), 23)
    weight = _catmull_rom(knots, stations).toarray()
    np.testing.assert_allclose(weight.sum(axis=1), 1)
    np.testing.assert_allclose(weight @ knots, stations, atol=1e-12)
    np.testing.assert_allclose(_catmull_rom(knots, knots).toarray(), np.eye(count), atol=1e-12)
    if count > 2:
        np.testing.assert_allclose(weight @ knots**2, stations**2, atol=1e-10)


def test_a_turn_of_eight_metres_is_followed_to_a_millimetre():
    knots = np.arange(0, 20.0, 2.0)
    circle = 8 * np.column_stack([np.sin(knots / 8), np.cos(knots / 8)])
    radius = np.linalg.norm(_catmull_rom(knots, np.linspace(0, 18, 91)) @ circle, axis=1)
    assert np.abs(radius - 8)[5:-5].max() < 1e-3
    assert np.abs(radius - 8).max() < 4e-3


def test_a_line_that_too_few_images_show_is_named_and_keeps_its_place(highway, inputs, solved, caplog):
    options = replace(JOINTLY.lanes, min_images=1)
    few = [in_image for in_image in highway.detections if in_image.image in (20, 21)]
    rig = solved[0].bundle.rig
    arguments = highway.drive, few, ("front",), rig, None
    assert find_knots(*arguments, options).count
    with caplog.at_level(logging.WARNING):
        drawn_by_one = find_knots(highway.drive, few[:1], *arguments[2:], options)
    assert "lane lines are not in the adjustment" in caplog.text
    assert not drawn_by_one.count
    assert draw_lanes(drawn_by_one, solved[0].bundle.solution, 0.5) == drawn_by_one.lanes


def test_a_drive_without_lane_paint_has_no_knots(highway, inputs, solved):
    bare = [replace(in_image, lanes=()) for in_image in highway.detections]
    assert find_knots(highway.drive, bare, ("front",), solved[0].bundle.rig, None, JOINTLY.lanes) is None


def test_sigmas_survive_writing_and_reading_as_features(solved):
    bundle = solved[1].bundle
    lanes = draw_lanes(bundle.knots, bundle.solution, 0.5)
    again = map_of(features_of(HDMap((), lanes)), range(1, len(lanes) + 1), None)
    for lane, other in zip(lanes, again.lanes, strict=True):
        np.testing.assert_array_equal(lane.sigma_m, other.sigma_m)


@pytest.mark.parametrize("along", [[1.0, 0.0], [0.0, 1.0], [-0.6, 0.8], [1e-9, 1.0]])
def test_a_survey_that_knows_one_direction_holds_a_corner_in_that_alone(along):
    point = ControlPoints(np.zeros(1, int), np.zeros((1, 2)), np.array([[0.1, np.inf]]), np.array([along]))
    ((a, b, c),) = point.root_information
    root = np.array([[a, 0], [b, c]])
    np.testing.assert_allclose(root.T @ root, 100 * np.outer(along, along), atol=1e-6)
