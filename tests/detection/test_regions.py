"""A look at parts of an image finds there what a look at all of it does."""

import io
import json
import logging

import numpy as np
import pytest

from tests.detection.pictures import brightness_model, diamond, make_camera, picture
from v2hdm.detection.detector import Detector
from v2hdm.detection.frames import Frame
from v2hdm.detection.network import run_on_road
from v2hdm.detection.pointing import Pointer
from v2hdm.detection.regions import NO_PAINT, merged, run_in_regions
from v2hdm.detection.road import RoadDetector

DIAMONDS = [diamond(6.0, -1.0), diamond(8.0, 0.5), diamond(11.0, -0.5)]
AROUND_PX = np.array([-20.0, -20.0, 20.0, 20.0])


@pytest.fixture(scope="module")
def detector(tmp_path_factory):
    return Detector.load(brightness_model(tmp_path_factory.mktemp("model")))


@pytest.fixture(scope="module")
def image():
    return picture(make_camera(), DIAMONDS, seed=0)


def box_of(marking):
    return np.array([*marking.corners_px.min(axis=0), *marking.corners_px.max(axis=0)])


def whole(detector, image):
    """All markings of an image, from near to far."""
    markings, _ = detector.detect(image, make_camera())
    return sorted(markings, key=lambda marking: -marking.corners_px[:, 1].max())


def test_what_lies_in_a_region_is_found_as_in_the_whole_image_and_nothing_else(detector, image):
    markings = whole(detector, image)
    assert len(markings) == 3
    for marking in markings:
        regions_px = (box_of(marking) + AROUND_PX)[None]
        (detection,) = detector.detect_in_regions(image, make_camera(), regions_px)
        assert detection.kind == marking.kind
        np.testing.assert_allclose(detection.corners_px, marking.corners_px, atol=0.05)
        np.testing.assert_allclose(detection.covariance_px, marking.covariance_px, rtol=0.3, atol=0.02)


def test_all_regions_at_once_find_all(detector, image):
    markings = whole(detector, image)
    regions_px = np.array([box_of(marking) + AROUND_PX for marking in markings])
    detections = detector.detect_in_regions(image, make_camera(), regions_px)
    detections = sorted(detections, key=lambda marking: -marking.corners_px[:, 1].max())
    assert [marking.kind for marking in detections] == [marking.kind for marking in markings]
    for part, marking in zip(detections, markings, strict=True):
        np.testing.assert_allclose(part.corners_px, marking.corners_px, atol=0.05)


def test_a_marking_that_a_region_cuts_is_none(detector, image):
    marking = whole(detector, image)[0]
    left, upper, right, lower = box_of(marking)
    regions_px = np.array([[left - 60, upper - 60, (left + right) / 2 - 30, lower + 60]])
    assert detector.detect_in_regions(image, make_camera(), regions_px) == ()


@pytest.mark.parametrize(
    "regions_px", [np.zeros((0, 4)), [[-900, -900, -800, -800]], [[9e3, 9e3, 9.1e3, 9.1e3]]]
)
def test_regions_without_road_show_nothing(detector, image, regions_px):
    assert detector.detect_in_regions(image, make_camera(), np.array(regions_px)) == ()


def test_the_output_where_it_is_trusted_is_that_of_the_whole_image(detector, image):
    camera = detector.road_camera(make_camera())
    everywhere = run_on_road(detector.network, image, camera)
    box = box_of(whole(detector, image)[1])
    inside = run_in_regions(detector.network, image, camera, (box + AROUND_PX)[None])
    assert inside.paint.shape == everywhere.paint.shape
    assert inside.kinds.shape == everywhere.kinds.shape
    is_seen = inside.paint > NO_PAINT
    assert 0.001 < is_seen.mean() < 0.5
    np.testing.assert_allclose(inside.paint[is_seen], everywhere.paint[is_seen], atol=1e-3)


def test_boxes_that_overlap_become_one_and_none_is_lost():
    boxes = np.array([[0, 0, 10, 10], [8, 0, 20, 10], [100, 100, 110, 110]])
    out = merged(boxes)
    assert sorted(map(tuple, out.tolist())) == [(0, 0, 20, 10), (100, 100, 110, 110)]


def test_a_road_detector_takes_regions(detector, image):
    road = RoadDetector(detector, make_camera())
    marking = whole(detector, image)[2]
    in_image = road.detect(image, regions_px=(box_of(marking) + AROUND_PX)[None])
    assert len(in_image.markings) == 1
    assert in_image.lanes == ()
    assert not in_image.is_whole
    assert road.detect(image).is_whole


def test_a_line_holds_for_an_image_of_its_time_alone():
    pointer = Pointer()
    pointer.follow(io.StringIO(json.dumps({"stamp_s": 10.0, "regions_px": [[1, 2, 3, 4]]}) + "\n"))
    np.testing.assert_array_equal(pointer.at(10.03).regions_px, [[1, 2, 3, 4]])
    assert not pointer.at(10.03).is_all_later
    assert pointer.at(10.1) is None
    assert pointer.at(9.9) is None
    assert pointer.at(Frame("image", "image", 0, None, np.zeros((1, 1, 3), np.uint8)).stamp_s) is None
    pointer.follow(io.StringIO(json.dumps({"stamp_s": 10.0, "regions_px": None, "all_later": True}) + "\n"))
    assert pointer.at(10.03) == (10.0, None, True)


@pytest.mark.parametrize(
    "line",
    [
        "{",
        "[]",
        "{}",
        '{"stamp_s": "x", "regions_px": [[1, 2, 3, 4]]}',
        '{"stamp_s": 1, "regions_px": [[1, 2, 3]]}',
    ],
)
def test_a_line_that_cannot_be_read_is_said_once_and_all_is_looked_at(line, caplog):
    pointer = Pointer()
    right = json.dumps({"stamp_s": 1.0, "regions_px": [[1, 2, 3, 4]]})
    with caplog.at_level(logging.WARNING):
        pointer.follow([right, line, line])
    assert pointer.at(1.0) is None
    assert len(caplog.records) == 1
    assert "give stamp_s and regions_px" in caplog.text
