"""The network's target outputs for a labelled image, at the resolution of each output."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from skimage.measure import label
from torch import Tensor

from models.marking_net import KIND_STRIDE, LANE_STRIDE, PAINT_STRIDE
from train.labels_image import PAINT_ONLY
from train.scenes.scenes import TrainingSample
from v2hdm.records import FloatArray

IGNORE = 255
"""Marks elements that carry no loss."""

_FULL_SIZE = 64
"""A piece of paint of so many cells of 4 px is a near marking."""

_MOST_WEIGHT = 4.0
"""The weight of the smallest pieces of paint, relative to near ones."""

_LEAST_PAINT = 0.4
"""A cell shows the class of its paint where that covers at least this share of it."""

_MAX_SLOPE = 4.0
"""Lines that run flatter across the row anchors than this (px along per px down) have no clear crossing."""

_NEAR_EDGE = 0.3
"""Beyond this offset, in cells, the next cell would be nearly as good an answer."""

Bytes = NDArray[np.uint8]


class Targets(NamedTuple):
    """The answers for images (B, H, W); the batch dimension is missing for a single one.

    ``paint`` (B, H/2, W/2) uint8: 1 for paint, and ``paint_weight`` (B, H/4, W/4) float32: what the 2 x 2
    elements there are worth, see :func:`paint_weight`. ``kinds`` (B, H/4, W/4) uint8: index of
    the class, and ``kind_weight`` (B, H/4, W/4) float32: what each is worth, see :func:`kind_weight`.
    ``lane_there`` (B, H/8, W/8) uint8: 1 where a lane's line crosses the row anchor in that cell, and
    ``lane_offset`` (B, H/8, W/8) float32: where in it, in cells from its centre. :data:`IGNORE` carries no
    loss.
    """

    paint: Tensor
    paint_weight: Tensor
    kinds: Tensor
    kind_weight: Tensor
    lane_there: Tensor
    lane_offset: Tensor


def targets(sample: TrainingSample) -> Targets:
    """The answers for one image. Where a box stands before a lane's line, either answer will do."""
    lines, offset = lane_targets(sample.lanes_px, *sample.labels.shape)
    lines[_blocks(sample.hidden, LANE_STRIDE).any(axis=2) & (lines == 1)] = IGNORE
    kinds = kind_target(sample.labels)
    size = piece_size(kinds)
    painted = paint_target(sample.labels)
    if sample.unknown is not None:
        painted[_blocks(sample.unknown, PAINT_STRIDE).any(axis=2)] = IGNORE
    paint = painted, paint_weight(size)
    answers = *paint, kinds, kind_weight(size), lines, offset
    return Targets(*(torch.from_numpy(answer) for answer in answers))


def paint_target(labels: Bytes) -> Bytes:
    """Paint (H/2, W/2) where three or more of a block's four pixels are, ignored where two are.

    Where paint and background halve a block neither answer is right; ignoring those keeps the learnt
    edge at the true one instead of half a pixel outside or inside it.
    """
    count = _blocks(labels, PAINT_STRIDE).astype(bool).sum(axis=2)
    return np.where(count == PAINT_STRIDE**2 // 2, IGNORE, count > PAINT_STRIDE**2 // 2).astype(np.uint8)


def kind_target(labels: Bytes) -> Bytes:
    """The commonest paint class (H/4, W/4) of each block, ignored where there is little paint of any."""
    labels = np.where(labels == PAINT_ONLY, 0, labels)
    blocks = _blocks(labels, KIND_STRIDE)
    classes = max(int(labels.max(initial=0)), 1)
    counts = np.stack([(blocks == 1 + c).sum(axis=2) for c in range(classes)], axis=2)
    painted = counts.sum(axis=2) >= _LEAST_PAINT * KIND_STRIDE**2
    return np.where(painted, counts.argmax(axis=2), IGNORE).astype(np.uint8)


def piece_size(kinds: Bytes) -> NDArray[np.float32]:
    """How many cells the piece of paint has that a cell is of, for all (H/4, W/4) of a target of classes.

    0 where there is none.
    """
    pieces, count = label(kinds, background=IGNORE, return_num=True)
    size = np.bincount(pieces.ravel(), minlength=count + 1)
    size[0] = 0
    return size[pieces].astype(np.float32)


def kind_weight(size: NDArray[np.float32]) -> NDArray[np.float32]:
    """The weight of each cell's class: a piece of paint of n cells counts as much as sqrt(n) ones.

    A map asks for each marking alike, and a far one has a hundredth of the cells that a near one has.
    """
    return np.where(size > 0, 1 / np.sqrt(np.maximum(size, 1)), 0).astype(np.float32)


def paint_weight(size: NDArray[np.float32]) -> NDArray[np.float32]:
    """The weight of each cell's paint: larger in and around small pieces, for the same reason.

    Around them too: if paint weighed more than what lies beside it, its learnt edge would move outwards.
    """
    weight = np.where(size > 0, np.sqrt(_FULL_SIZE / np.maximum(size, 1)), 1).clip(1, _MOST_WEIGHT)
    return np.asarray(cv2.dilate(weight.astype(np.float32), np.ones((5, 5), np.uint8)))


def lane_targets(
    lanes_px: Sequence[FloatArray], height: int, width: int
) -> tuple[Bytes, NDArray[np.float32]]:
    """Which cells (H/8, W/8) the lines cross at the cell row's middle, and where in the cell."""
    rows = height // LANE_STRIDE
    columns = width // LANE_STRIDE
    lines = np.zeros((rows, columns), dtype=np.uint8)
    offset = np.zeros((rows, columns), dtype=np.float32)
    for lane in lanes_px:
        row, u, slope = _crossings(lane, rows)
        cell = (u + 0.5) / LANE_STRIDE
        column = np.floor(cell).astype(np.intp)
        within = cell - column - 0.5
        inside = (column >= 0) & (column < columns)
        flat = inside & (np.abs(slope) > _MAX_SLOPE)
        lines[row[flat], column[flat]] = IGNORE
        side = column + np.sign(within).astype(np.intp)
        unclear = (np.abs(within) > _NEAR_EDGE) & (side >= 0) & (side < columns)
        beside = row[unclear], side[unclear]
        lines[beside] = np.where(lines[beside] == 1, 1, IGNORE)
        clear = inside & ~flat
        lines[row[clear], column[clear]] = 1
        offset[row[clear], column[clear]] = within[clear]
    return lines, offset


def _crossings(lane_px: FloatArray, rows: int) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Where a polyline (N, 2) crosses the row anchors: row (K,), pixel column (K,), columns per row (K,)."""
    anchors = LANE_STRIDE * np.arange(rows) + (LANE_STRIDE - 1) / 2
    first = lane_px[:-1]
    second = lane_px[1:]
    crossed = (first[:, None, 1] > anchors) != (second[:, None, 1] > anchors)
    segment, row = np.nonzero(crossed)
    slope = (second[segment, 0] - first[segment, 0]) / (second[segment, 1] - first[segment, 1])
    return row, first[segment, 0] + slope * (anchors[row] - first[segment, 1]), slope


def _blocks(labels: NDArray[Any], size: int) -> NDArray[Any]:
    """The pixels (H / size, W / size, size * size) of each block."""
    height, width = labels.shape
    split = labels.reshape(height // size, size, width // size, size).transpose(0, 2, 1, 3)
    return split.reshape(height // size, width // size, size * size)
