"""Constants of statistics and units that many stages share."""

from __future__ import annotations

SIGMA_OF_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

SIGMAS_95 = 2.4477
"""Semi-axes of the 95 % ellipse of a two-dimensional normal error, in standard deviations: the root of the
chi-square quantile with two degrees of freedom."""

TWO_SIDED_95 = 1.96
"""Half the width of the band that holds 95 % of a normal error in one dimension, in standard deviations."""

FOOT_M = 0.3048  # an international foot, m
US_FOOT_M = 1200 / 3937  # a US survey foot, m (NIST Handbook 44, appendix C)
HEIGHT_NOISE = 2.0  # noise of heights by RTK over that of positions in the plane, about

HEAVE_SIGMA_M = 0.01
"""Standard deviation, m, of a vehicle body's height on its suspension, on paved ground."""

BEST = "Opt"
"""Name of the method whose map and calibration are the result, also in ``metrics.json``."""
