import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.drive.road import lay_flat, log_road, unevenness
from v2hdm.records import FloatArray, Road, Trajectory

SIGMA_M = 0.02
STEP_M = 0.5
Slope = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


def plane(by_x, by_y, up_m=0.0):
    """Height (P,) and slope (P, 2) at points (P, 2) of a plane."""
    return lambda at: (up_m + at @ [by_x, by_y], np.tile([by_x, by_y], (len(at), 1)))


def ramp(from_m, length_m, rise_m):
    """A ramp by x between two level grounds, rounded at both ends: half a wave of a cosine."""

    def ground(at):
        phase = np.pi * np.clip((at[:, 0] - from_m) / length_m, 0.0, 1.0)
        slope = 0.5 * np.pi * rise_m / length_m * np.sin(phase)
        return 0.5 * rise_m * (1.0 - np.cos(phase)), np.column_stack([slope, np.zeros(len(at))])

    return ground


def turning(length_m=150.0):
    """Points (P, 2) and heading (P,) of a route with two left turns of 90 degrees, over 40 and 20 m."""
    way = np.arange(0.0, length_m, STEP_M)
    yaw = 0.2 + np.interp(way, [30.0, 70.0, 100.0, 120.0], [0.0, np.pi / 2, np.pi / 2, np.pi])
    steps = STEP_M * np.column_stack([np.cos(yaw), np.sin(yaw)])
    return np.cumsum(steps, axis=0), yaw


def straight(length_m=150.0):
    way = np.arange(0.0, length_m, STEP_M)
    return np.column_stack([way, np.zeros_like(way)]), np.zeros_like(way)


def driven(route, ground, sensor_rad=(0.0, 0.0)):
    """A drive whose vehicle stands square on the ground, by a sensor with this roll and pitch on it."""
    points, yaw = route
    height_m, slope = ground(points)
    up = np.column_stack([-slope, np.ones(len(points))])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
    ahead[:, 2] = np.sum(ahead[:, :2] * slope, axis=1)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3] = np.stack([ahead, np.cross(up, ahead), up], axis=2)
    poses[:, :3, :3] @= rotation_from_euler(*np.array(sensor_rad)[:, None], np.zeros(1))
    poses[:, :2, 3], poses[:, 2, 3] = points, height_m
    return Trajectory(0.1 * np.arange(len(points)), poses)


def tilt_deg(trajectory):
    """Angle (P,) of the vehicle's floor to the plane z = 0."""
    return np.degrees(np.arccos(np.clip(trajectory.map_from_vehicle[:, 2, 2], -1.0, 1.0)))


@pytest.mark.parametrize("slope", [(0.003, 0.0), (0.01, -0.004), (-0.05, 0.03)])
def test_a_tilted_yard_is_laid_flat_on_a_turning_route(slope):
    recorded = driven(turning(), plane(*slope, up_m=46.2))
    laid = lay_flat(recorded, SIGMA_M)
    flat = laid.trajectory.map_from_vehicle
    assert tilt_deg(laid.trajectory).max() < 1e-3
    np.testing.assert_array_equal(flat[:, 2, 3], 0.0)
    np.testing.assert_array_equal(flat[:, :2, 3], recorded.map_from_vehicle[:, :2, 3])
    np.testing.assert_allclose(np.arctan2(flat[:, 1, 0], flat[:, 0, 0]), np.arctan2(
        recorded.map_from_vehicle[:, 1, 0], recorded.map_from_vehicle[:, 0, 0]), atol=1e-12)  # fmt: skip
    np.testing.assert_allclose(laid.road.slope, np.tile(slope, (len(laid.road.slope), 1)), atol=1e-6)
    np.testing.assert_allclose(laid.road.height_m, plane(*slope, 46.2)(laid.road.points_map)[0], atol=1e-6)


def test_heights_with_2_cm_of_noise_tilt_the_vehicle_by_less_than_a_fiftieth_of_a_degree():
    recorded = driven(turning(), plane(0.01, 0.0))
    recorded.map_from_vehicle[:, 2, 3] += np.random.default_rng(0).normal(
        scale=0.02, size=len(recorded.stamp_s)
    )
    assert np.sqrt(np.mean(tilt_deg(lay_flat(recorded, SIGMA_M).trajectory) ** 2)) < 0.02


def test_a_ramp_of_40_m_is_laid_flat_by_a_receiver_that_measures_attitude():
    recorded = driven(straight(), ramp(50.0, 40.0, 1.0))
    assert tilt_deg(recorded).max() > 2.0
    assert tilt_deg(lay_flat(recorded, SIGMA_M).trajectory).max() < 0.35


@pytest.mark.parametrize("route", [straight, turning])
def test_a_sensor_that_is_not_level_is_found_and_told(route, caplog):
    pitch_rad = np.radians(1.2)
    laid = lay_flat(driven(route(), plane(0.02, 0.01), (0.0, pitch_rad)), SIGMA_M)
    assert np.degrees(laid.mount_rad[1]) == pytest.approx(1.2, abs=0.03)
    assert tilt_deg(laid.trajectory).max() < 0.03
    with caplog.at_level(logging.INFO):
        log_road(laid, Path("drive"))
    assert "1.2" in caplog.text
    assert "deg of pitch (nose down)" in caplog.text


def test_what_the_suspension_does_stays_in_the_attitude():
    recorded = driven(straight(), plane(0.03, -0.02))
    bounce = 0.005 * np.sin(2.0 * np.pi / 7.0 * recorded.map_from_vehicle[:, 0, 3])
    zero = np.zeros_like(bounce)
    recorded.map_from_vehicle[:, :3, :3] @= rotation_from_euler(zero, bounce, zero)
    flat = lay_flat(recorded, SIGMA_M).trajectory.map_from_vehicle
    np.testing.assert_allclose(np.arcsin(-flat[20:-20, 2, 0]), bounce[20:-20], atol=5e-4)


