"""The probability that an area is writing, given the other words of its image.

Words are painted beside and below each other, and a word that is far away is named less surely than one that
is near. What else the network names writing, such as a manhole or worn paint, stands by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from v2hdm.detection.network import as_log_odds, as_probability
from v2hdm.geometry.planar import rectangle_size
from v2hdm.records import FloatArray

FITTED = 4.45
"""Weight of the company, fitted to photographs and renders by ``python -m train.fit_writing``."""

_REACH = 1.0  # largest gap between words of one message, in lengths of the longer one


def company_of_words(score: FloatArray, hulls: Sequence[FloatArray]) -> FloatArray:
    """How much likelier (N,) than not the surest other word near to each is, 0 where none is likelier.

    ``score`` (N,) are probabilities alone, ``hulls`` (K, 2) lie on the ground, m.
    """
    extent_m = np.array([rectangle_size(hull)[0] for hull in hulls])
    likelier = np.maximum(2.0 * score - 1.0, 0.0)
    company = np.zeros(len(hulls))
    for first, second in combinations(range(len(hulls)), 2):
        gap_m = np.linalg.norm(hulls[first][:, None] - hulls[second], axis=2).min()
        if gap_m <= _REACH * max(extent_m[first], extent_m[second]):
            company[first] = max(company[first], likelier[second])
            company[second] = max(company[second], likelier[first])
    return company


def writing_probability(score: FloatArray, company: FloatArray, weight: float = FITTED) -> FloatArray:
    """The probability (N,) that areas are writing, by that alone (N,) and their company (N,)."""
    raised = as_probability(as_log_odds(score) + weight * company)
    return np.asarray(np.where(company > 0, raised, score))
