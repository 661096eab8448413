"""Shapes that are named arrows and are none: sizes and directions on the ground."""

from __future__ import annotations

import numpy as np
import pytest

from v2hdm.detection.arrows import FEATURES, arrow_features, arrow_probability
from v2hdm.detection.camera import RoadCamera, camera_from_calibration, rough_calibration
from v2hdm.records import FloatArray

CAMERA = RoadCamera(camera_from_calibration(rough_calibration("front", 1280, 720, 1.6, 12.0, 80.0)))


def rectangle(at: tuple[float, float], length_m: float, width_m: float, yaw_rad: float = 0.0) -> FloatArray:
    """A rectangle (4, 2) whose longer side points there, 0 ahead."""
    ahead = np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
    left = np.array([-ahead[1], ahead[0]])
    half = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
    return np.array(at) + half * [length_m, width_m] @ np.array([ahead, left])


def probability(share: float, outline: FloatArray) -> float:
    return arrow_probability(share, arrow_features(outline, CAMERA))


def test_of_an_arrow_of_usual_size_the_network_is_believed_whatever_its_way():
    sizes = [rectangle((9.0, 0.3), length, width) for length, width in ((5.0, 0.8), (7.5, 1.2), (2.4, 0.6))]
    for outline in [*sizes, rectangle((9.0, 1.0), 5.0, 0.8, 0.8)]:
        assert probability(0.9, outline) == pytest.approx(0.9, abs=0.01)


@pytest.mark.parametrize(("length_m", "width_m"), [(1.3, 0.2), (0.9, 0.3), (0.5, 0.4)])
def test_what_is_as_short_as_a_spoke_or_a_handle_is_none_even_if_it_is_named_one(length_m, width_m):
    assert probability(0.75, rectangle((9.0, 3.0), length_m, width_m)) < 0.5


def test_the_narrow_part_of_an_arrow_that_a_shadow_leaves_is_one():
    assert probability(0.6, rectangle((9.0, 0.5), 3.0, 0.2)) > 0.5


def test_what_points_to_the_cameras_foot_beside_the_way_stands():
    place = CAMERA.foot_vehicle + np.array([8.0, 4.0])
    towards = float(np.arctan2(4.0, 8.0))
    along, standing = (
        dict(zip(FEATURES, arrow_features(rectangle(tuple(place), 3.0, 0.5, yaw), CAMERA), strict=True))
        for yaw in (0.0, towards)
    )
    assert standing["standing"] == pytest.approx(1.0)
    assert along["standing"] < 0.01
    assert probability(0.8, rectangle(tuple(place), 3.0, 0.5, towards)) < 0.5


def test_of_what_the_border_cuts_the_length_says_nothing():
    tip = rectangle((5.0, 0.3), 0.9, 0.2)
    whole, cut = (arrow_features(tip, CAMERA, is_whole=is_whole) for is_whole in (True, False))
    assert arrow_probability(0.8, whole) < 0.5
    assert arrow_probability(0.8, cut) == pytest.approx(0.8, abs=0.02)


def test_far_off_where_a_pixel_is_as_long_as_it_the_length_says_little():
    far = rectangle((20.0, 0.5), 1.4, 0.3)
    exact, coarse = (arrow_probability(0.7, arrow_features(far, CAMERA, spare_m)) for spare_m in (0.0, 0.5))
    assert exact < 0.5 < coarse


def test_straight_ahead_nothing_is_told_by_the_way_it_points():
    foot = CAMERA.foot_vehicle
    assert CAMERA.standing(foot[None] + [8.0, 0.0], np.array([[1.0, 0.0]]))[0] < 1e-6


def test_the_surer_the_network_the_likelier():
    outline = rectangle((9.0, 1.0), 1.5, 0.4)
    shares = [probability(share, outline) for share in (0.0, 0.4, 0.6, 0.8, 0.95, 1.0)]
    assert shares == sorted(shares)
    assert np.isfinite(shares).all()
