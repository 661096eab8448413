"""Crosswalks in an image: rows of bars, which make each other likelier.

From afar, and over a camera whose mounting is known about, a bar by itself shows little. But hardly anything
other than a crosswalk shows paint that the network names so in an even row of alike quadrilaterals.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.network import as_log_odds, as_probability
from v2hdm.geometry.rows import IN_IMAGE, LEAST_BARS, rows_of_bars
from v2hdm.records import CROSSWALK, CROSSWALK_BAR, BoolArray, FloatArray, MarkingDetection

FEATURES = ("row", "alone", "bars")
"""Features of a bar in a row: 1; its log odds alone; log of the row's number of bars over the least."""

FITTED = (1.87, 0.19, 3.04)
"""Weights of the features, fitted to photographs and renders by ``python -m train.fit_crosswalks``."""

LEAST_NAMED = 0.5  # least share of a bar's paint that the network names so, for a place in a row


def row_features(score: FloatArray) -> FloatArray:
    """The :data:`FEATURES` (N, F) of the bars of a row, whose probability alone is ``score`` (N,)."""
    alone = as_log_odds(score)
    bars = np.full(len(alone), np.log(len(alone) / LEAST_BARS))
    return np.column_stack([np.ones(len(alone)), alone, bars])


def in_rows(score: FloatArray, ground: FloatArray, is_bar: BoolArray) -> FloatArray:
    """The probabilities ``score`` (N,) of quadrilaterals, given the rows that some of them are in.

    ``ground`` (N, 4, 2) are corners, m, NaN above the horizon; ``is_bar`` (N,) tells which may be bars.
    """
    candidates = np.flatnonzero(is_bar & np.isfinite(ground).all(axis=(1, 2)))
    raised = score.copy()
    for row in rows_of_bars(ground[candidates], IN_IMAGE):
        members = candidates[row]
        raised[members] = as_probability(row_features(score[members]) @ np.array(FITTED))
    return raised


def find_crosswalks(
    markings: Sequence[MarkingDetection], camera: RoadCamera
) -> list[tuple[MarkingDetection, tuple[int, ...]]]:
    """The crosswalks of an image's bars, each with the hull ``outline_px`` and the indices of its bars."""
    bars = [k for k, marking in enumerate(markings) if marking.kind == CROSSWALK_BAR]
    ground = camera.unproject(np.array([markings[k].corners_px for k in bars]).reshape(-1, 4, 2))
    on_ground = np.flatnonzero(np.isfinite(ground).all(axis=(1, 2)))
    crosswalks = []
    for row in rows_of_bars(ground[on_ground], IN_IMAGE):
        parts = tuple(bars[k] for k in on_ground[row].tolist())
        corners_px = np.concatenate([markings[k].corners_px for k in parts])
        outline_px = corners_px[cv2.convexHull(corners_px.astype(np.float32), returnPoints=False).ravel()]
        crosswalk = MarkingDetection(
            kind=CROSSWALK,
            score=float(np.mean([markings[k].score for k in parts])),
            corners_px=np.full((4, 2), np.nan),
            covariance_px=np.full((8, 8), np.nan),
            corner_valid=np.zeros(4, dtype=np.bool_),
            outline_px=outline_px,
            outline_seen=np.ones(len(outline_px), dtype=np.bool_),
        )
        crosswalks.append((crosswalk, parts))
    return crosswalks
