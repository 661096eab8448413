"""The judge: how probable it is that a quadrilateral is a whole marking, and which of its sides to trust.

It is asked twice. First of each reading alone: the network in ``judge.onnx`` gets the :mod:`.evidence` and
the view of the quadrilateral in its own frame (:mod:`.rectified`). It answers with log odds, and with how far
each side may be off for reasons that the fit's residuals do not show: worn ends, seams along a side, shadows,
something in front. Then of each among the others of its image: a logistic function of :mod:`.context`, whose
weights are in ``confidence.json``. Both files belong to the paint network beside them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.detection.markings.context import COMPANY, company
from v2hdm.detection.network import open_session
from v2hdm.detection.odds import as_probability
from v2hdm.detection.weights import CONFIDENCE_FILE, JUDGE_FILE
from v2hdm.records import DIAMOND, LANE_DASH, FloatArray

JUDGE_INPUTS = ("views", "evidence", "shape")
JUDGE_OUTPUTS = ("odds", "log_side_sigma")

_Fit = tuple[FloatArray, float]
"""Weights (F,) and bias of a logistic function."""

TOLD = ("alone", *COMPANY)
"""What a quadrilateral is judged by among others: its own log odds, and what the others say."""

SHAPES = (DIAMOND, LANE_DASH, "bar")
"""Diamonds, lane dashes, and whatever else has four corners."""


def shape_of(kind: str) -> str:
    """The one of :data:`SHAPES` that a class with four corners has."""
    return kind if kind in SHAPES else SHAPES[-1]


def judge_alone(
    evidence: FloatArray, views: np.ndarray, kinds: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Log odds (R,) of each reading, and how far each of its sides may be off, px, (R, 4).

    Args:
        evidence: (R, F), in the order of :data:`~v2hdm.detection.markings.evidence.FEATURES`.
        views: (R, C, S, S) float32 of :mod:`v2hdm.detection.markings.rectified`; sides are in their order.
        kinds: the classes.
    """
    given = (views, evidence.astype(np.float32), one_hot(kinds))
    odds, log_sigma = _session(JUDGE_FILE).run(
        list(JUDGE_OUTPUTS), dict(zip(JUDGE_INPUTS, given, strict=True))
    )
    return odds.astype(np.float64), np.exp(log_sigma.astype(np.float64))


def judge_among(odds: FloatArray, ground: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """Probability (R,) of readings that alone have such log odds (R,), all those of an image.

    Args:
        odds: (R,) of :func:`judge_alone`.
        ground: corners (R, 4, 2) on the ground, m.
        kinds: the classes.
    """
    fitted = _fitted(CONFIDENCE_FILE)
    weights, bias = zip(*(fitted[shape_of(kind)] for kind in kinds), strict=True)
    return as_probability((told(odds, ground, kinds) * np.array(weights)).sum(axis=1) + np.array(bias))


def one_hot(kinds: Sequence[str]) -> np.ndarray:
    """Which of the :data:`SHAPES` each class has: (R, 3) float32, 1 there and else 0."""
    return np.eye(len(SHAPES), dtype=np.float32)[[SHAPES.index(shape_of(kind)) for kind in kinds]]


def told(odds: FloatArray, ground: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """The features (R, 6) :data:`TOLD` of readings, of the log odds (R,) that each has alone."""
    return np.column_stack([odds, company(ground, kinds, as_probability(odds))])


@cache
def _session(path: Path) -> Any:
    return open_session(path, threads=1)


@cache
def _fitted(path: Path) -> dict[str, _Fit]:
    """Weights and bias of each shape among others."""
    fitted = json.loads(path.read_text(encoding="utf-8"))
    return {
        shape: (np.array([part["weights"][name] for name in TOLD]), float(part["bias"]))
        for shape, part in fitted.items()
    }
