"""Words and boxes of the map, from their hulls in images."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.detection.painted import word
from tests.site.scene import CAMERAS, given_and_left_out, mapped, of_outlines, seen
from v2hdm.geometry.planar import signed_area
from v2hdm.site.candidates import LACKS_A_CORNER

WIDTH, HEIGHT = CAMERAS[0].info.width, CAMERAS[0].info.height
AT = np.array([13.0, 1.0])
LETTERS = word("EBHO", AT, height_m=1.2, yaw_deg=4.0)
WAYS_M = np.arange(0.0, 7.0, 0.5)
BORDER = np.array([[0, 0], [WIDTH - 1, 0], [WIDTH - 1, HEIGHT - 1], [0, HEIGHT - 1]], dtype=np.float32)


def hull(polygons):
    points = np.asarray(polygons).reshape(-1, 2)
    return points[cv2.convexHull(points.astype(np.float32), returnPoints=False).ravel()]


def rectangle(polygons):
    """The true smallest rectangle (4, 2) around polygons, counter-clockwise."""
    points = np.asarray(polygons).reshape(-1, 2)
    middle = points.mean(axis=0)
    box = cv2.boxPoints(cv2.minAreaRect((points - middle).astype(np.float32))).astype(float) + middle
    return box if signed_area(box) > 0 else box[::-1]


def errors_m(area, true):
    """Corner errors (4, 2) in the order of the truth that suits best."""
    turns = [np.roll(area.outline_map, k, axis=0) for k in range(4)]
    return min((turn - true for turn in turns), key=lambda off: float((off**2).sum()))


def clipped(symbols):
    """The symbols as far as they lie in the image, and which sides the border has not cut."""
    outlines, sides = [], []
    for outline in symbols.outlines_pinhole_px:
        _, part = cv2.intersectConvexConvex(outline.astype(np.float32), BORDER)
        points = part.reshape(-1, 2).astype(float)
        inside = ((points > 3) & (points < [WIDTH - 4, HEIGHT - 4])).all(axis=1)
        outlines.append(points)
        sides.append(inside & np.roll(inside, -1))
    return replace(of_outlines(symbols, outlines), seen_sides=tuple(sides))


def noisy(symbols, rng, sigma_px=0.7, jitter_px=1.6):
    """Outlines off by noise of their points, and by the jitter of each image's direction."""
    moved = [
        outline + rng.normal(0.0, sigma_px, outline.shape) + rng.normal(0.0, jitter_px, 2)
        for outline in symbols.outlines_pinhole_px
    ]
    return replace(of_outlines(symbols, moved), seen_sides=symbols.seen_sides)


@pytest.mark.parametrize("kind", ["text", "box"])
def test_an_area_is_the_rectangle_around_its_paint(kind):
    (area,) = mapped(*seen([hull(LETTERS)] * 6, [kind] * 6, WAYS_M[:6]))
    assert (area.kind, area.sightings, area.outline_map.shape) == (kind, 6, (4, 2))
    assert signed_area(area.outline_map) > 0
    assert np.linalg.norm(errors_m(area, rectangle(LETTERS)), axis=1).max() < 0.02


def test_images_that_cut_a_word_at_their_border_do_not_shrink_it():
    near_word = word("EBHO", (7.0, 3.2), height_m=1.6)
    symbols, rig = seen([hull(near_word)] * len(WAYS_M), ["text"] * len(WAYS_M), WAYS_M)
    cut = clipped(symbols)
    areas_px = [
        abs(signed_area(now)) / abs(signed_area(before))
        for now, before in zip(cut.outlines_pinhole_px, symbols.outlines_pinhole_px, strict=True)
        if len(now)
    ]
    assert sum(share < 0.9 for share in areas_px) >= 3
    enough = np.array([share > 0.1 for share in areas_px])
    few = replace(
        of_outlines(
            cut, [outline for outline, use in zip(cut.outlines_pinhole_px, enough, strict=False) if use]
        ),
        seen_sides=tuple(sides for sides, use in zip(cut.seen_sides, enough, strict=False) if use),
        camera=cut.camera[: len(enough)][enough],
        frame=cut.frame[: len(enough)][enough],
        kinds=("text",) * int(enough.sum()),
    )
    (area,) = mapped(few, rig)
    assert np.linalg.norm(errors_m(area, rectangle(near_word)), axis=1).max() < 0.03


