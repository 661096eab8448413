"""Connected pieces of paint: found in the network's output, and split where two markings touch.

Labels and outlines are found on the network's ``paint`` in a frame of no paint that is one element wide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.catalogue import SHIPPED, Catalogue
from v2hdm.detection.network import NetworkOutput, as_probability
from v2hdm.native import kernels
from v2hdm.records import BoolArray, FloatArray, IntArray

_MIN_CELLS = 5  # blobs of fewer cells are noise: their outline does not determine four corners
_LEAST_SHARE = 0.15  # share of a blob from which a group of classes is present: two groups are two markings
_LEAST_SYMBOL_SHARE = 0.25  # that share for a group of symbols: the head is more of an arrow

_SURE = 2.0  # log odds at which paint is sure: markings that nearly touch come apart in sure paint
_DOUBTFUL = -2.0  # least log odds of doubtful paint, which joins parts of a marking that a shadow divides
_LEAST_SURE = 0.2  # least likely share of a doubtful piece of paint that is used
_MOST_SURE = 0.6  # share of it that is likely up to which the piece is news
_MOST_PARTS = 12  # parts that are looked at of one piece: more are the grains of bad light

Box = tuple[slice, slice]
"""Rows and columns of the framed ``paint``."""


@dataclass(frozen=True)
class Blob:
    """One connected piece of paint; one that may be several markings comes whole, followed by its parts."""

    class_score: dict[str, float]  # mean probability of each class
    level: np.ndarray  # (h, w) float32, positive inside
    origin_px: FloatArray  # of element (0, 0), recorded px; others are ``stride`` apart
    stride: int
    outline_px: FloatArray  # (N, 2) zero crossings of ``level``, recorded px, in no order
    touches_symbol: bool = False  # split off a piece another part of which is a symbol or other paint
    parts: int = 0
    traced: bool = True  # lanes are, in pieces of likely paint or parts of one class

    @property
    def kind(self) -> str:
        """The likeliest class."""
        return max(self.class_score, key=self.class_score.__getitem__)


class _Groups:
    """Groups of classes, the ``least_share`` (G,) of a blob for each to be present, and the ``symbols``."""

    def __init__(self, classes: Sequence[str], catalogue: Catalogue) -> None:
        names = [catalogue.classes[name].group for name in classes]
        self.of_class = np.array([names.index(name) for name in names], dtype=np.int64)
        self.symbols = catalogue.of_any_shape
        self.least_share = np.full(len(names), _LEAST_SHARE)
        self.least_share[self.of_class[np.isin(classes, self.symbols)]] = _LEAST_SYMBOL_SHARE


def find_blobs(
    output: NetworkOutput, reach_px: int = 0, catalogue: Catalogue = SHIPPED
) -> tuple[list[Blob], np.ndarray]:
    """Blobs of paint below image row ``reach_px``, and 1 + the index of each element's (h, w) int16."""
    # A frame of no paint around it lets every outline close.
    level = cv2.copyMakeBorder(output.paint, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=-1.0)
    pieces = _find_pieces(level, (reach_px - output.top) / output.stride + 1)
    count = len(pieces.boxes)
    groups = _Groups(output.classes, catalogue)
    scores = _class_scores(output, pieces.number, level, count, groups)
    # Pieces of several groups, or with several parts of sure paint.
    may_split = ((scores.votes >= groups.least_share).sum(axis=1) > 1) | (pieces.sure_parts > 1)
    outlines = outlines_of(level, pieces.number, count)
    levels = _signed_levels(level, pieces)
    first_px = _origin_px(output, 0, 0)
    number_of_piece = np.zeros(count + 1, dtype=np.int16)
    of_parts: list[tuple[Box, BoolArray, int]] = []
    blobs: list[Blob] = []
    area_of_piece = _areas_of_use(pieces, scores.cells)
    first_of_area: dict[int, int] = {}
    for index in _by_area(area_of_piece):
        if scores.cells[index] < _MIN_CELLS:
            continue
        area = int(area_of_piece[index])
        if area and area not in first_of_area:
            first_of_area[area] = len(blobs)
            blobs.append(_doubtful_blob(pieces, area, level, output))
        box = _framed(pieces.boxes[index].tolist())
        parts: list[Blob] = []
        if may_split[index]:
            inside = pieces.number[box] == index + 1
            parts = _split(inside, level[box], output, box, groups, scores.votes[index])
        whole = Blob(
            class_score=dict(zip(output.classes, scores.score[:, index].tolist(), strict=True)),
            level=levels[index],
            origin_px=_origin_px(output, box[0].start, box[1].start),
            stride=output.stride,
            outline_px=first_px + output.stride * outlines[index],
            parts=len(parts),
            traced=not any(part.traced for part in parts),
        )
        blobs.append(whole)
        number_of_piece[index + 1] = len(blobs)
        for part in parts:
            blobs.append(part)
            of_parts.append((box, part.level > 0, len(blobs)))
        if area:
            first = first_of_area[area]
            blobs[first] = replace(blobs[first], parts=len(blobs) - 1 - first)
    owner = number_of_piece.take(pieces.number)
    for box, is_of_part, number in of_parts:
        owner[box][is_of_part] = number
    return blobs, owner[1:-1, 1:-1]


