"""The result of a solve: estimate, status, covariance, verdicts on observations, and observability."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from v2hdm.adjust.covariance import Covariance, Dropped
from v2hdm.adjust.model import state_residual
from v2hdm.adjust.problem import Observations, Problem
from v2hdm.records import BoolArray, FloatArray, IntArray

VerdictArray = NDArray[np.int8]

_MEDIAN_SQUARED = 2 * float(np.log(2))  # median of a chi-square distribution with two degrees of freedom


class Verdict(IntEnum):
    """Verdict on an observation; unconfirmed: all others of its corner contradict it and each other."""

    ACCEPTED = 0
    CONTRADICTS = 1
    UNCONFIRMED = 2
    BEHIND_CAMERA = 3


def noise_scale(mahalanobis2: FloatArray) -> float:
    """Robust variance factor of the observations, from the median; at least 1."""
    # Counting is a tenth of ordering, and tells where the median is below that of a right noise model.
    if 2 * np.count_nonzero(mahalanobis2 <= _MEDIAN_SQUARED) > len(mahalanobis2):
        return 1.0
    ordered = mahalanobis2.astype(np.float32)
    middle = [(len(ordered) - 1) // 2, len(ordered) // 2]
    ordered.partition(middle)
    return max(1.0, float(ordered[middle].mean()) / _MEDIAN_SQUARED)


def as_of_point(squared_of_line: FloatArray) -> FloatArray:
    """Squared residuals of lines, chi-square with one degree of freedom, as equally likely ones of points."""
    with np.errstate(divide="ignore"):  # a probability of 0 is infinitely unlikely
        return np.asarray(-2 * np.log(chdtrc(1, squared_of_line)))


def classify(
    observations: Observations, mahalanobis2: FloatArray, behind: BoolArray, probability: float, scale: float
) -> VerdictArray:
    """:class:`Verdict` (K,) on observations with squared Mahalanobis distances ``mahalanobis2`` (K,).

    The gate is the chi-square quantile that a sound observation exceeds with ``probability`` (two degrees of
    freedom: -2 ln p), times the variance ``scale``, so that understated covariances do not empty the map. An
    observation is unconfirmed if the gate leaves it as the last of several of its corner.
    """
    from v2hdm.adjust.kernels.layout import classify as classify_all

    gate = -2 * math.log(probability) * scale
    corner = np.ascontiguousarray(observations.corner, dtype=np.int64)
    verdict = np.empty(len(corner), dtype=np.int8)
    counts = np.zeros((2, int(corner.max()) + 1), dtype=np.int64)
    classify_all(corner, mahalanobis2, behind, gate, verdict, *counts)
    return verdict


_OUTLIER_SQUARED = 13.8  # chi-square, 2 degrees of freedom, that one good observation in a thousand exceeds

# Mean of half a chi-square variable below that limit: truncating the tail reduces the chi-square a little.
_TRIMMED_MEAN = 1 - _OUTLIER_SQUARED / 2 / math.expm1(_OUTLIER_SQUARED / 2)


@dataclass(frozen=True)
class VarianceFactors:
    """Variance factors, relative to the stated variances: of all data, and of the observations alone."""

    all: float
    observations: float


def variance_factors(
    squared: FloatArray, of_priors: float, free: int, scale: float | None = None
) -> VarianceFactors:
    """Chi-square per degree of freedom of inliers and priors together, and of inliers alone.

    The observations use up the degrees of freedom that priors lose: the expected chi-square of a prior is its
    redundancy (Foerstner and Wrobel, Photogrammetric Computer Vision, section 4.2.4, on variance components).
    ``free`` is the number of unknowns less those that priors other than the poses' determine.
    """
    good = squared <= _OUTLIER_SQUARED * (noise_scale(squared) if scale is None else scale)
    of_observations = float(squared.sum(where=good)) / _TRIMMED_MEAN
    redundancy = 2 * int(good.sum()) - free
    return VarianceFactors(
        all=(of_observations + of_priors) / max(redundancy, 1),
        observations=of_observations / max(redundancy - of_priors, 1),
    )


class Status(Enum):
    """Outcome of a solve; :attr:`advice` says what to do about it."""

    CONVERGED = "converged"
    STALLED = "stalled"
    EVALUATIONS_EXHAUSTED = "evaluations exhausted"
    UNDETERMINED = "undetermined"
    BEHIND_CAMERA = "corners behind the camera"

    @property
    def advice(self) -> str:
        """One sentence: meaning of the status, and what to try."""
        return _ADVICE[self]


_ADVICE = {
    Status.CONVERGED: "The optimum is reached; nothing needs to be done.",
    Status.STALLED: "No step lowers the cost further although its gradient is not zero: check the "
    "starting extrinsic and the observation covariances for values that are orders of magnitude off.",
    Status.EVALUATIONS_EXHAUSTED: "The optimum was not reached in time: start closer, or raise "
    "max_evaluations.",
    Status.UNDETERMINED: "The observations leave a direction free: add a prior on the camera centre, "
    "include a turn, or estimate fewer pose states.",
    Status.BEHIND_CAMERA: "At the solution some corners lie behind the camera that saw them: their "
    "observations are wrong associations or the starting extrinsic points the wrong way.",
}


@dataclass(frozen=True)
class Solution:
    """Adjusted extrinsics, poses and corners, and the evidence that they are optimal."""

    status: Status  # outcome
    cam_from_vehicle: FloatArray  # adjusted extrinsics (C, 4, 4)
    map_from_vehicle: FloatArray  # adjusted poses (J, 4, 4); the recorded ones without frame states
    corners_map: FloatArray  # (N, 2) m
    residual_px: FloatArray  # projected minus observed, (K, 2)
    mahalanobis2: FloatArray  # (K,) squared Mahalanobis distances, chi-square of 2 degrees of freedom
    verdict: VerdictArray  # a :class:`v2hdm.adjust.Verdict` on each observation (K,)
    clock_offset_s: FloatArray  # (C, V) exposure minus stamp by camera and session; 0 if not estimated
    read_out_s: FloatArray  # (C,) time from an image's first row to its last; as stated if not estimated
    cost_terms: Mapping[str, float]  # parts of the cost by name, which sum to :attr:`cost`
    evaluations: int  # of cost and gradient, all stages together
    gap: float  # predicted decrease still possible, as a fraction of the cost (the certificate)
    chi2_per_dof: float  # about 1 if the noise model is right; without outliers
    observation_factor: float  # variance factor of the observations if priors are right; without outliers
    covariance: Covariance = field(repr=False)  # of everything estimated, on demand

    def without_factors(self) -> Solution:
        """The solution without its covariances, whose factors are large and bound to this process."""
        return replace(self, covariance=Dropped())

    @property
    def cost(self) -> float:
        """Half the sum of squared residuals, those of observations under the loss, and priors."""
        return sum(self.cost_terms.values())

    @property
    def variance_scale(self) -> float:
        """Factor, at least 1, that turns stated covariances into those that the residuals show."""
        return max(1.0, self.chi2_per_dof)

    @property
    def accepted(self) -> BoolArray:
        """Accepted observations (K,)."""
        return np.asarray(self.verdict == Verdict.ACCEPTED)

    @property
    def extrinsic_covariance(self) -> FloatArray:
        """Covariance (C, 6, 6) of each extrinsic's left tangent: translation m, rotation rad."""
        return self.covariance.extrinsic()

    def corner_covariance(self, indices: IntArray) -> FloatArray:
        """Joint covariance (2n, 2n), m^2, x0, y0, x1, ..., of corners (n,); of groups (M, n) stacked."""
        covariance = self.covariance.corners(np.atleast_2d(indices))
        return covariance if np.ndim(indices) == 2 else covariance[0]


