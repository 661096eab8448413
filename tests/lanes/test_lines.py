"""Lanes of the map."""

import time
from dataclasses import replace

import numpy as np

from v2hdm.lanes.lines import join_paths, lanes_along, map_lanes, paths_of
from v2hdm.lanes.points import NODE_SPACING_M, Guides, LaneCloud, distance_beside_m
from v2hdm.site.options import LaneOptions

OPTIONS = LaneOptions()


def cloud_of(lines, dash=False, images=12, sigma_m=0.03, seed=0):
    """Each line (N, 2) seen by ``images`` images, every point off by ``sigma_m``."""
    rng = np.random.default_rng(seed)
    points, tangents, image = [], [], []
    for line in lines:
        direction = np.gradient(line, axis=0)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        for i in range(images):
            points.append(line + rng.normal(size=line.shape) * sigma_m)
            tangents.append(direction * rng.choice([-1.0, 1.0]))
            image.append(np.full(len(line), i))
    count = sum(len(p) for p in points)
    weight, kind = np.full(count, 1 / sigma_m**2), np.full(count, dash)
    return LaneCloud(np.concatenate(points), np.concatenate(tangents), weight, np.concatenate(image), kind)


def guides_of(lines):
    """Whole lines (N, 2), each as one image saw it."""
    index = np.arange(len(lines))
    return Guides(np.concatenate(lines), np.repeat(index, [len(line) for line in lines]), index)


def arc(start, stop, radius=60.0):
    """A bend to the left from the origin, between two distances along it, m."""
    angle = np.arange(start, stop, 0.3) / radius
    return radius * np.column_stack([np.sin(angle), 1 - np.cos(angle)])


def straight(start, stop, y=0.0, step=0.3):
    x = np.arange(start, stop, step)
    return np.column_stack([x, np.full_like(x, y)])


def length(lane):
    return float(np.linalg.norm(np.diff(lane.points_map, axis=0), axis=1).sum())


def test_a_straight_line_becomes_one_polyline_on_its_centre():
    (lane,) = map_lanes(cloud_of([straight(0, 40)]), OPTIONS)
    assert lane.kind == "lane_line"
    assert length(lane) > 38
    assert np.abs(lane.points_map[:, 1]).max() < 0.03
    steps = np.linalg.norm(np.diff(lane.points_map, axis=0), axis=1)
    np.testing.assert_allclose(steps, NODE_SPACING_M, rtol=0.1)


def test_a_turn_of_twelve_metres_radius_stays_one_line():
    angle = np.arange(0, np.pi, 0.3 / 12)
    (lane,) = map_lanes(cloud_of([12 * np.column_stack([np.cos(angle), np.sin(angle)])]), OPTIONS)
    assert length(lane) > 0.95 * 12 * np.pi
    assert np.abs(np.linalg.norm(lane.points_map, axis=1) - 12).max() < 0.05


def test_dashes_of_one_line_become_one_dashed_lane_across_their_gaps():
    dashes = [straight(s, s + 3.0) for s in np.arange(0, 36, 6.0)]
    (lane,) = map_lanes(cloud_of(dashes, dash=True), OPTIONS)
    assert lane.kind == "lane_dash"
    assert length(lane) > 31
    assert np.abs(lane.points_map[:, 1]).max() < 0.05


def test_dashes_of_a_bend_follow_it_across_their_gaps():
    radius = 25.0
    dashes = []
    for start in np.arange(0, 30, 6.0):
        angle = np.arange(start, start + 3.0, 0.3) / radius
        dashes.append(radius * np.column_stack([np.cos(angle), np.sin(angle)]))
    (lane,) = map_lanes(cloud_of(dashes, dash=True), OPTIONS)
    assert np.abs(np.linalg.norm(lane.points_map, axis=1) - radius).max() < 0.1


def test_solid_paint_is_not_continued_across_a_wide_gap():
    lanes = map_lanes(cloud_of([straight(0, 15), straight(22, 40)]), OPTIONS)
    assert len(lanes) == 2


def test_neighbouring_dashed_lines_are_never_connected():
    left = [straight(s, s + 3.0, 1.7) for s in np.arange(0, 24, 6.0)]
    right = [straight(s, s + 3.0, -1.7) for s in np.arange(3, 27, 6.0)]
    lanes = map_lanes(cloud_of(left + right, dash=True), OPTIONS)
    assert len(lanes) == 2
    assert all(np.ptp(lane.points_map[:, 1]) < 0.1 for lane in lanes)


def test_a_double_line_stays_double():
    lanes = map_lanes(cloud_of([straight(0, 20, 0.0), straight(0, 20, 0.35)]), OPTIONS)
    assert len(lanes) == 2
    assert sorted(round(float(np.median(lane.points_map[:, 1])), 1) for lane in lanes) == [0.0, 0.3]


def test_crossing_lines_do_not_bend_each_other():
    across = straight(-10, 10)[:, ::-1] + [10.0, 0.0]
    lanes = map_lanes(cloud_of([straight(0, 20), across]), OPTIONS)
    assert sum(length(lane) for lane in lanes) > 36
    for lane in lanes:
        assert min(np.abs(lane.points_map[:, 1]).max(), np.abs(lane.points_map[:, 0] - 10).max()) < 0.06


def test_what_two_images_saw_is_no_lane():
    assert map_lanes(cloud_of([straight(0, 20)], images=2), OPTIONS) == ()


