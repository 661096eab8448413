"""Lanes and symbols of the map."""

import time
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from tests.cameras import level, mounted
from v2hdm.association.ground import images_with_line, images_with_symbol
from v2hdm.association.sightings import NO_SYMBOLS, Rig, Symbols
from v2hdm.geometry.planar import signed_area
from v2hdm.lanes.lines import map_lanes
from v2hdm.lanes.points import NODE_SPACING_M, Guides, LaneCloud
from v2hdm.records import CameraInfo, Marking
from v2hdm.site.candidates import LACKS_A_CORNER
from v2hdm.site.options import AcceptanceOptions, LaneOptions
from v2hdm.site.parallax import NOT_OBSERVED, NOT_ON_GROUND
from v2hdm.site.polygons import Polygon
from v2hdm.site.symbols import NO_POLYGON, map_symbols

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


INTRINSIC = np.array([[800.0, 0.0, 640.0], [0.0, 800.0, 360.0], [0.0, 0.0, 1.0]])
INFOS = [CameraInfo("front", 1280, 720, INTRINSIC)]
ARROW = np.array(
    [[-1.5, -0.08], [0.5, -0.08], [0.5, -0.35], [1.5, 0.0], [0.5, 0.35], [0.5, 0.08], [-1.5, 0.08]]
)


def symbols_of(outlines, kinds):
    """One outline in each frame of one camera, whose shutter is global."""
    count, rows = len(outlines), tuple(np.zeros(len(one)) for one in outlines)
    seen = tuple(np.ones(len(one), dtype=bool) for one in outlines)
    return Symbols(
        np.zeros(count, dtype=np.int64), np.arange(count), tuple(outlines), tuple(kinds), rows, seen
    )


def of_outlines(symbols, outlines):
    """The symbols with other outlines, whose sides all lie along edges."""
    seen = tuple(np.ones(len(one), dtype=bool) for one in outlines)
    rows = tuple(np.zeros(len(one)) for one in outlines)
    return replace(symbols, outlines_pinhole_px=tuple(outlines), row_shares=rows, seen_sides=seen)


def scene(arrow_x_m):
    """Three frames, a metre apart, that all see an arrow ahead of the first one."""
    return seen([ARROW + np.array([arrow_x_m, 1.0])] * 3, ("arrow",) * 3, [0.0, 1.0, 2.0])


def rectangle(centre, length_m, width_m):
    """Corners (4, 2) of a rectangle, long in x."""
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length_m / 2, width_m / 2]
    return np.asarray(centre) + half


def test_parts_of_the_arrow_are_counted_in_every_image_that_shows_it():
    symbols, rig = scene(9.0)
    shaft, head = rectangle((8.5, 1.0), 1.6, 0.15), rectangle((9.8, 1.02), 0.5, 0.3)
    beside, far = rectangle((9.0, 1.4), 1.6, 0.15), rectangle((5.0, 1.0), 1.6, 0.15)
    corners = np.stack([shaft, head, beside, far, np.full((4, 2), np.nan)])
    assert images_with_symbol(symbols, rig, corners).tolist() == [3, 3, 0, 0, 0]


def test_what_an_arrow_crosses_is_no_part_of_it():
    symbols, rig = scene(9.0)
    stop_line = rectangle((8.5, 1.0), 0.4, 3.0)
    assert images_with_symbol(symbols, rig, stop_line[None]).tolist() == [0]


def test_far_arrows_say_nothing():
    symbols, rig = scene(40.0)
    assert images_with_symbol(symbols, rig, rectangle((40.0, 1.05), 0.5, 0.3)[None]).tolist() == [0]


JITTER_RAD = 0.002
AT, OFF = np.array([9.0, 1.0]), np.array([0.1, 0.0])


def seen(shapes, kinds, poses_x):
    """What a camera at so many places ahead says of shapes on the ground, one from each."""
    poses = level(poses_x)
    rig = Rig(INTRINSIC[None], mounted([0.0, 0.0, 2.0])[None], poses)
    return symbols_of(
        [outline_px(*one, rig.cam_from_vehicle[0]) for one in zip(shapes, poses, strict=True)], kinds
    ), rig


def outline_px(shape, pose, cam_from_vehicle):
    """A shape (N, 2) on the ground as a camera at a pose shows it."""
    ground = np.column_stack([shape, np.zeros(len(shape)), np.ones(len(shape))])
    cam = ground @ (cam_from_vehicle @ np.linalg.inv(pose)).T
    return (cam[:, :3] @ INTRINSIC.T)[:, :2] / cam[:, 2:3]


