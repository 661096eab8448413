"""Log odds, in which evidence adds up, and the probabilities that they are."""

from __future__ import annotations

import numpy as np

_MOST = 30.0
"""Log odds of more than this either way are too many to be meant, and more than exponentials bear."""


def as_probability(odds: np.ndarray) -> np.ndarray:
    """Probabilities, in the shape and precision of the log odds."""
    return np.asarray(1 / (1 + np.exp(-np.clip(odds, -_MOST, _MOST))))
