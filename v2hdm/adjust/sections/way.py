"""The way of one or many drives divided into parts where few frames of neighbours see the same ground."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from v2hdm.records import BoolArray, FloatArray, IntArray

_CELL_M = 5.0  # side of the cells of ground whose frames stay together; a lane and the one beside it
_NEAR_M = 12.0  # distance of cells that are neighbours: those of both directions of a street are
_BORDER_M = 40.0  # way on either side of a cut whose frames see the same: twice a camera's reach
_OFF_MIDDLE = 0.15  # share of a half by which a cut may be off the middle, for a narrower place; chosen


def parts_of_way(position_map: FloatArray, session: Sequence[int] | IntArray, most_m: float) -> IntArray:
    """The part (J,) of each frame at ``position_map`` (J, 2): neighbours, on at most ``most_m`` of way.

    Frames are divided along the streets, as often as their way asks, near the middle and where the fewest are
    close to the cut: so drives along one street are in one part, and parts have little in common.
    """
    session = np.asarray(session)
    steps_m = np.linalg.norm(np.diff(position_map, axis=0, prepend=position_map[:1]), axis=1)
    is_first = np.concatenate([[True], session[1:] != session[:-1]])
    steps_m[is_first] = 0.0
    cells, cell = np.unique(np.floor(position_map / _CELL_M), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    streets = _streets(_CELL_M * cells, cell, is_first)
    out = np.zeros(len(position_map), dtype=np.int64)
    todo = [np.arange(len(position_map))]
    done = 0
    while todo:
        frames = todo.pop()
        count = int(np.ceil(steps_m[frames].sum() / most_m))
        if count < 2 or len(frames) < 2:
            out[frames] = done
            done += 1
            continue
        along_m = _along(streets, cell[frames])
        order = np.argsort(along_m, kind="stable")
        middle = _cut(along_m[order], np.cumsum(steps_m[frames[order]]), count, most_m)
        todo += [np.sort(frames[order[middle:]]), np.sort(frames[order[:middle]])]
    return out


def _streets(cells_map: FloatArray, cell: IntArray, is_first: BoolArray) -> csr_matrix:
    """The graph of cells (N, 2) that are near each other, or follow one another in a drive; lengths in m."""
    near_pairs = cKDTree(cells_map).query_pairs(_NEAR_M, output_type="ndarray")
    before = cell[:-1][~is_first[1:]]
    after = cell[1:][~is_first[1:]]
    follows = np.column_stack([before, after])[before != after]
    pairs = np.unique(np.sort(np.concatenate([near_pairs, follows]), axis=1), axis=0)
    first, second = pairs.T
    length_m = np.linalg.norm(cells_map[first] - cells_map[second], axis=1)
    return coo_matrix((length_m, (first, second)), shape=(len(cells_map), len(cells_map))).tocsr()


def _along(streets: csr_matrix, cell: IntArray) -> FloatArray:
    """How far (F,) along the streets frames in cells (F,) are from an end; other streets come after."""
    cells, place = np.unique(cell, return_inverse=True)
    graph = streets[cells][:, cells]
    along_m = np.full(len(cells), np.inf)
    beyond_m = 0.0
    while not np.isfinite(along_m).all():
        anywhere = int(np.flatnonzero(~np.isfinite(along_m))[0])
        away_m = dijkstra(graph, directed=False, indices=anywhere)
        end = int(np.where(np.isfinite(away_m), away_m, -1.0).argmax())
        away_m = dijkstra(graph, directed=False, indices=end)
        reached = np.isfinite(away_m)
        along_m[reached] = beyond_m + away_m[reached]
        beyond_m = float(along_m[reached].max()) + 2 * _BORDER_M
    return np.asarray(along_m[place.reshape(-1)])


def _cut(along_m: FloatArray, way_m: FloatArray, count: int, most_m: float) -> int:
    """The first frame after the best cut of frames in their order, for ``count`` parts in all.

    ``along_m`` (F,) is where they are, ``way_m`` (F,) the way up to each.
    """
    whole_m = float(way_m[-1])
    before = count // 2
    wanted_m = whole_m * before / count
    least_m = max(whole_m - (count - before) * most_m, wanted_m - _OFF_MIDDLE * whole_m / 2)
    largest_m = min(before * most_m, wanted_m + _OFF_MIDDLE * whole_m / 2)
    frames = np.arange(1, len(along_m))
    reached_m = way_m[:-1]
    is_free = (along_m[1:] > along_m[:-1]) & (reached_m >= least_m) & (reached_m <= largest_m)
    if not is_free.any():
        return int(frames[np.abs(reached_m - wanted_m).argmin()])
    frames = frames[is_free]
    cut_m = (along_m[frames] + along_m[frames - 1]) / 2
    close = np.searchsorted(along_m, cut_m + _BORDER_M) - np.searchsorted(along_m, cut_m - _BORDER_M)
    return int(frames[np.lexsort((np.abs(way_m[frames - 1] - wanted_m), close))[0]])