def mapped(symbols, rig, markings=()):
    """The symbols of the map."""
    return map_symbols(symbols, rig, INFOS, JITTER_RAD, markings, AcceptanceOptions())[0]


def overlap(one, other):
    """Intersection over union, by cells of a centimetre."""
    low = np.minimum(one.min(axis=0), other.min(axis=0)) - 0.1
    size = np.ceil((np.maximum(one.max(axis=0), other.max(axis=0)) + 0.1 - low) * 100).astype(int)
    masks = []
    for shape in (one, other):
        mask = np.zeros(size[::-1], dtype=np.uint8)
        cv2.fillPoly(mask, [np.round((shape - low) * 100).astype(np.int32)], 1)
        masks.append(mask > 0)
    return float((masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum())


def test_an_arrow_is_mapped_where_it_lies():
    symbols, rig = scene(9.0)
    (arrow,) = mapped(symbols, rig)
    assert (arrow.kind, arrow.sightings) == ("arrow", 3)
    assert overlap(arrow.outline_map, ARROW + AT) > 0.97
    assert abs(signed_area(arrow.outline_map) - signed_area(ARROW)) < 0.01 * signed_area(ARROW)
    assert signed_area(arrow.outline_map) > 0
    assert arrow.covariance_m2 is not None
    assert corner_errors_m(arrow, ARROW + AT).max() < 0.002


def corner_errors_m(symbol, true):
    """How far each true vertex (N, 2) is from the nearest one of a symbol that has as many."""
    assert len(symbol.outline_map) == len(true)
    return np.linalg.norm(symbol.outline_map[:, None] - true, axis=2).min(axis=0)


def noisy(outlines_px, rng):
    """Outlines whose sides wave by half a pixel."""
    dense = [
        np.concatenate(
            [a + np.linspace(0, 1, 40, endpoint=False)[:, None] * (b - a) for a, b in pairwise(ring)]
        )
        for ring in (np.vstack([one, one[:1]]) for one in outlines_px)
    ]
    waves = [np.convolve(rng.normal(0, 0.5 * np.sqrt(9), len(one)), np.ones(9) / 9, "same") for one in dense]
    return tuple(one + wave[:, None] for one, wave in zip(dense, waves, strict=True))


def test_the_vertices_of_arrows_of_one_stencil_have_one_order():
    rng, places = np.random.default_rng(3), np.array([[9.0, 1.0], [10.5, -1.2]])
    shapes = [shape for place in places for shape in [ARROW + place] * 4]
    symbols, rig = seen(shapes, ["arrow"] * 8, 2 * [0.0, 0.7, 1.4, 2.1])
    symbols = of_outlines(symbols, noisy(symbols.outlines_pinhole_px, rng))
    arrows = sorted(mapped(symbols, rig), key=lambda one: one.outline_map[:, 0].mean())
    off_m = [one.outline_map - place - ARROW[3] for one, place in zip(arrows, places, strict=True)]
    assert len({int(np.linalg.norm(one, axis=1).argmin()) for one in off_m}) == 1
    for arrow, place in zip(arrows, places, strict=True):
        assert corner_errors_m(arrow, ARROW + place).max() < 0.035


CHEVRON = np.array([[0, -0.9], [0.8, 0], [0, 0.9], [-0.5, 0.9], [0.3, 0], [-0.5, -0.9]])
_HALF_H = [[0, 0], [1.6, 0], [1.6, 0.2], [0.9, 0.2], [0.9, 0.6], [1.6, 0.6]]
LETTER_H = np.vstack([_HALF_H, np.array([1.6, 0.8]) - _HALF_H])
PARKING_T = np.array(
    [
        [0.35, -0.5],
        [0.5, -0.5],
        [0.5, 0.5],
        [0.35, 0.5],
        [0.35, 0.08],
        [-0.5, 0.08],
        [-0.5, -0.08],
        [0.35, -0.08],
    ]
)


@pytest.mark.parametrize("shape", [CHEVRON, LETTER_H, PARKING_T])
def test_chevrons_letters_and_own_symbols_have_the_vertices_of_their_template(shape):
    places, ways_m = np.array([[8.5, 1.5], [9.5, -1.6]]), [0.0, 0.7, 1.4, 2.1, 2.8, 3.5]
    symbols, rig = seen([shape + at for at in places for _ in ways_m], ["parking_t"] * 12, 2 * ways_m)
    symbols = of_outlines(symbols, noisy(symbols.outlines_pinhole_px, np.random.default_rng(3)))
    found = sorted(mapped(symbols, rig), key=lambda one: one.outline_map[:, 0].mean())
    assert len(found) == len(places)
    for symbol, at in zip(found, places, strict=True):
        assert corner_errors_m(symbol, shape + at).max() < 0.025


def test_an_outline_that_no_simple_polygon_explains_is_left_out_by_class_and_reason(monkeypatch):
    bow = np.array([[7.0, 0.5], [8.2, 1.5], [8.2, 0.5], [7.0, 1.5]])
    given = *seen([bow] * 5, ["bow"] * 5, np.arange(5.0)), INFOS, JITTER_RAD, (), AcceptanceOptions()
    for crossing in (None, Polygon(bow, *3 * [1e-6 * np.eye(8)], 0.0, 1.0)):
        if crossing:
            monkeypatch.setattr("v2hdm.site.symbols.find_polygons", lambda *_, one=crossing: [one])
        found, left_out = map_symbols(*given)
        assert not found
        assert [(one.kind, one.reason) for one in left_out] == [("bow", NO_POLYGON)]


def cut(place_m):
    """An arrow whose shaft other paint crosses at a place along it, and which sides lie along its edge."""
    shape = np.where(ARROW[:, :1] < place_m, [place_m, np.nan], ARROW)
    shape[:, 1] = ARROW[:, 1]
    at_cut = shape[:, 0] == place_m
    return shape, ~(at_cut & np.roll(at_cut, -1))


@pytest.mark.parametrize("others", [0, 4])
def test_where_other_paint_cuts_an_arrow_its_template_says_how_long_it_is_or_it_is_left_out(others):
    ways_m, places = (
        [0.0, 0.7, 1.4, 2.1],
        np.array([[10.0, y] for y in (1.0, -1.0, 2.0, 0.0, -2.0)][: 1 + others]),
    )
    short, own = cut(-1.0)
    shapes = [short + places[0]] * 4 + [ARROW + at for at in places[1:] for _ in ways_m]
    symbols, rig = seen(shapes, ["arrow"] * len(shapes), (1 + others) * ways_m)
    symbols = replace(symbols, seen_sides=tuple([own] * 4) + symbols.seen_sides[4:])
    found, left_out = map_symbols(symbols, rig, INFOS, JITTER_RAD, (), AcceptanceOptions())
    if others:
        arrow = min(found, key=lambda one: np.linalg.norm(one.outline_map.mean(axis=0) - places[0]))
        assert corner_errors_m(arrow, ARROW + places[0]).max() < 0.05
    else:
        assert (found, [one.reason for one in left_out]) == ((), [LACKS_A_CORNER])


def test_an_arrow_whose_near_end_the_border_cuts_from_near_by_is_mapped_whole():
    true, poses_x = ARROW + AT, [0.0, 1.0, 2.0, 6.6, 6.7, 6.8]
    head = true[(true[:, 0] > 9.4)]
    shapes = [true] * 3 + [head] * 3
    (arrow,) = mapped(*seen(shapes, ["arrow"] * 6, poses_x))
    assert overlap(arrow.outline_map, true) > 0.9


def test_a_sighting_that_misses_a_part_does_not_deny_it():
    true = ARROW + AT
    shaft = np.array([[7.5, 0.92], [9.3, 0.92], [9.3, 1.08], [7.5, 1.08]])
    shapes = [true, true, true, shaft, shaft]
    (arrow,) = mapped(*seen(shapes, ["arrow"] * 5, [0.0, 0.5, 1.0, 2.0, 2.5]))
    assert overlap(arrow.outline_map, true) > 0.9


def test_a_sighting_that_is_off_moves_the_outline_little_and_shows_in_its_sigma():
    true = ARROW + AT
    shapes = [true, true + OFF, true, true, true]
    (arrow,) = mapped(*seen(shapes, ["arrow"] * 5, [0.0, 1.0, 2.0, 3.0, 4.0]))
    assert overlap(arrow.outline_map, true) > 0.95
    assert arrow.sigma_m is not None
    assert 0.005 < arrow.sigma_m < 0.05


def test_the_class_is_what_most_sightings_say():
    shapes = [ARROW + AT] * 4
    kinds = ["arrow", "parking_t", "parking_t", "parking_t"]
    (symbol,) = mapped(*seen(shapes, kinds, [0.0, 1.0, 2.0, 3.0]))
    assert (symbol.kind, symbol.sightings) == ("parking_t", 4)


def test_neighbours_are_symbols_of_their_own():
    bars = [np.array([[7.0, y], [9.0, y], [9.0, y + 0.4], [7.0, y + 0.4]]) for y in (-1.0, 0.0)]
    found = mapped(*seen(bars * 3, ["chevron"] * 6, [0.0, 0, 1, 1, 2, 2]))
    assert len(found) == 2


def test_what_is_far_seen_seldom_or_never_is_left_out():
    symbols, rig = scene(9.0)
    assert mapped(replace(symbols, frame=np.array([0, 1, 1])), rig) == ()
    assert mapped(*scene(40.0)) == ()
    assert mapped(NO_SYMBOLS, rig) == ()
    assert images_with_symbol(NO_SYMBOLS, rig, np.zeros((4, 4, 2))).tolist() == [0, 0, 0, 0]


def test_images_tell_that_a_solid_line_goes_on_behind_a_dash():
    line, dash = (
        np.array([[9.3, 0.5], [12.0, 0.5]]),
        np.array([[7.0, 0.0], [9.0, 0.0], [9.0, 0.15], [7.0, 0.15]]),
    )
    symbols, rig = seen([line] * 3, ["lane_line"] * 3, [0.0, 1.0, 2.0])
    crossing = np.array([[9.5, 0.0], [9.5, 3.0]])
    across, _ = seen([crossing] * 3, ["lane_line"] * 3, [0.0, 1.0, 2.0])
    beside = np.array([[0.0, shift] for shift in (0.0, 0.5 - 0.075, 1.5)])
    ahead = np.array([5.0, 0.0])
    places = np.concatenate([dash + beside[:, None], [dash + beside[1] - ahead]])
    assert images_with_line(symbols, rig, places).tolist() == [0, 3, 0, 0]
    assert images_with_line(across, rig, places).tolist() == [0, 0, 0, 0]
    assert images_with_line(NO_SYMBOLS, rig, places).tolist() == [0, 0, 0, 0]


def test_paint_that_is_a_marking_is_no_symbol():
    symbols, rig = scene(9.0)
    square = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    on, beside = (Marking("pad", square + place, 9) for place in ([9.0, 1.0], [9.0, 3.0]))
    assert mapped(symbols, rig, (on,)) == ()
    assert len(mapped(symbols, rig, (beside,))) == 1


@pytest.mark.parametrize(("step_m", "reason"), [(0.0, NOT_OBSERVED), (0.3, NOT_ON_GROUND)])
def test_a_window_of_the_lorry_ahead_is_no_symbol_and_the_reason_is_given(step_m, reason):
    way_m = step_m * np.arange(8)
    shapes = [ARROW + AT + [x, 0.0] for x in way_m]
    found, (left_out,) = map_symbols(
        *seen(shapes, ["arrow"] * 8, way_m), INFOS, JITTER_RAD, (), AcceptanceOptions()
    )
    assert not found
    assert (left_out.kind, left_out.sightings, left_out.reason) == ("arrow", 8, reason)


def test_an_arrow_seen_from_both_sides_lies_on_the_ground():
    way_m = np.array([0.0, 2.0, 4.0, 14.0, 16.0, 18.0])
    symbols, rig = seen([ARROW + AT] * 6, ["arrow"] * 6, way_m)
    back = mounted([0.0, 0.0, 2.0], yaw_deg=180.0)
    both = replace(rig, cam_from_vehicle=np.stack([rig.cam_from_vehicle[0], back]))
    both = replace(both, intrinsic=np.stack([INTRINSIC, INTRINSIC]))
    behind = [outline_px(ARROW + AT, pose, back) for pose in rig.map_from_vehicle[3:]]
    symbols = of_outlines(symbols, (*symbols.outlines_pinhole_px[:3], *behind))
    symbols = replace(symbols, camera=np.array([0, 0, 0, 1, 1, 1]))
    assert len(map_symbols(symbols, both, INFOS * 2, JITTER_RAD, (), AcceptanceOptions())[0]) == 1
