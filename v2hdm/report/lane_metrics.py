"""How well mapped lane lines cover the true ones, and how far they lie beside them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.records import BoolArray, FloatArray, Lane, Truth

SAMPLE_STEP_M = 0.1
"""Polylines are compared at points this far apart."""

LATERAL_GATE_M = 0.3
"""A mapped lane this near to a true one maps it."""


@dataclass(frozen=True)
class LaneMetrics:
    """Mapped lane lines against the true ones.

    ``mean_lateral_error_m`` is over the mapped length that lies within :data:`LATERAL_GATE_M` of a
    true line, ``mapped_fraction`` the share of the visible true length with a mapped line that
    near, ``false_length_m`` the mapped length without a true line beside it.
    """

    lanes: int
    length_m: float
    mean_lateral_error_m: float
    mapped_fraction: float
    false_length_m: float


def lane_metrics(lanes: Sequence[Lane], truth: Truth) -> LaneMetrics:
    """Compare mapped lanes with the truth; see :class:`LaneMetrics`."""
    true_all = _stack(resample(lane.points_map) for lane in truth.map.lanes)
    true_visible = _stack(
        resample(piece)
        for lane, visible in zip(truth.map.lanes, truth.lane_visible, strict=True)
        for piece in _runs(lane.points_map, visible)
    )
    mapped = _stack(resample(lane.points_map) for lane in lanes)
    if not len(mapped) or not len(true_all):
        return LaneMetrics(
            len(lanes), len(mapped) * SAMPLE_STEP_M, float("nan"), 0.0, len(mapped) * SAMPLE_STEP_M
        )
    lateral = distance_to_points(mapped, true_all)
    near = lateral <= LATERAL_GATE_M
    covered = distance_to_points(true_visible, mapped) <= LATERAL_GATE_M
    return LaneMetrics(
        lanes=len(lanes),
        length_m=len(mapped) * SAMPLE_STEP_M,
        mean_lateral_error_m=float(lateral[near].mean()) if near.any() else float("nan"),
        mapped_fraction=float(covered.mean()) if len(covered) else float("nan"),
        false_length_m=float((~near).sum() * SAMPLE_STEP_M),
    )


def resample(points: FloatArray, step_m: float = SAMPLE_STEP_M) -> FloatArray:
    """Points (M, 2) every ``step_m`` along a polyline (N, 2), its first point included."""
    if len(points) < 2:
        return points
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.arange(0.0, along[-1] + 1e-9, step_m)
    return np.column_stack([np.interp(at, along, points[:, 0]), np.interp(at, along, points[:, 1])])


def distance_to_points(points: FloatArray, line: FloatArray) -> FloatArray:
    """Distance (N,) of points to a densely sampled line, the samples joined by their tangent.

    The two nearest samples span the local line, so the result is lateral to far below the
    sampling step.
    """
    if not len(points):
        return np.empty(0)
    if len(line) < 2:
        return np.asarray(np.linalg.norm(points - line[0], axis=1))
    distance, nearest = cKDTree(line).query(points, k=2)
    first, second = line[nearest[:, 0]], line[nearest[:, 1]]
    span = second - first
    length2 = np.maximum((span**2).sum(axis=1), 1e-18)
    share = np.clip(((points - first) * span).sum(axis=1) / length2, 0.0, 1.0)
    # Samples of two different lines are farther apart than a step: do not join those.
    joined = np.sqrt(length2) <= 1.5 * SAMPLE_STEP_M
    lateral = np.linalg.norm(points - (first + share[:, None] * span), axis=1)
    return np.asarray(np.where(joined, lateral, distance[:, 0]))


def _runs(points: FloatArray, keep: BoolArray) -> list[FloatArray]:
    """The maximal stretches of a polyline whose vertices are all kept."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], keep.astype(int), [0]])))
    return [points[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 2]


def _stack(pieces: Iterable[FloatArray]) -> FloatArray:
    arrays = [piece for piece in pieces if len(piece)]
    return np.concatenate(arrays) if arrays else np.empty((0, 2))