def test_a_word_of_which_no_image_shows_one_side_has_no_place():
    symbols, rig = seen([hull(LETTERS)] * 6, ["text"] * 6, WAYS_M[:6])
    middle = [outline[:, 0].mean() for outline in symbols.outlines_pinhole_px]
    halves = [
        np.column_stack([np.minimum(outline[:, 0], u), outline[:, 1]])
        for outline, u in zip(symbols.outlines_pinhole_px, middle, strict=True)
    ]
    sides = tuple(
        (half[:, 0] < u) & (np.roll(half[:, 0], -1) < u) for half, u in zip(halves, middle, strict=True)
    )
    areas, left_out = given_and_left_out(replace(of_outlines(symbols, halves), seen_sides=sides), rig)
    assert not areas
    assert [exclusion.reason for exclusion in left_out] == [LACKS_A_CORNER]


def test_what_hides_a_part_in_a_third_of_the_images_does_not_shrink_a_word():
    whole, part = hull(LETTERS), hull(word("EB", AT, height_m=1.2, yaw_deg=4.0))
    shapes = [part if k % 3 == 0 else whole for k in range(len(WAYS_M))]
    (area,) = mapped(*seen(shapes, ["text"] * len(shapes), WAYS_M))
    assert np.linalg.norm(errors_m(area, rectangle(LETTERS)), axis=1).max() < 0.06


def test_a_word_in_a_box_is_a_word_in_a_box():
    frame = np.array([[-2.0, -4.0], [5.0, -4.0], [5.0, 3.0], [-2.0, 3.0]]) + AT
    shapes = [shape for _ in range(6) for shape in (hull(LETTERS), frame)]
    symbols, rig = seen(shapes, ["text", "box"] * 6, np.repeat(WAYS_M[:6], 2))
    areas = mapped(symbols, rig)
    assert sorted(area.kind for area in areas) == ["box", "text"]


def test_paint_that_some_images_take_for_a_word_is_what_most_take_it_for():
    count = len(WAYS_M)
    kinds = ["text" if number % 3 == 0 else "box" for number in range(count)]
    (area,) = mapped(*seen([hull(LETTERS)] * count, kinds, WAYS_M))
    assert area.kind == "box"
    assert area.sightings == count


def test_the_corners_of_words_are_as_uncertain_as_they_are_stated():
    rng = np.random.default_rng(2)
    true = rectangle(LETTERS)
    squared, sizes = [], []
    for _ in range(40):
        symbols, rig = seen([hull(LETTERS)] * 8, ["text"] * 8, WAYS_M[:8])
        (area,) = mapped(noisy(symbols, rng), rig)
        off = errors_m(area, true)
        turn = min(range(4), key=lambda k: float(((np.roll(area.outline_map, k, axis=0) - true) ** 2).sum()))
        order = [(k - turn) % 4 for k in range(4)]
        blocks = area.covariance_m2.reshape(4, 2, 4, 2)[order, :, order, :]
        squared.append(np.einsum("ki,kij,kj->k", off, np.linalg.inv(blocks), off))
        sizes.append(np.linalg.norm(off, axis=1))
    assert np.median(sizes) < 0.1
    inside = (np.array(squared) < 5.99).mean()
    assert inside > 0.85, inside
    assert np.mean(squared) > 0.3  # not vastly overstated


def test_letters_that_images_see_apart_are_one_word_in_images_that_see_them_together():
    whole, first = hull(LETTERS), hull(word("E", AT, height_m=1.2, yaw_deg=4.0))
    other_letters = hull(word(" BHO", AT, height_m=1.2, yaw_deg=4.0))
    shapes = [whole] * 5 + [first, other_letters, first, other_letters]
    ways_m = [*WAYS_M[:5], 2.5, 2.5, 3.0, 3.0]
    (area,) = mapped(*seen(shapes, ["text"] * len(shapes), np.array(ways_m)))
    assert np.linalg.norm(errors_m(area, rectangle(LETTERS)), axis=1).max() < 0.03
