"""From the network's outputs to blobs of paint: what is connected, of which class, its soft outline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from v2hdm.detection.sight import Sight
from v2hdm.records import (
    ARROW,
    CHEVRON,
    CROSSWALK_BAR,
    DIAMOND,
    LANE_DASH,
    LANE_LINE,
    OTHER_PAINT,
    STOP_LINE,
    BoolArray,
    FloatArray,
)

_MIN_CELLS = 5
"""Blobs of fewer cells are noise: their outline is not worth four corners."""

_SPLIT_FRACTION = 0.15
"""Where a second group of classes holds this much of a blob, two markings touch."""

_GROUPS: tuple[tuple[str, ...], ...] = (
    (DIAMOND,),
    (LANE_DASH, LANE_LINE),
    (STOP_LINE,),
    (CROSSWALK_BAR,),
    (ARROW, CHEVRON, OTHER_PAINT),
)
"""Classes that are never split from each other: a dash that looks like a line here and there is one blob."""

_SYMBOLS = _GROUPS[-1]

_OUTLINE_SCALE = 4

_MAX_VOTES = 400
"""Cells of a blob that are asked for its class; more of them say nothing new."""


@dataclass(frozen=True)
class Blob:
    """One connected piece of paint.

    ``level`` (h, w) float32 is positive inside, its zero crossing is the soft outline; element
    (i, j) lies at recorded pixel ``origin_px + stride * (j, i)``. ``outline_px`` (N, 2) are the
    zero crossings between neighbouring elements, recorded px, in no order. ``class_score`` maps
    each class to its mean probability over the blob. ``touches_symbol`` says that it was split
    off a connected piece of paint another part of which is an arrow, a chevron or other paint.
    """

    class_score: dict[str, float]
    level: np.ndarray
    origin_px: FloatArray
    stride: int
    outline_px: FloatArray
    touches_symbol: bool = False

    @property
    def kind(self) -> str:
        """The likeliest class."""
        return max(self.class_score, key=self.class_score.__getitem__)


def find_blobs(
    sight: Sight, classes: Sequence[str], stride: int, top_px: int, reach_px: int = 0
) -> tuple[list[Blob], np.ndarray]:
    """Split the paint of one image into blobs.

    Args:
        sight: what the network says of a band of the image.
        classes: names of the channels of its ``kinds``.
        stride: recorded pixels per element of its ``paint``.
        top_px: image row at which the band starts.
        reach_px: image row; blobs that lie above it as a whole are too far away to be of use.

    Returns:
        The blobs, and a map (h, w) int16 with 1 + the index of the blob that covers each element of
        ``paint``, 0 for none.
    """
    framed_level = np.pad(sight.paint, 1, constant_values=-1.0)
    level = framed_level[1:-1, 1:-1]
    contours, _ = cv2.findContours((level > 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    owner = np.zeros(level.shape, dtype=np.int16)
    blobs: list[Blob] = []
    for contour in contours:
        if len(contour) < 4:
            continue
        x, y, w, h = cv2.boundingRect(contour)
        if stride * (y + h) + top_px < reach_px:
            continue
        filled = np.zeros((h, w), dtype=np.uint8)
        cv2.drawContours(filled, [contour], -1, 1, cv2.FILLED, offset=(-x, -y))
        inside = filled.view(np.bool_)
        box = (slice(y, y + h), slice(x, x + w))
        siblings: list[int] = []
        parts = _parts(inside, sight, box, classes)
        for mask, part_level, scores in parts:
            framed = framed_level[y : y + h + 2, x : x + w + 2].copy()
            framed[1:-1, 1:-1] = part_level
            origin_px = stride * np.array([x - 1.0, y - 1.0]) + (stride - 1) / 2 + [0.0, top_px]
            blobs.append(_make_blob(mask, framed, scores, classes, stride, origin_px))
            siblings.append(len(blobs) - 1)
            owner[box][mask] = len(blobs)
        if any(blobs[s].kind in _SYMBOLS for s in siblings):
            for s in siblings:
                blobs[s] = replace(blobs[s], touches_symbol=True)
    return blobs, owner


_Part = tuple[BoolArray, np.ndarray, np.ndarray]
"""A part's mask (h, w), its signed level (h, w), and the mean probability (K,) of each class in it."""


