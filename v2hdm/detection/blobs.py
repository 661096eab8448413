"""From logits to blobs of paint: what is connected, of which class, and its soft outline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from v2hdm.records import DIAMOND, LANE_DASH, LANE_LINE, OTHER_PAINT, BoolArray, FloatArray

_MIN_CELLS = 5
"""Blobs of fewer logits are noise: their outline is not worth four corners."""

_SPLIT_FRACTION = 0.15
"""Where a second group of classes holds this much of a blob, two markings touch."""

_GROUPS: tuple[tuple[str, ...], ...] = ((DIAMOND,), (LANE_DASH, LANE_LINE))
"""Classes that are never split from each other: a dash that looks like a line here and there is one blob."""


@dataclass(frozen=True)
class Blob:
    """One connected piece of paint.

    ``level`` (h, w) float32 is positive inside, its zero crossing is the soft outline; element
    (i, j) lies at recorded pixel ``origin_px + stride * (j, i)``. ``outline_px`` (N, 2) are the
    zero crossings between neighbouring elements, recorded px, in no order. ``class_score`` maps
    each class to its mean probability over the blob. ``touches_other_paint`` says that it was split
    off a connected piece of paint another part of which is other paint, such as the head of an arrow.
    """

    class_score: dict[str, float]
    level: np.ndarray
    origin_px: FloatArray
    stride: int
    outline_px: FloatArray
    touches_other_paint: bool = False

    @property
    def kind(self) -> str:
        """The likeliest class."""
        return max(self.class_score, key=self.class_score.__getitem__)


def foreground_level(logits: np.ndarray) -> np.ndarray:
    """Log odds (h, w) of paint of any class against background, from logits (C, h, w)."""
    odds = cv2.exp(np.minimum(logits[1] - logits[0], 30.0))
    for logit in logits[2:]:
        odds += cv2.exp(np.minimum(logit - logits[0], 30.0))
    return np.asarray(cv2.log(odds))


def find_blobs(
    logits: np.ndarray, classes: Sequence[str], stride: int, top_px: int
) -> tuple[list[Blob], np.ndarray]:
    """Split the paint of one image into blobs.

    Args:
        logits: (C, h, w) float32, background first.
        classes: names of the paint channels.
        stride: recorded pixels per logit.
        top_px: image row at which the logits' band starts.

    Returns:
        The blobs, and a map (h, w) int16 with 1 + the index of the blob that covers each logit, 0
        for none.
    """
    framed_level = np.pad(foreground_level(logits), 1, constant_values=-1.0)
    level = framed_level[1:-1, 1:-1]
    contours, _ = cv2.findContours((level > 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    owner = np.zeros(level.shape, dtype=np.int16)
    blobs: list[Blob] = []
    for contour in contours:
        if len(contour) < 4:
            continue
        x, y, w, h = cv2.boundingRect(contour)
        inside = np.zeros((h, w), dtype=np.uint8)
        cv2.drawContours(inside, [contour], -1, 1, cv2.FILLED, offset=(-x, -y))
        box = (slice(y, y + h), slice(x, x + w))
        local_logits, local_level = logits[(slice(None), *box)], level[box]
        siblings: list[int] = []
        parts = _split_by_group(inside.astype(bool), local_logits, local_level, classes)
        for mask, part_level in parts:
            if np.count_nonzero(mask) < _MIN_CELLS:
                continue
            framed = framed_level[y : y + h + 2, x : x + w + 2].copy()
            framed[1:-1, 1:-1] = part_level
            origin_px = stride * np.array([x - 1.0, y - 1.0]) + (stride - 1) / 2 + [0.0, top_px]
            blobs.append(_make_blob(mask, framed, local_logits, classes, stride, origin_px))
            siblings.append(len(blobs) - 1)
            owner[box][mask] = len(blobs)
        if any(blobs[s].kind == OTHER_PAINT for s in siblings):
            for s in siblings:
                blobs[s] = replace(blobs[s], touches_other_paint=True)
    return blobs, owner


def _split_by_group(
    inside: BoolArray, logits: np.ndarray, level: np.ndarray, classes: Sequence[str]
) -> list[tuple[BoolArray, np.ndarray]]:
    """The parts of a blob that belong to different groups of classes, each with its own signed level."""
    votes = np.bincount(logits[1:].argmax(axis=0)[inside], minlength=len(classes))
    group_of = np.array([_group_index(name) for name in classes])
    groups = np.unique(group_of)
    share = np.array([votes[group_of == g].sum() for g in groups]) / max(1, votes.sum())
    present = groups[share >= _SPLIT_FRACTION]
    if len(present) < 2:
        return [(inside, level)]
    parts = []
    for group in present:
        mine = logits[1:][group_of == group].max(axis=0)
        rest = logits[1:][group_of != group].max(axis=0)
        group_level = np.minimum(level, mine - rest)
        count, labels = cv2.connectedComponents(((group_level > 0) & inside).astype(np.uint8))
        parts += [(labels == label, group_level) for label in range(1, count)]
    return parts


def _group_index(name: str) -> int:
    for index, group in enumerate(_GROUPS):
        if name in group:
            return index
    return len(_GROUPS)


def _make_blob(
    mask: BoolArray,
    framed_level: np.ndarray,
    logits: np.ndarray,
    classes: Sequence[str],
    stride: int,
    origin_px: FloatArray,
) -> Blob:
    cells = logits[:, mask]
    cells = np.exp(cells - cells.max(axis=0))
    probability = (cells / cells.sum(axis=0)).mean(axis=1)
    # Holes are filled and other blobs in the same box emptied, so that only this outline crosses zero.
    level = np.where(np.pad(mask, 1), np.maximum(framed_level, 1e-3), np.minimum(framed_level, -1e-3))
    return Blob(
        class_score={name: float(probability[c + 1]) for c, name in enumerate(classes)},
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
