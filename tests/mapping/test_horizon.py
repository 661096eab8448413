"""Rays that meet the ground too far away to be used."""

import numpy as np
import pytest

from v2hdm.adjust import MIN_DEPRESSION_SINE
from v2hdm.association.ground import Located


def test_the_depression_of_a_ray_follows_from_height_and_range():
    ray_map = np.array([[[3.0, 0.0], [0.0, 4.0], [400.0, 0.0], [np.nan, np.nan]]])
    located = Located(
        corners_map=ray_map,
        covariance_m2=np.zeros((1, 4, 2, 2)),
        ray_map=ray_map,
        height_m=np.array([3.0]),
        valid=np.ones((1, 4), dtype=bool),
        informs=np.ones((1, 4), dtype=bool),
    )
    sine = located.depression_sine[0]
    assert sine[:2] == pytest.approx([3 / np.hypot(3, 3), 3 / 5])
    assert (sine > MIN_DEPRESSION_SINE).tolist() == [True, True, False, False]
