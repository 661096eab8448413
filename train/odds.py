"""The worth of a judge's log odds where it knows nothing of some of what is true."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit

from v2hdm.records import BoolArray, FloatArray

_WEIGHT_SIGMA = 0.5
"""Standard deviation of the weight's prior about 1: log odds are meant to be right. Chosen; it decides where
there are few readings alone."""

_SHARE_SIGMA = 2.0  # standard deviation of the log odds of the unknown share, about even odds. Chosen


class Worth(NamedTuple):
    """Log odds are ``weight`` times the judge's plus ``bias``, but of an ``unknown`` share of readings."""

    weight: float
    bias: float
    unknown: float


def worth_of(odds: FloatArray, true: BoolArray) -> Worth:
    """The likeliest worth of log odds (N,) of readings of which it is known whether they are ``true`` (N,).

    A reading is true with the probability ``unknown`` whatever the judge says, else with that of its weighed
    log odds. Without such a share a few true readings that the judge is sure are none, such as the teeth of a
    give-way line, would make it doubt all the others.
    """

    def loss(parameters: FloatArray) -> float:
        weight, bias, log_share = parameters
        unknown = expit(log_share)
        probability = unknown + (1 - unknown) * expit(weight * odds + bias)
        surprise = -np.log(np.clip(np.where(true, probability, 1 - probability), 1e-12, 1.0)).sum()
        prior = ((weight - 1) / _WEIGHT_SIGMA) ** 2 + (log_share / _SHARE_SIGMA) ** 2
        return float(surprise + prior / 2)

    weight, bias, log_share = minimize(loss, (1.0, 0.0, logit(0.05)), method="Nelder-Mead").x
    return Worth(float(weight), float(bias), float(expit(log_share)))
