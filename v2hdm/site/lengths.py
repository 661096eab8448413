"""The length that a dash may have lost, where no other dash tells how long those of its road are.

A dash that is worn or covered from one end on shows any share of itself, all as likely. How long it was
painted, standards say: a density p(L) of lengths, to which each other dash of the drive adds its own, as in a
Dirichlet process. A length l is then as likely as p(l) of a whole dash, and as the integral of p(L) / L over
all L > l of one that has lost an end.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from v2hdm.densities import normal_density
from v2hdm.records import LANE_DASH, FloatArray

STANDARD_M: Mapping[str, tuple[float, ...]] = {LANE_DASH: (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)}
"""Lengths, m, of which most dashes of a class are painted: MUTCD 2009 section 3A.06 (10 ft), Germany's RMS-1
(1, 1.5, 3, 4 and 6 m), United Kingdom's TSRGD 2016 (1, 2, 4 and 6 m), France's IISR part 7 (1.5 and 3 m)."""

_STANDARD_SHARE = 0.7  # fraction of dashes that are painted to a standard: yards and older roads are not
_LAID_OUT = 0.05  # standard deviation of the logarithm of a painted length about its standard
_OTHER_M = 3.0  # median of other lengths, m
_OTHER_SPREAD = 0.7  # standard deviation of the logarithm of other lengths: 0.7 to 12 m

_STANDARDS_COUNT = 3.0
"""How many dashes of a drive the standards weigh as much as: the concentration of the Dirichlet process."""

_LONGEST_M = 20.0  # longest dash, m, that is reckoned with
_STEP_M = 0.01  # of the integrals over lengths, m


class Lost(NamedTuple):
    """The lengths that N dashes have lost at one end, if they have lost anything."""

    log_odds: FloatArray  # (N,) log-likelihood ratio of their lengths, against whole dashes
    mean_m: FloatArray  # (N,) length that was lost
    variance_m2: FloatArray  # (N,) of that


def lost_of(standard_m: tuple[float, ...], length_m: FloatArray, sigma_m: FloatArray) -> Lost:
    """Losses of dashes of lengths (N,), known to ``sigma_m`` (N,), by standards and the other dashes.

    ``sigma_m`` is infinite for a dash of unknown length, which tells the others nothing.
    """
    grid_m = np.arange(_STEP_M, _LONGEST_M, _STEP_M)
    by_standards = _density(standard_m, grid_m)
    is_known = np.isfinite(sigma_m)
    width_m = np.hypot(_LAID_OUT * length_m, np.where(is_known, sigma_m, 1.0))
    by_dash = normal_density(grid_m, length_m[:, None], width_m[:, None]) * is_known[:, None]
    others = is_known.sum() - is_known
    by_others = by_dash.sum(axis=0) - by_dash
    density = (_STANDARDS_COUNT * by_standards + by_others) / (_STANDARDS_COUNT + others)[:, None]
    whole = np.array([np.interp(m, grid_m, painted) for m, painted in zip(length_m, density, strict=True)])
    longer = np.where(grid_m > length_m[:, None], density / grid_m, 0.0)
    cut = longer.sum(axis=1) * _STEP_M
    weight = longer / np.maximum(longer.sum(axis=1, keepdims=True), 1e-300)
    gone_m = grid_m - length_m[:, None]
    mean_m = np.sum(weight * gone_m, axis=1)
    variance_m2 = np.sum(weight * gone_m**2, axis=1) - mean_m**2
    log_odds = np.log(np.maximum(cut, 1e-300)) - np.log(np.maximum(whole, 1e-300))
    return Lost(log_odds, mean_m, np.maximum(variance_m2, 0.0))


def _density(standard_m: tuple[float, ...], grid_m: FloatArray) -> FloatArray:
    """Density (K,) of painted lengths at ``grid_m`` (K,), by standards and other habits."""
    log_m = np.log(grid_m)
    standards = [normal_density(log_m, np.log(length_m), _LAID_OUT) for length_m in standard_m]
    of_standards = np.mean(standards, axis=0)
    of_others = normal_density(log_m, np.log(_OTHER_M), _OTHER_SPREAD)
    return np.asarray((_STANDARD_SHARE * of_standards + (1 - _STANDARD_SHARE) * of_others) / grid_m)
