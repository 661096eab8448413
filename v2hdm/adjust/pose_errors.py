"""The joint covariance of the errors of recorded poses, whichever frames are asked for.

The same model as :mod:`v2hdm.adjust.pose_prior`, a white part and a drift along the route, as a dense matrix:
what a marking or a few dozen of them saw are some ten to a hundred frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from v2hdm.records import FloatArray, IntArray


@dataclass(frozen=True)
class Frames:
    """F frames: their ``number`` (F,), the distance ``travelled_m`` (F,) until then, and their poses.

    ``vehicle_from_map`` (F, 4, 4) are the recorded poses, inverted.
    """

    number: IntArray
    travelled_m: FloatArray
    vehicle_from_map: FloatArray


@dataclass(frozen=True)
class Noise:
    """How the observations err beyond their covariances.

    ``pose_sigma`` (6,) of the frames' tangents (0 where a state does not err), of which ``drift_sigma`` (6,)
    fades to 1 / e over ``drift_over_m`` (6,) of driving, as in :class:`v2hdm.adjust.PoseSigma`.
    ``cauchy_scale`` is the residual, in standard deviations, from which an observation loses weight
    (infinite: never).
    """

    pose_sigma: FloatArray
    cauchy_scale: float
    drift_sigma: FloatArray = field(default_factory=lambda: np.zeros(6))
    drift_over_m: FloatArray = field(default_factory=lambda: np.ones(6))

    @property
    def reach_m(self) -> float:
        """The driven distance over which the slowest drift fades to 1 / e; 0 where nothing drifts."""
        return float(np.max(np.where(self.drift_sigma > 0, self.drift_over_m, 0.0)))

    def covariance(self, first: Frames, second: Frames) -> FloatArray:
        """Of the states of frames ``first`` (F) with those of ``second`` (G): (6F, 6G)."""
        apart_m = np.abs(first.travelled_m[:, None] - second.travelled_m)
        same = first.number[:, None] == second.number
        white = np.maximum(self.pose_sigma**2 - self.drift_sigma**2, 0.0)
        drift = self.drift_sigma**2 * np.exp(-apart_m[..., None] / self.drift_over_m)
        value = drift + same[..., None] * white
        out = np.zeros((len(first.number), 6, len(second.number), 6))
        for state in range(2, 6):
            out[:, state, :, state] = value[..., state]
        # A drift of the position keeps its direction in the map, and so turns in the vehicle as it turns.
        to, back = first.vehicle_from_map[:, :2, :2], second.vehicle_from_map[:, :2, :2]
        out[:, :2, :, :2] = np.einsum("fab,gcb,fg->fagc", to, back, value[..., 0])
        return out.reshape(6 * len(first.number), -1)
