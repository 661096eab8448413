"""How probable it is that a quadrilateral is a whole marking of its class: a logistic function of evidence.

It is asked twice: first what speaks for each one alone, then with what the others, as probable as they were
alone, say of it. The weights, in ``confidence.json`` beside the network that they belong to, are those that
``python -m tests.benchmarks.detector_confidence`` fits to renders which no benchmark shows. What speaks for a
diamond does not speak for a dash, so each of the :data:`SHAPES` has its own.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from v2hdm.detection.corners.company import COMPANY, company
from v2hdm.detection.corners.evidence import FEATURES
from v2hdm.records import DIAMOND, LANE_DASH, FloatArray

CONFIDENCE_FILE = Path(__file__).parents[1] / "confidence.json"

_Fit = tuple[FloatArray, float]
"""Weights (F,) and bias of a logistic function."""

TOLD = ("alone", *COMPANY)
"""What a quadrilateral is judged by among others: its own log odds, and what the others say."""

SHAPES = (DIAMOND, LANE_DASH, "bar")
"""Diamonds, lane dashes, and whatever else has four corners."""


def shape_of(kind: str) -> str:
    """The one of :data:`SHAPES` that a class with four corners has."""
    return kind if kind in SHAPES else SHAPES[-1]


def confidence(evidence: FloatArray, kinds: Sequence[str], ground: FloatArray) -> FloatArray:
    """Probability (M,) of each one's class.

    Args:
        evidence: (M, F), in the order of :data:`FEATURES`.
        kinds: the classes.
        ground: corners (M, 4, 2) on the ground, m.
    """
    alone, among = _fitted(CONFIDENCE_FILE)
    shapes = [shape_of(kind) for kind in kinds]
    odds = _odds(evidence, [alone[shape] for shape in shapes])
    return as_probability(_odds(told(odds, ground, kinds), [among[shape] for shape in shapes]))


def told(odds: FloatArray, ground: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """The features (M, 6) :data:`TOLD` of quadrilaterals, of the log odds (M,) that each has alone."""
    return np.column_stack([odds, company(ground, kinds, as_probability(odds))])


def as_probability(odds: FloatArray) -> FloatArray:
    """Of log odds, of which more than 30 either way are too many."""
    return np.asarray(1 / (1 + np.exp(-np.clip(odds, -30, 30))))


def _odds(features: FloatArray, fits: Sequence[_Fit]) -> FloatArray:
    """Log odds (M,) of features (M, F) by the fit that belongs to each."""
    weights, bias = zip(*fits, strict=True)
    return np.asarray((features * np.array(weights)).sum(axis=1) + np.array(bias))


@cache
def _fitted(path: Path) -> tuple[dict[str, _Fit], dict[str, _Fit]]:
    """Weights and bias of each shape, alone and among others."""
    fitted = json.loads(path.read_text(encoding="utf-8"))
    names = {"alone": FEATURES, "among": TOLD}
    alone, among = (
        {
            shape: (np.array([part["weights"][name] for name in names[asked]]), float(part["bias"]))
            for shape in SHAPES
            for part in (fitted[shape][asked],)
        }
        for asked in ("alone", "among")
    )
    return alone, among
