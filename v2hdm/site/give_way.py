"""Give-way lines: short dashes end to end across a lane are one stop line of that variety.

The network has no class of them. It takes their pieces for stop lines, dashes or bars, and the size of the
pieces, their steps and the direction of the lanes tell what they are together. Rows of triangles are not
recognised: they have no four corners.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.geometry.planar import following, turned_left
from v2hdm.geometry.rows import linked_groups
from v2hdm.records import (
    CROSSWALK_BAR,
    GIVE_WAY,
    LANE_DASH,
    STOP_LINE,
    FloatArray,
    HDMap,
    IntArray,
    Lane,
    Marking,
)
from v2hdm.site.joint import joint_covariance

_PIECES = (STOP_LINE, LANE_DASH, CROSSWALK_BAR)  # what the network takes the pieces for

_LEAST_PIECES = 3  # of a row: fewer show no even steps
_LENGTH_M = (0.25, 1.1)
"""Length of a piece along the row, m: dashes of 0.3 to 0.6 m (UK diagram 1003), 0.5 m (Germany's Zeichen
341), with some room. Dashes that lead along a lane are 1 m long or more."""
_WIDTH_M = (0.1, 0.8)  # of a piece along the lane, m: 0.2 m in the UK, 0.5 m in Germany, with some room
_GAP = (0.2, 1.3)  # least and largest gap between two pieces, in lengths of a piece; the same standards
_ALIKE = 1.5  # largest ratio of the lengths of two neighbours: ends are worn, and the border cuts one
_BESIDE = 0.5  # largest offset of a piece across the row, in its widths
_ACROSS = 0.5  # largest cosine between the row and the nearest lane line; a row along a lane is its line
_NEAR_M = 8.0  # distance, m, within which a lane line tells where the lanes lead; chosen: two lanes' widths


@dataclass(frozen=True)
class _Piece:
    """A rectangle about a marking."""

    centre: FloatArray  # (2,)
    sizes: FloatArray  # (2,) m, along its first and second axis
    axes: FloatArray  # (2, 2) unit


def with_give_way_lines(hd_map: HDMap) -> HDMap:
    """The map in which rows of short pieces across a lane are stop lines of the variety ``give_way``."""
    places = [k for k, marking in enumerate(hd_map.markings) if marking.kind in _PIECES]
    rows = [
        [places[k] for k in row.tolist()]
        for row in _rows([hd_map.markings[k].corners_map for k in places], hd_map.lanes)
    ]
    if not rows:
        return hd_map
    pieces = {k for row in rows for k in row}
    others = [marking for k, marking in enumerate(hd_map.markings) if k not in pieces]
    lines = [_line([hd_map.markings[k] for k in row]) for row in rows]
    return replace(hd_map, markings=(*others, *lines))


def _rows(corners: Sequence[FloatArray], lanes: Sequence[Lane]) -> Iterator[IntArray]:
    """The rows among quadrilaterals (4, 2), m: the indices of each one's pieces, in order along it."""
    pieces = [_piece_of(quadrilateral) for quadrilateral in corners]
    is_next = np.zeros((len(pieces), len(pieces)), dtype=np.bool_)
    for i, first in enumerate(pieces):
        for j, second in enumerate(pieces[:i]):
            is_next[i, j] = is_next[j, i] = _follows(first, second)
    for members in linked_groups(is_next):
        if len(members) < _LEAST_PIECES:
            continue
        centres = np.array([pieces[k].centre for k in members])
        course = centres[np.linalg.norm(centres - centres[0], axis=1).argmax()] - centres[0]
        course = course / np.linalg.norm(course)
        if _leads_across(centres.mean(axis=0), course, lanes):
            yield members[np.argsort(centres @ course)]


def _piece_of(corners: FloatArray) -> _Piece:
    """The mean rectangle of a quadrilateral (4, 2)."""
    sides = (corners + following(corners)) / 2
    middle_lines = sides[2:] - sides[:2]
    sizes = np.maximum(np.linalg.norm(middle_lines, axis=1), 1e-9)
    return _Piece(corners.mean(axis=0), sizes, middle_lines / sizes[:, None])


def _follows(first: _Piece, second: _Piece) -> bool:
    """Whether two pieces are neighbours of one row, end to end along one axis of both."""
    offset = second.centre - first.centre
    distance = float(np.linalg.norm(offset))
    if not 0 < distance < 2 * _LENGTH_M[1] * (1 + _GAP[1]):
        return False
    lengths = []
    for piece in (first, second):
        along = int(np.abs(piece.axes @ offset).argmax())
        length = piece.sizes[along]
        width = piece.sizes[1 - along]
        beside = abs(float(offset @ turned_left(piece.axes[along])))
        is_size = _LENGTH_M[0] <= length <= _LENGTH_M[1] and _WIDTH_M[0] <= width <= _WIDTH_M[1]
        if not is_size or beside > _BESIDE * width:
            return False
        lengths.append(float(length))
    mean_m = sum(lengths) / 2
    gap = (distance - mean_m) / mean_m
    return max(lengths) <= _ALIKE * min(lengths) and _GAP[0] <= gap <= _GAP[1]


def _leads_across(centre: FloatArray, course: FloatArray, lanes: Sequence[Lane]) -> bool:
    """Whether the nearest lane line leads across a row; False where none is near."""
    nearest_m = _NEAR_M
    cosine = 1.0
    for lane in lanes:
        points = lane.points_map
        if len(points) < 2:
            continue
        distance_m = np.linalg.norm(points - centre, axis=1)
        if distance_m.min() < nearest_m:
            nearest_m = float(distance_m.min())
            at = int(distance_m.argmin())
            ahead = points[min(at + 1, len(points) - 1)] - points[max(at - 1, 0)]
            cosine = abs(float(ahead @ course)) / max(float(np.linalg.norm(ahead)), 1e-9)
    return cosine <= _ACROSS


def _line(pieces: Sequence[Marking]) -> Marking:
    """The stop line about the pieces of a row, in order: from the first one's outer end to the last one's."""
    first = pieces[0]
    last = pieces[-1]
    course = last.corners_map.mean(axis=0) - first.corners_map.mean(axis=0)
    outer_first, outer_last = (
        np.argsort(sign * (piece.corners_map @ course))[:2] for piece, sign in ((first, 1.0), (last, -1.0))
    )
    corners = np.concatenate([first.corners_map[outer_first], last.corners_map[outer_last]])
    middle = corners.mean(axis=0)
    order = np.argsort(np.arctan2(*(corners - middle).T[::-1]))  # counter-clockwise
    place = np.concatenate([outer_first, 4 + outer_last])[order]
    covariance_m2 = joint_covariance((first, last))
    if covariance_m2 is not None:
        rows = (2 * place[:, None] + np.arange(2)).ravel()
        covariance_m2 = covariance_m2[np.ix_(rows, rows)]
    return replace(
        first,
        kind=STOP_LINE,
        corners_map=corners[order],
        sightings=max(piece.sightings for piece in pieces),
        covariance_m2=covariance_m2,
        heights_m=_heights([first.heights_m, last.heights_m], place),
        heights_sigma_m=_heights([first.heights_sigma_m, last.heights_sigma_m], place),
        id=min((piece.id for piece in pieces if piece.id), default=None),
        variety=GIVE_WAY,
    )


def _heights(of_pieces: Sequence[FloatArray | None], place: IntArray) -> FloatArray | None:
    """Values (4,) of the corners at ``place`` among those of two pieces; None where a piece has none."""
    stated = [values for values in of_pieces if values is not None]
    return np.concatenate(stated)[place] if len(stated) == len(of_pieces) else None
