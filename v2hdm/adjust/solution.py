"""The result of a solve: the estimate, how it went, and how sure it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from v2hdm.adjust.covariance import Covariance
from v2hdm.adjust.validation import Verdict, VerdictArray
from v2hdm.records import BoolArray, FloatArray, IntArray


class Status(Enum):
    """How a solve ended; :attr:`advice` says what to do about it."""

    CONVERGED = "converged"
    STALLED = "stalled"
    EVALUATIONS_EXHAUSTED = "evaluations exhausted"
    UNDETERMINED = "undetermined"
    BEHIND_CAMERA = "corners behind the camera"

    @property
    def advice(self) -> str:
        """One sentence: what the status means and what to try."""
        return _ADVICE[self]


_ADVICE = {
    Status.CONVERGED: "The optimum is reached; nothing needs to be done.",
    Status.STALLED: "No step lowers the cost further although its gradient is not zero: check the "
    "starting extrinsic and the observation covariances for values that are orders of magnitude off.",
    Status.EVALUATIONS_EXHAUSTED: "The optimum was not reached in time: start closer, or raise "
    "max_evaluations.",
    Status.UNDETERMINED: "The observations leave a direction free: add a prior on the camera centre, "
    "drive a turn, or estimate fewer pose states.",
    Status.BEHIND_CAMERA: "At the solution some corners lie behind the camera that saw them: their "
    "observations are wrong associations or the starting extrinsic points the wrong way.",
}


@dataclass(frozen=True)
class Solution:
    """The adjusted extrinsics, poses and corners, and the evidence that they are the optimum."""

    status: Status  # how it ended
    cam_from_vehicle: FloatArray  # adjusted extrinsics (C, 4, 4)
    map_from_vehicle: FloatArray  # adjusted poses (J, 4, 4); the recorded ones where no state is estimated
    corners_map: FloatArray  # (N, 2) m
    residual_px: FloatArray  # projected minus observed, (K, 2)
    # squared residual in standard deviations (K,), chi-square with 2 degrees of freedom where model and
    # covariances are right (what was seen of a line is scaled to that)
    mahalanobis2: FloatArray
    verdict: VerdictArray  # a :class:`v2hdm.adjust.Verdict` on each observation (K,)
    # (C, V) how much later than stated each camera's images of each visit were taken; 0 where that is not
    # estimated
    clock_offset_s: FloatArray
    # (C,) the time from the first row of each camera's images to the last; as stated where that is not
    # estimated
    read_out_s: FloatArray
    cost_terms: Mapping[str, float]  # the parts of the cost by name; they add up to :attr:`cost`
    evaluations: int  # of cost and gradient, all stages together
    gap: float  # predicted decrease still possible, as a fraction of the cost (the certificate)
    chi2_per_dof: float  # about 1 where the noise model is right; outliers are left out
    # how many times as large as stated the observations' variances are, if the priors' are right; outliers
    # are left out
    observation_factor: float
    covariance: Covariance = field(repr=False)  # of everything estimated, on demand

    @property
    def cost(self) -> float:
        """Half the squared, robustified residuals plus priors."""
        return sum(self.cost_terms.values())

    @property
    def accepted(self) -> BoolArray:
        """Which observations (K,) the verdict is for."""
        return np.asarray(self.verdict == Verdict.ACCEPTED)

    @property
    def extrinsic_covariance(self) -> FloatArray:
        """Covariance (C, 6, 6) of each extrinsic's left tangent: translation m, rotation rad."""
        return self.covariance.extrinsic()

    def corner_covariance(self, indices: IntArray) -> FloatArray:
        """Joint covariance (2n, 2n), m^2, x0, y0, x1, ..., of corners (n,); of groups (M, n), one each."""
        groups = np.atleast_2d(indices)
        covariance = self.covariance.corners(groups)
        return covariance if np.ndim(indices) == 2 else covariance[0]
