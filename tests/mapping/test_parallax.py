"""Images tell what lies on the ground from what stands above it or moves, as far as the vehicle moves."""

from dataclasses import replace

import numpy as np
import pytest

from v2hdm.geometry.ipm import direction_covariance
from v2hdm.site.parallax import NOT_OBSERVED, NOT_ON_GROUND, PointViews, measure_parallax

HEIGHT_M = 2.0
POSE_SIGMA = np.array([0.01, 0.01, 0.01, 0.002, 0.002, 0.001])
PIXEL_RAD = 0.5 / 900  # half a pixel at a focal length of 900 pixels
QUAD = np.array([[0.5, 0.2], [-0.5, 0.2], [-0.5, -0.2], [0.5, -0.2]])
AHEAD = np.array([8.0, 1.0])


def sighted(way_m, corners_m, height_m=0.0, moved_m=0.0, seed=0):
    """A quadrilateral (4, 2), ``height_m`` (4,) up and ``moved_m`` (N,) further ahead, from the way (N,).

    Corners err by half a pixel and by what the pose is off, both as stated.
    """
    rng = np.random.default_rng(seed)
    centre = np.column_stack([way_m, np.zeros(len(way_m))])
    true_corners_m = corners_m + np.stack(np.broadcast_arrays(moved_m, 0.0), axis=-1).reshape(-1, 1, 2)
    scale = HEIGHT_M / (HEIGHT_M - np.broadcast_to(height_m, 4))[:, None]
    ray = (true_corners_m - centre[:, None]) * scale
    covariance = direction_covariance(ray, np.full(ray.shape[:2], HEIGHT_M), PIXEL_RAD)
    off = np.einsum("npij,npj->npi", np.linalg.cholesky(covariance), rng.standard_normal(ray.shape))
    pitch = rng.normal(0.0, POSE_SIGMA[3], (len(way_m), 1, 1))
    ray = ray + off + pitch * (HEIGHT_M**2 + (ray**2).sum(axis=2, keepdims=True)) / HEIGHT_M * [1.0, 0.0]
    recorded = centre + rng.normal(0.0, POSE_SIGMA[0], centre.shape)
    none = np.zeros(len(way_m), dtype=np.int64)
    return PointViews(
        group=none,
        camera=none,
        points_map=recorded[:, None] + ray,
        ray_map=ray,
        covariance_m2=covariance,
        used=np.ones((len(way_m), 4), dtype=bool),
        height_m=np.full(len(way_m), HEIGHT_M),
        pose_sigma=np.tile(POSE_SIGMA, (len(way_m), 1)),
    )


def objection(views):
    return measure_parallax(views, 1).objections(0.9)[0]


@pytest.mark.parametrize("seed", range(10))
def test_a_metre_of_way_tells_paint_from_a_plane_one_metre_higher(seed):
    way_m = np.linspace(0.0, 1.0, 6)
    assert objection(sighted(way_m, AHEAD + QUAD, seed=seed)) is None
    assert objection(sighted(way_m, AHEAD / 2 + QUAD, 1.0, seed=seed)) == NOT_ON_GROUND


def test_the_slope_errs_as_stated():
    way_m = np.linspace(0.0, 2.0, 8)
    measured = [measure_parallax(sighted(way_m, AHEAD + QUAD, seed=seed), 1) for seed in range(60)]
    squared = [
        ((parallax.slope[0] - 1.0) @ np.linalg.solve(parallax.covariance[0], parallax.slope[0] - 1.0)) / 4
        for parallax in measured
    ]
    assert 0.7 < np.mean(squared) < 1.5


@pytest.mark.parametrize("height_m", [0.0, 1.0])
def test_a_standing_vehicle_tells_nothing_however_many_images_it_takes(height_m):
    standing = sighted(np.full(300, 0.05), AHEAD / (1 + height_m) + QUAD, height_m)
    assert objection(standing) == NOT_OBSERVED
    assert abs(measure_parallax(standing, 1).log_odds[0]) < 2.0


def test_paint_stays_paint_where_the_vehicle_stood_before_it_moved_on():
    way_m = np.concatenate([np.zeros(300), np.linspace(0.0, 2.0, 10)])
    assert objection(sighted(way_m, AHEAD + QUAD)) is None


