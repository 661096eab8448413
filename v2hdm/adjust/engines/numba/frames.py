"""The frames' states: which tiles corners couple, and what eliminating them takes off the reduced system."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from v2hdm.adjust.engine import WEIGHT_FLOOR
from v2hdm.adjust.engines.numba.build import inlined, kernel
from v2hdm.adjust.engines.numba.evaluate import Base
from v2hdm.adjust.engines.numba.inline import solve_unit_rows, weigh
from v2hdm.adjust.engines.numba.layout import Layout
from v2hdm.adjust.engines.numba.linearise import couple, differentiate
from v2hdm.records import FloatArray, IntArray


class TileMap(NamedTuple):
    """Where the tiles of a :class:`~v2hdm.adjust.tiles.TiledMatrix` lie among its ``values``.

    Attributes:
        per_tile: frames of a tile.
        size: rows of a tile.
        position: (G,) of each tile along the route in the order of elimination.
        diagonal_at, panel_at: (G,) where the tile on each column's diagonal begins, and those below it.
        below, below_at: the rows below each diagonal, ascending, and (G + 1,) where those of a column begin.
    """

    per_tile: int
    size: int
    position: IntArray
    diagonal_at: IntArray
    panel_at: IntArray
    below: IntArray
    below_at: IntArray


class Scratch(NamedTuple):
    """The workspace: by tile (G,) the last unit that touched it and its place, a list of tiles, and more.

    ``low`` and ``high`` are the columns of each touched tile that are not zero, ``jacobian`` and ``coupling``
    those of an observation, ``rows`` the unit's of all touched tiles and of the cameras.
    """

    mark: IntArray
    place: IntArray
    touched: IntArray
    low: IntArray
    high: IntArray
    jacobian: FloatArray
    coupling: FloatArray
    rows: FloatArray

    @classmethod
    def of(cls, layout: Layout, tile_count: int, tiles: int, width: int) -> Scratch:
        """Room for units that touch so many of the tiles, and rows of ``width`` columns."""
        return cls(
            np.full(tile_count, -1),
            np.empty(tile_count, dtype=np.int64),
            np.empty(tile_count, dtype=np.int64),
            np.empty(tiles, dtype=np.int64),
            np.empty(tiles, dtype=np.int64),
            np.empty(16),
            np.empty((1, 12)),
            np.empty((2 * layout.most_joined, width)),
        )


@inlined
def _touch(layout: Layout, u: int, per_tile: int, mark: IntArray, tiles: IntArray) -> int:
    """List the tiles that unit u touches, as they come; ``mark`` (G,) is below u. Returns their number."""
    count = 0
    for k in range(layout.begin[layout.unit[u]], layout.begin[layout.unit[u + 1]]):
        tile = layout.pair[k] % layout.frames // per_tile
        if mark[tile] != u:
            mark[tile] = u
            tiles[count] = tile
            count += 1
    return count


@kernel
def count_edges(layout: Layout, per_tile: int, scratch: Scratch, counts: IntArray) -> None:
    """Count the pairs of tiles that units couple, each as often, and the tiles of a unit at most."""
    for u in range(len(layout.unit) - 1):
        if layout.kept[u]:
            continue
        count = _touch(layout, u, per_tile, scratch.mark, scratch.touched)
        counts[0] += count * (count - 1) // 2
        counts[1] = max(counts[1], count)


@kernel
def list_edges(layout: Layout, per_tile: int, scratch: Scratch, edges: IntArray) -> None:
    """List the pairs that :func:`count_edges` counts, each as one number, lower tile times G plus higher."""
    tiles, tile_count, at = scratch.touched, len(scratch.mark), 0
    for u in range(len(layout.unit) - 1):
        if layout.kept[u]:
            continue
        count = _touch(layout, u, per_tile, scratch.mark, tiles)
        for a in range(count):
            for b in range(a):
                low, high = min(tiles[a], tiles[b]), max(tiles[a], tiles[b])
                edges[at] = low * tile_count + high
                at += 1


@inlined
def _sort_by_position(count: int, tiles: IntArray, position: IntArray, place: IntArray) -> None:
    for a in range(1, count):
        tile, b = tiles[a], a
        while b > 0 and position[tiles[b - 1]] > position[tile]:
            tiles[b] = tiles[b - 1]
            b -= 1
        tiles[b] = tile
    for a in range(count):
        place[tiles[a]] = a


@kernel
def subtract_frames(
    begin: int,
    end: int,
    layout: Layout,
    base: Base,
    tiles: TileMap,
    by_state: FloatArray,
    clock: FloatArray,
    each: int,
    code: int,
    scale: float,
    scratch: Scratch,
    values: FloatArray,
) -> None:
    """Take B'B of all corners off the columns ``begin`` to ``end`` of the reduced system.

    Whoever takes off other columns, each tile's parts come in the same order.

    Args:
        begin: the first column in the order of elimination.
        end: the one after the last.
        layout: the problem.
        base: where, and the factors of V.
        tiles: of the system.
        by_state: (P, 6 S) the pairs' left tangents by the states of their frame.
        clock: (P, 6 Q) those by the clock offset of their camera.
        each: unknowns of a camera.
        code: the loss.
        scale: of the loss.
        scratch: room to work in.
        values: the tiles' numbers.
    """
    states, size = by_state.shape[1] // 6, tiles.size
    width = len(base.table) // layout.frames * each
    mark, place, touched, low, high, jacobian, w, rows = scratch
    for u in range(len(layout.unit) - 1):
        if layout.kept[u]:
            continue
        count = _touch(layout, u, tiles.per_tile, mark, touched)
        wanted = False
        for a in range(count):
            wanted |= begin <= tiles.position[touched[a]] < end
        if not wanted:
            continue
        _sort_by_position(count, touched, tiles.position, place)
        low[:count], high[:count] = size, 0
        first, last = layout.unit[u], layout.unit[u + 1]
        joined, tip = last - first, count * size
        rows[: 2 * joined, : tip + width] = 0.0
        for c in range(first, last):
            i = 2 * (c - first)
            for k in range(layout.begin[c], layout.begin[c + 1]):
                t = layout.pair[k]
                r0, r1, _, _, _ = differentiate(
                    layout, base.table, k, base.corners[c, 0], base.corners[c, 1], jacobian
                )
                weight = weigh(code, scale, r0 * r0 + r1 * r1)
                couple(jacobian, WEIGHT_FLOOR if weight < WEIGHT_FLOOR else weight, w, 0)
                frame = t % layout.frames
                a, within = place[frame // tiles.per_tile], frame % tiles.per_tile * states
                low[a], high[a] = min(low[a], within), max(high[a], within + states)
                column = a * size + within
                for p in range(6):
                    for s in range(states):
                        rows[i, column + s] += w[0, p] * by_state[t, p * states + s]
                        rows[i + 1, column + s] += w[0, 6 + p] * by_state[t, p * states + s]
                column = tip + t // layout.frames * each
                for p in range(6):
                    rows[i, column + p] += w[0, p]
                    rows[i + 1, column + p] += w[0, 6 + p]
                    for v in range(each - 6):
                        rows[i, column + 6 + v] += w[0, p] * clock[t, p * (each - 6) + v]
                        rows[i + 1, column + 6 + v] += w[0, 6 + p] * clock[t, p * (each - 6) + v]
        for a in range(count):
            solve_unit_rows(
                joined,
                base.lower,
                first,
                base.joint,
                layout.joint_at[u],
                rows,
                a * size + low[a],
                a * size + high[a],
            )
        solve_unit_rows(joined, base.lower, first, base.joint, layout.joint_at[u], rows, tip, tip + width)
        for a in range(count):
            column = tiles.position[touched[a]]
            if not begin <= column < end:
                continue
            below, below_end = tiles.below_at[column], tiles.below_at[column + 1]
            for b in range(a, count):
                at = tiles.diagonal_at[column]
                if b > a:
                    row = tiles.position[touched[b]]
                    found = 0
                    while tiles.below[below + found] != row:
                        found += 1
                    at = tiles.panel_at[column] + found * size * size
                for i in range(0, 2 * joined, 2):
                    _subtract(
                        rows[i],
                        rows[i + 1],
                        b * size,
                        low[b],
                        high[b],
                        a * size,
                        low[a],
                        high[a],
                        a == b,
                        at,
                        size,
                        values,
                    )
            at = tiles.panel_at[column] + (below_end - below) * size * size
            for i in range(0, 2 * joined, 2):
                _subtract(
                    rows[i], rows[i + 1], tip, 0, width, a * size, low[a], high[a], False, at, size, values
                )


@inlined
def _subtract(
    top: FloatArray,
    bottom: FloatArray,
    left: int,
    left_low: int,
    left_high: int,
    right: int,
    right_low: int,
    right_high: int,
    lower: bool,
    at: int,
    size: int,
    values: FloatArray,
) -> None:
    """Take the products of two rows' columns off a tile, or off its lower triangle only."""
    for r in range(left_low, left_high):
        x, y = top[left + r], bottom[left + r]
        if x == 0.0 and y == 0.0:
            continue
        stop = r + 1 if lower else right_high
        out = values[at + r * size + right_low : at + r * size + stop]
        a, b = top[right + right_low : right + stop], bottom[right + right_low : right + stop]
        for s in range(len(out)):
            out[s] -= x * a[s] + y * b[s]