def test_a_vehicle_that_squats_for_60_m_does_so_on_a_level_road():
    recorded = driven(straight(), plane(0.0, 0.0, 10.0))
    squat = -0.008 * np.exp(-0.5 * ((recorded.map_from_vehicle[:, 0, 3] - 75.0) / 20.0) ** 2)
    zero = np.zeros_like(squat)
    recorded.map_from_vehicle[:, :3, :3] @= rotation_from_euler(zero, squat, zero)
    laid = lay_flat(recorded, SIGMA_M)
    pitch = np.arcsin(-laid.trajectory.map_from_vehicle[:, 2, 0])
    assert np.ptp(pitch) > 0.5 * np.ptp(squat)


def test_without_attitude_the_vehicle_follows_the_road_that_the_heights_draw():
    points, yaw = turning()
    level = driven((points, yaw), plane(0.0, 0.0))
    level.map_from_vehicle[:, 2, 3] = plane(0.02, 0.01, 5.0)(points)[0]
    laid = lay_flat(level, SIGMA_M)
    assert tilt_deg(laid.trajectory).max() == 0.0
    np.testing.assert_allclose(laid.road.height_m, plane(0.02, 0.01, 5.0)(laid.road.points_map)[0], atol=0.01)


def test_a_receiver_of_heading_and_pitch_says_nothing_of_roll():
    points, yaw = straight()
    recorded = driven((points, yaw), plane(0.03, 0.0))
    laid = lay_flat(recorded, SIGMA_M)
    assert tilt_deg(laid.trajectory).max() < 1e-3
    assert np.abs(laid.trajectory.map_from_vehicle[:, 2, 1]).max() == 0.0


@pytest.mark.parametrize("height_m", [46.2, 1.8, -3.0])
def test_one_height_for_all_poses_is_a_level_ground_at_that_height(height_m):
    laid = lay_flat(driven(turning(), plane(0.0, 0.0, height_m)), SIGMA_M)
    np.testing.assert_array_equal(laid.trajectory.map_from_vehicle[:, 2, 3], 0.0)
    np.testing.assert_allclose(laid.road.height_m, height_m)


def test_poses_on_the_plane_z_0_stay_as_they_are():
    recorded = driven(turning(), plane(0.0, 0.0))
    laid = lay_flat(recorded, SIGMA_M)
    assert laid.road is None
    assert laid.trajectory is recorded


def test_a_crown_is_laid_flat_along_a_road_that_turns():
    """Its cross-fall of 2 % turns with the road, on which the heights stay the same."""
    recorded = driven(turning(), plane(0.0, 0.0, 3.0), (np.arctan(0.02), 0.0))
    assert tilt_deg(lay_flat(recorded, SIGMA_M).trajectory).max() < 0.1


def test_a_height_that_jumps_by_30_cm_is_not_taken_for_a_slope():
    recorded = driven(straight(), plane(0.01, 0.0))
    recorded.map_from_vehicle[150:, 2, 3] += 0.3
    assert tilt_deg(lay_flat(recorded, SIGMA_M).trajectory).max() < 0.15


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_poses_lie_flat_as_well(count):
    recorded = driven(turning(), plane(0.02, 0.01, 5.0))
    few = Trajectory(recorded.stamp_s[:count], recorded.map_from_vehicle[:count])
    laid = lay_flat(few, SIGMA_M)
    assert tilt_deg(laid.trajectory).max() < 1e-3
    assert laid.road is not None
    assert unevenness(laid.road, 15.0).value_m == pytest.approx(0.0, abs=1e-9)


def test_a_vehicle_that_stands_has_the_slope_that_its_attitude_says():
    rng = np.random.default_rng(0)
    points = rng.normal(scale=0.02, size=(500, 2))
    recorded = driven((points, np.full(500, 0.7)), plane(0.02, -0.01, 46.2))
    recorded.map_from_vehicle[:, 2, 3] += rng.normal(scale=0.04, size=500)
    laid = lay_flat(recorded, SIGMA_M)
    assert tilt_deg(laid.trajectory).max() < 1e-6
    assert len(laid.road.points_map) == 1


def test_poses_whose_z_axis_points_down_are_left_alone(caplog):
    recorded = driven(turning(), plane(0.01, 0.0))
    recorded.map_from_vehicle[:, :3, 1:3] *= -1.0
    laid = lay_flat(recorded, SIGMA_M)
    assert laid.trajectory is recorded
    assert "does not point up" in caplog.text


def road_of(ground):
    points = straight()[0]
    return Road(points, *ground(points))


def test_a_plane_is_even_and_a_crest_is_found_where_it_is():
    assert unevenness(road_of(plane(0.05, 0.02)), 15.0).value_m < 1e-9
    uneven = unevenness(road_of(ramp(70.0, 20.0, 1.0)), 15.0)
    # The ramp's ends are at 70 and 90 m; at 80 m, its middle, a plane of 7.9 % would go on beyond both.
    assert 60.0 < uneven.station_m < 100.0
    assert uneven.value_m > 0.3
    np.testing.assert_allclose(uneven.at_map, [uneven.station_m, 0.0])


def test_a_cross_fall_that_changes_makes_a_road_uneven_beside_the_path():
    points = straight()[0]
    slope = np.column_stack([np.zeros(len(points)), np.where(points[:, 0] < 75.0, 0.02, -0.02)])
    uneven = unevenness(Road(points, np.zeros(len(points)), slope), 10.0)
    assert uneven.value_m == pytest.approx(3.5 * 0.04)
    assert uneven.station_m == pytest.approx(75.0, abs=10.0)
