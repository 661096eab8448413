"""A word tells a vehicle where it is among markings that look alike everywhere."""

from dataclasses import replace

import numpy as np
import pytest

from tests.localization.driven import cameras, drive, mapped, with_words, word_at, yard
from v2hdm.localization.areas import AreaMap
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.pose import Status
from v2hdm.localization.seeing import Hull
from v2hdm.localization.words import WordPatch
from v2hdm.records import HDMap

WORDS = (word_at(74.0), word_at(83.0), word_at(101.0))


def followed(words_of_map, words_seen):
    """A drive among dashes that repeat, with words in the map and in the images; its poses."""
    painted = yard(5, diamonds=False)
    driven = drive(painted, 5, begin_m=60.0, seconds=8.0)
    hd_map = replace(mapped(painted, 5), symbols=words_of_map)
    localizer = Localizer(hd_map, driven.calibrations, driven.rough(np.random.default_rng(0)))
    poses = []
    for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
        shown = [with_words(look, driven.poses[frame], words_seen) for look in looks]
        poses.append(localizer.update(shown, motion))
    return driven, poses


def test_words_tell_where_a_vehicle_is_among_dashes_that_repeat():
    driven, poses = followed(WORDS, WORDS)
    tracked = [frame for frame, pose in enumerate(poses) if pose.status == Status.TRACKING]
    assert len(tracked) > 20
    for frame in tracked:
        bounds = [*poses[frame].protection_m, poses[frame].protection_rad]
        assert (np.abs(driven.errors(poses[frame], frame)) < bounds).all()


@pytest.mark.parametrize(
    ("words_of_map", "words_seen"),
    [
        ((), WORDS),
        (WORDS, ()),
        (tuple(word_at(float(x_m)) for x_m in range(2, 160, 6)), (word_at(74.0), word_at(80.0))),
    ],
)
def test_words_that_the_map_lacks_or_that_repeat_as_the_dashes_do_tell_nothing(words_of_map, words_seen):
    _, poses = followed(words_of_map, words_seen)
    assert not any(pose.status == Status.TRACKING for pose in poses)


def test_a_place_is_scored_by_the_words_that_lie_on_those_of_the_map():
    patch = WordPatch()
    shape = np.array([[5.0, -0.5], [7.0, -0.5], [7.0, 0.5], [5.0, 0.5]])
    calibration = cameras()["front"]
    cam = np.column_stack([shape, np.zeros(4), np.ones(4)]) @ calibration.cam_from_vehicle[:3].T
    hull = Hull("text", (cam @ calibration.info.intrinsic.T)[:, :2] / cam[:, 2:])
    area_map = AreaMap(HDMap((), symbols=(word_at(4.8), word_at(20.0, kind="box"))), 0.0, 0)
    poses = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, np.pi], [14.0, 0.0, 0.0]])
    patch.add([hull], calibration, np.zeros(3), 0.0)
    assert (patch.scores(poses, area_map) == 0.0).all()  # one image shows many a word that is none
    patch.add([hull], calibration, np.zeros(3), 0.0)
    on_word, *others = patch.scores(poses, area_map)
    assert on_word > 6.0
    assert max(others) < 0.0
    patch.add([], calibration, np.zeros(3), 30.0)
    assert (patch.scores(poses, area_map) == 0.0).all()  # it lies too far back
