"""How probable it is that a quadrilateral is a whole marking of its class.

It is asked twice. First of each one alone: the network in ``judge.onnx`` gets what was measured of it and
what it looks like. Then of each among the others, as probable as they were alone: a logistic function of what
they say of it, whose weights are in ``confidence.json``. Both belong to the paint network beside them;
``python -m train.fit_judge`` fits them to renders which no benchmark shows. What speaks
for a diamond does not speak for a dash, so each of the :data:`SHAPES` has its own weights.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.detection.corners.company import COMPANY, company
from v2hdm.detection.network import open_session
from v2hdm.detection.odds import as_probability
from v2hdm.detection.weights import CONFIDENCE_FILE, JUDGE_FILE
from v2hdm.records import DIAMOND, LANE_DASH, FloatArray

JUDGE_INPUTS = ("views", "evidence", "shape")

_Fit = tuple[FloatArray, float]
"""Weights (F,) and bias of a logistic function."""

TOLD = ("alone", *COMPANY)
"""What a quadrilateral is judged by among others: its own log odds, and what the others say."""

SHAPES = (DIAMOND, LANE_DASH, "bar")
"""Diamonds, lane dashes, and whatever else has four corners."""


def shape_of(kind: str) -> str:
    """The one of :data:`SHAPES` that a class with four corners has."""
    return kind if kind in SHAPES else SHAPES[-1]


def confidence(
    evidence: FloatArray, views: np.ndarray, kinds: Sequence[str], ground: FloatArray
) -> FloatArray:
    """Probability (M,) of each one's class.

    Args:
        evidence: (M, F), in the order of :data:`~v2hdm.detection.corners.evidence.FEATURES`.
        views: (M, C, S, S) float32, what each one looks like: :mod:`v2hdm.detection.corners.rectified`.
        kinds: the classes.
        ground: corners (M, 4, 2) on the ground, m.
    """
    given = (views, evidence.astype(np.float32), one_hot(kinds))
    odds = _judge(JUDGE_FILE).run(None, dict(zip(JUDGE_INPUTS, given, strict=True)))[0].astype(np.float64)
    fitted = _fitted(CONFIDENCE_FILE)
    return as_probability(_odds(told(odds, ground, kinds), [fitted[shape_of(kind)] for kind in kinds]))


def one_hot(kinds: Sequence[str]) -> np.ndarray:
    """Which of the :data:`SHAPES` each class has: (M, 3) float32, 1 there and else 0."""
    return np.eye(len(SHAPES), dtype=np.float32)[[SHAPES.index(shape_of(kind)) for kind in kinds]]


def told(odds: FloatArray, ground: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """The features (M, 6) :data:`TOLD` of quadrilaterals, of the log odds (M,) that each has alone."""
    return np.column_stack([odds, company(ground, kinds, as_probability(odds))])


def _odds(features: FloatArray, fits: Sequence[_Fit]) -> FloatArray:
    """Log odds (M,) of features (M, F) by the fit that belongs to each."""
    weights, bias = zip(*fits, strict=True)
    return np.asarray((features * np.array(weights)).sum(axis=1) + np.array(bias))


@cache
def _judge(path: Path) -> Any:
    return open_session(path, threads=1)


@cache
def _fitted(path: Path) -> dict[str, _Fit]:
    """Weights and bias of each shape among others."""
    fitted = json.loads(path.read_text(encoding="utf-8"))
    return {
        shape: (np.array([part["weights"][name] for name in TOLD]), float(part["bias"]))
        for shape, part in fitted.items()
    }
