"""The frames' states: what eliminating corners takes off the reduced system."""

from __future__ import annotations

from typing import NamedTuple

from v2hdm.adjust.engines.numba.inline import floored, solve_unit_rows, weigh
from v2hdm.adjust.engines.numba.layout import Base, Layout, Scratch
from v2hdm.adjust.engines.numba.linearise import add_camera, couple, differentiate
from v2hdm.compiled import inlined, kernel
from v2hdm.records import FloatArray, IntArray


class TileMap(NamedTuple):
    """Where the tiles of a :class:`~v2hdm.adjust.tiles.TiledMatrix` lie among its ``values``."""

    per_tile: int  # frames of a tile
    size: int  # rows of a tile
    position: IntArray  # (G,) of each tile along the route in the order of elimination
    begin: IntArray  # (G,) the first tile of each column, that on the diagonal
    # the row of each tile, G for the tip's, and where it lies
    row: IntArray
    at: IntArray


@inlined
def _touch(layout: Layout, u: int, tiles: TileMap, marks: IntArray) -> int:
    """List the tiles that unit u touches in order of elimination, with ``marks`` by tile; their number."""
    mark, place, touched = marks[0], marks[1], marks[2]
    count = 0
    for k in range(layout.begin[layout.unit[u]], layout.begin[layout.unit[u + 1]]):
        tile = layout.frame[layout.pair[k] % layout.moments] // tiles.per_tile
        if mark[tile] != u:
            mark[tile], touched[count] = u, tile
            count += 1
    for a in range(1, count):
        tile, b = touched[a], a
        while b > 0 and tiles.position[touched[b - 1]] > tiles.position[tile]:
            touched[b] = touched[b - 1]
            b -= 1
        touched[b] = tile
    for a in range(count):
        place[touched[a]] = a
    return count


@inlined
def _subtract_products(
    begin: int, end: int, tiles: TileMap, marks: IntArray, count: int, rows: FloatArray, values: FloatArray
) -> None:
    """Take B'B of a unit's ``rows`` (2g, ...) off the columns ``begin`` to ``end`` of its ``count`` tiles."""
    size, touched, low, high = tiles.size, marks[2], marks[3], marks[4]
    for a in range(count):
        column = tiles.position[touched[a]]
        if not begin <= column < end:
            continue
        for b in range(a, count + 1):
            row = len(tiles.begin) if b == count else tiles.position[touched[b]]
            found = tiles.begin[column]
            while tiles.row[found] != row:
                found += 1
            for i in range(0, len(rows), 2):
                for r in range(low[b], high[b]):
                    x, y = rows[i, b * size + r], rows[i + 1, b * size + r]
                    if x == 0.0 and y == 0.0:
                        continue
                    # Of a tile on the diagonal the lower triangle counts.
                    stop = r + 1 if a == b else high[a]
                    at, right = tiles.at[found] + r * size, a * size
                    out = values[at + low[a] : at + stop]
                    top = rows[i, right + low[a] : right + stop]
                    bottom = rows[i + 1, right + low[a] : right + stop]
                    for s in range(len(out)):
                        out[s] -= x * top[s] + y * bottom[s]


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
    marks: IntArray,
    scratch: Scratch,
    values: FloatArray,
) -> None:
    """Take B'B of all corners off the columns ``begin`` to ``end`` of the reduced system's ``values``.

    Whoever takes off other columns, each tile's parts come in the same order. ``by_state`` (P, 6 S) and
    ``clock`` (P, 6 Q) are the pairs' left tangents by the states of their frame and the clock offset of their
    camera, of which ``each`` is the number of unknowns. ``marks`` (5, G + 1), -1 at first, is room to work
    in; its last two rows are the columns of each touched tile, and of the tip behind them, that are not zero.
    """
    states, size = by_state.shape[1] // 6, tiles.size
    width = len(base.table) // layout.moments * each
    place, touched, low, high = marks[1], marks[2], marks[3], marks[4]
    jacobian, w, rows = scratch.jacobian, scratch.coupling, scratch.rows
    for u in range(len(layout.unit) - 1):
        if layout.kept[u]:
            continue
        count = _touch(layout, u, tiles, marks)
        wanted = False
        for a in range(count):
            wanted |= begin <= tiles.position[touched[a]] < end
        if not wanted:
            continue
        low[:count], high[:count] = size, 0
        low[count], high[count] = 0, width
        first, last = layout.unit[u], layout.unit[u + 1]
        joined, tip = last - first, count * size
        rows[: 2 * joined, : tip + width] = 0.0
        for c in range(first, last):
            i = 2 * (c - first)
            for k in range(layout.begin[c], layout.begin[c + 1]):
                t = layout.pair[k]
                x, y = base.corners[c, 0], base.corners[c, 1]
                r0, r1, _, _, _ = differentiate(layout, base.table, k, x, y, jacobian)
                couple(jacobian, floored(weigh(base, r0 * r0 + r1 * r1)), w, 0)
                frame = layout.frame[t % layout.moments]
                a, within = place[frame // tiles.per_tile], frame % tiles.per_tile * states
                low[a], high[a] = min(low[a], within), max(high[a], within + states)
                column = a * size + within
                for p in range(6):
                    for s in range(states):
                        rows[i, column + s] += w[0, p] * by_state[t, p * states + s]
                        rows[i + 1, column + s] += w[0, 6 + p] * by_state[t, p * states + s]
                add_camera(w, 0, clock, t, each, rows, i, tip + t // layout.moments * each)
        for a in range(count + 1):
            solve_unit_rows(layout, base, u, rows, a * size + low[a], a * size + high[a])
        _subtract_products(begin, end, tiles, marks, count, rows[: 2 * joined], values)