def test_what_moves_along_or_belongs_to_the_vehicle_is_not_on_the_ground():
    way_m = np.linspace(0.0, 3.0, 12)
    assert objection(sighted(way_m, AHEAD + QUAD, moved_m=way_m)) == NOT_ON_GROUND
    assert objection(sighted(way_m, AHEAD / 2 + QUAD, 0.8, moved_m=0.9 * way_m)) == NOT_ON_GROUND


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("height_m", "is_paint"), [(0.0, True), (0.08, True), (0.35, False), (0.45, False)])
def test_the_sill_of_a_car_is_not_taken_for_paint_but_paint_on_a_bump_is(height_m, is_paint, seed):
    views = sighted(np.linspace(0.0, 3.0, 10), AHEAD + QUAD, height_m, seed=seed)
    assert (objection(views) is None) is is_paint
    no_bar = measure_parallax(views, 1, np.zeros(1, dtype=bool)).log_odds[0]
    assert no_bar > measure_parallax(views, 1).log_odds[0], "only bars look like sills"


def test_a_camera_lower_than_a_sill_still_tells_paint():
    views = sighted(np.linspace(0.0, 3.0, 10), AHEAD + QUAD)
    low = replace(views, height_m=np.full_like(views.height_m, 0.3))
    assert np.isfinite(measure_parallax(low, 1).log_odds).all()
    assert objection(low) is None


def test_stripes_on_an_upright_rear_are_not_on_the_ground():
    rear = np.array([[6.0, 0.5], [6.0, 0.2], [6.0, 0.2], [6.0, 0.5]])
    assert objection(sighted(np.linspace(0.0, 1.5, 8), rear, np.array([0.5, 0.5, 1.0, 1.0]))) == NOT_ON_GROUND


@pytest.mark.parametrize("seed", range(3))
def test_a_rear_that_came_nearer_before_the_vehicle_stood_behind_it_is_not_on_the_ground(seed):
    way_m = np.concatenate([np.linspace(-6.0, -1.0, 5), np.zeros(90)])
    bumper = np.array([[8.0, 0.5], [8.0, -0.5], [8.0, -0.5], [8.0, 0.5]])
    assert objection(sighted(way_m, bumper, np.array([0.6, 0.6, 0.7, 0.7]), seed=seed)) == NOT_ON_GROUND


def test_what_moves_off_before_the_vehicle_that_stood_long_does_is_not_on_the_ground():
    way_m = np.concatenate([np.zeros(90), np.linspace(0.1, 1.2, 13)])
    moved_m = np.concatenate([np.zeros(88), np.linspace(0.1, 1.5, 15)])
    assert objection(sighted(way_m, AHEAD + QUAD, moved_m=moved_m)) == NOT_ON_GROUND


@pytest.mark.parametrize("seed", range(5))
def test_paint_stays_paint_where_some_sightings_are_of_something_else(seed):
    views = sighted(np.linspace(0.0, 3.0, 16), AHEAD + QUAD, seed=seed)
    off = np.random.default_rng(seed).normal(0.0, 0.8, (2, 1, 2))
    views.points_map[[1, 12]] += off
    views.ray_map[[1, 12]] += off
    assert objection(views) is None


def test_of_many_candidates_each_has_the_odds_that_it_has_alone():
    alone = [sighted(np.linspace(0.0, 2.0, 8), AHEAD + QUAD, height, seed=5) for height in (0.0, 0.3, 0.8)]
    group = np.repeat(np.arange(3), 8)
    fields = [name for name in vars(alone[0]) if name != "group"]
    joint = {name: np.concatenate([getattr(views, name) for views in alone]) for name in fields}
    odds = [measure_parallax(views, 1).log_odds[0] for views in alone]
    assert measure_parallax(PointViews(group=group, **joint), 3).log_odds == pytest.approx(odds)


def test_corners_that_were_not_used_say_nothing():
    views = sighted(np.linspace(0.0, 2.0, 8), AHEAD + QUAD)
    of_all_views = measure_parallax(views, 1)
    views.used[:, 3] = False
    views.points_map[:, 3], views.covariance_m2[:, 3] = np.nan, np.nan
    fewer = measure_parallax(views, 1)
    assert fewer.slope[0, :3] == pytest.approx(of_all_views.slope[0, :3], abs=0.05)
    assert fewer.covariance[0, 3, 3] > 50 > 0.1 > fewer.covariance[0, 0, 0]
    assert 2 < fewer.log_odds[0] < of_all_views.log_odds[0]


def test_a_candidate_without_any_image_is_not_observed():
    views = sighted(np.linspace(0.0, 2.0, 8), AHEAD + QUAD)
    assert measure_parallax(views, 2).objections(0.9) == [None, NOT_OBSERVED]
