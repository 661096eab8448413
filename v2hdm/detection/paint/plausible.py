"""What a blob can be, judged by its class scores and its size on the ground.

The initial IPM may be decimetres wrong, so sizes only rule out what is far off.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.both_sides import LONGEST_DASH_M
from v2hdm.detection.paint.blobs import Blob
from v2hdm.records import (
    ARROW,
    CHEVRON,
    CORNERED_CLASSES,
    CROSSWALK_BAR,
    DIAMOND,
    LANE_CLASSES,
    LANE_DASH,
    LANE_LINE,
    OTHER_PAINT,
    OUTLINED_CLASSES,
    STOP_LINE,
    FloatArray,
)

_SIZE_LIMITS_M: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    DIAMOND: ((0.25, 5.0), (0.1, 3.0)),
    LANE_DASH: ((0.7, LONGEST_DASH_M), (0.03, 0.8)),
    LANE_LINE: ((0.3, np.inf), (0.03, np.inf)),
    STOP_LINE: ((0.8, 25.0), (0.12, 1.2)),
    CROSSWALK_BAR: ((0.8, 10.0), (0.15, 1.2)),
    ARROW: ((0.6, 9.0), (0.1, 4.0)),
    CHEVRON: ((0.5, 20.0), (0.1, 10.0)),
}
"""Least and largest length and width of each class: road codes have no dash below 1 m, and
letters have strokes of half a metre. A line's box is wide where the line bends. Other paint is
not reported at all."""

_DASH_LENGTH_M = 7.5
_DASH_SHARE = 0.25
"""A piece of lane paint that ends at both sides, no longer than that, is a dash even if the network
gives only this share of its lane score to dashes: seen locally, dash and line are the same paint."""

_SURE_DASH_SHARE = 0.5
"""With more than this share what is too long for one dash is tried as several."""

_LEAST_RIVAL_SHARE = 0.05
"""With this share another class is tried, too: all evidence decides between them."""

_LEAST_SECOND_SHARE = 0.12
"""What the network takes for a symbol is tried as a quadrilateral if it leaves that class this share."""

_LEAST_ELONGATION = 3.0
"""Lane paint is at least this many times as long as wide; far diamonds look like dashes, but are not."""

_HEAD_REACH_M = 0.4
_HEAD_OVERLAP_M = 0.3
_HEAD_WIDENING = 1.7
"""The head of an arrow begins so far from the end of the shaft at most, and is so many times as wide."""

_BORDER_PX = 4.0


def plausible_kind(blob: Blob, outline_vehicle: FloatArray, view: CameraView) -> tuple[str, float] | None:
    """The likeliest class that the blob's size on the ground allows, with its score; None for none.

    Where it does not allow the likeliest of all, that is the likeliest with four corners; but letters, whose
    strokes are like other markings, stay letters.

    Args:
        blob: the blob.
        outline_vehicle: its outline on the ground (N, 2), m.
        view: its camera.
    """
    length_m, width_m = _ground_size(outline_vehicle)
    whole = is_whole(blob, view)
    if whole and length_m < _LEAST_ELONGATION * width_m:
        kind, score = _likeliest_compact(blob.class_score)
    else:
        kind, score = _likeliest(blob.class_score, whole and length_m <= _DASH_LENGTH_M)
    if kind == LANE_DASH and not _fits(LANE_DASH, length_m, width_m):
        kind = LANE_LINE
    if _fits(kind, length_m, width_m):
        return kind, score
    fitting = _fitting(blob, length_m, width_m) if whole and kind != OTHER_PAINT else []
    return (fitting[0], score) if fitting else None


def cornered_kind(blob: Blob, outline_vehicle: FloatArray, kind: str, view: CameraView) -> str | None:
    """The class as which a blob, taken for ``kind``, is tried as a quadrilateral; None for none.

    Short lane paint that ends at both sides may be a dash although the network says line, or, if shorter than
    any dash, a slim diamond: seen locally they are alike. What the network takes for a dash but is too long
    is several, or one that runs on along something else, and what it takes for an arrow or a chevron may be
    what it thinks next likely: its shape and the image will tell.
    """
    if kind in CORNERED_CLASSES:
        return kind
    length_m, width_m = _ground_size(outline_vehicle)
    if kind in OUTLINED_CLASSES:
        return _second_choice(blob, length_m, width_m) if is_whole(blob, view) else None
    lane_score = sum(blob.class_score.get(name, 0.0) for name in LANE_CLASSES)
    if length_m > LONGEST_DASH_M and blob.class_score.get(LANE_DASH, 0.0) > _SURE_DASH_SHARE * lane_score:
        return LANE_DASH
    if not is_whole(blob, view) or not length_m <= _DASH_LENGTH_M:
        return None
    if length_m < _SIZE_LIMITS_M[LANE_DASH][0][0]:
        return next(iter(_fitting(blob, length_m, width_m)), None)
    return LANE_DASH if _fits(LANE_DASH, length_m, width_m) else None


def rival_kinds(blob: Blob, outline_vehicle: FloatArray, kind: str, view: CameraView) -> list[str]:
    """The other classes with four corners that a quadrilateral, tried as ``kind``, may well be of."""
    if not is_whole(blob, view):
        return []
    least = _LEAST_RIVAL_SHARE * sum(blob.class_score.values())
    fitting = _fitting(blob, *_ground_size(outline_vehicle))
    return [name for name in fitting if name != kind and blob.class_score.get(name, 0.0) >= least]


def _fitting(blob: Blob, length_m: float, width_m: float) -> list[str]:
    """Classes with four corners that are of such a size and shape, the likeliest first."""
    slim = length_m >= _LEAST_ELONGATION * width_m
    fitting = [
        name
        for name in CORNERED_CLASSES
        if _fits(name, length_m, width_m) and (slim or name not in (LANE_DASH, STOP_LINE))
    ]
    return sorted(fitting, key=lambda name: -blob.class_score.get(name, 0.0))


def _second_choice(blob: Blob, length_m: float, width_m: float) -> str | None:
    """The likeliest class with four corners, if a blob that is not taken for it may well be of it."""
    slim = length_m >= _LEAST_ELONGATION * width_m
    share = {
        name: score
        for name, score in blob.class_score.items()
        if name in CORNERED_CLASSES and (name == LANE_DASH) == slim and _fits(name, length_m, width_m)
    }
    best = max(share, key=share.__getitem__, default=None)
    if best is None or blob.touches_symbol:
        return None
    return best if share[best] >= _LEAST_SECOND_SHARE * sum(blob.class_score.values()) else None


def is_whole(blob: Blob, view: CameraView) -> bool:
    """Whether a blob keeps off the image's border."""
    return bool(view.inside(blob.outline_px, _BORDER_PX).all())


