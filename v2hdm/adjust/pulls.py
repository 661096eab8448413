"""How far the recorded poses had to give way, in the standard deviations stated for them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.adjust.model import state_residual
from v2hdm.adjust.problem import POSE_STATES
from v2hdm.adjust.solution import Solution
from v2hdm.records import FloatArray, IntArray


@dataclass(frozen=True)
class PosePulls:
    """Whitened innovations of the frames' states: errors drawn anew, and what is new in a drift.

    Attributes:
        state: (S,) which of :data:`v2hdm.adjust.POSE_STATES` each is; a state with a drift has two.
        pulls: (J, S) in sigmas. Their mean square is at most 1 where the sigmas are right.
    """

    state: IntArray
    pulls: FloatArray

    def rms(self) -> dict[str, float]:
        """Root mean square by the state's name, the larger one where it has two."""
        size = np.sqrt(np.mean(self.pulls**2, axis=0)) if len(self.pulls) else np.zeros(len(self.state))
        out: dict[str, float] = {}
        for state, one in zip(self.state, size, strict=True):
            name = POSE_STATES[state]
            out[name] = max(out.get(name, 0.0), float(one))
        return out


def pose_pulls(solution: Solution) -> PosePulls:
    """The pulls on the poses of a solution; none where it estimates no state of a frame."""
    descent = solution.covariance.descent
    pulls = state_residual(descent.engine.arrays, descent.estimate.frame_state)
    return PosePulls(np.array(descent.engine.arrays.states, dtype=np.int64), pulls.cpu().numpy())
