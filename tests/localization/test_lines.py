"""Solid lines of a map hold a vehicle in its lane between markings, and no better than they are known."""

from dataclasses import replace

import numpy as np
import pytest

from tests.localization.driven import MOUNT, cameras, drive, lined, mapped, yard
from v2hdm.localization.belief import HEADING, Plane, start
from v2hdm.localization.joint import Scene
from v2hdm.localization.lines import LineMap, _observed, with_lines
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.motion import MotionNoise
from v2hdm.localization.paint import Paint
from v2hdm.localization.pose import Status
from v2hdm.localization.seeing import Look, expect_points, pieces_of_lines, sighted
from v2hdm.records import HDMap, Lane, LaneDetection

SIGMA = np.array([0.05, 0.05, np.deg2rad(0.5)])


def line_at(y_m, begin_m=-5.0, end_m=40.0, sigma_m=0.01):
    """A line along x."""
    x_m = np.arange(begin_m, end_m, 0.5)
    points_map = np.column_stack([x_m, np.full(len(x_m), y_m)])
    return Lane("lane_line", points_map, 10, sigma_m=np.full(len(x_m), sigma_m))


def before(lines, y_m=0.0, heading_rad=0.0, sigma=SIGMA):
    """A belief at (0, y) and a camera ahead of it before a map of lines alone."""
    hd_map = HDMap((), tuple(lines))
    calibrations = cameras()
    belief = start(0.0, np.array([0.0, y_m, heading_rad]), sigma, [MOUNT, MOUNT], MotionNoise())
    nothing = sighted(Look("front", 0.0), calibrations["front"])
    scene = Scene(nothing, Paint(hd_map), Plane(), 0, calibrations["front"], 1.0)
    return belief, scene, LineMap(hd_map, 0.0, 0)


def piece_of(y_m, first_m=5.0, last_m=14.0, slope=0.0):
    """Points of a line along x as the camera ahead of a vehicle at the origin shows them."""
    belief, scene, _ = before([])
    x_m = np.arange(first_m, last_m, 0.5)
    points_map = np.column_stack([x_m, y_m + slope * (x_m - x_m.mean()), np.zeros(len(x_m))])
    return expect_points(belief, scene.plane, 0, scene.calibration, points_map).px


def test_a_piece_tells_distance_and_direction_and_nothing_along_the_line():
    belief, scene, line_map = before([line_at(-1.7)], y_m=0.06, heading_rad=0.004)
    update = with_lines(belief, scene, line_map, [piece_of(-1.7), piece_of(-1.7, 6.0, 12.0)])
    assert len(update.observations) == 2
    assert update.belief.mean[1] == pytest.approx(0.0, abs=0.01)
    assert update.belief.mean[HEADING] == pytest.approx(0.0, abs=0.0015)
    sigma = np.sqrt(np.diag(update.belief.covariance([0, 1, HEADING])))
    assert sigma[0] == pytest.approx(SIGMA[0], rel=0.01)
    assert sigma[1] < 0.5 * SIGMA[1]
    assert sigma[2] < 0.5 * SIGMA[2]


def test_no_number_of_images_makes_the_place_surer_than_the_line_is_mapped():
    belief, scene, line_map = before([line_at(-1.7, sigma_m=0.02)])
    for _ in range(200):
        belief = with_lines(belief, scene, line_map, [piece_of(-1.7)]).belief
    across_m = float(np.sqrt(belief.covariance([1])[0, 0]))
    assert 0.01 < across_m < 0.03


def test_points_of_one_piece_are_wrong_together():
    """Twice as many points on the same way make its distance hardly surer."""
    belief, scene, line_map = before([line_at(-1.7)])
    points_px = piece_of(-1.7)
    dense_px = np.stack(
        [
            np.interp(np.arange(0, len(points_px) - 0.5, 0.5), np.arange(len(points_px)), axis)
            for axis in points_px.T
        ],
        axis=1,
    )
    (thin,) = with_lines(belief, scene, line_map, [points_px]).observations
    (dense,) = with_lines(belief, scene, line_map, [dense_px]).observations
    assert dense.noise[0, 0] > 0.8 * thin.noise[0, 0]


