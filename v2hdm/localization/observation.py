"""Observations of two numbers, such as the distance and the direction of a line: paired, gated and taken."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from v2hdm.localization.belief import Belief, corrected
from v2hdm.localization.joint import CLEARER_BY, largest_square
from v2hdm.records import FloatArray

_NUMBERS = 2  # of an observation


class Observation(NamedTuple):
    """A detection as an observation of the states, if it shows a certain line or area of the map."""

    detection: int
    target: int  # the line or area
    residual: FloatArray  # (2,) observed less expected
    noise: FloatArray  # (2, 2) its covariance
    slope: FloatArray  # (2, n) derivative of what is expected by the whitened states
    features: tuple[int, ...]  # whose places' errors are among the states

    @property
    def covariance(self) -> FloatArray:
        """The covariance (2, 2) of the residual."""
        return np.asarray(self.noise + self.slope @ self.slope.T)

    @property
    def squared(self) -> float:
        """The squared residual in sigmas."""
        return float(self.residual @ np.linalg.solve(self.covariance, self.residual))

    @property
    def loss(self) -> float:
        """Minus twice the log likelihood, but for a constant."""
        return self.squared + float(np.linalg.slogdet(self.covariance)[1])


class Taken(NamedTuple):
    """A belief after observations, and those that it took."""

    belief: Belief
    observations: tuple[Observation, ...]

    @property
    def features(self) -> list[int]:
        """The features that were seen."""
        return sorted({feature for view in self.observations for feature in view.features})


def clear_ones(observations: Sequence[Observation]) -> list[Observation]:
    """For each detection its only explanation; none for one with several, or with none that fits."""
    by_detection: dict[int, list[Observation]] = {}
    for observation in observations:
        if observation.squared <= largest_square(np.array(float(_NUMBERS))):
            by_detection.setdefault(observation.detection, []).append(observation)
    clear = []
    for rivals in by_detection.values():
        best, *others = sorted(rivals, key=lambda rival: rival.loss)
        if all(rival.loss >= best.loss + CLEARER_BY for rival in others):
            clear.append(best)
    return clear


def take(belief: Belief, observations: Sequence[Observation]) -> Taken:
    """The belief after those of some observations that are clear and fit together."""
    chosen = clear_ones(observations)
    while chosen:
        residual = np.concatenate([observation.residual for observation in chosen])
        slope = np.concatenate([observation.slope for observation in chosen])
        rows = np.arange(len(residual)).reshape(-1, _NUMBERS)
        noise = np.zeros((len(residual), len(residual)))
        for numbers, observation in zip(rows, chosen, strict=True):
            noise[np.ix_(numbers, numbers)] = observation.noise
        pull = np.linalg.solve(noise + slope @ slope.T, residual)
        if residual @ pull <= largest_square(np.array(float(len(residual)))):
            inner = np.linalg.inv(np.linalg.cholesky(noise))
            return Taken(corrected(belief, inner @ residual, inner @ slope), tuple(chosen))
        # What noise has to explain of each once all are taken: of the worst it is not noise.
        left = noise @ pull
        squared = [float(left[numbers] @ pull[numbers]) for numbers in rows]
        del chosen[int(np.argmax(squared))]
    return Taken(belief, ())