def test_a_closed_line_is_closed():
    angle = np.arange(0, 2 * np.pi, 0.3 / 15)
    (lane,) = map_lanes(cloud_of([15 * np.column_stack([np.cos(angle), np.sin(angle)])]), OPTIONS)
    assert np.linalg.norm(lane.points_map[0] - lane.points_map[-1]) < 0.6


def as_shown(lines, images_of_line, sigma_m=0.02):
    """The cloud of lines (N, 2), each a piece of the first images, of as many as are given for it."""
    clouds = [
        cloud_of([line], images=count, sigma_m=sigma_m, seed=seed)
        for seed, (line, count) in enumerate(zip(lines, images_of_line, strict=True))
    ]
    joined = {
        name: np.concatenate([getattr(cloud, name) for cloud in clouds])
        for name in ("points_map", "tangent", "weight", "image", "dash")
    }
    piece = np.repeat(np.arange(len(lines)), [len(cloud.weight) for cloud in clouds])
    beside_m = distance_beside_m(joined["points_map"], joined["tangent"], joined["image"], piece)
    return LaneCloud(**joined, beside_m=beside_m)


DOUBLE = [straight(0, 20), straight(0, 20, y=0.26)]


def test_two_lines_that_images_show_beside_each_other_stay_two():
    lanes = map_lanes(as_shown(DOUBLE, [12, 12]), OPTIONS)
    middles = sorted(float(lane.points_map[:, 1].mean()) for lane in lanes)
    np.testing.assert_allclose(middles, [0.0, 0.26], atol=0.02)


def test_two_lines_stay_two_though_half_of_the_images_show_one_of_them():
    assert len(map_lanes(as_shown(DOUBLE, [24, 12]), OPTIONS)) == 2


def test_paint_that_no_image_shows_as_two_lines_is_one_line():
    cloud = as_shown(DOUBLE, [12, 12])
    image = cloud.image + 12 * (cloud.points_map[:, 1] > 0.13)
    beside_m = distance_beside_m(cloud.points_map, cloud.tangent, image, image)
    assert np.isnan(beside_m).all()
    assert len(map_lanes(replace(cloud, image=image, beside_m=beside_m), OPTIONS)) == 1


def test_an_empty_cloud_has_no_lanes():
    nothing = LaneCloud(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, int), np.zeros(0, bool))
    assert map_lanes(nothing, OPTIONS) == ()


def test_a_hundred_thousand_points_take_seconds():
    cloud = cloud_of([straight(0, 350, y, 0.25) for y in (-3.5, 0.0, 3.5, 7.0)], images=18)
    assert len(cloud.weight) > 100_000
    begin = time.process_time()
    lanes = map_lanes(cloud, OPTIONS)
    assert len(lanes) == 4
    assert time.process_time() - begin < 15


def test_a_break_is_bridged_along_the_lines_that_images_saw_run_across_it():
    cloud = cloud_of([arc(0, 15), arc(30, 45)], dash=True)
    assert len(map_lanes(cloud, OPTIONS)) == 2
    beside = arc(5, 40) + np.array([0.0, 0.1])
    guided = replace(cloud, guides=guides_of([beside] * OPTIONS.min_images))
    (lane,) = map_lanes(guided, OPTIONS)
    assert length(lane) > 43
    assert np.abs(np.linalg.norm(lane.points_map - [0.0, 60.0], axis=1) - 60).max() < 0.05


def test_a_break_that_too_few_images_saw_a_line_cross_stays_one():
    cloud = cloud_of([arc(0, 15), arc(30, 45)], dash=True)
    few = [arc(5, 40)] * (OPTIONS.min_images - 1)
    short_of_it = [arc(5, 27)] * 10 + [arc(20, 40)] * 10
    assert len(map_lanes(replace(cloud, guides=guides_of(few + short_of_it)), OPTIONS)) == 2


def test_lines_beside_each_other_are_not_bridged_whatever_was_seen():
    cloud = cloud_of([straight(0, 20), straight(21, 40, y=3.0)])
    across = np.column_stack([np.linspace(15, 25, 40), np.linspace(-3.0, 6.0, 40)])
    assert len(map_lanes(replace(cloud, guides=guides_of([across] * 20)), OPTIONS)) == 2


def test_a_short_piece_must_be_seen_more_often_than_a_long_one():
    piece = straight(0, 4.0)
    assert map_lanes(cloud_of([piece], images=OPTIONS.min_images), OPTIONS) == ()
    assert len(map_lanes(cloud_of([piece], images=3 * OPTIONS.min_images), OPTIONS)) == 1
    assert len(map_lanes(cloud_of([straight(0, 12)], images=OPTIONS.min_images), OPTIONS)) == 1


def test_paths_found_on_both_sides_of_a_border_are_one_lane_when_joined():
    """A long drive does so in sections: each finds the paths inside its own ground."""
    cloud = cloud_of([straight(0, 40), straight(0, 40, 3.5)])
    west = paths_of(cloud, OPTIONS, lambda points_map: points_map[:, 0] < 17.3)
    east = paths_of(cloud, OPTIONS, lambda points_map: points_map[:, 0] >= 17.3)
    assert len(west) == len(east) == 2
    lanes = lanes_along(join_paths([*west, *east]), OPTIONS)
    whole = map_lanes(cloud, OPTIONS)
    assert len(lanes) == len(whole) == 2
    for lane, other in zip(
        sorted(lanes, key=lambda lane: lane.points_map[0, 1]),
        sorted(whole, key=lambda lane: lane.points_map[0, 1]),
        strict=True,
    ):
        assert abs(length(lane) - length(other)) < 0.1
        assert np.abs(lane.points_map[:, 1] - other.points_map[:, 1].mean()).max() < 0.03
