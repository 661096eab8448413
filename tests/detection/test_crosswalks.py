"""Crosswalks of single images, and what a row says of its bars."""

import numpy as np
import pytest

from tests.detection.painted import network_output
from tests.detection.pictures import bar, make_camera, to_image
from v2hdm.catalogue import SHIPPED
from v2hdm.detection.areas import find_areas
from v2hdm.detection.camera import RoadCamera, camera_from_calibration, rough_calibration
from v2hdm.detection.crosswalks import continuing_features, find_crosswalks, in_rows
from v2hdm.detection.detector import Detector, _of_several
from v2hdm.geometry.rows import IN_IMAGE, MAPPED, rows_of_bars
from v2hdm.records import MarkingDetection

CAMERA = make_camera("pinhole")
BARS = np.array([bar(9.0, across, 2.5, 0.5) for across in np.arange(-3.0, 3.1, 1.0)])


def raised(score, ground=BARS, is_bar=None):
    is_bar = np.ones(len(ground), dtype=bool) if is_bar is None else is_bar
    return in_rows(np.full(len(ground), score), ground, is_bar)


def seen_wrongly(ground, pitch_off_deg, roll_off_deg=0.0):
    """Corners on the ground (N, 4, 2) as a camera sees them that looks lower or is rolled unknown to us."""
    true = RoadCamera(camera_from_calibration(rough_calibration("a", 1280, 720, 1.5, 6.0, 70.0)))
    stated = rough_calibration("b", 1280, 720, 1.5, 6.0 + pitch_off_deg, 70.0)
    px = true.project(ground.reshape(-1, 2))
    c, s = np.cos(np.radians(roll_off_deg)), np.sin(np.radians(roll_off_deg))
    px = (px - [640, 360]) @ np.array([[c, s], [-s, c]]) + [640, 360]
    return RoadCamera(camera_from_calibration(stated)).unproject(px).reshape(ground.shape)


def test_doubtful_bars_in_a_row_make_each_other_likely():
    assert (raised(0.2) > 0.7).all()


@pytest.mark.parametrize("score", [0.02, 0.2, 0.6, 0.95])
def test_the_more_bars_a_row_has_the_likelier_they_are(score):
    by_count = [raised(score, BARS[:count]).mean() for count in (3, 5, 7)]
    assert by_count == sorted(by_count)


@pytest.mark.parametrize(
    "ground",
    [BARS[:2], np.array([BARS[0], BARS[0] * 0.4, BARS[0] + [9.0, 2.0]])],
    ids=["two", "three unlike ones"],
)
def test_bars_in_no_row_keep_their_probability(ground):
    assert raised(0.2, ground).tolist() == [0.2] * len(ground)


def test_what_is_no_bar_neither_makes_a_row_nor_gains_by_it():
    is_bar = np.array([True, True, False, True, True, False, True])
    of_bars = raised(0.2, is_bar=is_bar)
    assert (of_bars[is_bar] > 0.2).all()
    assert (of_bars[~is_bar] == 0.2).all()
    assert raised(0.2, is_bar=np.arange(7) < 2).tolist() == [0.2] * 7


def test_bars_above_the_horizon_keep_their_probability():
    ground = BARS.copy()
    ground[2] = np.nan
    of_bars = raised(0.2, ground)
    assert of_bars[2] == 0.2
    assert (np.delete(of_bars, 2) > 0.2).all()


@pytest.mark.parametrize(
    ("pitch_off_deg", "roll_off_deg"), [(0.0, 0.0), (-2.0, 0.0), (1.0, 2.0), (-1.0, -2.0)]
)
def test_a_row_is_one_in_an_image_even_where_pitch_and_roll_are_known_about(pitch_off_deg, roll_off_deg):
    ground = seen_wrongly(BARS, pitch_off_deg, roll_off_deg)
    (row,) = rows_of_bars(ground, IN_IMAGE)
    assert sorted(row.tolist()) == list(range(7))


def test_a_row_that_bends_is_one_in_an_image_and_none_on_a_map():
    ground = np.array([bar(9.0 + 0.12 * across**2, across, 2.5, 0.5) for across in np.arange(-4.0, 4.1)])
    assert rows_of_bars(ground, MAPPED) == []
    (row,) = rows_of_bars(ground, IN_IMAGE)
    assert sorted(row.tolist()) == list(range(9))


def test_of_two_readings_of_the_same_paint_a_row_has_the_larger():
    ground = np.concatenate([BARS, [bar(8.8, 0.1, 2.0, 0.3)]])
    (row,) = rows_of_bars(ground, IN_IMAGE)
    assert sorted(row.tolist()) == list(range(7))


