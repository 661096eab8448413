"""The joint covariance of neighbouring markings, which err alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from v2hdm.records import FloatArray, Marking


def joint_covariance(markings: Sequence[Marking]) -> FloatArray | None:
    """Joint covariance (8N, 8N) of the corners of N markings, None where one of them has none.

    Neighbours share the error of their centres, all but its ``relative_sigma_m``: it shifts all alike.
    """
    covariances = [marking.covariance_m2 for marking in markings if marking.covariance_m2 is not None]
    if len(covariances) < len(markings):
        return None
    centre_m2 = np.mean([whole.reshape(4, 2, 4, 2).mean(axis=(0, 2)) for whole in covariances], axis=0)
    relative_m2 = float(np.mean([(marking.relative_sigma_m or 0.0) ** 2 for marking in markings]))
    values, vectors = np.linalg.eigh(centre_m2 - relative_m2 * np.eye(2))
    shared_m2 = (vectors * np.maximum(values, 0.0)) @ vectors.T
    by_marking = block_diag(*(_without(whole, shared_m2) for whole in covariances))
    return np.asarray(by_marking + np.tile(shared_m2, (4 * len(markings), 4 * len(markings))))


def _without(covariance_m2: FloatArray, shared_m2: FloatArray) -> FloatArray:
    """The covariance (8, 8) less a shift (2, 2) of all corners, and never less than nothing."""
    values, vectors = np.linalg.eigh(covariance_m2 - np.tile(shared_m2, (4, 4)))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
