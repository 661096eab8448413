"""Mapped words, boxes, crosswalks and double lines against ground truth, for ``metrics.json``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from v2hdm.catalogue import AREAS
from v2hdm.geometry.planar import clip_convex, signed_area
from v2hdm.records import DOUBLE_LINE, TEXT, BoolArray, FloatArray, HDMap, Symbol, Truth
from v2hdm.report.metrics import LATERAL_GATE_M, SAMPLE_STEP_M, distance_to_points, resample, runs

LEAST_IOU = 0.3  # least intersection over union of a mapped area and a true one that are the same


@dataclass(frozen=True)
class AreaMetrics:
    """Mapped areas of one class against the true ones; nan without matches."""

    areas: int
    false_areas: int  # without a true counterpart
    expected: int  # true ones driven past within the region of interest
    recall: float  # mapped fraction of these
    median_iou: float


@dataclass(frozen=True)
class TextMetrics(AreaMetrics):
    """Mapped words against the true ones whose text is known."""

    readable: int  # mapped, and the truth knows what they say
    read: float  # fraction of these that were read right


@dataclass(frozen=True)
class DoubleMetrics:
    """Mapped double lines against the true ones."""

    length_m: float
    mapped_fraction: float  # of the visible true length, with a mapped double line near
    false_length_m: float  # mapped without a true double line near


def area_figures(hd_map: HDMap, truth: Truth, expected: BoolArray) -> dict[str, Any]:
    """Figures of the areas by class, and of double lines; ``expected`` (S,) are the symbols driven past."""
    figures = {kind: asdict(area_metrics(hd_map, truth, expected, kind)) for kind in AREAS}
    return figures | {DOUBLE_LINE: asdict(double_metrics(hd_map, truth))}


def area_metrics(hd_map: HDMap, truth: Truth, expected: BoolArray, kind: str) -> AreaMetrics:
    """Compare areas of ``kind`` with the truth; see :class:`AreaMetrics`, for words :class:`TextMetrics`."""
    mapped = [symbol for symbol in hd_map.symbols if symbol.kind == kind]
    number = [k for k, symbol in enumerate(truth.map.symbols) if symbol.kind == kind]
    iou = _overlaps(mapped, [truth.map.symbols[k] for k in number])
    rows, columns = linear_sum_assignment(-iou)
    is_match = iou[rows, columns] >= LEAST_IOU
    rows = rows[is_match]
    columns = columns[is_match]
    is_mapped = np.zeros(len(number), dtype=bool)
    is_mapped[columns] = True
    is_expected = expected[number]
    counted = AreaMetrics(
        areas=len(mapped),
        false_areas=len(mapped) - len(rows),
        expected=int(is_expected.sum()),
        recall=float(is_mapped[is_expected].mean()) if is_expected.any() else float("nan"),
        median_iou=float(np.median(iou[rows, columns])) if len(rows) else float("nan"),
    )
    if kind != TEXT:
        return counted
    words = [
        (mapped[row], truth.texts.get(number[column])) for row, column in zip(rows, columns, strict=True)
    ]
    right = [
        symbol.reading is not None and symbol.reading.text == text
        for symbol, text in words
        if text is not None
    ]
    return TextMetrics(
        **asdict(counted), readable=len(right), read=float(np.mean(right)) if right else np.nan
    )


def double_metrics(hd_map: HDMap, truth: Truth) -> DoubleMetrics:
    """Compare double lines with the truth; see :class:`DoubleMetrics`."""
    mapped = [lane.points_map for lane in hd_map.lanes if lane.kind == DOUBLE_LINE]
    pairs = zip(truth.map.lanes, truth.lane_visible, strict=True)
    true = [(lane.points_map, visible) for lane, visible in pairs if lane.kind == DOUBLE_LINE]
    visible_map = _sampled([piece for points, visible in true for piece in runs(points, visible)])
    mapped_map = _sampled(mapped)
    covered = _is_near(visible_map, mapped_map)
    false = ~_is_near(mapped_map, _sampled([points for points, _ in true]))
    return DoubleMetrics(
        length_m=len(mapped_map) * SAMPLE_STEP_M,
        mapped_fraction=float(covered.mean()) if len(covered) else float("nan"),
        false_length_m=float(false.sum() * SAMPLE_STEP_M),
    )


def _overlaps(mapped: Sequence[Symbol], true: Sequence[Symbol]) -> FloatArray:
    """Intersection over union (N, M) of convex outlines."""
    iou = np.zeros((len(mapped), len(true)))
    for row, column in np.ndindex(*iou.shape):
        first, second = (_counter_clockwise(symbol.outline_map) for symbol in (mapped[row], true[column]))
        if np.linalg.norm(first.mean(axis=0) - second.mean(axis=0)) > np.ptp(first, axis=0).max() * 2:
            continue
        part = clip_convex(first, second)
        shared = float(signed_area(part)) if len(part) > 2 else 0.0
        iou[row, column] = shared / (float(signed_area(first)) + float(signed_area(second)) - shared)
    return iou


def _counter_clockwise(outline: FloatArray) -> FloatArray:
    return outline if signed_area(outline) > 0 else outline[::-1]


def _sampled(lines: Sequence[FloatArray]) -> FloatArray:
    """Points (N, 2) along lines."""
    return np.concatenate([np.empty((0, 2)), *map(resample, lines)])


def _is_near(points: FloatArray, lines: FloatArray) -> BoolArray:
    """Which points (N,) are near those (M, 2) of lines."""
    if not len(points) or not len(lines):
        return np.zeros(len(points), dtype=np.bool_)
    return distance_to_points(points, lines) <= LATERAL_GATE_M
