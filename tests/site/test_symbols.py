"""Symbols of the map."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from skimage.draw import polygon

from tests.cameras import mounted
from tests.site.scene import (
    ARROW,
    CAMERAS,
    INTRINSIC,
    JITTER_RAD,
    all_views,
    corner_errors_m,
    given_and_left_out,
    mapped,
    noisy,
    of_outlines,
    outline_px,
    seen,
)
from v2hdm.association.ground import images_with_line, images_with_symbol
from v2hdm.association.sightings import NO_SYMBOLS
from v2hdm.geometry.planar import signed_area
from v2hdm.records import Marking
from v2hdm.site.candidates import FOUND_SELDOM, LACKS_A_CORNER
from v2hdm.site.options import AcceptanceOptions
from v2hdm.site.parallax import NOT_OBSERVED, NOT_ON_GROUND
from v2hdm.site.polygons import Polygon
from v2hdm.site.symbols import NO_POLYGON, cells_inside, map_symbols


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


AT, OFF = np.array([9.0, 1.0]), np.array([0.1, 0.0])


def overlap(outline, other):
    """Intersection over union, by cells of a centimetre."""
    low = np.minimum(outline.min(axis=0), other.min(axis=0)) - 0.1
    size = np.ceil((np.maximum(outline.max(axis=0), other.max(axis=0)) + 0.1 - low) * 100).astype(int)
    masks = []
    for shape in (outline, other):
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


def test_the_vertices_of_arrows_of_one_stencil_have_one_order():
    rng, places = np.random.default_rng(3), np.array([[9.0, 1.0], [10.5, -1.2]])
    shapes = [shape for place in places for shape in [ARROW + place] * 4]
    symbols, rig = seen(shapes, ["arrow"] * 8, 2 * [0.0, 0.7, 1.4, 2.1])
    symbols = of_outlines(symbols, noisy(symbols.outlines_pinhole_px, rng))
    arrows = sorted(mapped(symbols, rig), key=lambda symbol: symbol.outline_map[:, 0].mean())
    off_m = [arrow.outline_map - place - ARROW[3] for arrow, place in zip(arrows, places, strict=True)]
    assert len({int(np.linalg.norm(differences, axis=1).argmin()) for differences in off_m}) == 1
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
    symbols_found = sorted(mapped(symbols, rig), key=lambda symbol: symbol.outline_map[:, 0].mean())
    assert len(symbols_found) == len(places)
    for symbol, at in zip(symbols_found, places, strict=True):
        assert corner_errors_m(symbol, shape + at).max() < 0.025


def test_an_outline_that_no_simple_polygon_explains_is_left_out_by_class_and_reason(monkeypatch):
    bow = np.array([[7.0, 0.5], [8.2, 1.5], [8.2, 0.5], [7.0, 1.5]])
    sighted = seen([bow] * 5, ["bow"] * 5, np.arange(5.0))
    for crossing in (None, Polygon(bow, *3 * [1e-6 * np.eye(8)], 0.0, 1.0)):
        if crossing:
            monkeypatch.setattr("v2hdm.site.symbols.find_polygons", lambda *_, polygon=crossing: [polygon])
        symbols, left_out = given_and_left_out(*sighted)
        assert not symbols
        assert [(exclusion.kind, exclusion.reason) for exclusion in left_out] == [("bow", NO_POLYGON)]


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
    short, own_sides = cut(-1.0)
    shapes = [short + places[0]] * 4 + [ARROW + at for at in places[1:] for _ in ways_m]
    symbols, rig = seen(shapes, ["arrow"] * len(shapes), (1 + others) * ways_m)
    symbols = replace(symbols, seen_sides=tuple([own_sides] * 4) + symbols.seen_sides[4:])
    arrows, left_out = given_and_left_out(symbols, rig)
    if others:
        arrow = min(arrows, key=lambda symbol: np.linalg.norm(symbol.outline_map.mean(axis=0) - places[0]))
        assert corner_errors_m(arrow, ARROW + places[0]).max() < 0.05
    else:
        assert (arrows, [exclusion.reason for exclusion in left_out]) == ((), [LACKS_A_CORNER])


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
    symbols = mapped(*seen(bars * 3, ["chevron"] * 6, [0.0, 0, 1, 1, 2, 2]))
    assert len(symbols) == 2


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
    symbols, (left_out,) = given_and_left_out(*seen(shapes, ["arrow"] * 8, way_m))
    assert not symbols
    assert (left_out.kind, left_out.sightings, left_out.reason) == ("arrow", 8, reason)


def test_an_arrow_seen_from_both_sides_lies_on_the_ground():
    way_m = np.array([0.0, 2.0, 4.0, 14.0, 16.0, 18.0])
    symbols, rig = seen([ARROW + AT] * 6, ["arrow"] * 6, way_m)
    back = mounted([0.0, 0.0, 2.0], yaw_deg=180.0)
    of_both = replace(rig, cam_from_vehicle=np.stack([rig.cam_from_vehicle[0], back]))
    of_both = replace(of_both, intrinsic=np.stack([INTRINSIC, INTRINSIC]))
    behind = [outline_px(ARROW + AT, pose, back) for pose in rig.map_from_vehicle[3:]]
    symbols = of_outlines(symbols, (*symbols.outlines_pinhole_px[:3], *behind))
    symbols = replace(symbols, camera=np.array([0, 0, 0, 1, 1, 1]))
    assert len(mapped(symbols, of_both)) == 1


WAYS_M = np.arange(0.0, 4.0, 0.5)
ROWS = np.array([[10.0, y] for y in (1.5, 0.0, -1.5)])


def with_ghost(images):
    """Three arrows that all eight images show, and one that some see: paint that was erased."""
    whole = [(ARROW + at, way) for at in ROWS for way in WAYS_M]
    ghost = [(ARROW + np.array([10.0, 3.0]), way) for way in WAYS_M[:images]]
    shapes, ways = zip(*whole, *ghost, strict=True)
    symbols, rig = seen(shapes, ["arrow"] * len(shapes), ways)
    return of_outlines(symbols, noisy(symbols.outlines_pinhole_px, np.random.default_rng(5))), rig


def test_an_arrow_that_few_of_the_images_find_that_show_it_well_is_left_out_however_like_the_others():
    arrows, left_out = given_and_left_out(*with_ghost(3))
    assert len(arrows) == len(ROWS)
    assert [(exclusion.sightings, exclusion.reason) for exclusion in left_out] == [(3, FOUND_SELDOM)]
    assert len(mapped(*with_ghost(len(WAYS_M)))) == len(ROWS) + 1


def test_an_arrow_known_to_decimetres_only_is_mapped_with_the_sigma_that_it_has():
    symbols, rig = seen([ARROW + np.array([13.0, 1.0])] * 4, ["arrow"] * 4, np.arange(4.0))
    (near_arrows, far) = (
        map_symbols(symbols, rig, all_views(rig), CAMERAS, jitter_rad, (), AcceptanceOptions())
        for jitter_rad in (JITTER_RAD, 4 * JITTER_RAD)
    )
    assert [len(arrows) for arrows, _ in (near_arrows, far)] == [1, 1]
    assert far[0][0].sigma_m > 2 * near_arrows[0][0].sigma_m > 0.02


def with_sides(symbols, outlines_px, seen_sides):
    """The symbols with outlines of forty points a side, and which sides lie along an edge of the paint."""
    flags = tuple(np.repeat(is_seen, 40) for is_seen in seen_sides)
    return replace(of_outlines(symbols, outlines_px), seen_sides=flags)


def squared_sigmas(symbol, true):
    """Squared Mahalanobis distances (N,) of true vertices (N, 2) from the nearest ones of a symbol."""
    off_m = symbol.outline_map[:, None] - true
    nearest = np.linalg.norm(off_m, axis=2).argmin(axis=0)
    rows = 2 * nearest[:, None] + np.arange(2)
    covariance = symbol.covariance_m2[rows[:, :, None], rows[:, None, :]]
    off_m = off_m[nearest, np.arange(len(true))]
    return np.einsum("ni,nij,nj->n", off_m, np.linalg.inv(covariance), off_m)


INSIDE_95 = 5.99  # chi-squared of two degrees of freedom


@pytest.mark.parametrize("seed", range(3))
def test_the_foot_that_other_paint_hides_is_completed_by_the_template_within_its_stated_sigma(seed):
    rng = np.random.default_rng(seed)
    ways_m, places = [0.0, 0.7, 1.4, 2.1], [np.array([10.0, y]) for y in (1.0, -1.0, 2.0, 0.0, -2.0)]
    painted = [
        ARROW * np.exp(rng.normal(0, 0.01, 2)) + rng.normal(0, 0.01, ARROW.shape) + at for at in places
    ]
    hidden = np.maximum(painted[0], [places[0][0] - 1.0, -np.inf])
    shapes = [shape for arrow in (hidden, *painted[1:]) for shape in [arrow] * 4]
    symbols, rig = seen(shapes, ["arrow"] * len(shapes), 5 * ways_m)
    sides = 4 * [cut(-1.0)[1]] + 16 * [np.ones(7, dtype=bool)]
    symbols = with_sides(symbols, noisy(symbols.outlines_pinhole_px, rng), sides)
    arrow = min(
        mapped(symbols, rig), key=lambda symbol: np.linalg.norm(symbol.outline_map.mean(axis=0) - places[0])
    )
    feet = [0, 6]
    assert corner_errors_m(arrow, painted[0])[feet].max() < 0.08
    assert squared_sigmas(arrow, painted[0])[feet].max() < INSIDE_95
    variance_m2 = np.diag(arrow.covariance_m2).reshape(-1, 2).sum(axis=1)
    assert arrow.outline_map[variance_m2.argsort()[-2:], 0].max() < places[0][0] - 1.0
    assert np.sqrt(variance_m2.max()) < 0.12


@pytest.mark.parametrize("seed", range(3))
def test_an_arrow_of_which_each_image_cuts_another_end_is_whole(seed):
    true = ARROW + AT
    front, front_sides = cut(-0.9)
    back = rectangle(((0.45 - 1.5) / 2, 0.0), 0.45 + 1.5, 0.16)
    back_sides = np.array([True, False, True, True])
    symbols, rig = seen(4 * [front + AT, back + AT], ["arrow"] * 8, np.arange(8) * 0.4)
    outlines_px = noisy(symbols.outlines_pinhole_px, np.random.default_rng(seed))
    (arrow,) = mapped(with_sides(symbols, outlines_px, 4 * [front_sides, back_sides]), rig)
    assert corner_errors_m(arrow, true).max() < 0.06
    assert squared_sigmas(arrow, true).max() < 2 * INSIDE_95


@pytest.mark.parametrize("vertices", [3, 40])
def test_the_cells_inside_an_outline_are_those_that_scikit_image_fills(vertices):
    # Such an outline leaves the raster, and crosses itself.
    ring = np.random.default_rng(vertices).uniform((-10.0, -10.0), (70.0, 50.0), (vertices, 2))
    filled = np.zeros((40, 60), dtype=bool)
    filled[polygon(ring[:, 1], ring[:, 0], filled.shape)] = True
    np.testing.assert_array_equal(cells_inside(ring, filled.shape), filled)
