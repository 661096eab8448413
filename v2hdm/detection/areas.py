"""Areas of paint: words, numbers and hatched boxes, each by the hull on the ground of all of its pieces.

An area is made of pieces that do not touch: letters, hatching. Each is named whole, as writing or as a box.
Pieces of one class are one area where the gap between them on the ground is small beside their own size.
Crosswalks are composed of bars.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.catalogue import Catalogue
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.hatching import box_probability, meshes
from v2hdm.detection.network import NetworkOutput, as_probability
from v2hdm.detection.quads.blobs import outlines_of
from v2hdm.geometry.planar import rectangle_size
from v2hdm.geometry.rows import linked_groups, outline_of_row, rows_of_bars
from v2hdm.records import (
    BOX,
    CROSSWALK,
    CROSSWALK_BAR,
    TEXT,
    BoolArray,
    FloatArray,
    IntArray,
    MarkingDetection,
)

_LEAST_CELLS = 5  # elements of paint of a piece: fewer are noise
_LEAST_SHARE = 0.25
"""Least share of the area's class in a connected piece of paint of its group of classes: the network may give
the foot of an arrow such a name."""

_GAP = 0.35
"""Largest gap between pieces of one area, in parts of the larger one's longest extent: letters stand a fifth
of their height apart, words two thirds or more (DIN 1451-3, FHWA Series D)."""
_GAP_OF_CUT = 0.5  # the same for a piece that the image cuts: its extent is larger than what is seen
_MOST_GAP_M = {TEXT: 1.0}  # largest gap by class, m: lines of letters of 4 m are as far apart
_OTHER_GAP_M = 2.0  # largest gap in any other area, m: hatching is 1 to 2 m apart
_MOST_POINTS = 80  # points of an outline, evenly along it, by which gaps are measured
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
) -> list[MarkingDetection]:
    """The areas of an image below row ``reach_px``, each with the polygon ``outline_px`` of its hull.

    ``outline_seen`` is true for sides at which neither the image, nor its road, nor the vehicle's own mask
    cuts the paint.
    """
    names = output.area_classes
    # Most images show none: that is seen at once where no area is the likeliest anywhere.
    if not names or not (output.areas.max(axis=0) > output.kinds.max(axis=0)).any():
        return []
    rows, columns = np.nonzero(output.paint > 0)
    is_in_reach = output.top + output.stride * (rows + 1) > reach_px
    rows = rows[is_in_reach]
    columns = columns[is_in_reach]
    probability = output.area_probability(rows, columns)
    best = probability.argmax(axis=0)
    of_group = {catalogue.classes[name].group for name in names}
    all_names = (*names, *output.classes)
    is_alike = np.array([catalogue.classes[name].group in of_group for name in all_names])[best]
    alike = np.zeros(output.paint.shape, dtype=np.uint8)
    alike[rows[is_alike], columns[is_alike]] = 1
    pieces: list[_Piece] = []
    for kinds in _named_together(names):
        numbers = [names.index(kind) for kind in kinds]
        is_of_kinds = np.isin(best, numbers)
        if np.count_nonzero(is_of_kinds) < _LEAST_CELLS:
            continue
        share = np.zeros((len(kinds), *output.paint.shape), dtype=np.float32)
        share[:, rows[is_of_kinds], columns[is_of_kinds]] = probability[np.ix_(numbers, is_of_kinds)]
        pieces += _pieces(kinds, output, camera, share, alike)
    areas = []
    for name in names:
        named = [piece for piece in pieces if piece.kind == name]
        for members in _together(named, _MOST_GAP_M.get(name, _OTHER_GAP_M)):
            area = _area(name, [named[k] for k in members], output, camera, catalogue)
            ground = camera.unproject(area.outline_px)
            within = camera.range_m(ground.mean(axis=0)) <= max_range_m
            if within and area.score >= least_score:
                areas.append(area)
    return areas


def _named_together(names: Sequence[str]) -> list[tuple[str, ...]]:
    """The classes of areas; those of which a piece may show both to the network are together."""
    written = (TEXT, BOX) if {TEXT, BOX} <= set(names) else ()
    return [*([written] if written else []), *((name,) for name in names if name not in written)]


def find_crosswalks(
    markings: Sequence[MarkingDetection], camera: RoadCamera
) -> list[tuple[MarkingDetection, tuple[int, ...]]]:
    """The crosswalks of an image's bars, each with ``outline_px`` (4, 2) and the indices of its bars."""
    bars = [k for k, marking in enumerate(markings) if marking.kind == CROSSWALK_BAR]
    ground = camera.unproject(np.array([markings[k].corners_px for k in bars]).reshape(-1, 4, 2))
    on_ground = np.flatnonzero(np.isfinite(ground).all(axis=(1, 2)))
    crosswalks = []
    for row in rows_of_bars(ground[on_ground]):
        parts = tuple(bars[k] for k in on_ground[row].tolist())
        outline_px = camera.project(outline_of_row(ground[on_ground[row]]).corners)
        crosswalk = MarkingDetection(
            kind=CROSSWALK,
            score=float(np.mean([markings[k].score for k in parts])),
            corners_px=np.full((4, 2), np.nan),
            covariance_px=np.full((8, 8), np.nan),
            corner_valid=np.zeros(4, dtype=np.bool_),
            outline_px=outline_px,
            outline_seen=np.ones(4, dtype=np.bool_),
        )
        crosswalks.append((crosswalk, parts))
    return crosswalks


