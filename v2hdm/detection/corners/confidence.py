"""How probable it is that a quadrilateral is a whole marking of its class: a logistic function of evidence.

Its weights, in ``confidence.json`` beside the network that they belong to, are those that
``python -m tests.benchmarks.detector_confidence`` fits to renders which no benchmark shows.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np

from v2hdm.detection.corners.evidence import FEATURES
from v2hdm.records import FloatArray

CONFIDENCE_FILE = Path(__file__).parents[1] / "confidence.json"


def confidence(evidence: FloatArray) -> FloatArray:
    """Probability (M,) from evidence (M, F), in the order of :data:`FEATURES`."""
    weights, bias = _fitted(CONFIDENCE_FILE)
    return np.asarray(1 / (1 + np.exp(-np.clip(evidence @ weights + bias, -30, 30))))


@cache
def _fitted(path: Path) -> tuple[FloatArray, float]:
    fitted = json.loads(path.read_text(encoding="utf-8"))
    return np.array([fitted["weights"][name] for name in FEATURES]), float(fitted["bias"])
