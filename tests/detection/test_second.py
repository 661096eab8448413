"""A whole search that follows a look at parts takes its steps between images, and finds the same."""

import time

import numpy as np
import pytest

from tests.detection.pictures import brightness_model, diamond, make_camera, picture
from v2hdm.detection.detector import Detector
from v2hdm.detection.frames import Frame, NewestFrames
from v2hdm.detection.road import RoadDetector
from v2hdm.detection.second import SecondLooks
from v2hdm.detection.steps import last

ALL_STEPS = 9 * [True]  # time for more steps than a search has


class Frames:
    """A camera that has time, or not, as it is told."""

    def __init__(self, has_time):
        self.has_time = has_time
        self.asked_s = []

    def is_idle_for(self, seconds):
        self.asked_s.append(seconds)
        return self.has_time.pop(0) if self.has_time else False


@pytest.fixture(scope="module")
def road(tmp_path_factory):
    model = brightness_model(tmp_path_factory.mktemp("model"))
    return RoadDetector(Detector.load(model), make_camera(), is_for_localizer=True)


@pytest.fixture(scope="module")
def frame():
    pixels = picture(make_camera(), [diamond(6.0, -1.0), diamond(8.0, 0.5)], seed=0)
    return Frame("image", "image", 3, 5.0, pixels)


def test_steps_find_what_a_look_at_once_does(road, frame):
    at_once = road.detect(frame.pixels)
    in_steps = last(road.steps(frame.pixels))
    assert len(in_steps.markings) == len(at_once.markings) == 2
    for marking, at_once_marking in zip(in_steps.markings, at_once.markings, strict=True):
        np.testing.assert_array_equal(marking.image.corners_px, at_once_marking.image.corners_px)
    assert in_steps.is_whole


def test_a_search_waits_where_an_image_is_expected_and_goes_on_after_it(road, frame):
    looks = SecondLooks(Frames([True, True, False, *ALL_STEPS]))
    assert looks.look() is None  # nothing is to be searched
    looks.add(frame, road)
    assert looks.look() is None  # two steps, then no time
    second = looks.look()
    assert second.frame is frame
    assert second.camera == road.camera.info.name
    assert second.road.is_second
    assert second.road.is_whole
    assert len(second.road.markings) == 2
    assert looks.look() is None


def test_of_two_images_the_one_that_is_searched_is_finished(road, frame):
    looks = SecondLooks(Frames([True, False, *ALL_STEPS]))
    looks.add(frame, road)
    assert looks.look() is None
    looks.add(Frame("later", "later", 4, 5.1, frame.pixels), road)
    assert looks.look().frame is frame
    assert looks.look() is None


def test_a_step_needs_the_time_that_it_took_before(road, frame):
    frames = Frames([*ALL_STEPS, *ALL_STEPS])
    looks = SecondLooks(frames)
    asked_s = []
    for _ in range(2):
        looks.add(frame, road)
        assert looks.look() is not None
        asked_s.append(frames.asked_s.copy())
        frames.asked_s.clear()
    first, second = asked_s
    assert len(set(first)) == 1  # nothing is known yet
    assert len(set(second)) == len(second) == len(first) > 4


def test_a_step_for_which_there_was_no_time_is_taken_before_long(road, frame):
    class Hurried(Frames):
        """A camera whose images leave little time."""

        def is_idle_for(self, seconds):
            self.asked_s.append(seconds)
            return seconds < 0.01

    frames = Hurried([])
    looks = SecondLooks(frames)
    looks.add(frame, road)
    looks._longest_s = dict.fromkeys(range(9), 0.05)  # as after an image during which something else ran
    images = next(image for image in range(200) if looks.look() is not None)
    assert images > 4
    waited_s = np.array(frames.asked_s)
    assert (waited_s[1:5] < waited_s[:4]).all()


def test_a_camera_has_time_until_its_next_image_is_expected():
    def camera():
        for number in range(3):
            yield Frame("camera", "image", number, None, np.zeros((1, 1, 3), np.uint8))
            time.sleep(0.2)
        time.sleep(2.0)

    newest = NewestFrames(camera())
    for _ in range(3):
        next(newest)
    assert newest.is_idle_for(0.01)
    assert not newest.is_idle_for(0.5)
    time.sleep(0.35)  # an image is overdue: nobody knows when it comes
    assert newest.is_idle_for(0.5)
