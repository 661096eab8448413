"""Where things lie that may be markings, and how often they were seen: the data of the site model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import polygamma, psi

from v2hdm.association.groups import FusedGroups, line_only
from v2hdm.geometry.planar import block_diagonal
from v2hdm.records import BoolArray, FloatArray, IntArray

_UNSEEN_M2 = 1e4  # variance of a corner that was not seen, m^2: infinite beside the size of a site

# Correlation of the errors of one corner in several images: .3 states sides too large, .1 corners too small.
CORRELATION = 0.2

_KNOWN_SIGMA_M = 0.5  # sigma, m, below which a corner counts as known: a fraction of any marking's length

TOO_UNCERTAIN, LACKS_A_CORNER = "its position is too uncertain", "a corner was never seen twice"

_OTHER_EDGE_M = 0.3
"""Sigma, m, of where a sighting sees an edge of the same marking that others do not: a worn end's, as in the
posterior; what lies farther off is of something else."""


@dataclass(frozen=True)
class Candidates:
    """Corners (G, 4, 2), m, and joint covariances (G, 8, 8), m^2; of unseen ones :data:`_UNSEEN_M2`."""

    corners_map: FloatArray
    covariance_m2: FloatArray

    @classmethod
    def seen(
        cls, corners_map: FloatArray, covariance_m2: FloatArray, about: FloatArray | float = 0.0
    ) -> Candidates:
        """Candidates of corners and covariances that are nan if unseen; ``about`` (G, 2) without any."""
        unseen = np.isnan(corners_map[..., 0]) | np.isnan(corners_map[..., 1])
        count = np.maximum((~unseen).sum(axis=1), 1)
        centre = np.where(unseen[..., None], 0.0, corners_map).sum(axis=1) / count[:, None]
        centre = np.where(np.all(unseen, axis=1)[:, None], about, centre)
        rows = np.repeat(unseen, 2, axis=1)
        covariance = np.where(rows[:, :, None] | rows[:, None, :], _UNSEEN_M2 * np.eye(8), covariance_m2)
        return cls(np.where(unseen[..., None], centre[:, None], corners_map), covariance)

    def __len__(self) -> int:
        return len(self.corners_map)

    def subset(self, rows: IntArray | BoolArray) -> Candidates:
        """The candidates at ``rows``."""
        return Candidates(self.corners_map[rows], self.covariance_m2[rows])

    @property
    def sigma_m(self) -> FloatArray:
        """Standard deviation (G, 4) of each corner, both directions together."""
        variance = np.diagonal(self.covariance_m2, axis1=1, axis2=2).reshape(-1, 4, 2)
        return np.asarray(np.sqrt(variance.sum(axis=2)))

    def along(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Covariances (G,) of what moves along two directions (G, 8) each."""
        return np.asarray(np.einsum("ni,nij,nj->n", first, self.covariance_m2, second))

    @property
    def known(self) -> BoolArray:
        """Which corners (G, 4) were seen as points."""
        return np.asarray(self.sigma_m < _KNOWN_SIGMA_M)


@dataclass(frozen=True)
class Counts:
    """How often G candidates were seen, each (G,)."""

    images: IntArray  # with accepted observations
    observations: IntArray  # of corners
    agreeing: IntArray  # of these, with the solution
    log_odds: FloatArray  # mean of the detector's, of these
    easy_views: IntArray  # images with the whole candidate in easy view
    found: IntArray  # of these, where it was found
    pointed: IntArray  # (G, 4) of these, where each corner is a point that agrees
    as_symbol: IntArray  # images in which a symbol lies on it, or a solid line goes on behind it

    def subset(self, rows: IntArray | BoolArray) -> Counts:
        """The candidates at ``rows``."""
        return Counts(*(values[rows] for values in vars(self).values()))


