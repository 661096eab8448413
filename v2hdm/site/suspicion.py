"""How suspicious a marking is: unlike the others of its class in shape, in residuals, or in dispute."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import polygamma, psi
from scipy.stats import beta, f

from v2hdm.records import FloatArray, IntArray
from v2hdm.site.candidates import Counts
from v2hdm.site.posterior import CORNERS_OF_IMAGE

_LISTED = 10  # markings that are listed: as many as a user looks at
_LEAST_TO_COMPARE = 3  # markings from which their residuals have a spread

_LARGEST = 1e9
"""Variance of residuals, in squared sigmas, beyond which (and below whose inverse) all are alike."""

_PRIOR_FREEDOM = (1.0, 1e4)
"""Between these is the freedom of the prior of a variance: from tails as heavy as Cauchy's to none."""


@dataclass(frozen=True)
class Suspicion:
    """How unlikely the marking of id ``marking`` is, were it like the others of its class.

    P-values: ``p_shape`` of how far it is from the shape of its class under the posterior predictive (1 where
    the class has none), ``p_residuals`` of its accepted observations, ``p_sightings`` of the share
    ``disputed`` of its observations that the joint solution rejected.
    """

    marking: int
    p_shape: float
    p_residuals: float
    p_sightings: float
    disputed: float

    @property
    def p(self) -> float:
        """The least of three p-values, as many times as there are tests (Bonferroni)."""
        return min(1.0, 3 * min(self.p_shape, self.p_residuals, self.p_sightings))


def most_suspicious(
    accepted: IntArray, misfit: FloatArray, squared: FloatArray, counts: Counts
) -> Sequence[Suspicion]:
    """The most suspicious of the ``accepted`` (M,) of G candidates, the worst first.

    ``misfit`` (G,) are p-values of shapes, ``squared`` (G,) the sums of squared residuals, in sigmas.
    """
    seen, agreed = counts.observations[accepted], counts.agreeing[accepted]
    freedom = np.maximum(2.0 * agreed - 8, 1.0)  # two an observation, less those of four corners
    residuals = _too_large(squared[accepted] / freedom, freedom)
    # The tail of a binomial distribution, continued to parts of an image.
    rate = (seen - agreed).sum() / max(seen.sum(), 1)
    disputes, images = (seen - agreed) / CORNERS_OF_IMAGE, seen / CORNERS_OF_IMAGE
    sightings = np.where(disputes > 0, beta.cdf(rate, np.maximum(disputes, 1e-9), images - disputes + 1), 1.0)
    rows = zip(misfit[accepted], residuals, sightings, (seen - agreed) / np.maximum(seen, 1), strict=True)
    found = [Suspicion(number, *map(float, row)) for number, row in enumerate(rows, start=1)]
    return sorted(found, key=lambda one: one.p)[:_LISTED]


def _too_large(variance: FloatArray, freedom: FloatArray) -> FloatArray:
    """P-values (M,) of variances that have a scale and a spread in common, both unknown, and heavy tails.

    By moments of logarithms: beside its ``freedom`` (M,) a variance has an inverse-gamma prior, so that it
    follows Fisher's F distribution (Smyth, Linear models and empirical Bayes methods, 2004, section 6.2).
    """
    if len(variance) < _LEAST_TO_COMPARE:
        return np.ones(len(variance))
    variance = np.clip(np.nan_to_num(variance, nan=_LARGEST), 1 / _LARGEST, _LARGEST)
    off = np.log(variance) - psi(freedom / 2) + np.log(freedom / 2)
    beyond = off.var(ddof=1) - polygamma(1, freedom / 2).mean()
    low, high = _PRIOR_FREEDOM
    beyond = float(np.clip(beyond, polygamma(1, high / 2) * 1.001, polygamma(1, low / 2) * 0.999))
    prior = brentq(lambda count: polygamma(1, count / 2) - beyond, low, high)
    scale = np.exp(off.mean() + psi(prior / 2) - np.log(prior / 2))
    return np.asarray(f.sf(variance / scale, freedom, prior))