AXES: tuple[str, ...] = ("forward", "left", "up", "roll", "pitch", "heading")

# Fraction of the information from which a direction rests on the survey: below one half, as two cameras
# that share an unobservable direction share its prior.
_RESTS_ON_PRIOR = 0.25


@dataclass(frozen=True)
class Observability:
    """Observability of one camera's extrinsic, along and about the vehicle's axes :data:`AXES`."""

    sigma: FloatArray  # (6,) m and rad, after the adjustment
    prior_share: FloatArray  # (3,) posterior over prior variance of the centre; 1: the prior decides

    @property
    def unobserved(self) -> tuple[str, ...]:
        """Directions of the camera centre that rest on its prior."""
        shares = zip(AXES, self.prior_share, strict=False)
        return tuple(axis for axis, share in shares if share > _RESTS_ON_PRIOR)

    def sentence(self, camera: str) -> str:
        """One sentence for the driver: the precision of the extrinsic, and how to improve it."""
        turns = np.rad2deg(self.sigma[3:])
        rotation = f"rotation known to {turns.max():.3f} deg"
        if not self.unobserved:
            centre = f"centre known to {100 * self.sigma[:3].max():.1f} cm"
            return f"{camera}: {centre}, {rotation}; the drive determines both"
        worst = 100 * max(self.sigma[AXES.index(axis)] for axis in self.unobserved)
        level = [axis for axis in self.unobserved if axis != "up"]
        hint = "a turn on the route would determine them" if level else "longer tracks would determine it"
        offsets = " and ".join(self.unobserved)
        return f"{camera}: {rotation}; the {offsets} offset ({worst:.1f} cm) rests on the survey: {hint}"


def observability(problem: Problem, solution: Solution) -> Sequence[Observability]:
    """Observability of each camera's extrinsic in ``problem``, one record per camera."""
    rotation = solution.cam_from_vehicle[:, :3, :3]
    covariance = solution.extrinsic_covariance
    centre_sigma_m = np.inf if problem.centre_sigma_m is None else problem.centre_sigma_m
    # The tangent is in camera axes; its translation is minus the motion of the centre.
    centre = rotation.transpose(0, 2, 1) @ covariance[:, :3, :3] @ rotation
    turn = rotation.transpose(0, 2, 1) @ covariance[:, 3:, 3:] @ rotation
    variance = np.concatenate([np.diagonal(block, axis1=1, axis2=2) for block in (centre, turn)], axis=1)
    share = np.minimum(variance[:, :3] / centre_sigma_m**2, 1.0)
    return [Observability(np.sqrt(v), s) for v, s in zip(variance, share, strict=True)]


@dataclass(frozen=True)
class PoseInnovations:
    """Normalised innovations of the frames' states: white errors, and the drifts' process noise."""

    state: IntArray  # (S,) index into :data:`v2hdm.adjust.problem.POSE_STATES`; twice for a drift
    normalised: FloatArray  # (J, S) in sigmas; mean square at most 1 if the sigmas are right

    @property
    def along_over_across(self) -> float:
        """Ratio of white position errors along and across the path; 1 if unknown."""
        ahead, left = (np.flatnonzero(self.state == axis)[:1] for axis in (0, 1))
        if not len(ahead) or not len(left):
            return 1.0
        along, across = np.sqrt(np.mean(self.normalised[:, [ahead[0], left[0]]] ** 2, axis=0))
        return float(along / max(across, 1e-9))


def pose_innovations(solution: Solution) -> PoseInnovations:
    """Normalised innovations of a solution's poses; empty without frame states."""
    descent = solution.covariance.descent
    normalised = state_residual(descent.engine.arrays, descent.estimate.frame_state)
    return PoseInnovations(np.array(descent.engine.arrays.states, dtype=np.int64), normalised.cpu().numpy())
