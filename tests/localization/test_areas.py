"""A word of the map tells about where along its lane a vehicle is."""

from dataclasses import replace

import numpy as np
import pytest

from tests.localization.driven import MOUNT, WORD, cameras, drive, mapped, outlined, with_words, word_at, yard
from v2hdm.localization.areas import AreaMap, middle_of_hull, with_areas
from v2hdm.localization.belief import Plane, start
from v2hdm.localization.joint import Scene
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.motion import MotionNoise
from v2hdm.localization.paint import Paint
from v2hdm.localization.pose import Status
from v2hdm.localization.seeing import Look, expect_points, hulls_of_areas, sighted
from v2hdm.records import HDMap

SIGMA = np.array([0.4, 0.1, np.deg2rad(0.5)])


def before(symbols, x_m=0.0):
    """A belief at (x, 0), a camera ahead of it, and a map of symbols alone."""
    hd_map = HDMap((), symbols=tuple(symbols))
    calibration = cameras()["front"]
    belief = start(0.0, np.array([x_m, 0.0, 0.0]), SIGMA, [MOUNT, MOUNT], MotionNoise())
    scene = Scene(sighted(Look("front", 0.0), calibration), Paint(hd_map), Plane(), 0, calibration, 1.0)
    return belief, scene, AreaMap(hd_map, 0.0, 0)


def shown(x_m, kind="text", is_seen=True):
    """A word as the camera ahead of a vehicle at the origin shows it."""
    belief, scene, _ = before([])
    outline_map = np.column_stack([WORD + np.array([x_m, 0.0]), np.zeros(4)])
    return outlined(expect_points(belief, scene.plane, 0, scene.calibration, outline_map).px, kind, is_seen)


def hulls_of(*markings):
    return hulls_of_areas(Look("front", 0.0, markings), cameras()["front"])


def test_the_middle_of_a_hull_is_that_of_its_area_wherever_its_points_are():
    corners = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [0.0, 2.0]]) + 500.0
    crowded = np.concatenate([corners, corners[:1] + np.linspace(0, 0.5, 20)[:, None]])
    np.testing.assert_allclose(middle_of_hull(crowded), [502.0, 501.0], atol=1e-4)


def test_a_word_tells_about_where_the_vehicle_is():
    belief, scene, area_map = before([word_at(8.0)], x_m=0.5)
    update = with_areas(belief, scene, area_map, hulls_of(shown(8.0)))
    assert len(update.observations) == 1
    assert abs(update.belief.mean[0]) < 0.15
    along_m = float(np.sqrt(update.belief.covariance([0])[0, 0]))
    assert 0.1 < along_m < 0.25


def test_no_number_of_images_makes_a_word_a_place_of_centimetres():
    belief, scene, area_map = before([word_at(8.0)])
    for _ in range(200):
        belief = with_areas(belief, scene, area_map, hulls_of(shown(8.0))).belief
    assert float(np.sqrt(belief.covariance([0])[0, 0])) > 0.05


@pytest.mark.parametrize(
    "detection",
    [shown(8.0, kind="box"), shown(8.0, is_seen=False), shown(12.5), shown(8.0, kind="crosswalk")],
)
def test_another_class_a_cut_outline_a_place_too_far_and_a_crosswalk_say_nothing(detection):
    belief, scene, area_map = before([word_at(8.0)])
    assert not with_areas(belief, scene, area_map, hulls_of(detection)).observations


def test_a_word_that_may_be_either_of_two_decides_nothing():
    belief, scene, area_map = before([word_at(8.0), word_at(8.3)])
    assert not with_areas(belief, scene, area_map, hulls_of(shown(8.1))).observations


def test_the_derivative_of_an_observation_is_that_of_its_difference():
    belief, scene, area_map = before([word_at(8.0)])
    (hull,) = hulls_of(shown(8.0))
    (observation,) = with_areas(belief, scene, area_map, [hull]).observations
    step = 1e-4
    ends = []
    for by in (step, -step):
        moved = replace(belief, mean=belief.mean + by * belief.root[:, 0] / SIGMA[0])
        (end,) = with_areas(moved, scene, area_map, [hull]).observations
        ends.append(end.residual)
    numeric = (ends[1] - ends[0]) / (2 * step) * SIGMA[0]
    np.testing.assert_allclose(observation.slope[:, 0], numeric, rtol=0.02, atol=0.1)


def test_words_hold_a_vehicle_along_its_lane_where_no_marking_is():
    painted = yard(0)
    words = tuple(word_at(x_m) for x_m in (35.0, 50.0, 65.0))
    driven = drive(painted, 0, seconds=14.0)
    hd_map = replace(mapped(painted, 0), symbols=words)
    along_m = {}
    for has_words in (True, False):
        localizer = Localizer(hd_map, driven.calibrations, driven.rough(np.random.default_rng(0)))
        for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
            blind = [replace(look, markings=()) if frame > 30 else look for look in looks]
            if has_words:
                blind = [with_words(look, driven.poses[frame], words) for look in blind]
            pose = localizer.update(blind, motion)
        assert pose.status == Status.TRACKING
        assert abs(driven.errors(pose, len(driven.looks) - 1)[0]) < pose.protection_m[0]
        along_m[has_words] = pose.protection_m[0]
    assert along_m[True] < 0.7 * along_m[False]
