"""Areas of paint: words, numbers and hatched boxes, each by the hull on the ground of all of its pieces.

An area is made of pieces that do not touch: letters, hatching. Each is named whole, as writing or as a box.
Pieces of one class are one area where the gap between them on the ground is small beside their own size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.catalogue import Catalogue
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.hatching import box_probability, meshes
from v2hdm.detection.network import NetworkOutput, as_probability, as_shares
from v2hdm.detection.quads.blobs import outlines_of
from v2hdm.detection.writing import company_of_words, writing_probability
from v2hdm.geometry.planar import rectangle_size
from v2hdm.geometry.rows import linked_groups
from v2hdm.records import BOX, TEXT, BoolArray, FloatArray, IntArray, MarkingDetection

_LEAST_CELLS = 5  # elements of paint of an area's largest piece: fewer are noise
_LEAST_CELLS_BESIDE = 2  # elements of paint of a piece beside such a piece: from afar a letter has few
_LEAST_SHARE = 0.25
"""Least share of the area's class in a connected piece of paint of its group of classes: the network may give
the foot of an arrow such a name."""

_GAP = 0.35
"""Largest gap between pieces of one area, in parts of the larger one's longest extent: letters stand a fifth
of their height apart, words two thirds or more (DIN 1451-3, FHWA Series D)."""
_GAP_OF_CUT = 0.5  # the same for a piece that the image cuts: its extent is larger than what is seen
_MOST_GAP_M = {TEXT: 1.0}  # largest gap by class, m: lines of letters of 4 m are as far apart
_OTHER_GAP_M = 2.0  # largest gap in any other area, m: hatching is 1 to 2 m apart
_MOST_POINTS = 80  # number of points, evenly along an outline, that measure gaps
_CUT_PX = 6.0  # distance from where the image or its road begins, px, within which an outline may be cut


class _Piece(NamedTuple):
    """A connected piece of paint of one class."""

    kind: str
    points_px: FloatArray  # (N, 2) of its outline, recorded px, in no order
    ground: FloatArray  # (N, 2) the same on the ground, m
    extent_m: float  # length of the smallest rectangle around it
    cells: int  # elements of paint
    certainty: float  # mean probability of paint of its class
    is_cut: bool  # by the image, its road or the vehicle's own mask


def find_areas(
    output: NetworkOutput,
    camera: RoadCamera,
    catalogue: Catalogue,
    reach_px: int,
    least_score: float,
    max_range_m: float,
    *,
    has_company: bool = True,
) -> list[MarkingDetection]:
    """The areas of an image below row ``reach_px``, each with the polygon ``outline_px`` of its hull.

    Unless ``has_company`` each is scored alone.

    ``outline_seen`` is true for sides at which neither the image, nor its road, nor the vehicle's own mask
    cuts the paint.
    """
    names = output.area_classes
    # Most images show none.
    if not names or not (output.areas.max(axis=0) >= output.kinds.max(axis=0)).any():
        return []
    rows, columns = np.divmod(np.flatnonzero(output.paint > 0), output.paint.shape[1])
    is_in_reach = output.top + output.stride * (rows + 1) > reach_px
    rows = rows[is_in_reach]
    columns = columns[is_in_reach]
    odds = output.area_odds(rows, columns)
    best = odds.argmax(axis=0)
    if max(np.bincount(best, minlength=len(names))[: len(names)], default=0) < _LEAST_CELLS:
        return []
    probability = as_shares(odds)
    of_group = {catalogue.classes[name].group for name in names}
    all_names = (*names, *output.classes)
    is_alike = np.array([catalogue.classes[name].group in of_group for name in all_names])[best]
    alike = _Part.of(rows[is_alike], columns[is_alike])
    whole = alike.connected(np.ones(np.count_nonzero(is_alike), dtype=np.uint8))
    pieces: list[_Piece] = []
    for kinds in _named_together(names):
        numbers = [names.index(kind) for kind in kinds]
        is_of_kinds = np.isin(best, numbers)
        if np.count_nonzero(is_of_kinds) < _LEAST_CELLS:
            continue
        part = _Part.of(rows[is_of_kinds], columns[is_of_kinds])
        share = probability[numbers][:, is_of_kinds]
        pieces += _pieces(kinds, output, camera, part, share, alike, whole)
    areas = []
    for name in names:
        named = [piece for piece in pieces if piece.kind == name]
        of_name = []
        for members in _together(named, _MOST_GAP_M.get(name, _OTHER_GAP_M)):
            if max(named[k].cells for k in members) < _LEAST_CELLS:
                continue
            area = _area(name, [named[k] for k in members], output, camera, catalogue)
            ground = camera.unproject(area.outline_px)
            if camera.range_m(ground.mean(axis=0)) <= max_range_m:
                of_name.append(area)
        areas += in_company(of_name, camera) if name == TEXT and has_company else of_name
    return [area for area in areas if area.score >= least_score]


def in_company(words: Sequence[MarkingDetection], camera: RoadCamera) -> list[MarkingDetection]:
    """Areas that are named writing, with their probability given each other."""
    if not words:
        return []
    score = np.array([word.score for word in words])
    company = company_of_words(score, [camera.unproject(word.outline_px) for word in words])
    probability = writing_probability(score, company).tolist()
    return [replace(word, score=score) for word, score in zip(words, probability, strict=True)]


def _named_together(names: Sequence[str]) -> list[tuple[str, ...]]:
    """The classes of areas, in groups that the network may confuse within one piece."""
    written = (TEXT, BOX) if {TEXT, BOX} <= set(names) else ()
    return [*([written] if written else []), *((name,) for name in names if name not in written)]


class _Part(NamedTuple):
    """Elements of the paint, in the part of it that they reach, and one row or column more all around."""

    rows: IntArray  # (N,) of the part
    columns: IntArray  # (N,) of the part
    first: tuple[int, int]  # row and column of the paint that are the part's first
    shape: tuple[int, int]  # of the part

    @classmethod
    def of(cls, rows: IntArray, columns: IntArray) -> _Part:
        """The part that elements at rows and columns (N,) of the paint are in; N is not 0."""
        first = int(rows.min()) - 1, int(columns.min()) - 1
        shape = int(rows.max()) + 2 - first[0], int(columns.max()) + 2 - first[1]
        return cls(rows - first[0], columns - first[1], first, shape)

    def filled(self, values: np.ndarray) -> np.ndarray:
        """A map of the part with these values (N,) at the elements, and 0 elsewhere."""
        plane = np.zeros(self.shape, dtype=values.dtype)
        plane[self.rows, self.columns] = values
        return plane

    def connected(self, values: np.ndarray) -> _Connected:
        """The connected pieces of elements with ``values`` (N,) over 0."""
        _, labels, stats, _ = cv2.connectedComponentsWithStats(self.filled(values), ltype=cv2.CV_16U)
        return _Connected(labels, stats)


class _Connected(NamedTuple):
    """Connected pieces of elements of a part."""

    labels: np.ndarray  # (h, w) of the pieces, from 1 on
    stats: np.ndarray  # (P + 1, 5) OpenCV's


def _framed_paint(part: _Part, output: NetworkOutput) -> np.ndarray:
    """The network's paint over a part, whose frame may lie outside the network's rows and columns: -1."""
    first_row, first_column = part.first
    framed = np.full(part.shape, -1.0, dtype=np.float32)
    rows = slice(max(first_row, 0), first_row + part.shape[0])
    columns = slice(max(first_column, 0), first_column + part.shape[1])
    paint = output.paint[rows, columns]
    down = max(-first_row, 0)
    right = max(-first_column, 0)
    framed[down : down + paint.shape[0], right : right + paint.shape[1]] = paint
    return framed


def _pieces(
    kinds: tuple[str, ...],
    output: NetworkOutput,
    camera: RoadCamera,
    part: _Part,
    share: np.ndarray,
    alike: _Part,
    whole: _Connected,
) -> list[_Piece]:
    """The pieces of K classes, whose ``part`` has these ``share`` (K, N) of the paint; of two: text and box.

    ``alike`` is the part of their group, and ``whole`` are the pieces of that.
    """
    of_all = share.sum(axis=0)
    labels, stats = part.connected((of_all > 0).view(np.uint8))
    framed = _framed_paint(part, output)
    piece = labels.astype(np.int16)
    level = np.where(piece > 0, np.maximum(framed, 1e-3), np.minimum(framed, -1e-3))
    first_row, first_column = part.first
    first_px = (
        (output.stride - 1) / 2 + output.stride * np.array([first_column, first_row]) + [0.0, output.top]
    )
    of_element = labels[part.rows, part.columns]
    pieces = []
    for number, points in enumerate(outlines_of(level, piece, len(stats) - 1), start=1):
        cells = int(stats[number, cv2.CC_STAT_AREA])
        if cells < _LEAST_CELLS_BESIDE:
            continue
        elements = np.flatnonzero(of_element == number)
        row = part.rows[elements]
        column = part.columns[elements]
        in_whole = whole.labels[row + first_row - alike.first[0], column + first_column - alike.first[1]]
        if cells < _LEAST_SHARE * whole.stats[np.bincount(in_whole).argmax(), cv2.CC_STAT_AREA]:
            continue
        points_px = first_px + output.stride * points
        ground = camera.unproject(points_px)
        is_on_ground = np.isfinite(ground).all(axis=1)
        if is_on_ground.sum() < 3:
            continue
        extent_m = rectangle_size(ground[is_on_ground])[0]
        certainty = float((as_probability(framed[row, column]) * of_all[elements]).mean())
        kind = kinds[0]
        if len(kinds) > 1:
            text_cells, box_cells = share[:, elements].sum(axis=1).tolist()
            probability = box_probability(text_cells, box_cells, meshes(row, column, framed > 0))
            kind = kinds[int(probability > 0.5)]
            certainty *= max(probability, 1.0 - probability)
        pieces.append(
            _Piece(
                kind=kind,
                points_px=points_px[is_on_ground],
                ground=ground[is_on_ground],
                extent_m=extent_m,
                cells=cells,
                certainty=certainty,
                is_cut=bool(_cut(points_px, output, camera).any()),
            )
        )
    return pieces


def _together(pieces: Sequence[_Piece], most_gap_m: float) -> list[IntArray]:
    """The indices of the pieces of each area."""
    points = [
        piece.ground[np.linspace(0, len(piece.ground) - 1, min(len(piece.ground), _MOST_POINTS)).astype(int)]
        for piece in pieces
    ]
    is_linked = np.zeros((len(pieces), len(pieces)), dtype=np.bool_)
    for first, second in combinations(range(len(pieces)), 2):
        pair = (pieces[first], pieces[second])
        reach_m = max((_GAP_OF_CUT if piece.is_cut else _GAP) * piece.extent_m for piece in pair)
        gap_m = np.linalg.norm(points[first][:, None] - points[second], axis=2).min()
        is_linked[first, second] = is_linked[second, first] = gap_m <= min(reach_m, most_gap_m)
    return linked_groups(is_linked)


def _area(
    name: str, pieces: Sequence[_Piece], output: NetworkOutput, camera: RoadCamera, catalogue: Catalogue
) -> MarkingDetection:
    """The area of some pieces; its score is less where its size on the ground does not suit its class."""
    ground = np.concatenate([piece.ground for piece in pieces])
    points_px = np.concatenate([piece.points_px for piece in pieces])
    middle = ground.mean(axis=0)
    hull = cv2.convexHull((ground - middle).astype(np.float32), returnPoints=False).ravel()
    outline_px = points_px[hull]
    is_cut = _cut(outline_px, output, camera)
    length_m, width_m = rectangle_size(ground[hull])
    fit = catalogue.classes[name].size_log_likelihood(
        length_m,
        width_m,
        whole=not is_cut.any(),
        log_sigma=camera.log_size_sigma(camera.range_m(middle)),
    )
    cells = [piece.cells for piece in pieces]
    certainty = float(np.average([piece.certainty for piece in pieces], weights=cells))
    return MarkingDetection(
        kind=name,
        score=certainty * float(np.exp(fit)),
        corners_px=np.full((4, 2), np.nan),
        covariance_px=np.full((8, 8), np.nan),
        corner_valid=np.zeros(4, dtype=np.bool_),
        outline_px=outline_px,
        outline_seen=~(is_cut | np.roll(is_cut, -1)),
    )


def _cut(points_px: FloatArray, output: NetworkOutput, camera: RoadCamera) -> BoolArray:
    """Which points (N, 2) lie where the image, the network's rows or the vehicle's own mask end the paint."""
    is_cut = ~camera.inside(points_px, _CUT_PX) | (points_px[:, 1] < output.top + _CUT_PX)
    mask = camera.camera.own_vehicle
    if mask is None:
        return is_cut
    widened = cv2.dilate(mask.astype(np.uint8), np.ones((2 * int(_CUT_PX) + 1,) * 2, dtype=np.uint8))
    column, row = np.clip(np.rint(points_px), 0, np.array(mask.shape[::-1]) - 1).astype(np.int64).T
    return np.asarray(is_cut | (widened[row, column] > 0))
