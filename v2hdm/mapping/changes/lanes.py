"""Lane lines and symbols of an earlier map, brought up to date by those of a new drive.

Nothing is said of lane lines or symbols that have vanished: where the new drive has none, the earlier stay.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.mapping.changes.field import Shift
from v2hdm.records import FloatArray, Lane, Symbol

_SAME_LINE_M = 0.3
"""Distance of two maps' lines up to which they are one, m: two lines side by side lie twice as far apart."""

_LEAST_SHARED = 0.5
"""Share of a new line's vertices that lie on an earlier line, from which it is that line."""


@dataclass(frozen=True)
class _Piece:
    """A new line that lies on an earlier one: from ``begin`` to ``end`` of its stations, m, along that."""

    begin: float
    end: float
    lane: Lane


def updated_lanes(
    old: Sequence[Lane], new: Sequence[Lane], shift: Shift, number: Callable[[], int]
) -> tuple[Lane, ...]:
    """The lines of both maps: an earlier one keeps its id, and its course where the new drive has none of it.

    Args:
        old: of the earlier map.
        new: of the new drive's own map.
        shift: how the maps lie to each other.
        number: gives a fresh id.
    """
    before = [replace(one, points_map=_moved(one.points_map, shift, of_old=True)) for one in old]
    pieces: list[list[_Piece]] = [[] for _ in before]
    added = []
    for one in new:
        lane = replace(one, points_map=_moved(one.points_map, shift, of_old=False))
        owner = _owner(lane, before)
        if owner is None:
            added.append(replace(lane, id=number()))
        else:
            pieces[owner].append(_piece(lane, before[owner]))
    kept = [_renewed(lane, parts) for lane, parts in zip(before, pieces, strict=True)]
    return (*kept, *added)


def updated_symbols(
    old: Sequence[Symbol], new: Sequence[Symbol], shift: Shift, number: Callable[[], int]
) -> tuple[Symbol, ...]:
    """The symbols of both maps: of those that lie on each other the new outline under the earlier id."""
    out = [replace(one, outline_map=_moved(one.outline_map, shift, of_old=True)) for one in old]
    centres = np.array([one.outline_map.mean(axis=0) for one in out]).reshape(-1, 2)
    taken: set[int] = set()
    for one in new:
        symbol = replace(one, outline_map=_moved(one.outline_map, shift, of_old=False))
        off_m = np.linalg.norm(centres - symbol.outline_map.mean(axis=0), axis=1)
        within = 0.5 * float(np.ptp(symbol.outline_map, axis=0).max())
        near = [k for k in np.argsort(off_m).tolist() if k < len(old) and off_m[k] < within]
        same = next((k for k in near if k not in taken and old[k].kind == one.kind), None)
        if same is None:
            out.append(replace(symbol, id=number()))
        else:
            taken.add(same)
            out[same] = replace(
                symbol, id=old[same].id, sightings=old[same].sightings + one.sightings, heights_m=None
            )
    return tuple(out)


def _moved(points_map: FloatArray, shift: Shift, of_old: bool) -> FloatArray:
    """Points without the error that they share with the markings around them."""
    errors = shift.of_old if of_old else shift.of_new
    at = shift.of_old_at if of_old else shift.of_new_at
    return points_map - at(*errors.at(points_map))[0]


def _owner(lane: Lane, lanes: Sequence[Lane]) -> int | None:
    """The earlier line of the same class that most of a new line lies on."""
    shares = [
        float((_apart(lane.points_map, one.points_map) <= _SAME_LINE_M).mean())
        if one.kind == lane.kind
        else 0.0
        for one in lanes
    ]
    best = int(np.argmax(shares)) if shares else 0
    return best if shares and shares[best] >= _LEAST_SHARED else None


def _apart(points: FloatArray, line: FloatArray) -> FloatArray:
    """Distances (N,) of points (N, 2) from a polyline (M, 2)."""
    place = _stations(points, line)
    along = _along(line)
    foot = np.column_stack([np.interp(place, along, line[:, k]) for k in (0, 1)])
    return np.asarray(np.linalg.norm(points - foot, axis=1))


def _along(line: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def _stations(points: FloatArray, line: FloatArray) -> FloatArray:
    """How far along a polyline (M, 2) the feet of points (N, 2) lie, m: beside its nearest vertex."""
    along, nearest = _along(line), cKDTree(line).query(points)[1]
    best = np.full(len(points), np.inf)
    station = np.asarray(along[nearest], dtype=np.float64)
    for first in (nearest - 1, nearest):
        begin = np.clip(first, 0, len(line) - 2)
        side = line[begin + 1] - line[begin]
        length2 = np.maximum((side**2).sum(axis=1), 1e-12)
        share = np.clip(((points - line[begin]) * side).sum(axis=1) / length2, 0.0, 1.0)
        off = np.linalg.norm(points - line[begin] - share[:, None] * side, axis=1)
        nearer = off < best
        station[nearer] = along[begin[nearer]] + share[nearer] * np.sqrt(length2[nearer])
        best = np.minimum(best, off)
    return station


def _piece(lane: Lane, on: Lane) -> _Piece:
    """The line, in the direction of the earlier one that it lies on."""
    station = _stations(lane.points_map, on.points_map)
    if station[-1] < station[0]:
        lane, station = replace(lane, points_map=lane.points_map[::-1]), station[::-1]
    return _Piece(float(station.min()), float(station.max()), lane)


def _renewed(lane: Lane, pieces: Sequence[_Piece]) -> Lane:
    """The earlier line with its course replaced where new lines lie on it."""
    if not pieces:
        return lane
    along = _along(lane.points_map)
    heights = None if lane.heights_m is None else lane.heights_m
    points: list[FloatArray] = []
    up: list[FloatArray] = []
    reached = -1.0
    for piece in sorted(pieces, key=lambda one: one.begin):
        old = (along > reached) & (along < piece.begin)
        # Of two new pieces that overlap, the later one begins where the earlier one ends.
        station = _stations(piece.lane.points_map, lane.points_map)
        own = (station > reached) | (reached < 0)
        points += [lane.points_map[old], piece.lane.points_map[own]]
        if heights is not None:
            up += [heights[old], np.interp(station[own], along, heights)]
        reached = max(reached, piece.end)
    left = along > reached
    points.append(lane.points_map[left])
    if heights is not None:
        up.append(heights[left])
    return replace(
        lane,
        points_map=np.concatenate(points),
        heights_m=np.concatenate(up) if heights is not None else None,
        sightings=lane.sightings + max(piece.lane.sightings for piece in pieces),
    )
