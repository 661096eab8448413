"""A judge's log odds are fitted to be worth what readings show."""

import numpy as np
import pytest

from train.fit_judge import fit
from train.odds import worth_of


def readings(weight, bias, count, spread=3.0, seed=1):
    """Log odds, and whether each reading is true by a logistic function of them."""
    rng = np.random.default_rng(seed)
    odds = rng.normal(-1.0, spread, count)
    return odds, rng.random(count) < 1 / (1 + np.exp(-weight * odds - bias))


def test_the_weight_and_bias_that_made_many_readings_are_fitted_to_them():
    worth = worth_of(*readings(0.6, -1.0, 20_000))
    assert worth.weight == pytest.approx(0.6, abs=0.04)
    assert worth.bias == pytest.approx(-1.0, abs=0.1)
    assert worth.unknown < 0.01


def test_a_few_true_readings_that_the_judge_is_sure_are_none_leave_the_others_their_odds():
    odds, true = readings(1.0, -0.5, 6000, spread=6.0)
    true[::50] = True
    assert fit(odds[:, None], true)[0][0] < 0.8
    worth = worth_of(odds, true)
    assert worth.weight == pytest.approx(1.0, abs=0.1)
    assert worth.bias == pytest.approx(-0.5, abs=0.15)
    assert worth.unknown == pytest.approx(0.02, abs=0.01)


def test_few_readings_leave_the_judge_its_word():
    odds, true = readings(1.0, 0.0, 10, seed=4)
    assert worth_of(odds, true).weight == pytest.approx(1.0, abs=0.5)
    assert abs(worth_of(odds, true).weight - 1) < abs(fit(odds[:, None], true)[0][0] - 1)
