"""Positions of possible markings and counts of their sightings: the data of the site model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import polygamma, psi

from v2hdm.association.groups import FusedGroups, line_only
from v2hdm.geometry.planar import block_diagonal
from v2hdm.records import BoolArray, FloatArray, IntArray

UNSEEN_M2 = 1e4  # variance of an unseen corner, m^2: effectively infinite at the size of a site
CORRELATION = 0.2
"""Correlation of a corner's errors between images: 0.3 overstates sides' sigmas, 0.1 understates corners'."""

_KNOWN_SIGMA_M = 0.5  # largest sigma, m, of a known corner: a fraction of any marking's length

TOO_UNCERTAIN = "its shape is too uncertain"
LACKS_A_CORNER = "a corner was never seen twice"
SEEN_SELDOM = "seen in too few images"
FOUND_SELDOM = "found in too few of its images"

_OTHER_EDGE_M = 0.3
"""Sigma, m, of a sighting's edge, such as a worn end's, about where others see it; what lies farther off is
something else."""


@dataclass(frozen=True)
class Candidates:
    """Corners (G, 4, 2), m, and joint covariances (G, 8, 8), m^2; :data:`UNSEEN_M2` for unseen corners."""

    corners_map: FloatArray
    covariance_m2: FloatArray

    @classmethod
    def seen(
        cls, corners_map: FloatArray, covariance_m2: FloatArray, about: FloatArray | float = 0.0
    ) -> Candidates:
        """Candidates of corners and covariances, nan if unseen, ``about`` (G, 2) if all are."""
        unseen = np.isnan(corners_map[..., 0]) | np.isnan(corners_map[..., 1])
        count = np.maximum((~unseen).sum(axis=1), 1)
        centre = np.where(unseen[..., None], 0.0, corners_map).sum(axis=1) / count[:, None]
        centre = np.where(np.all(unseen, axis=1)[:, None], about, centre)
        rows = np.repeat(unseen, 2, axis=1)
        covariance = np.where(rows[:, :, None] | rows[:, None, :], UNSEEN_M2 * np.eye(8), covariance_m2)
        return cls(np.where(unseen[..., None], centre[:, None], corners_map), covariance)

    def __len__(self) -> int:
        return len(self.corners_map)

    def subset(self, rows: IntArray | BoolArray) -> Candidates:
        """The candidates at ``rows``."""
        return Candidates(self.corners_map[rows], self.covariance_m2[rows])

    @property
    def sigma_m(self) -> FloatArray:
        """Standard deviation (G, 4) of each corner over both directions."""
        variance = np.diagonal(self.covariance_m2, axis1=1, axis2=2).reshape(-1, 4, 2)
        return np.asarray(np.sqrt(variance.sum(axis=2)))

    def along(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Covariances (G,) of motions along two directions (G, 8) each."""
        return np.asarray(np.einsum("ni,nij,nj->n", first, self.covariance_m2, second))

    @property
    def known(self) -> BoolArray:
        """Corners (G, 4) known as points."""
        return np.asarray(self.sigma_m < _KNOWN_SIGMA_M)


@dataclass(frozen=True)
class Counts:
    """Counts of the sightings of G candidates, (G,) each."""

    images: IntArray  # with accepted observations
    observations: IntArray  # corner observations
    agreeing: IntArray  # of these, consistent with the solution
    log_odds: FloatArray  # the detector's mean log-odds over these
    easy_views: IntArray  # images with an unobstructed view of the whole candidate
    detected_views: IntArray  # of these, with a detection
    pointed: IntArray  # (G, 4) of these, with the corner as a consistent point
    as_symbol: IntArray  # images with a symbol on it, or a solid line that continues it

    def subset(self, rows: IntArray | BoolArray) -> Counts:
        """The candidates at ``rows``."""
        return Counts(**{name: values[rows] for name, values in vars(self).items()})


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

    The joint solution rejected R corners: ``corner`` (R,) of candidate ``group`` (R,), which sighting ``row``
    (R,) saw at ``seen_map`` (R, 2), m, with ``covariance_m2`` (R, 2, 2). Images of one view share errors, so
    either is right with a probability p in proportion to its information; the mixture adds the variance p
    (1 - p) of their squared distance. Corners of one sighting are treated jointly.
    """
    offset_m = seen_map - candidates.corners_map[group, corner]
    away_m = np.linalg.norm(offset_m, axis=1)
    agreed_m2 = fused.covariance_m2[group, corner]
    usable = fused.valid[group, corner] & (away_m < 3 * _OTHER_EDGE_M)
    usable &= np.isfinite(covariance_m2).all(axis=(1, 2)) & np.isfinite(offset_m).all(axis=1)
    offset_m = offset_m[usable]
    away_m = away_m[usable]
    alone = _information(offset_m, covariance_m2[usable])
    all_others = _information(offset_m, agreed_m2[usable])
    share = alone / (alone + all_others) * np.exp(-0.5 * (away_m / _OTHER_EDGE_M) ** 2)
    sightings, sighting_of_corner = np.unique(np.stack([group, row])[:, usable], axis=1, return_inverse=True)
    moved = np.zeros((sightings.shape[1], 4, 2))
    moved[sighting_of_corner.ravel(), corner[usable]] = np.sqrt(share)[:, None] * offset_m
    covariance = candidates.covariance_m2.copy()
    shift = moved.reshape(-1, 8)
    np.add.at(covariance, sightings[0], shift[:, :, None] * shift[:, None, :])
    return Candidates(candidates.corners_map, covariance)


def _information(offset_m: FloatArray, covariance_m2: FloatArray) -> FloatArray:
    """Information x' C^-1 x (R,) along ``offset_m`` (R, 2), times its squared length, of (R, 2, 2)."""
    return np.asarray(np.einsum("ri,rij,rj->r", offset_m, np.linalg.inv(covariance_m2), offset_m))


def with_shared_errors(candidates: Candidates, fused: FusedGroups, scatter: FloatArray) -> Candidates:
    """The solved candidates (G,), plus errors common to all images of a corner, as of a worn end.

    With correlation r, the mean of n images has the variance (1 + (n - 1) r) / n (Kish, Survey Sampling,
    1965): about r times a single image's, as in ``fused``. ``scatter`` (G, 4) inflates a corner's variance.
    """
    sightings = np.maximum(fused.point_sightings, 1)
    share = scatter - 1 + CORRELATION * sightings * scatter
    unseen = np.asarray(np.isnan(fused.corners_map).any(axis=2))
    shared = np.where(unseen[..., None, None], 0.0, share[..., None, None] * fused.covariance_m2)
    # Images that are cut alike share one error: their number does not locate the corner.
    no_point = (fused.point_sightings == 0) & ~unseen
    shared[no_point] = line_only(shared[no_point], UNSEEN_M2**0.5)
    return Candidates(candidates.corners_map, candidates.covariance_m2 + block_diagonal(shared))


_LARGEST = 1e9  # largest residual variance, squared sigmas: beyond it, and below its inverse, all are equal

_PRIOR_FREEDOM = (1.0, 1e4)
"""Limits of the prior's degrees of freedom for a variance: from tails as heavy as Cauchy's to none."""

_LEAST_TO_COMPARE = 3  # least number of variances with a spread


def variance_prior(variance: FloatArray, freedom: FloatArray) -> tuple[float, float]:
    """Scale and degrees of freedom of the inverse-gamma prior of variances (M,) with ``freedom`` (M,).

    By moments of their logarithms (Smyth, 2004, section 6.2); fewer than three are uninformative.
    """
    if len(variance) < _LEAST_TO_COMPARE:
        return _LARGEST, _PRIOR_FREEDOM[1]
    offset = np.log(np.clip(variance, 1 / _LARGEST, _LARGEST)) - psi(freedom / 2) + np.log(freedom / 2)
    excess = offset.var(ddof=1) - polygamma(1, freedom / 2).mean()
    low, high = _PRIOR_FREEDOM
    excess = float(np.clip(excess, polygamma(1, high / 2) * 1.001, polygamma(1, low / 2) * 0.999))
    prior = float(brentq(lambda count: polygamma(1, count / 2) - excess, low, high))
    return float(np.exp(offset.mean() + psi(prior / 2) - np.log(prior / 2))), prior


def scatter_of(squared: FloatArray, freedom: FloatArray) -> FloatArray:
    """Variance inflation (G, 4) of corners' images relative to the usual, at least 1; all are shrunk."""
    has_spread = freedom > 0
    squared = np.minimum(squared, _LARGEST * np.maximum(freedom, 1.0))  # infinite in the camera's plane
    scale, prior = variance_prior(squared[has_spread] / freedom[has_spread], freedom[has_spread])
    posterior_variance = (prior * scale + squared) / (prior + np.maximum(freedom, 0.0))
    return np.asarray(np.where(has_spread, np.maximum(posterior_variance / scale, 1.0), 1.0))
