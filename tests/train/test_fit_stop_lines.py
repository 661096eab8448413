"""How sure a reading is a stop line is fitted."""

import numpy as np
import pytest

from train.fit_judge import fit
from train.fit_stop_lines import Readings, fitted
from v2hdm.detection.classifier import AMONG


def readings(slope, bias, count, seed=1):
    """Readings whose probability is a logistic function of the judge's log odds."""
    rng = np.random.default_rng(seed)
    odds = rng.normal(-1.0, 3.0, count)
    return Readings(odds, rng.random(count) < 1 / (1 + np.exp(-slope * odds - bias)))


def test_many_readings_decide_for_themselves():
    function = fitted(readings(0.5, -1.0, 20_000))
    assert function["weights"]["alone"] == pytest.approx(0.5, abs=0.05)
    assert function["bias"] == pytest.approx(-1.0, abs=0.1)


def test_few_readings_leave_the_judge_its_word():
    few = readings(1.0, 0.0, 12)
    assert abs(fitted(few)["weights"]["alone"] - 1.0) < abs(fit(few.odds[:, None], few.true)[0][0] - 1.0)


def test_the_company_of_a_stop_line_says_nothing():
    weights = fitted(readings(1.0, 0.0, 500))["weights"]
    assert list(weights) == list(AMONG)
    assert [weights[name] for name in AMONG if name != "alone"] == [0.0] * (len(AMONG) - 1)
