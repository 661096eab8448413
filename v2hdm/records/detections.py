"""Markings and lanes that were detected in an image."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from v2hdm.records.arrays import BoolArray, FloatArray

OUTLINE_SIGMA_PX = 2.5
"""Standard deviation, px, of the network's outline of a marking from its paint's edge; 1 to 3 on renders."""


@dataclass(frozen=True)
class MarkingDetection:
    """One quadrilateral marking, or symbol, in one image.

    ``corners_px`` (4, 2) run counter-clockwise as seen from above, and so on the screen, from any first one.
    ``covariance_px`` (8, 8), px^2, of the stacked corners (u0, v0, u1, ...) is large in a direction that the
    image hides, as along a dash whose end lies beyond the border; ``corner_valid`` (4,) flags corners known
    well in every direction. Symbols such as arrows have corners of nan and a polygon ``outline_px`` (N, 2),
    empty otherwise; ``outline_seen`` (N,) flags its sides, each to the next point, along an edge of paint.
    """

    kind: str
    score: float
    corners_px: FloatArray
    covariance_px: FloatArray
    corner_valid: BoolArray
    outline_px: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    outline_seen: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))


@dataclass(frozen=True)
class LaneDetection:
    """A centre line in one image."""

    kind: str  # of one piece of lane paint, or :data:`LANE_BOUNDARY` for a whole line
    score: float
    points_px: FloatArray  # (N, 2), near to far
    identity: int | None = None  # of whole lines: 1, 2, ... to the left, -1, -2, ... to the right
    sigma_px: FloatArray | None = None  # (N,) along the image row


@dataclass(frozen=True)
class ImageDetections:
    """The detections in image ``i`` of a drive (an index into ``Drive.images``)."""

    image: int
    markings: tuple[MarkingDetection, ...]
    lanes: tuple[LaneDetection, ...]
