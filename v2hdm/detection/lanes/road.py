"""What the lines of one road have in common: where they meet in the image, and how they bend.

Lines painted along a road are parallel. Of u = a + b v + c / v (:mod:`v2hdm.detection.lanes.curves`) they
share a, their vanishing point, and c; only b, the place beside the camera, is each one's own. A short dash
far away, which by itself could point anywhere, is thereby known as well as the line beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from v2hdm.detection.lanes.curves import Evidence, Horizon, Prior
from v2hdm.records import FloatArray

_FREE_SIGMAS = (0.5, 8.0, 0.008)
"""Lines of any kind: direction about the camera's, rad, place beside it, m, and curvature, 1/m."""

_PARALLEL_SIGMAS = (0.012, 0.0, 0.001)
"""By how much lines of one road differ in direction, rad, and curvature, 1/m.

An error of half a degree in the camera's pitch turns lines 2 m to the side of a low camera by as much.
"""

_SHARE = 0.85
"""So many lines keep to the road; kerbs and strokes of letters need not."""

_FREE_KEPT = np.diag([0.04, 0.04, 1.0])
_ALONG_KEPT = np.array([[1.0, 0.0, 1.0], [0.0, 0.04, 0.0], [1.0, 0.0, 1.0]])
"""Where lines tend to be says what is one line, not where that one is: so much of the prior is kept there."""

_CANDIDATES = 4
"""So many of the groups known best are tried as the road's direction."""

_SHARED = [0, 2]
_SHARED_BLOCK = np.ix_(_SHARED, _SHARED)


@dataclass(frozen=True)
class Road:
    """A road: the priors of lines ``along`` it and of ``free`` ones."""

    along: Prior
    free: Prior

    @cached_property
    def _both(self) -> Prior:
        return Prior.several([self.along, self.free])

    def judge(self, evidence: Evidence) -> tuple[FloatArray, FloatArray]:
        """Log probability (N,) of each group as one line, and how much likelier (N,) it is along the road.

        The first is up to a constant per point, the second a log ratio that leaves out how common each is.
        """
        along, free = evidence.log_evidence(self._both)
        return np.logaddexp(along + np.log(_SHARE), free + np.log1p(-_SHARE)), along - free

    def drawn_by(self, log_ratio: float) -> Prior:
        """What helps to draw a line of such a log ratio of :meth:`judge`."""
        keeps = log_ratio + np.log(_SHARE) > np.log1p(-_SHARE)
        prior, kept = (self.along, _ALONG_KEPT) if keeps else (self.free, _FREE_KEPT)
        return Prior(prior.mean, prior.information * kept)


def find_road(evidence: Evidence, horizon: Horizon) -> Road:
    """The road that N groups of points, each roughly a line, agree on best."""
    free = Prior(np.zeros(3), np.diag(horizon.parameters(*_FREE_SIGMAS) ** -2.0))
    covariance = np.linalg.inv(evidence.information + free.information)
    mean = np.einsum("nij,nj->ni", covariance, evidence.moment)[:, _SHARED]
    spread = np.diag(horizon.parameters(*_PARALLEL_SIGMAS)[_SHARED] ** 2)
    # By how much the road may differ from what each line says.
    doubt = covariance[:, [[0], [2]], _SHARED] + spread
    certain = np.argsort((np.diagonal(doubt, axis1=1, axis2=2) / np.diag(spread)).sum(axis=1))[:_CANDIDATES]
    candidates = [_along(mean[k], doubt[k], free) for k in certain]
    *along, alone = evidence.log_evidence(Prior.several([*candidates, free]))
    best = max((ratio - alone for ratio in along), key=_agreement)
    # The mean of what all say of the road, each as far as it keeps to it.
    weight = 1 / (1 + (1 - _SHARE) / _SHARE * np.exp(-np.clip(best, -50, 50)))
    each = np.linalg.inv(doubt) * weight[:, None, None]
    shared = np.linalg.inv(each.sum(axis=0) + free.information[_SHARED_BLOCK])
    return Road(_along(shared @ np.einsum("nij,nj->i", each, mean), shared + spread, free), free)


def _agreement(gain: FloatArray) -> float:
    """Log probability of lines of such log ratios, some of which keep to the road."""
    return float(np.logaddexp(np.log(_SHARE) + gain, np.log1p(-_SHARE)).sum())


def _along(shared: FloatArray, covariance: FloatArray, free: Prior) -> Prior:
    """Lines of known a and c (2,), with their covariance (2, 2), anywhere beside the camera."""
    information = free.information.copy()
    information[_SHARED_BLOCK] = np.linalg.inv(covariance)
    return Prior(np.array([shared[0], 0.0, shared[1]]), information)
