"""Words and boxes of single images, from outputs drawn of the truth."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.detection.painted import framed, hatched, network_output, word
from tests.detection.pictures import bar, make_camera, to_image
from v2hdm.catalogue import SHIPPED
from v2hdm.detection.areas import find_areas
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.detector import _likelier, _not_of, _of_several
from v2hdm.detection.network import NetworkOutput, as_shares
from v2hdm.geometry.planar import rectangle_size
from v2hdm.records import MarkingDetection

CAMERA = make_camera("pinhole")


def areas_of(*paints, camera=CAMERA):
    road = RoadCamera(camera, 16)
    return find_areas(network_output(camera, paints), road, SHIPPED, 0, 0.5, 22.0), road


def overlap(outline_px, polygons):
    """Intersection over union of a detected hull and that of true polygons, in the image."""
    true = cv2.convexHull(to_image(CAMERA, polygons.reshape(-1, 2)).astype(np.float32))
    common, _ = cv2.intersectConvexConvex(outline_px.astype(np.float32), true)
    return common / (cv2.contourArea(outline_px.astype(np.float32)) + cv2.contourArea(true) - common)


@pytest.mark.parametrize("yaw_deg", [0.0, 25.0, 180.0])
def test_the_letters_of_a_word_are_one_area_with_the_hull_of_all(yaw_deg):
    at = (7.0, 0.8) if yaw_deg < 90 else (8.2, -1.2)
    letters = word("EBH", at, yaw_deg=yaw_deg)
    (area,), road = areas_of(("text", letters))
    assert area.kind == "text"
    assert area.score > 0.8
    assert overlap(area.outline_px, letters) > 0.9
    assert area.outline_seen.all()
    size_m = rectangle_size(road.unproject(area.outline_px))
    np.testing.assert_allclose(size_m, rectangle_size(letters.reshape(-1, 2)), atol=0.1)


def test_two_words_are_two_areas_and_two_letters_of_one_are_one():
    first, second = word("EB", (7.0, 2.2)), word("HO", (7.0, -0.8))
    areas, _ = areas_of(("text", first), ("text", second))
    overlaps = sorted(max(overlap(area.outline_px, letters) for letters in (first, second)) for area in areas)
    assert len(overlaps) == 2
    assert overlaps[0] > 0.85


def test_a_letter_of_few_elements_belongs_to_the_word_beside_it_and_is_none_by_itself():
    letters = word("EB", (7.0, 0.8))
    output = network_output(CAMERA, [("text", letters)])
    rows, columns = np.nonzero(output.paint > 0)
    right = columns.max() + 4
    for row, column in ((rows.mean(), right), (rows.mean(), right + 120)):
        output.paint[int(row), column : column + 3] = 5.0
        span = output.paint.shape[0] // output.areas.shape[1]
        name = output.area_classes.index("text")
        output.areas[name, int(row) // span, column // span : (column + 2) // span + 1] = 9.0
    (area,) = find_areas(output, RoadCamera(CAMERA, 16), SHIPPED, 0, 0.5, 22.0)
    assert area.outline_px[:, 0].max() == pytest.approx(output.stride * (right + 2.5), abs=2.0)


def test_a_hatched_box_is_one_area_with_its_frame():
    box = hatched((6.5, -1.5))
    (area,), _ = areas_of(("box", box))
    assert area.kind == "box"
    assert overlap(area.outline_px, box) > 0.9


def test_sides_that_the_image_s_border_cuts_are_no_sides_of_the_word():
    letters = word("EBHO", (3.6, 2.6), height_m=1.6)
    (area,), road = areas_of(("text", letters))
    assert not area.outline_seen.all()
    assert area.outline_seen.any()
    cut = ~area.outline_seen
    at_border = ~road.inside(area.outline_px, 6.0)
    assert (cut == (at_border | np.roll(at_border, -1))).all()
    assert area.score > 0.5  # half a word is a word all the same


def test_the_vehicle_s_own_mask_cuts_a_word_like_the_border():
    letters = word("EBH", (5.5, 0.8))
    mask = np.zeros((CAMERA.info.height, CAMERA.info.width), dtype=bool)
    low = int(to_image(CAMERA, letters.reshape(-1, 2))[:, 1].max()) - 15
    mask[low:] = True
    masked = replace(CAMERA, own_vehicle=mask)
    output = network_output(masked, [("text", letters)])
    output.paint[low // 2 :] = -20.0
    (area,) = find_areas(output, RoadCamera(masked, 16), SHIPPED, 0, 0.5, 22.0)
    bottom = area.outline_px[:, 1] > low - 8
    assert not area.outline_seen[bottom & np.roll(bottom, -1)].any()
    assert area.outline_seen.any()


def test_a_network_that_does_not_know_areas_finds_none():
    output = network_output(CAMERA, [("text", word("EBH", (7.0, 0.8)))])
    old = replace(output, areas=output.areas[:0], area_classes=())
    assert find_areas(old, RoadCamera(CAMERA, 16), SHIPPED, 0, 0.5, 22.0) == []


def test_what_is_no_area_shares_paint_as_if_there_were_none():
    strokes = word("EBH", (7.0, 0.8))
    output = network_output(CAMERA, [("lane_dash", strokes)])
    named = network_output(CAMERA, [("lane_dash", strokes), ("text", strokes)])
    rows, columns = np.nonzero(output.paint > 0)
    shares = output.class_probability(rows, columns)
    np.testing.assert_array_equal(shares, named.class_probability(rows, columns))
    np.testing.assert_allclose(shares.sum(axis=0), 1.0, rtol=1e-5)
    with_areas = as_shares(named.area_odds(rows, columns))
    np.testing.assert_allclose(with_areas.sum(axis=0), 1.0, rtol=1e-5)
    text = with_areas[named.area_classes.index("text")]
    dash = with_areas[len(named.area_classes) + named.classes.index("lane_dash")]
    np.testing.assert_allclose(text, dash, rtol=1e-5)


def test_the_order_of_the_classes_in_a_file_does_not_matter():
    strokes = word("EBH", (7.0, 0.8))
    output = network_output(CAMERA, [("text", strokes)])
    names = [*output.area_classes, *output.classes]
    logits = np.concatenate([output.areas, output.kinds])
    turned = NetworkOutput.of(output.paint, logits, [], names, output.stride, 0)
    assert (turned.classes, turned.area_classes) == (output.classes, output.area_classes)
    np.testing.assert_array_equal(turned.kinds, output.kinds)
    np.testing.assert_array_equal(turned.areas, output.areas)


def test_a_foot_of_an_arrow_that_is_named_text_is_no_word():
    arrow = np.array([[[6.0, -0.15], [8.0, -0.15], [8.0, 0.15], [6.0, 0.15]]])
    foot = np.array([[[7.7, -0.15], [8.0, -0.15], [8.0, 0.15], [7.7, 0.15]]])
    output = network_output(CAMERA, [("arrow", arrow)])
    named = network_output(CAMERA, [("text", foot)])
    is_named = named.areas.max(axis=0) > 0
    output.areas[:] = np.where(is_named, named.areas, output.areas)
    output.kinds[:] = np.where(is_named, named.kinds, output.kinds)
    assert find_areas(output, RoadCamera(CAMERA, 16), SHIPPED, 0, 0.5, 22.0) == []


def test_a_letter_is_no_marking_and_a_surer_marking_in_a_box_stays():
    letters = word("EBH", (7.0, 0.8))
    (area,), _ = areas_of(("text", letters))
    corners = to_image(CAMERA, letters[0])
    markings = tuple(
        MarkingDetection("lane_dash", score, corners, np.eye(8), np.ones(4, dtype=bool))
        for score in (0.4, 0.999)
    )
    beside = MarkingDetection("diamond", 0.3, corners + np.array([300, 0]), np.eye(8), np.ones(4, dtype=bool))
    assert [marking.score for marking in _not_of([area], (*markings, beside))] == [0.999, 0.3]


def test_a_box_whose_lines_the_network_takes_for_strokes_of_letters_is_named_by_its_meshes():
    def named(polygons):
        output = network_output(CAMERA, [("text", polygons)])
        text, box = (output.area_classes.index(name) for name in ("text", "box"))
        output.areas[box] = np.where(output.areas[text] > 0, output.areas[text] - 2.0, output.areas[box])
        return [area.kind for area in find_areas(output, RoadCamera(CAMERA, 16), SHIPPED, 0, 0.5, 22.0)]

    assert named(framed((6.0, -1.2), 2.4, 2.4)) == ["box"]
    assert named(word("BOBO", (6.5, 1.5))) == ["text"]


def test_a_stop_line_that_an_arrow_crosses_is_a_marking_and_a_dash_on_its_shaft_is_none():
    valid = np.ones(4, dtype=bool)
    stop = MarkingDetection("stop_line", 0.5, to_image(CAMERA, bar(7.0, 0, 0.4, 3.0)), np.eye(8), valid)
    dash = MarkingDetection("lane_dash", 0.5, to_image(CAMERA, bar(7.2, 0, 1.4, 0.2)), np.eye(8), valid)
    shape = np.array(
        [[6.4, -0.12], [8.0, -0.12], [8.0, -0.4], [9.0, 0], [8.0, 0.4], [8.0, 0.12], [6.4, 0.12]]
    )
    arrow = MarkingDetection(
        "arrow", 0.9, np.full((4, 2), np.nan), np.eye(8), np.zeros(4, dtype=bool), to_image(CAMERA, shape)
    )
    assert [marking.kind for marking in _likelier([stop, dash], [arrow])] == ["stop_line", "arrow"]


def test_an_area_that_is_part_of_an_arrow_is_no_word():
    letters = word("EBH", (7.0, 0.8))
    (area,), _ = areas_of(("text", letters))
    empty = MarkingDetection("arrow", 0.3, np.full((4, 2), np.nan), np.eye(8), np.zeros(4, dtype=bool))
    middle = area.outline_px.mean(axis=0)
    arrow = replace(empty, outline_px=middle + 3 * (area.outline_px - middle))
    letter = replace(empty, outline_px=to_image(CAMERA, letters[0]))
    assert _of_several([area], (arrow,)) == []
    assert _of_several([area], (letter,)) == [area]
    assert _of_several([area], ()) == [area]
