"""Which of several readings of the same paint to believe."""

from __future__ import annotations

import cv2
import numpy as np

from v2hdm.detection.corners.quad import signed_area
from v2hdm.records import BoolArray, FloatArray

_SHARED = 0.3
"""Two quadrilaterals are of the same paint if they share so much of the smaller one."""


def surest_readings(corners_px: FloatArray, plane: np.ndarray, score: FloatArray) -> BoolArray:
    """Which (M,) of the quadrilaterals (M, 4, 2) no surer one of another ``plane`` (M,) contradicts.

    Those of one plane are of different blobs. Of equals the first is believed.
    """
    stay = np.ones(len(score), dtype=np.bool_)
    if not plane.any():
        return stay
    quads = np.nan_to_num(corners_px).astype(np.float32)
    low, high = quads.min(axis=1), quads.max(axis=1)
    area = np.abs(signed_area(np.nan_to_num(corners_px)))
    meet = ((low[:, None] < high) & (high[:, None] > low)).all(axis=2) & (plane[:, None] != plane)
    order = np.argsort(-score, kind="stable").tolist()
    for rank, first in enumerate(order):
        if not stay[first]:
            continue
        for second in order[rank + 1 :]:
            if stay[second] and meet[first, second]:
                shared, _ = cv2.intersectConvexConvex(quads[first], quads[second])
                stay[second] = shared < _SHARED * min(area[first], area[second])
    return stay
