"""How far painted edges are from where all images agree that they are.

An edge that is worn or dirty is measured in the same wrong place by every image. The error does not average
out, and the residuals of the adjustment do not show it. The shape that the markings of a class share does:
each marking deviates from it by its own error. Most deviate by a millimetre, some by centimetres. A normal
variance per marking with an inverse-gamma prior describes both, so that deviations follow Student's t
distribution (Lange, Little and Taylor, Robust statistical modeling using the t distribution, JASA 1989). The
class teaches the prior; the posterior of a marking is added to the covariance of its corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import gammaln

from v2hdm.records import FloatArray

_FREEDOM_BOUNDS = (1.0, 30.0)
"""Degrees of freedom of the t distribution: from tails as heavy as Cauchy's to those of a normal one."""

_SIGMA_BOUNDS_M = (1e-4, 0.05)
"""Scale of a paint error, m: from the rounding of a survey to the width of a line."""

_EDGE_SIGMA_M = 0.004
"""How far all images may misplace a painted edge alike, m: a ragged edge of a sprayed line is about so wide.

A class whose typical marking scatters by more was painted so: that scatter is no error of the map."""

_START = (0.002, 3.0)
"""Scale, m, and degrees of freedom from which the search starts."""


@dataclass(frozen=True)
class PaintError:
    """Student's t distribution of a corner's coordinate: its scale ``sigma_m`` and degrees of ``freedom``."""

    sigma_m: float
    freedom: float

    def variance_m2(self, deviation: FloatArray, formal: FloatArray) -> float:
        """The variance, m^2, of a marking's errors of measurement, given how it deviates from its class.

        Args:
            deviation: (m,) m, in orthonormal directions.
            formal: (m, m) its covariance without paint errors.
        """
        count = len(deviation)
        beyond = max(float(deviation @ deviation) - float(np.trace(formal)), 0.0)
        posterior_m2 = (self.freedom * self.sigma_m**2 + beyond) / (self.freedom + count)
        painted_m2 = max(self.sigma_m**2 - _EDGE_SIGMA_M**2, 0.0)
        return max(posterior_m2 - painted_m2, 0.0)


def learn_paint_error(deviations: Sequence[FloatArray], formal: Sequence[FloatArray]) -> PaintError:
    """The distribution under which deviations (m,) of markings are likeliest; of formal covariances (m, m).

    Without any deviation it is the one from which the search starts.
    """
    if not deviations:
        return PaintError(*_START)
    count = np.array([len(one) for one in deviations])
    squared = np.array([float(one @ one) for one in deviations])
    own = np.array([float(np.trace(one)) for one in formal]) / count

    def cost(parameters: FloatArray) -> float:
        sigma_m, freedom = np.exp(parameters)
        variance = sigma_m**2 + own
        likelihood = gammaln((freedom + count) / 2) - gammaln(freedom / 2)
        likelihood -= count / 2 * np.log(freedom * np.pi * variance)
        likelihood -= (freedom + count) / 2 * np.log1p(squared / (freedom * variance))
        return -float(likelihood.sum())

    bounds = [np.log(_SIGMA_BOUNDS_M).tolist(), np.log(_FREEDOM_BOUNDS).tolist()]
    found = minimize(cost, np.log(_START), method="L-BFGS-B", bounds=bounds)
    sigma_m, freedom = np.exp(found.x)
    return PaintError(float(sigma_m), float(freedom))
