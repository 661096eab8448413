"""TuSimple's own figures for lanes: accuracy, false positives and negatives.

As its ``evaluate/lane.py`` has them. Lanes are columns on the rows 160, 170, ... 710 of an image of
1280 x 720, a negative number where there is none. A point is right within 20 px, widened by the line's
slope; one that is rightly left out counts as right.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from v2hdm.records import FloatArray

ROWS = np.arange(160.0, 720.0, 10.0)
_WIDTH = 1280
_TOLERANCE_PX = 20.0
_MATCH = 0.85
_ABSENT = -100.0
_LANES_JUDGED = 4


class TuSimple(NamedTuple):
    """One image's figures, each from 0 to 1."""

    accuracy: float
    false_positive: float
    false_negative: float


def columns(line_px: FloatArray) -> FloatArray:
    """A line (N, 2) of pixels on :data:`ROWS`, in TuSimple's way."""
    order = np.argsort(line_px[:, 1])
    u = np.interp(ROWS, line_px[order, 1], line_px[order, 0], left=_ABSENT, right=_ABSENT)
    return np.where((u >= 0) & (u < _WIDTH), u, _ABSENT)


def judge(truth_px: list[FloatArray], given_px: list[FloatArray]) -> TuSimple | None:
    """The figures of one image; None where it has no lanes, of which TuSimple has no images."""
    truth = [u for line in truth_px if ((u := columns(line)) >= 0).sum() > 1]
    answered = [u for line in given_px if ((u := columns(line)) >= 0).any()]
    if not truth:
        return None
    if len(answered) > len(truth) + 2:
        return TuSimple(0.0, 0.0, 1.0)
    right = sorted((_best(line, answered) for line in truth), reverse=True)
    matched = sum(share >= _MATCH for share in right)
    missed = len(truth) - matched
    if len(truth) > _LANES_JUDGED:
        missed -= missed > 0
        right = right[:-1]
    judged = min(_LANES_JUDGED, len(truth))
    false = (len(answered) - matched) / len(answered) if answered else 0.0
    return TuSimple(sum(right) / judged, false, missed / judged)


def _best(line: FloatArray, answered: list[FloatArray]) -> float:
    """The share of rows on which the best of the given lines is right."""
    has_line = line >= 0
    slope = np.polyfit(ROWS[has_line], line[has_line], 1)[0]
    tolerance = _TOLERANCE_PX * np.hypot(1, slope)
    return max((float((np.abs(u - line) < tolerance).mean()) for u in answered), default=0.0)