def with_dissent(
    candidates: Candidates,
    fused: FusedGroups,
    row: IntArray,
    group: IntArray,
    corner: IntArray,
    seen_map: FloatArray,
    covariance_m2: FloatArray,
) -> Candidates:
    """The candidates (G,), less certain where sightings contradict what ``fused`` ones agree on.

    The joint solution rejected R corners: the ``corner`` (R,) of candidate ``group`` (R,), which sighting
    ``row`` (R,) saw at ``seen_map`` (R, 2), m, of the covariance ``covariance_m2`` (R, 2, 2). Either is right
    in proportion to its information, since images of one view err alike; a mixture of two places has the
    variance p (1 - p) of their distance squared. Corners of one sighting go together.
    """
    off = seen_map - candidates.corners_map[group, corner]
    away_m = np.linalg.norm(off, axis=1)
    # x' C^-1 x is the information along the line between both places, times its length squared.
    agreed = fused.covariance_m2[group, corner]
    usable = fused.valid[group, corner] & (away_m < 3 * _OTHER_EDGE_M)
    usable &= np.isfinite(covariance_m2).all(axis=(1, 2)) & np.isfinite(off).all(axis=1)
    off, away_m, agreed = off[usable], away_m[usable], agreed[usable]
    one, all_others = (
        np.einsum("ri,rij,rj->r", off, np.linalg.inv(each), off) for each in (covariance_m2[usable], agreed)
    )
    share = one / (one + all_others) * np.exp(-0.5 * (away_m / _OTHER_EDGE_M) ** 2)
    sightings, number = np.unique(np.stack([group, row])[:, usable], axis=1, return_inverse=True)
    moved = np.zeros((sightings.shape[1], 4, 2))
    moved[number.ravel(), corner[usable]] = np.sqrt(share)[:, None] * off
    covariance, ways = candidates.covariance_m2.copy(), moved.reshape(-1, 8)
    np.add.at(covariance, sightings[0], ways[:, :, None] * ways[:, None, :])
    return Candidates(candidates.corners_map, covariance)


def with_shared_errors(candidates: Candidates, fused: FusedGroups, scatter: FloatArray) -> Candidates:
    """The solved candidates (G,), with the errors that all images of a corner share, as of a worn end.

    Of errors that are correlated by r, n images have a mean of the variance (1 + (n - 1) r) / n (Kish, Survey
    Sampling, 1965): about r times a single image's, as in ``fused``. ``scatter`` (G, 4) makes a corner less
    known.
    """
    seen = np.maximum(fused.seen, 1)
    share = scatter - 1 + CORRELATION * seen * scatter
    unseen = np.asarray(np.isnan(fused.corners_map).any(axis=2))
    shared = np.where(unseen[..., None, None], 0.0, share[..., None, None] * fused.covariance_m2)
    # Images that are cut alike are wrong alike, so that no number of them says where a corner lies.
    no_point = (fused.seen == 0) & ~unseen
    shared[no_point] = line_only(shared[no_point], _UNSEEN_M2**0.5)
    return Candidates(candidates.corners_map, candidates.covariance_m2 + block_diagonal(shared))


_LARGEST = 1e9  # variance of residuals, squared sigmas, beyond which (and below whose inverse) all are alike

_PRIOR_FREEDOM = (1.0, 1e4)
"""Between these is the freedom of the prior of a variance: from tails as heavy as Cauchy's to none."""

_LEAST_TO_COMPARE = 3  # variances from which they have a spread


def variance_prior(variance: FloatArray, freedom: FloatArray) -> tuple[float, float]:
    """Scale and freedom of the inverse-gamma prior of variances (M,), each estimated with ``freedom`` (M,).

    By moments of their logarithms (Smyth, 2004, section 6.2); of fewer than three nothing is known.
    """
    if len(variance) < _LEAST_TO_COMPARE:
        return _LARGEST, _PRIOR_FREEDOM[1]
    off = np.log(np.clip(variance, 1 / _LARGEST, _LARGEST)) - psi(freedom / 2) + np.log(freedom / 2)
    beyond = off.var(ddof=1) - polygamma(1, freedom / 2).mean()
    low, high = _PRIOR_FREEDOM
    beyond = float(np.clip(beyond, polygamma(1, high / 2) * 1.001, polygamma(1, low / 2) * 0.999))
    prior = float(brentq(lambda count: polygamma(1, count / 2) - beyond, low, high))
    return float(np.exp(off.mean() + psi(prior / 2) - np.log(prior / 2))), prior


def scatter_of(squared: FloatArray, freedom: FloatArray) -> FloatArray:
    """How many times the usual the variance (G, 4) of corners' images is, at least once, by all corners'."""
    known = freedom > 0
    squared = np.minimum(squared, _LARGEST * np.maximum(freedom, 1.0))  # infinite in the camera's plane
    scale, prior = variance_prior(squared[known] / freedom[known], freedom[known])
    after = (prior * scale + squared) / (prior + np.maximum(freedom, 0.0))
    return np.asarray(np.where(known, np.maximum(after / scale, 1.0), 1.0))
