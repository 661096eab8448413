"""The van of the closed loop, its follower, and how its room is measured."""

import numpy as np
import pytest

from tests.benchmarks.made.closed_loop import Lap
from tests.benchmarks.made.follower import Follower, PlannedPath
from tests.benchmarks.made.van import HALF_WIDTH_M, STEP_S, WHEELBASE_M, Van, clearance_m, outlines

RADIUS_M = 20.0


def _van(**at):
    return Van(np.random.default_rng(0), np.zeros(2), 0.0, **at)


def _circle():
    angle = np.linspace(0, 1.8 * np.pi, 400)
    return PlannedPath.recorded(RADIUS_M * np.column_stack([np.sin(angle), 1 - np.cos(angle)]))


def _lap(clearance):
    none = np.zeros(len(clearance))
    poses = np.zeros((len(clearance), 3))
    return Lap(none, poses, none, np.array(clearance), none, np.zeros((0, 4, 4)), 0, 0.0, 0.0)


def test_a_steered_van_drives_the_circle_of_its_wheelbase():
    van = _van(speed_m_s=4.0)
    van.steer_off_rad = 0.0
    for _ in range(round(20.0 / STEP_S)):
        van.step(np.arctan(WHEELBASE_M / RADIUS_M), 4.0)
    assert van.heading_rad == pytest.approx(4.0 * 20.0 / RADIUS_M, abs=0.05)
    assert van.place_map[1] == pytest.approx(RADIUS_M * (1 - np.cos(van.heading_rad)), abs=0.2)


def test_a_recorded_circle_has_its_curvature():
    path = _circle()
    assert path.curvature[50:-50] == pytest.approx(np.full(len(path.curvature) - 100, 1 / RADIUS_M), abs=1e-3)


def test_a_foot_says_how_a_vehicle_is_off():
    path = PlannedPath.recorded(np.column_stack([np.linspace(0, 50, 101), np.zeros(101)]))
    foot = path.foot(np.array([20.03, 0.4]), 0.1, 19.0)
    assert foot == pytest.approx((20.03, 0.4, 0.1), abs=1e-6)


@pytest.mark.parametrize("pull_deg", [-0.6, 0.6])
def test_a_follower_comes_back_to_the_path_though_the_steering_pulls_aside(pull_deg):
    path = _circle()
    van = _van(speed_m_s=4.0)
    van.place_map = np.array([0.0, 0.3])
    van.steer_off_rad = np.deg2rad(pull_deg)
    follower = Follower(path)
    left_m = []
    while follower.station_m < path.length_m - 5.0:
        van.step(follower.steer(van.place_map, van.heading_rad, van.speed_m_s), 4.0)
        left_m.append(path.foot(van.place_map, van.heading_rad, follower.station_m).left_m)
    assert np.abs(left_m[-500:]).max() < 0.02


def test_a_border_is_as_far_as_the_side_of_the_van():
    borders = np.column_stack([np.linspace(-10, 10, 2001), np.full(2001, HALF_WIDTH_M + 0.25)])
    assert clearance_m(_van(), borders) == pytest.approx(0.25, abs=1e-9)
    assert clearance_m(_van(), borders - [0, 0.35]) == pytest.approx(-0.1, abs=1e-9)


def test_clearance_is_negative_just_where_the_outline_holds_a_point():
    rng = np.random.default_rng(1)
    van = _van()
    van.place_map = np.array([3.0, -2.0])
    van.heading_rad = 0.7
    (outline,) = outlines(np.array([[3.0, -2.0, 0.7]]))
    for point in rng.uniform(-6, 8, (300, 2)):
        sides = np.roll(outline, -1, axis=0) - outline
        offsets = point - outline
        is_inside = bool((sides[:, 0] * offsets[:, 1] - sides[:, 1] * offsets[:, 0] > 0).all())
        assert (clearance_m(van, point[None]) < 0) == is_inside


def test_touches_are_counted_as_they_begin():
    assert _lap([0.1, -0.1, -0.2, 0.1, -0.1]).collisions == 2
    assert _lap([-0.1, 0.1]).collisions == 1
    assert _lap([]).collisions == 0
