"""Logistic regressions of a few weights, by Newton's method."""

from __future__ import annotations

import numpy as np

from v2hdm.records import FloatArray

_STEPS = 40  # of Newton's method, which settles within ten


def likeliest_weights(
    features: FloatArray, offset: FloatArray, is_true: FloatArray, ridge: float
) -> tuple[float, ...]:
    """The likeliest weights (F,) of features (N, F), rounded to hundredths.

    The log odds of the truth (N,), 1 or 0, are ``offset`` (N,) and the weighted features; ``ridge`` is the
    information of the prior that weights are 0.
    """
    weights = np.zeros(features.shape[1])
    information = ridge * np.eye(features.shape[1])
    for _ in range(_STEPS):
        probability = 1.0 / (1.0 + np.exp(-(offset + features @ weights)))
        slope = features.T @ (is_true - probability) - information @ weights
        curvature = (features * (probability * (1.0 - probability))[:, None]).T @ features + information
        weights = weights + np.linalg.solve(curvature, slope)
    return tuple(np.round(weights, 2).tolist())