def _parts(inside: BoolArray, sight: Sight, box: tuple[slice, slice], classes: Sequence[str]) -> list[_Part]:
    """The parts of a blob that belong to different groups of classes; one where all of it is of one group."""
    level = sight.paint[box]
    if np.count_nonzero(inside) < _MIN_CELLS:
        return []
    probability = _class_probability(inside, sight, box)
    certainty = _certainty(inside, level)
    votes = np.bincount(probability.argmax(axis=0), minlength=len(classes))
    group_of = np.array([_group_index(name) for name in classes])
    share = np.array([votes[group_of == g].sum() for g in range(len(_GROUPS))]) / max(1, votes.sum())
    present = np.flatnonzero(share >= _SPLIT_FRACTION)
    if len(present) < 2:
        return [(inside, level, certainty * probability.mean(axis=1))]
    kinds = _kinds_at_full(sight, box)
    parts = []
    for group in present:
        mine = kinds[group_of == group].max(axis=0)
        rest = kinds[group_of != group].max(axis=0)
        group_level = np.minimum(level, mine - rest)
        count, labels = cv2.connectedComponents(((group_level > 0) & inside).astype(np.uint8))
        for label in range(1, count):
            mask = labels == label
            if np.count_nonzero(mask) >= _MIN_CELLS:
                own = _class_probability(mask, sight, box).mean(axis=1)
                parts.append((mask, group_level, _certainty(mask, level) * own))
    return parts


def _class_probability(mask: BoolArray, sight: Sight, box: tuple[slice, slice]) -> np.ndarray:
    """Probability (K, n) of each class at cells of the mask (h, w) that is placed at ``box``."""
    i, j = np.nonzero(mask)
    step = -(-len(i) // _MAX_VOTES)
    scale = sight.kind_scale
    rows = ((i[::step] + box[0].start) / scale).astype(np.intp)
    columns = ((j[::step] + box[1].start) / scale).astype(np.intp)
    logits = sight.kinds[:, rows, columns]
    odds = np.exp(logits - logits.max(axis=0))
    return np.asarray(odds / odds.sum(axis=0))


def _certainty(mask: BoolArray, level: np.ndarray) -> float:
    """Mean probability of paint where the mask (h, w) is."""
    return float((1 / (1 + np.exp(-np.clip(level[mask], -30, 30)))).mean())


def _kinds_at_full(sight: Sight, box: tuple[slice, slice]) -> np.ndarray:
    """Class logits (K, h, w), interpolated to the elements of ``paint`` in a box."""
    rows, columns = (np.arange(part.start, part.stop, dtype=np.float32) for part in box)
    scale = np.float32(sight.kind_scale)
    u, v = np.meshgrid((columns + 0.5) / scale - 0.5, (rows + 0.5) / scale - 0.5)
    return np.stack(
        [cv2.remap(plane, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in sight.kinds]
    )


def _group_index(name: str) -> int:
    return next(index for index, group in enumerate(_GROUPS) if name in group)


def _make_blob(
    mask: BoolArray,
    framed_level: np.ndarray,
    scores: np.ndarray,
    classes: Sequence[str],
    stride: int,
    origin_px: FloatArray,
) -> Blob:
    # Holes are filled and other blobs in the same box emptied, so that only this outline crosses zero.
    level = np.where(np.pad(mask, 1), np.maximum(framed_level, 1e-3), np.minimum(framed_level, -1e-3))
    return Blob(
        class_score=dict(zip(classes, scores.tolist(), strict=True)),
        level=level,
        origin_px=origin_px,
        stride=stride,
        outline_px=origin_px + stride * zero_crossings(level),
    )


def zero_crossings(level: np.ndarray) -> FloatArray:
    """Where a field (h, w) changes sign between neighbours: points (N, 2) as (column, row), interpolated."""
    points = []
    for axis in (0, 1):
        first = level[:-1] if axis == 0 else level[:, :-1]
        second = level[1:] if axis == 0 else level[:, 1:]
        i, j = np.nonzero((first > 0) != (second > 0))
        fraction = first[i, j] / (first[i, j] - second[i, j])
        points.append(np.column_stack([j, i + fraction] if axis == 0 else [j + fraction, i]))
    return np.concatenate(points).astype(np.float64)


def outline_polygon(blob: Blob) -> FloatArray:
    """The soft outline as a closed polygon (N, 2) in recorded px, to a fifth of an element."""
    fine = cv2.resize(blob.level, None, fx=_OUTLINE_SCALE, fy=_OUTLINE_SCALE, interpolation=cv2.INTER_LINEAR)
    contours, _ = cv2.findContours((fine > 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    longest = max(contours, key=len)
    polygon = cv2.approxPolyDP(longest, 0.2 * _OUTLINE_SCALE, closed=True).reshape(-1, 2)
    cells = (polygon + 0.5) / _OUTLINE_SCALE - 0.5
    return np.asarray(blob.origin_px + blob.stride * cells)