def _framed(rectangle: Sequence[int]) -> Box:
    """Rows and columns of a rectangle (x, y, width, height) with one element around it."""
    x, y, width, height = rectangle
    return slice(y - 1, y + height + 1), slice(x - 1, x + width + 1)


def _origin_px(output: NetworkOutput, row: int, column: int) -> FloatArray:
    """Recorded px (2,) of an element of the framed ``paint``."""
    first = (output.stride - 1) / 2 - output.stride
    return np.array([first + output.stride * column, first + output.top + output.stride * row])


class _Pieces(NamedTuple):
    """B connected pieces of likely paint that reach far enough down, and the areas of doubtful paint."""

    number: np.ndarray  # (h, w) int16 1 + the index of each element's piece, 0 for none; holes are filled
    boxes: IntArray  # (B, 4) left, top, width and height of each
    sure_parts: IntArray  # (B,) parts of sure paint, large enough to count, that each has
    area_number: np.ndarray  # (h, w) int16 1 + the index of each element's area, 0 for none
    area_boxes: IntArray  # (A, 4)
    area_cells: IntArray  # (A,) elements
    area: IntArray  # (B,) number of the area in which each piece lies


def _find_pieces(level: np.ndarray, least_row: float) -> _Pieces:
    """The pieces of paint of a framed level (h, w) that reach ``least_row``, the last row first."""
    compiled = kernels()
    if compiled is not None:
        return _Pieces(*compiled.find_pieces(level, least_row, _SURE, _DOUBTFUL, _MIN_CELLS))
    contours, _ = cv2.findContours((level > 0).view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contours = [c for c in contours if len(c) >= 4 and c[:, 0, 1].max() + 1 >= least_row]
    number = np.zeros(level.shape, dtype=np.int16)
    for index, contour in enumerate(contours):
        cv2.drawContours(number, [contour], -1, index + 1, cv2.FILLED)
    doubtful = (level > _DOUBTFUL).view(np.uint8)
    doubtful[[0, -1]] = 0
    doubtful[:, [0, -1]] = 0
    # Labels of 16 bits take a third of the time.
    _, labels, stats, _ = cv2.connectedComponentsWithStats(doubtful, ltype=cv2.CV_16U)
    first_point = np.array([contour[0, 0] for contour in contours], dtype=np.int64).reshape(-1, 2)
    boxes = [cv2.boundingRect(contour) for contour in contours]
    return _Pieces(
        number=number,
        boxes=np.array(boxes, dtype=np.int64).reshape(-1, 4),
        sure_parts=_sure_parts(number, level, len(contours)),
        area_number=labels.view(np.int16),
        area_boxes=stats[1:, : cv2.CC_STAT_AREA].astype(np.int64),
        area_cells=stats[1:, cv2.CC_STAT_AREA].astype(np.int64),
        area=labels[first_point[:, 1], first_point[:, 0]].astype(np.int64),
    )


def _sure_parts(number: np.ndarray, level: np.ndarray, count: int) -> IntArray:
    """How many parts (B,) of sure paint each of ``count`` pieces has, in a map (h, w) of their numbers.

    Sure paint of two pieces never touches: it is labelled for all of them at once.
    """
    sure = ((level > _SURE) & (number > 0)).view(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(sure, ltype=cv2.CV_16U)
    large = np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= _MIN_CELLS) + 1
    # The piece of a part is that at any of its elements: on its first row there is one.
    rows = stats[large, cv2.CC_STAT_TOP]
    firsts = (labels[rows] == large[:, None]).argmax(axis=1) if len(large) else rows
    return np.bincount(number[rows, firsts], minlength=count + 1)[1:]


def _areas_of_use(pieces: _Pieces, cells: np.ndarray) -> IntArray:
    """The number of the area of doubtful paint about each piece, which has so many ``cells`` (B,).

    It is 0 where the area says nothing new, or hardly anything of it is likely.
    """
    areas = len(pieces.area_cells) + 1
    is_likely = np.bincount(pieces.area, cells, areas)[1:] / np.maximum(pieces.area_cells, 1)
    holds_several = np.bincount(pieces.area, minlength=areas)[1:] > 1
    is_of_use = (holds_several | (is_likely < _MOST_SURE)) & (is_likely > _LEAST_SURE)
    return np.where(np.append(False, is_of_use)[pieces.area], pieces.area, 0)


def _by_area(area_of_piece: IntArray) -> list[int]:
    """The indices of pieces, those of one area together."""
    first_of: dict[int, int] = {}
    firsts = [first_of.setdefault(area, index) for index, area in enumerate(area_of_piece.tolist())]
    return sorted(range(len(firsts)), key=firsts.__getitem__)


def _doubtful_blob(pieces: _Pieces, area: int, level: np.ndarray, output: NetworkOutput) -> Blob:
    """The blob of one area of doubtful paint."""
    box = _framed(pieces.area_boxes[area - 1].tolist())
    raised = level[box] - np.float32(_DOUBTFUL)
    labels = np.ascontiguousarray(pieces.area_number[box])
    return replace(_blob(labels, area, raised, output, box), traced=False)


class _Scores(NamedTuple):
    """The network's scores of B pieces of paint."""

    cells: np.ndarray  # (B,) elements of paint
    score: FloatArray  # (K, B) mean probability of each class
    votes: FloatArray  # (B, G) share of the elements that each group has


def _class_scores(
    output: NetworkOutput, piece: np.ndarray, level: np.ndarray, count: int, groups: _Groups
) -> _Scores:
    """The scores of ``count`` pieces; ``piece`` (h, w) maps elements to pieces."""
    tally = _tally(output, piece, level, count, (-1, -1))
    number = np.maximum(tally.cells, 1)
    score = (tally.certainty / number) * (tally.probability / number[:, None]).T
    votes = np.zeros((count, len(groups.least_share)))
    for group in np.unique(groups.of_class):
        votes[:, group] = tally.best[:, groups.of_class == group].sum(axis=1)
    return _Scores(tally.cells, score, votes / number[:, None])


class _Tally(NamedTuple):
    """The network's probabilities over the elements of ``count`` pieces, added up."""

    cells: IntArray  # (count,) elements
    best: IntArray  # (count, K) elements where each class is the likeliest
    certainty: FloatArray  # (count,) sum of the probabilities of paint
    probability: FloatArray  # (count, K) sums of those of the classes, were it paint


def _tally(
    output: NetworkOutput, piece: np.ndarray, level: np.ndarray, count: int, first: tuple[int, int]
) -> _Tally:
    """The sums over the pieces of a map (h, w), whose first element is that row and column of the paint."""
    compiled = kernels()
    if compiled is not None:
        return _Tally(*compiled.tally(level, piece, count, output.kinds, output.kind_scale, *first))
    element = np.flatnonzero(piece > 0)
    of_piece = piece.ravel()[element] - 1
    i, j = np.divmod(element, piece.shape[1])
    probability = output.class_probability(i + first[0], j + first[1])
    classes = len(probability)
    likeliest = of_piece * classes + probability.argmax(axis=0)
    return _Tally(
        cells=np.bincount(of_piece, minlength=count),
        best=np.bincount(likeliest, minlength=count * classes).reshape(count, classes),
        certainty=np.bincount(of_piece, as_probability(level.ravel()[element]), count).astype(np.float64),
        probability=np.stack([np.bincount(of_piece, plane, count) for plane in probability], axis=1),
    )


def outlines_of(level: np.ndarray, piece: np.ndarray, count: int) -> list[FloatArray]:
    """Points (N, 2), (column, row), of each piece's outline: where the level falls to zero beside it."""
    compiled = kernels()
    if compiled is not None:
        outlines: list[FloatArray] = compiled.outlines(level, piece, count)
        return outlines
    pieces = piece.ravel()
    levels = level.ravel()
    columns = piece.shape[1]
    points = []
    owners = []
    # The frame is empty, so that the step from the end of one row to the start of the next crosses nothing.
    for step in (columns, 1):
        border = np.flatnonzero(pieces[:-step] != pieces[step:])
        fraction = levels[border] / (levels[border] - levels[border + step])
        i, j = np.divmod(border, columns)
        points.append(np.column_stack([j, i + fraction] if step == columns else [j + fraction, i]))
        owners.append(np.maximum(pieces[border], pieces[border + step]))
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    ends = np.searchsorted(owner[order], np.arange(1, count + 2)).tolist()
    ordered = np.concatenate(points).astype(np.float64)[order]
    return [ordered[begin:end] for begin, end in pairwise(ends)]


def _split(
    inside: BoolArray,
    level: np.ndarray,
    output: NetworkOutput,
    box: Box,
    groups: _Groups,
    votes: FloatArray,
) -> list[Blob]:
    """The parts of a piece (h, w) of different groups, by their ``votes`` (G,), or else of sure paint."""
    present = np.flatnonzero(votes >= groups.least_share)
    levels = [level - _SURE]
    if len(present) > 1:
        levels = [np.minimum(level, _lead(output, groups.of_class == group, box)) for group in present]
    labelled = []
    for part_level in levels:
        is_part = ((part_level > 0) & inside).view(np.uint8)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(is_part, ltype=cv2.CV_16U)
        large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= _MIN_CELLS)[:_MOST_PARTS].tolist()
        labelled += [(labels.view(np.int16), label, part_level) for label in large if label]
    if len(labelled) < 2:
        return []
    parts = [_blob(labels, label, part_level, output, box) for labels, label, part_level in labelled]
    touches = any(part.kind in groups.symbols for part in parts)
    return [replace(part, touches_symbol=touches, traced=len(present) > 1) for part in parts]