def test_bars_that_stand_at_random_are_no_row_in_an_image():
    rng = np.random.default_rng(5)
    for _ in range(20):
        places = rng.uniform(-8, 8, 6)
        ahead = rng.uniform(6, 20, 6)
        yaw = rng.uniform(0, np.pi, 6)
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]).transpose(2, 0, 1)
        ground = BARS[3] @ turn + np.column_stack([ahead, places])[:, None]
        assert rows_of_bars(ground, IN_IMAGE) == []


def test_bars_in_a_row_are_a_crosswalk_whatever_takes_them_for_letters():
    bars = [bar(8.0, across, 2.0, 0.4) for across in (-1.2, -0.4, 0.4, 1.2)]
    valid = np.ones(4, dtype=bool)
    markings = tuple(
        MarkingDetection("crosswalk_bar", 0.6, to_image(CAMERA, corners), np.eye(8), valid)
        for corners in bars
    )
    ((crosswalk, _),) = find_crosswalks(markings, RoadCamera(CAMERA, 16))
    output = network_output(CAMERA, [("text", np.array(bars[:3]))])
    (area,) = find_areas(output, RoadCamera(CAMERA, 16), SHIPPED, 0, 0.5, 22.0)
    assert _of_several([area], markings) == [area]
    assert _of_several([area], (*markings, crosswalk)) == []


def test_the_bars_of_an_image_are_its_crosswalk_s_parts():
    bars = [bar(8.0, across, 2.0, 0.4) for across in (-1.6, -0.8, 0.0, 0.8, 1.6)]
    valid = np.ones(4, dtype=bool)
    stop = MarkingDetection("stop_line", 0.9, to_image(CAMERA, bar(5.5, 0, 0.3, 3.0)), np.eye(8), valid)
    markings = [
        MarkingDetection("crosswalk_bar", 0.8, to_image(CAMERA, bar), np.eye(8), valid) for bar in bars
    ]
    ((crosswalk, parts),) = find_crosswalks([stop, *markings], RoadCamera(CAMERA, 16))
    assert (crosswalk.kind, crosswalk.score, sorted(parts)) == (
        "crosswalk",
        pytest.approx(0.8),
        [1, 2, 3, 4, 5],
    )
    ground = RoadCamera(CAMERA, 16).unproject(crosswalk.outline_px)
    np.testing.assert_allclose(np.ptp(ground, axis=0), [2.0, 3.6], atol=0.02)
    assert find_crosswalks(markings[:2], RoadCamera(CAMERA, 16)) == []


def painted_bars(places, kind="crosswalk_bar"):
    """Pieces of paint of which the network says that they are of a class."""
    output = network_output(CAMERA, [(kind, np.array([bar(8.0, across, 2.0, 0.4)])) for across in places])
    detector = Detector.load()
    return detector.propose(output, CAMERA).pieces


def crosswalk_of(places, pieces):
    bars = [to_image(CAMERA, bar(8.0, across, 2.0, 0.4)) for across in places]
    valid = np.ones(4, dtype=bool)
    markings = [MarkingDetection("crosswalk_bar", 0.8, px, np.eye(8), valid) for px in bars]
    ((crosswalk, parts),) = find_crosswalks(markings, RoadCamera(CAMERA, 16), pieces)
    assert sorted(parts) == list(range(len(places)))
    return np.ptp(RoadCamera(CAMERA, 16).unproject(crosswalk.outline_px)[:, 1])


def test_paint_that_the_network_names_a_bar_continues_a_row():
    places = (-1.6, -0.8, 0.0)
    pieces = painted_bars((*places, 0.8, 1.6))
    assert crosswalk_of(places, ()) == pytest.approx(2.0, abs=0.02)
    assert crosswalk_of(places, pieces) == pytest.approx(3.6, abs=0.1)


@pytest.mark.parametrize(("places", "kind"), [((3.2,), "crosswalk_bar"), ((0.8, 1.6), "lane_line")])
def test_paint_far_from_a_row_or_of_another_class_does_not_continue_it(places, kind):
    pieces = painted_bars(places, kind)
    assert crosswalk_of((-1.6, -0.8, 0.0), pieces) == pytest.approx(2.0, abs=0.02)


def test_paint_beyond_and_beside_a_row_is_measured_in_its_steps_and_lengths():
    centres = BARS.mean(axis=1)
    ahead = BARS[-1] + [1.25, 0.0]
    beyond = BARS[-1] + [0.0, 2.0]
    assert continuing_features(centres, 2.5, BARS[2]) == pytest.approx([1.0, 0.0, 0.0])
    assert continuing_features(centres, 2.5, ahead) == pytest.approx([1.0, 0.0, np.log(2.0)])
    assert continuing_features(centres, 2.5, beyond) == pytest.approx([1.0, 2.0, 0.0])
