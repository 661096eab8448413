"""How probable it is that a quadrilateral is a whole marking of its class: a logistic function of evidence.

Its weights, in ``confidence.json`` beside the network that they belong to, are those that
``python -m tests.benchmarks.detector_confidence`` fits to renders which no benchmark shows. What speaks for a
diamond does not speak for a dash, so each of the :data:`SHAPES` has its own.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from v2hdm.detection.corners.evidence import FEATURES
from v2hdm.records import DIAMOND, LANE_DASH, FloatArray

CONFIDENCE_FILE = Path(__file__).parents[1] / "confidence.json"

SHAPES = (DIAMOND, LANE_DASH, "bar")
"""Diamonds, lane dashes, and whatever else has four corners."""


def shape_of(kind: str) -> str:
    """The one of :data:`SHAPES` that a class with four corners has."""
    return kind if kind in SHAPES else SHAPES[-1]


def confidence(evidence: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """Probability (M,) from evidence (M, F), in the order of :data:`FEATURES`, of each one's class."""
    fitted = _fitted(CONFIDENCE_FILE)
    weights, bias = zip(*(fitted[shape_of(kind)] for kind in kinds), strict=True)
    odds = (evidence * np.array(weights)).sum(axis=1) + np.array(bias)
    return np.asarray(1 / (1 + np.exp(-np.clip(odds, -30, 30))))


@cache
def _fitted(path: Path) -> dict[str, tuple[FloatArray, float]]:
    """Weights (F,) and bias of each shape."""
    fitted = json.loads(path.read_text(encoding="utf-8"))
    return {
        shape: (np.array([fitted[shape]["weights"][name] for name in FEATURES]), float(fitted[shape]["bias"]))
        for shape in SHAPES
    }