def _blob(labels: np.ndarray, label: int, level: np.ndarray, output: NetworkOutput, box: Box) -> Blob:
    """The blob with one label of int16 ``labels`` (h, w) of a box of the framed ``paint``."""
    piece = (labels == label).astype(np.int16)
    tally = _tally(output, piece, level, 1, (box[0].start - 1, box[1].start - 1))
    scores = tally.probability[0] * tally.certainty[0] / tally.cells[0] ** 2
    signed = _signed(labels, label, level, (slice(0, len(level)), slice(0, level.shape[1])))
    origin_px = _origin_px(output, box[0].start, box[1].start)
    outline_px = origin_px + output.stride * outlines_of(signed, piece, 1)[0]
    named = dict(zip(output.classes, scores.tolist(), strict=True))
    return Blob(named, signed, origin_px, output.stride, outline_px)


def _lead(output: NetworkOutput, is_of_group: BoolArray, box: Box) -> np.ndarray:
    """By how many logits the best class of a group (K,) leads the rest, on the paint's elements in a box."""
    scale = output.kind_scale
    # The elements of ``kinds`` about the box, with a margin to interpolate in.
    kind_box = tuple(
        slice(max(int((part.start - 2) / scale) - 1, 0), int(part.stop / scale) + 2) for part in box
    )
    kinds = output.kinds[:, *kind_box]
    lead = kinds[is_of_group].max(axis=0) - kinds[~is_of_group].max(axis=0)
    v, u = (
        (np.arange(part.start, part.stop, dtype=np.float32) - 0.5) / np.float32(scale) - (0.5 + first.start)
        for part, first in zip(box, kind_box, strict=True)
    )
    map_u, map_v = np.meshgrid(u, v)
    return np.asarray(cv2.remap(lead, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _signed_levels(level: np.ndarray, pieces: _Pieces) -> list[np.ndarray]:
    """The level in the box around each piece, as :func:`_signed`."""
    compiled = kernels()
    if compiled is not None:
        levels: list[np.ndarray] = compiled.signed_levels(level, pieces.number, pieces.boxes)
        return levels
    boxes = [_framed(box) for box in pieces.boxes.tolist()]
    return [_signed(pieces.number, index + 1, level, box) for index, box in enumerate(boxes)]


def _signed(labels: np.ndarray, label: int, level: np.ndarray, box: Box) -> np.ndarray:
    """The level in a box of int16 ``labels``, positive in one only: holes filled, all else emptied."""
    compiled = kernels()
    if compiled is not None:
        rows, columns = box
        return np.asarray(
            compiled.signed(level, labels, label, rows.start, columns.start, rows.stop, columns.stop)
        )
    value = level[box]
    return np.asarray(np.where(labels[box] == label, np.maximum(value, 1e-3), np.minimum(value, -1e-3)))
