"""How well a drive determines each extrinsic, and how far the recorded poses had to give way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.adjust.model import state_residual
from v2hdm.adjust.problem import Problem
from v2hdm.adjust.solution import Solution
from v2hdm.records import FloatArray, IntArray

AXES: tuple[str, ...] = ("forward", "left", "up", "roll", "pitch", "heading")

# Share of the information from which a direction is said to rest on the survey. Two cameras that
# share an unobservable direction halve it between them, hence below one half.
_RESTS_ON_PRIOR = 0.25


@dataclass(frozen=True)
class Observability:
    """How well a drive knows one camera's extrinsic, along and about the vehicle's axes :data:`AXES`."""

    sigma: FloatArray  # (6,) m and rad, after the adjustment
    # (3,) of the variance of the centre after and before: 0, the drive alone determines it; 1, only the prior
    prior_share: FloatArray

    @property
    def unobserved(self) -> tuple[str, ...]:
        """Directions of the camera's centre that rest on its prior."""
        return tuple(
            axis for axis, share in zip(AXES, self.prior_share, strict=False) if share > _RESTS_ON_PRIOR
        )

    def sentence(self, camera: str) -> str:
        """For the person who drove: what is known how well, and what would help."""
        turns = np.rad2deg(self.sigma[3:])
        rotation = f"rotation known to {turns.max():.3f} deg"
        if not self.unobserved:
            centre = f"centre known to {100 * self.sigma[:3].max():.1f} cm"
            return f"{camera}: {centre}, {rotation}; the drive fixes both"
        worst = 100 * max(self.sigma[AXES.index(axis)] for axis in self.unobserved)
        level = [axis for axis in self.unobserved if axis != "up"]
        hint = "one turn on the route would fix them" if level else "longer sightings would fix it"
        offsets = " and ".join(self.unobserved)
        return f"{camera}: {rotation}; the {offsets} offset ({worst:.1f} cm) rests on the survey: {hint}"


def observability(problem: Problem, solution: Solution) -> Sequence[Observability]:
    """How well each camera of ``problem`` is determined by the drive, one record a camera."""
    rotation, covariance = solution.cam_from_vehicle[:, :3, :3], solution.extrinsic_covariance
    centre_sigma_m = np.inf if problem.centre_sigma_m is None else problem.centre_sigma_m
    # The tangent's axes are the camera's, and its translation is minus the motion of the centre.
    centre = rotation.transpose(0, 2, 1) @ covariance[:, :3, :3] @ rotation
    turn = rotation.transpose(0, 2, 1) @ covariance[:, 3:, 3:] @ rotation
    variance = np.concatenate([np.diagonal(block, axis1=1, axis2=2) for block in (centre, turn)], axis=1)
    share = np.minimum(variance[:, :3] / centre_sigma_m**2, 1.0)
    return [Observability(np.sqrt(v), s) for v, s in zip(variance, share, strict=True)]


@dataclass(frozen=True)
class PoseInnovations:
    """Whitened innovations of the frames' states: errors drawn anew, and what is new in a drift."""

    # (S,) which of :data:`v2hdm.adjust.problem.POSE_STATES` each is; a state with a drift has two
    state: IntArray
    normalised: FloatArray  # (J, S) in sigmas. Their mean square is at most 1 where the sigmas are right.

    @property
    def along_over_across(self) -> float:
        """How many times as much positions err anew along the way as across it; 1 where none is known."""
        ahead, left = (np.flatnonzero(self.state == axis)[:1] for axis in (0, 1))
        if not len(ahead) or not len(left):
            return 1.0
        along, across = np.sqrt(np.mean(self.normalised[:, [ahead[0], left[0]]] ** 2, axis=0))
        return float(along / max(across, 1e-9))


def pose_innovations(solution: Solution) -> PoseInnovations:
    """Normalised innovations of a solution's poses; none where it estimates no state of a frame."""
    descent = solution.covariance.descent
    normalised = state_residual(descent.engine.arrays, descent.estimate.frame_state)
    return PoseInnovations(np.array(descent.engine.arrays.states, dtype=np.int64), normalised.cpu().numpy())
