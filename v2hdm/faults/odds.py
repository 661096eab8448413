"""Which errors of inputs matter, can be observed, and are likelier than none.

A score test (:class:`v2hdm.faults.ScoreTest`) estimates one input's error. Its odds follow from the gain in
cost and from a Cauchy prior on its size, scaled by the usual size of such an error.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from scipy.special import expit, ndtr

from v2hdm.faults.score import ScoreTest
from v2hdm.faults.table import PRIOR_ODDS

CLEAR_SIGMAS = 4.0  # of a visible error; in one of 400 correct drives one of its forty tests exceeds it
RIVAL_LOG_ODDS = math.log(10.0)  # up to which a less likely cause may be the true one
_CERTAIN = 500.0  # log-odds beyond which none differ
_DOUBT = 0.05  # probability of a wrong input that a PASS, stated at 95 %, leaves


def is_contradicted(test: ScoreTest) -> bool:
    """Whether an input is observable, and more likely than not wrong by more than a drive tolerates."""
    return is_observable(test) and probability(test) > 0.5 and not test.fault.is_allowed_for


def is_doubtful(test: ScoreTest) -> bool:
    """Whether an input is observable, and with more than 5 % wrong by more than a drive tolerates."""
    return is_observable(test) and probability(test) > _DOUBT


def is_possible(test: ScoreTest) -> bool:
    """Whether an input's error of any size has more than 5 % probability."""
    return test.sigmas > possible_sigmas(test)


def probability(test: ScoreTest) -> float:
    """Posterior probability of an input's error that is larger than a drive tolerates."""
    return float(expit(doubt(test)) * _share_that_matters(test))


def probability_of_any(tests: Iterable[ScoreTest]) -> float:
    """Posterior probability that some input errs by more than a drive tolerates, if at most one of them does.

    Observable inputs alone speak: others resemble each other, and absorb remaining errors.
    """
    observable = [test for test in tests if is_observable(test)]
    odds = sum(math.exp(min(doubt(test), _CERTAIN)) * _share_that_matters(test) for test in observable)
    return odds / (1 + odds)


def leaves_doubt(tests: Iterable[ScoreTest]) -> bool:
    """Whether some input is with more than 5 % wrong by more than a drive tolerates."""
    return probability_of_any(tests) > _DOUBT


def _share_that_matters(test: ScoreTest) -> float:
    """Probability that an error is larger than a drive tolerates, given that there is one."""
    if not math.isfinite(test.sigma):
        return 0.0
    return float(sum(ndtr((side * test.value - test.fault.least) / test.sigma) for side in (1.0, -1.0)))


def even_sigmas(test: ScoreTest, odds: float = 1.0) -> float:
    """Sigmas from which an input's error has at least these posterior ``odds``."""
    return math.sqrt(2 * max(math.log(odds / test.fault.prior_odds) - _log_spread(test), 0.0))


def possible_sigmas(test: ScoreTest) -> float:
    """Sigmas from which an input's error of any size has more than 5 % probability."""
    return even_sigmas(test, _DOUBT / (1 - _DOUBT))


def doubt(test: ScoreTest) -> float:
    """Posterior log-odds of an input's error against none, from its sigmas and size."""
    return test.sigmas**2 / 2 + _log_spread(test) + math.log(test.fault.prior_odds)


def _log_spread(test: ScoreTest) -> float:
    """Log of the prior probability of an error within one sigma of its value."""
    usual = test.fault.usual
    size = math.sqrt(2 * math.pi) * test.sigma / (math.pi * usual * (1 + (test.value / usual) ** 2))
    return math.log(max(size, 1e-300))


def is_observable(test: ScoreTest) -> bool:
    """Whether a drive shows errors of an input of the sizes that they have."""
    return test.model_sigma <= test.fault.observable_sigma


def matters(test: ScoreTest) -> bool:
    """Whether an observable input's estimated error is larger than a drive tolerates."""
    return is_observable(test) and abs(test.value) > test.fault.least


def is_physical(test: ScoreTest) -> bool:
    """Whether an error can be of this size; otherwise its cause is unforeseen."""
    return abs(test.value) <= test.fault.most


def log_odds(test: ScoreTest) -> float:
    """Log-odds, up to a constant, of an input's error as the cause, from its gain and size."""
    return (
        test.gain
        - math.log1p((test.value / test.fault.usual) ** 2)
        + math.log(test.fault.prior_odds / PRIOR_ODDS)
    )
