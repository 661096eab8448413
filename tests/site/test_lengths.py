"""Standards and other dashes say how much of a dash may be lost."""

import numpy as np
import pytest

from v2hdm.records import LANE_DASH
from v2hdm.site.lengths import STANDARD_M, lost_of

DASH_M = STANDARD_M[LANE_DASH]


def lost(*lengths_m, sigma_m=0.01):
    return lost_of(DASH_M, np.array(lengths_m), np.full(len(lengths_m), sigma_m))


def test_a_dash_of_a_standard_length_is_likelier_whole_than_what_no_standard_knows():
    odds = [lost(length_m).log_odds[0] for length_m in (3.0, 3.5, 0.75)]
    assert odds[0] < odds[1] < odds[2]
    assert odds[0] < -1 < 2 < odds[2]


def test_what_is_lost_makes_up_the_next_longer_lengths():
    """Nearly all standard lengths that a dash of 5.5 m may be a piece of are 6 m."""
    of_long = lost(5.5)
    assert of_long.mean_m[0] == pytest.approx(0.9, abs=0.5)
    assert lost(0.75).mean_m[0] > 1.0
    assert lost(0.75).variance_m2[0] > 0.5


def test_two_dashes_of_one_length_are_whole_whatever_it_is():
    alone, together = lost(1.3).log_odds[0], lost(1.3, 1.3).log_odds[0]
    assert together < alone - 2


def test_a_short_dash_beside_a_long_one_is_likelier_cut():
    alone, beside_long = lost(0.75).log_odds[0], lost(0.75, 3.0).log_odds[0]
    assert beside_long > alone


def test_a_dash_of_unknown_length_tells_the_others_nothing():
    unknown = lost_of(DASH_M, np.array([0.75, 3.0]), np.array([0.01, np.inf]))
    assert unknown.log_odds[0] == pytest.approx(lost(0.75).log_odds[0])