def _pieces(
    kinds: tuple[str, ...], output: NetworkOutput, camera: RoadCamera, share: np.ndarray, alike: np.ndarray
) -> list[_Piece]:
    """The pieces of K classes with these ``share`` (K, h, w) of the paint; of two they are text and box.

    ``alike`` (h, w) is 1 for paint of their group of classes.
    """
    of_all = share.sum(axis=0)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((of_all > 0).view(np.uint8), ltype=cv2.CV_16U)
    _, whole, whole_stats, _ = cv2.connectedComponentsWithStats(alike, ltype=cv2.CV_16U)
    framed = cv2.copyMakeBorder(output.paint, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=-1.0)
    piece = cv2.copyMakeBorder(labels, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0).astype(np.int32)
    level = np.where(piece > 0, np.maximum(framed, 1e-3), np.minimum(framed, -1e-3))
    first_px = np.array([0.0, output.top]) + (output.stride - 1) / 2 - output.stride
    pieces = []
    for number, points in enumerate(outlines_of(level, piece, count - 1), start=1):
        cells = int(stats[number, cv2.CC_STAT_AREA])
        is_of_piece = labels == number
        whole_cells = whole_stats[np.bincount(whole[is_of_piece]).argmax(), cv2.CC_STAT_AREA]
        if cells < max(_LEAST_CELLS, _LEAST_SHARE * whole_cells):
            continue
        points_px = first_px + output.stride * points
        ground = camera.unproject(points_px)
        is_on_ground = np.isfinite(ground).all(axis=1)
        if is_on_ground.sum() < 3:
            continue
        certainty = float((as_probability(output.paint[is_of_piece]) * of_all[is_of_piece]).mean())
        kind = kinds[0]
        if len(kinds) > 1:
            text_cells, box_cells = share[:, is_of_piece].sum(axis=1).tolist()
            probability = box_probability(text_cells, box_cells, meshes(is_of_piece, output.paint))
            kind = kinds[int(probability > 0.5)]
            certainty *= max(probability, 1.0 - probability)
        extent_m = rectangle_size(ground[is_on_ground])[0]
        is_cut = bool(_cut(points_px, output, camera).any())
        pieces.append(
            _Piece(kind, points_px[is_on_ground], ground[is_on_ground], extent_m, cells, certainty, is_cut)
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
