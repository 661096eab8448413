"""Which errors of inputs matter, can be observed, and are likelier than none.

A score test (:class:`v2hdm.adjust.ScoreTest`) estimates one input's error. Its odds follow from the gain in
cost and from a Cauchy prior on its size, scaled by the usual size of such an error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from v2hdm.faults.score_tests import Fault, ScoreTest

CLEAR_SIGMAS = 4.0  # of a visible error; in one of 400 correct drives one of its forty tests exceeds it
_PRIOR_ODDS = 1 / 400  # prior odds of a wrong input: one in forty, in one of ten drives of a new vehicle
RIVAL_LOG_ODDS = math.log(10.0)  # up to which a less likely cause may be the true one
_DOUBT = 0.05  # probability of a wrong input that a PASS, stated at 95 %, leaves


@dataclass(frozen=True)
class _Size:
    """Limits on the size of a fault, in its unit."""

    least: float  # smaller errors do not matter
    # largest model sigma at which a drive observes it. A less observable fault resembles others, and absorbs
    # remaining errors: k1 on a straight street, for instance.
    sigma: float
    usual: float  # median size where an input is wrong
    most: float  # largest physical value; beyond it, the cause is unforeseen


_SIZES: Mapping[Fault, _Size] = {
    Fault.CLOCK: _Size(0.005, 0.02, 0.05, 5.0),
    Fault.CLOCK_DRIFT: _Size(0.01, 0.02, 0.05, 5.0),
    Fault.FOCAL: _Size(0.003, 0.01, 0.02, 1.0),
    Fault.DISTORTION: _Size(0.002, 0.02, 0.05, 1.0),
    Fault.PRINCIPAL: _Size(5.0, 10.0, 20.0, 500.0),
    Fault.SLOPE: _Size(0.002, 0.003, 0.01, 0.3),
    Fault.CROWN: _Size(0.005, 0.005, 0.02, 0.15),
    Fault.COURSE: _Size(0.3, 0.3, 1.0, 10.0),
    Fault.STEP: _Size(0.03, 0.02, 0.1, 100.0),
    Fault.KNOCK: _Size(0.002, 0.002, 0.01, 1.0),
    Fault.SURVEY: _Size(0.03, 0.15, 0.1, 20.0),
    Fault.LEVER: _Size(0.03, 0.15, 0.5, 20.0),
    Fault.SCALE: _Size(0.003, 0.05, 0.15, 1.0),  # Web Mercator at 30 degrees of latitude: .15
    Fault.SIZE: _Size(0.01, 0.05, 0.05, 10.0),
    Fault.CONTROL: _Size(0.02, 0.05, 0.1, 1e3),
    Fault.DATUM: _Size(0.02, 0.05, 0.1, 1e3),
}

OBSERVABLE_SIGMA = {fault: size.sigma for fault, size in _SIZES.items()}
"""Largest standard deviation, in the fault's unit, at which a drive observes it."""


def is_contradicted(one: ScoreTest) -> bool:
    """Whether an input's error matters, is observable, and is more likely than not."""
    return matters(one) and one.sigmas > even_sigmas(one)


def is_doubtful(one: ScoreTest) -> bool:
    """Whether an input's error matters, is observable, and has more than 5 % probability."""
    return matters(one) and one.sigmas > even_sigmas(one, _DOUBT / (1 - _DOUBT))


def even_sigmas(one: ScoreTest, odds: float = 1.0) -> float:
    """Sigmas from which an input's error has at least these posterior ``odds``."""
    return math.sqrt(2 * max(math.log(odds / _PRIOR_ODDS) - _log_spread(one), 0.0))


def doubt(one: ScoreTest) -> float:
    """Posterior log-odds of an input's error against none, from its sigmas and size."""
    return one.sigmas**2 / 2 + _log_spread(one) + math.log(_PRIOR_ODDS)


def _log_spread(one: ScoreTest) -> float:
    """Log of the prior probability of an error within one sigma of its value."""
    usual = _SIZES[one.fault].usual
    size = math.sqrt(2 * math.pi) * one.sigma / (math.pi * usual * (1 + (one.value / usual) ** 2))
    return math.log(max(size, 1e-300))


def matters(one: ScoreTest) -> bool:
    """Whether an observable input's error is larger than a drive tolerates."""
    size = _SIZES[one.fault]
    return one.model_sigma <= size.sigma and abs(one.value) > size.least


def is_physical(one: ScoreTest) -> bool:
    """Whether an error can be of this size; otherwise its cause is unforeseen."""
    return abs(one.value) <= _SIZES[one.fault].most


def log_odds(one: ScoreTest) -> float:
    """Log-odds, up to a constant, of an input's error as the cause, from its gain and size."""
    return one.gain - math.log1p((one.value / _SIZES[one.fault].usual) ** 2)
