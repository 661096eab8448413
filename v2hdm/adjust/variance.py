"""How many times as large as stated variances are, by what an adjustment leaves of its residuals."""

from __future__ import annotations

import math
from dataclasses import dataclass

from v2hdm.adjust.gating import noise_scale
from v2hdm.records import FloatArray

# Squared residual that one good observation in a thousand exceeds: chi-square, 2 degrees of freedom.
_OUTLIER_SQUARED = 13.8
# Mean of half such a variable below that limit: leaving the tail out takes a little off the chi-square.
_TRIMMED_MEAN = 1 - _OUTLIER_SQUARED / 2 / math.expm1(_OUTLIER_SQUARED / 2)


@dataclass(frozen=True)
class VarianceFactors:
    """Variances as multiples of the stated ones: of everything, and of the observations alone."""

    all: float
    observations: float


def variance_factors(
    squared: FloatArray, of_priors: float, free: int, scale: float | None = None
) -> VarianceFactors:
    """Chi-square per degree of freedom, of good observations and priors together and of the former.

    What the priors have left of their own degrees of freedom is what the observations have taken of them:
    the expected chi-square of a prior is the one less the other (Foerstner and Wrobel, Photogrammetric
    Computer Vision, section 4.2.4, on variance components).

    Args:
        squared: (K,) squared residuals of the observations, in standard deviations.
        of_priors: chi-square of the priors.
        free: unknowns less those that priors other than the poses' hold.
        scale: :func:`~v2hdm.adjust.gating.noise_scale` of ``squared``, where it is known already.
    """
    good = squared <= _OUTLIER_SQUARED * (noise_scale(squared) if scale is None else scale)
    of_observations = float(squared.sum(where=good)) / _TRIMMED_MEAN
    redundancy = 2 * int(good.sum()) - free
    return VarianceFactors(
        all=(of_observations + of_priors) / max(redundancy, 1),
        observations=of_observations / max(redundancy - of_priors, 1),
    )