class Heads:
    """What may be the heads of arrows: numbers of blobs, with their outlines (N, 2) on the ground, m."""

    def __init__(self, outlines_vehicle: Mapping[int, FloatArray]):
        known = {blob: outline[np.isfinite(outline[:, 0])] for blob, outline in outlines_vehicle.items()}
        self._blobs = [blob for blob, outline in known.items() if len(outline) >= 3]
        self._outlines = [known[blob] for blob in self._blobs]
        self._low = np.array([outline.min(axis=0) for outline in self._outlines]).reshape(-1, 2)
        self._high = np.array([outline.max(axis=0) for outline in self._outlines]).reshape(-1, 2)

    def within(self, centre: FloatArray, reach_m: float) -> list[tuple[int, FloatArray]]:
        """Those whose bounding box comes within a square of half the side ``reach_m``."""
        near = ((self._low < centre + reach_m) & (self._high > centre - reach_m)).all(axis=1)
        return [(self._blobs[k], self._outlines[k]) for k in np.flatnonzero(near)]


def head_of(outline_vehicle: FloatArray, heads_vehicle: Heads) -> int | None:
    """The blob that may be the head of an arrow of which a dash is the shaft; None for none.

    A head begins where the shaft ends, astride its axis, and is much wider.

    Args:
        outline_vehicle: outline (N, 2) of the dash on the ground, m.
        heads_vehicle: what may be heads.
    """
    points = outline_vehicle[np.isfinite(outline_vehicle).all(axis=1)]
    if len(points) < 3:
        return None
    centre, size, _ = box = cv2.minAreaRect(points.astype(np.float32))
    corners = cv2.boxPoints(box).astype(np.float64)
    sides = np.roll(corners, -1, axis=0) - corners
    axis = sides[int(np.argmax(np.linalg.norm(sides[:2], axis=1)))]
    axis = axis / np.linalg.norm(axis)
    half_m, width_m = max(size) / 2, min(size)
    across = np.array([-axis[1], axis[0]])
    for blob, head in heads_vehicle.within(np.array(centre), half_m + width_m + _HEAD_REACH_M):
        offset = head - np.array(centre)
        along, beside = np.abs(offset @ axis) - half_m, offset @ across
        begins = -_HEAD_OVERLAP_M < along.min() < _HEAD_REACH_M
        if begins and beside.min() < 0 < beside.max() and np.ptp(beside) > _HEAD_WIDENING * width_m:
            return blob
    return None


def _likeliest(class_score: dict[str, float], short: bool) -> tuple[str, float]:
    """The best class, lane classes taken together first; ``short`` paint is rather a dash than a line."""
    lane_score = sum(class_score.get(name, 0.0) for name in LANE_CLASSES)
    others = {name: score for name, score in class_score.items() if name not in LANE_CLASSES}
    best_other = max(others, key=others.__getitem__, default="")
    if best_other and others[best_other] >= lane_score:
        return best_other, others[best_other]
    dash_share = class_score.get(LANE_DASH, 0.0) / max(lane_score, 1e-9)
    return (LANE_DASH if dash_share > (_DASH_SHARE if short else _SURE_DASH_SHARE) else LANE_LINE), lane_score


def _likeliest_compact(class_score: dict[str, float]) -> tuple[str, float]:
    """The best class but lanes, which its shape rules out; their score is paint, so the best takes it."""
    lane_score = sum(class_score.get(name, 0.0) for name in LANE_CLASSES)
    others = {name: score for name, score in class_score.items() if name not in LANE_CLASSES}
    best = max(others, key=others.__getitem__, default=LANE_LINE)
    return best, others.get(best, 0.0) + lane_score


def _fits(kind: str, length_m: float, width_m: float) -> bool:
    if kind not in _SIZE_LIMITS_M:
        return False
    length, width = _SIZE_LIMITS_M[kind]
    return bool(length[0] <= length_m <= length[1] and width[0] <= width_m <= width[1])


def _ground_size(outline_vehicle: FloatArray) -> tuple[float, float]:
    """Length and width (m) of the smallest rectangle around the points on the ground (N, 2)."""
    points = outline_vehicle[np.isfinite(outline_vehicle).all(axis=1)]
    if len(points) < 3:
        return np.nan, np.nan
    _, size, _ = cv2.minAreaRect(points.astype(np.float32))
    return float(max(size)), float(min(size))