@pytest.mark.parametrize("state", [0, 1, 2, 5, 6, 7, 10, 11, 12, 13, 14, 15, 22, 23])
def test_the_derivative_of_an_observation_is_that_of_its_difference(state):
    belief, scene, line_map = before([line_at(-1.7)])
    points_px = piece_of(-1.7, 5.0, 11.0)
    held = with_lines(belief, scene, line_map, [points_px]).belief
    held = replace(held, mean=np.zeros(len(held.mean)), root=np.eye(len(held.mean)))
    points_map = np.column_stack([np.arange(5.0, 11.0, 0.5), np.full(12, -1.7)])
    feet = line_map.feet(points_map, line_map.near(np.zeros(2), 30.0))[0]
    residuals = []
    for step in (1e-5, -1e-5):
        mean = held.mean.copy()
        mean[state] = step
        residuals.append(_observed(replace(held, mean=mean), scene, 0, 0, points_px, feet).residual)
    at_mean = _observed(held, scene, 0, 0, points_px, feet)
    numeric = (residuals[1] - residuals[0]) / 2e-5
    np.testing.assert_allclose(at_mean.slope[:, state], numeric, rtol=0.02, atol=0.02)


def test_a_piece_between_two_lines_that_either_explains_decides_nothing():
    belief, scene, line_map = before([line_at(-1.65), line_at(-1.75)], sigma=2 * SIGMA)
    assert not with_lines(belief, scene, line_map, [piece_of(-1.7)]).observations


@pytest.mark.parametrize(
    ("y_m", "slope", "first_m", "last_m"),
    [(-2.3, 0.0, 5.0, 14.0), (-1.7, 0.1, 5.0, 14.0), (-1.7, 0.0, 5.0, 6.5), (-1.7, 0.0, 60.0, 80.0)],
)
def test_another_edge_a_bend_and_a_bit_of_paint_are_no_view_of_the_line(y_m, slope, first_m, last_m):
    belief, scene, line_map = before([line_at(-1.7)])
    assert not with_lines(belief, scene, line_map, [piece_of(y_m, first_m, last_m, slope)]).observations


def test_what_lies_beyond_the_end_of_a_line_is_no_view_of_it():
    belief, scene, line_map = before([line_at(-1.7, end_m=4.5)])
    assert not with_lines(belief, scene, line_map, [piece_of(-1.7)]).observations


def test_dashes_are_no_lines_for_their_corners_say_more():
    look = Look("front", 0.0, (), (LaneDetection("lane_dash", 0.9, piece_of(-1.7)),))
    assert pieces_of_lines(look, cameras()["front"]) == []


@pytest.mark.parametrize("seed", range(2))
def test_a_line_holds_the_vehicle_in_its_lane_where_no_marking_is(seed):
    painted = lined(yard(seed))
    driven = drive(painted, seed, seconds=19.0)
    hd_map = mapped(painted, seed)
    errors, bounds = {}, {}
    for has_lines in (True, False):
        localizer = Localizer(hd_map, driven.calibrations, driven.rough(np.random.default_rng(0)))
        for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
            blind = [replace(look, markings=()) if frame > 60 else look for look in looks]
            shown = blind if has_lines else [replace(look, lanes=()) for look in blind]
            pose = localizer.update(shown, motion)
        assert pose.status == Status.TRACKING
        assert (pose.matched_lines > 0) == has_lines
        errors[has_lines] = abs(driven.errors(pose, len(driven.looks) - 1)[1])
        bounds[has_lines] = pose.protection_m[1]
    assert errors[True] < min(0.02, bounds[True])
    assert errors[False] < bounds[False]
    assert bounds[True] < 0.3 * bounds[False]


def test_a_line_that_was_painted_elsewhere_does_not_move_a_pose_that_markings_hold():
    painted = lined(yard(3))
    driven = drive(painted, 3, seconds=6.0)
    (line,) = painted.lanes
    elsewhere = replace(line, points_map=line.points_map + np.array([0.0, 0.25]))
    hd_map = replace(mapped(painted, 3), lanes=(elsewhere,))
    localizer = Localizer(hd_map, driven.calibrations, driven.rough(np.random.default_rng(0)))
    for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
        pose = localizer.update(looks, motion)
        if pose.status == Status.TRACKING:
            errors = np.abs(driven.errors(pose, frame))
            assert (errors < [*pose.protection_m, pose.protection_rad]).all()
    assert pose.status == Status.TRACKING
    assert errors[1] < 0.02
