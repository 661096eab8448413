"""One pass for cost, gradient and Gauss-Newton blocks, corners eliminated unit by unit, and the frames."""

from __future__ import annotations

import math
from typing import NamedTuple

from v2hdm.adjust.kernels.inline import (
    add_corner_priors,
    add_force,
    add_loss,
    factorise_unit,
    floored,
    keep_unit,
    length_residual,
    number_touched,
    see,
    solve_unit,
    solve_unit_rows,
    solve_unit_transposed,
    weigh,
    whiten,
)
from v2hdm.adjust.kernels.layout import Base, Layout, Scratch
from v2hdm.compiled import inlined, kernel, twin
from v2hdm.records import FloatArray, IntArray


class Linearisation(NamedTuple):
    """Output of :func:`linearise` for Q chunks; R counts the pairs of each chunk, summed over chunks."""

    costs: FloatArray  # (Q, 3) of observations, survey and known lengths
    wrench: FloatArray  # (R, 6) gradient by the pairs
    coupled: FloatArray  # (R, 6) W V^-1 times the gradient by corners, by pair, if frames have states
    carried: FloatArray  # (Q, D) the same by the cameras' unknowns, if not
    whitened: FloatArray  # (2 N,) L^-1 g, gradient by the corners
    squares: FloatArray  # J'J by pair (R, 21), or by camera (Q C, 21) where pairs move with it alone
    tip: FloatArray  # (Q, D, D) B'B of the cameras' unknowns, lower triangle
    failed: FloatArray  # (Q,) units whose block is singular


@inlined
def differentiate(
    layout: Layout, table: FloatArray, k: int, x: float, y: float, jacobian: FloatArray
) -> tuple[float, float, float, float, float]:
    """Write the Jacobian (16,) of observation k by pair and corner; returns residual and point."""
    px, py, pz, inverse, slope, u, v = see(layout, table, k, x, y)
    a = layout.root[0, k]
    b = layout.root[1, k]
    c = layout.root[2, k]
    ad = a * inverse
    bd = b * inverse
    cd = c * inverse
    g = a * px * slope
    h = (b * px + c * py) * slope
    t = layout.pair[k]
    jacobian[0] = ad
    jacobian[1] = 0.0
    jacobian[2] = g
    jacobian[3] = py * g
    jacobian[4] = pz * ad - px * g
    jacobian[5] = -py * ad
    jacobian[6] = bd
    jacobian[7] = cd
    jacobian[8] = h
    jacobian[9] = py * h - pz * cd
    jacobian[10] = pz * bd - px * h
    jacobian[11] = px * cd - py * bd
    jacobian[12] = ad * table[t, 0] + g * table[t, 8]
    jacobian[13] = ad * table[t, 1] + g * table[t, 9]
    jacobian[14] = bd * table[t, 0] + cd * table[t, 4] + h * table[t, 8]
    jacobian[15] = bd * table[t, 1] + cd * table[t, 5] + h * table[t, 9]
    first, second = whiten(layout, k, u, v)
    return first, second, px, py, pz


@inlined
def couple(jacobian: FloatArray, weight: float, out: FloatArray, i: int) -> None:
    """Write W' of an observation, (12,), from :func:`differentiate`, in row i of ``out``."""
    for p in range(6):
        top = weight * jacobian[p]
        low = weight * jacobian[6 + p]
        out[i, p] = jacobian[12] * top + jacobian[14] * low
        out[i, 6 + p] = jacobian[13] * top + jacobian[15] * low


@inlined
def add_camera(
    coupling: FloatArray,
    j: int,
    clock: FloatArray,
    t: int,
    unknowns: int,
    rows: FloatArray,
    i: int,
    column: int,
) -> None:
    """Add W' in row j of ``coupling``, of pair t, to rows i, i + 1 at its camera's ``each`` unknowns."""
    for p in range(6):
        rows[i, column + p] += coupling[j, p]
        rows[i + 1, column + p] += coupling[j, 6 + p]
        for v in range(unknowns - 6):
            by_clock = clock[t, p * (unknowns - 6) + v]
            rows[i, column + 6 + v] += coupling[j, p] * by_clock
            rows[i + 1, column + 6 + v] += coupling[j, 6 + p] * by_clock


@inlined
def _add_corner(
    layout: Layout,
    base: Base,
    clock: FloatArray,
    by_pair: bool,
    q: int,
    c: int,
    first: int,
    scratch: Scratch,
    out: Linearisation,
    total: float,
    product: float,
) -> tuple[float, float]:
    """Add the observations of corner c to gradients, blocks, rows and loss; its unit begins at ``first``."""
    slot, jacobian, coupling, _, block, _, gradient, rows = scratch
    cameras = len(base.table) // layout.moments
    i = 2 * (c - first)
    unknowns = out.tip.shape[1] // cameras
    states = len(base.rows) == 0
    gx = gy = xx = yx = yy = 0.0
    for k in range(layout.begin[c], layout.begin[c + 1]):
        r0, r1, px, py, pz = differentiate(
            layout, base.table, k, base.corners[c, 0], base.corners[c, 1], jacobian
        )
        squared = r0 * r0 + r1 * r1
        total, product = add_loss(base, squared, total, product)
        weight = weigh(base, squared)
        w0 = weight * r0
        w1 = weight * r1
        gx += jacobian[12] * w0 + jacobian[14] * w1
        gy += jacobian[13] * w0 + jacobian[15] * w1
        at = slot[layout.pair[k]]
        camera = layout.pair[k] // layout.moments
        fx = jacobian[0] * w0 + jacobian[6] * w1
        fy = jacobian[7] * w1
        add_force(out.wrench, at, px, py, pz, fx, fy, jacobian[2] * w0 + jacobian[8] * w1)
        weight = floored(weight)
        xx += weight * (jacobian[12] * jacobian[12] + jacobian[14] * jacobian[14])
        yx += weight * (jacobian[13] * jacobian[12] + jacobian[15] * jacobian[14])
        yy += weight * (jacobian[13] * jacobian[13] + jacobian[15] * jacobian[15])
        _add_square(jacobian, weight, out.squares, at if by_pair else q * cameras + camera)
        j = k - layout.begin[first] if states else 0
        couple(jacobian, weight, coupling, j)
        add_camera(coupling, j, clock, layout.pair[k], unknowns, rows, i, camera * unknowns)
    a = layout.control_root[c, 0]
    b = layout.control_root[c, 1]
    d = layout.control_root[c, 2]
    block[i, i] = xx + a * a + b * b
    block[i + 1, i] = yx + b * d
    block[i + 1, i + 1] = yy + d * d
    gradient[i] = gx
    gradient[i + 1] = gy
    return total, product


@inlined
def _add_square(jacobian: FloatArray, weight: float, squares: FloatArray, owner: int) -> None:
    """Add J'J of an observation by its pair, upper triangle row by row, to row ``owner`` of ``own``."""
    m = 0
    for p in range(6):
        top = weight * jacobian[p]
        low = weight * jacobian[6 + p]
        for s in range(p, 6):
            squares[owner, m] += top * jacobian[s] + low * jacobian[6 + s]
            m += 1


@inlined
def _carry_back(layout: Layout, u: int, scratch: Scratch, coupled: FloatArray) -> None:
    """Add W times unit u's ``gradient`` to the pairs that see it."""
    coupling = scratch.coupling
    gradient = scratch.gradient
    first = layout.unit[u]
    for c in range(first, layout.unit[u + 1]):
        x = gradient[2 * (c - first)]
        y = gradient[2 * (c - first) + 1]
        for k in range(layout.begin[c], layout.begin[c + 1]):
            at = scratch.slot[layout.pair[k]]
            j = k - layout.begin[first]
            for p in range(6):
                coupled[at, p] += coupling[j, p] * x + coupling[j, 6 + p] * y


@inlined
def _add_products(rows: FloatArray, count: int, tip: FloatArray) -> None:
    """Add B'B of a unit's ``count`` rows to the lower triangle of the ``tip``."""
    for i in range(0, count, 2):
        for p in range(len(tip)):
            top = rows[i, p]
            low = rows[i + 1, p]
            for s in range(p + 1):
                tip[p, s] += top * rows[i, s] + low * rows[i + 1, s]


@twin("adjust.linearise")
@kernel
def linearise(
    begin: int,
    end: int,
    layout: Layout,
    base: Base,
    clock: FloatArray,
    by_pair: bool,
    scratch: Scratch,
    out: Linearisation,
) -> None:
    """Linearise chunks ``begin`` to ``end``, writing factors and rows of ``base``.

    ``clock`` (P, 6 Q) are the pairs' left tangents by their camera's clock offsets; ``by_pair`` requests J'J
    by pair.
    """
    states = len(base.rows) == 0
    width = out.tip.shape[1]
    block = scratch.block
    gradient = scratch.gradient
    rows = scratch.rows
    for q in range(begin, end):
        number_touched(layout, q, scratch.slot)
        total = 0.0
        product = 1.0
        for u in range(layout.chunk[q], layout.chunk[q + 1]):
            first = layout.unit[u]
            last = layout.unit[u + 1]
            size = last - first
            block[: 2 * size, : 2 * size] = 0.0
            gradient[: 2 * size] = 0.0
            rows[: 2 * size] = 0.0
            for c in range(first, last):
                total, product = _add_corner(
                    layout, base, clock, by_pair, q, c, first, scratch, out, total, product
                )
            add_corner_priors(layout, u, base.corners, gradient, out.costs[q])
            _add_lengths(layout, u, base.corners, block)
            if layout.is_kept[u]:
                keep_unit(layout, base, u, block)
                for i in range(2 * size):
                    out.whitened[2 * first + i] = gradient[i]
                continue
            if not factorise_unit(layout, base, u, block):
                out.failed[q] += 1.0
                continue
            solve_unit(layout, base, u, gradient)
            solve_unit_rows(layout, base, u, rows, 0, width)
            for i in range(2 * size):
                out.whitened[2 * first + i] = gradient[i]
                for p in range(0 if states else width):
                    base.rows[2 * first + i, p] = rows[i, p]
                    out.carried[q, p] += rows[i, p] * gradient[i]
            if states:
                solve_unit_transposed(layout, base, u, gradient)
                _carry_back(layout, u, scratch, out.coupled)
            _add_products(rows, 2 * size, out.tip[q])
        if base.code == 2:
            total += base.scale * base.scale * math.log(product)
        out.costs[q, 0] = total / 2


@inlined
def _add_lengths(layout: Layout, u: int, corners: FloatArray, block: FloatArray) -> None:
    """Add J'J of a unit's known lengths to the lower triangle of its block."""
    first = layout.unit[u]
    for m in range(layout.length_at[u], layout.length_at[u + 1]):
        _, jx, jy = length_residual(layout, m, corners)
        a = 2 * (layout.length_first[m] - first)
        b = 2 * (layout.length_second[m] - first)
        for at in (a, b):
            block[at, at] += jx * jx
            block[at + 1, at] += jx * jy
            block[at + 1, at + 1] += jy * jy
        low = min(a, b)
        high = max(a, b)
        block[high, low] -= jx * jx
        block[high, low + 1] -= jx * jy
        block[high + 1, low] -= jx * jy
        block[high + 1, low + 1] -= jy * jy


class TileMap(NamedTuple):
    """Positions of the tiles of a :class:`~v2hdm.adjust.tiles.TiledMatrix` among its ``values``."""

    per_tile: int  # frames per tile
    size: int  # rows per tile
    position: IntArray  # (G,) elimination order of each tile along the route
    begin: IntArray  # (G,) diagonal tile of each column
    row: IntArray  # of each tile, G for the tip's; its offset is ``at``
    at: IntArray


@inlined
def _touch(layout: Layout, u: int, tiles: TileMap, marks: IntArray) -> int:
    """List the tiles of unit u in elimination order, with ``marks`` by tile; returns their number."""
    mark = marks[0]
    place = marks[1]
    touched = marks[2]
    count = 0
    for k in range(layout.begin[layout.unit[u]], layout.begin[layout.unit[u + 1]]):
        tile = layout.frame[layout.pair[k] % layout.moments] // tiles.per_tile
        if mark[tile] != u:
            mark[tile] = u
            touched[count] = tile
            count += 1
    for a in range(1, count):
        tile = touched[a]
        b = a
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
    """Subtract B'B of a unit's ``rows`` (2g, ...) in columns ``begin`` to ``end`` of its ``count`` tiles."""
    size = tiles.size
    touched = marks[2]
    low = marks[3]
    high = marks[4]
    for a in range(count):
        column = tiles.position[touched[a]]
        if not begin <= column < end:
            continue
        for b in range(a, count + 1):
            row = len(tiles.begin) if b == count else tiles.position[touched[b]]
            place_of_tile = tiles.begin[column]
            while tiles.row[place_of_tile] != row:
                place_of_tile += 1
            for i in range(0, len(rows), 2):
                for r in range(low[b], high[b]):
                    x = rows[i, b * size + r]
                    y = rows[i + 1, b * size + r]
                    if x == 0.0 and y == 0.0:
                        continue
                    # Diagonal tiles are lower triangular.
                    stop = r + 1 if a == b else high[a]
                    at = tiles.at[place_of_tile] + r * size
                    right = a * size
                    out = values[at + low[a] : at + stop]
                    top = rows[i, right + low[a] : right + stop]
                    bottom = rows[i + 1, right + low[a] : right + stop]
                    for s in range(len(out)):
                        out[s] -= x * top[s] + y * bottom[s]


@inlined
def _fill_rows(
    u: int,
    count: int,
    layout: Layout,
    base: Base,
    tiles: TileMap,
    by_state: FloatArray,
    clock: FloatArray,
    unknowns: int,
    marks: IntArray,
    scratch: Scratch,
) -> None:
    """Write the rows of unit ``u`` by its ``count`` tiles and the tip, and their nonzero columns.

    Arguments are those of :func:`subtract_frames`.
    """
    states = by_state.shape[1] // 6
    size = tiles.size
    width = len(base.table) // layout.moments * unknowns
    place = marks[1]
    low = marks[3]
    high = marks[4]
    jacobian = scratch.jacobian
    w = scratch.coupling
    rows = scratch.rows
    low[:count] = size
    high[:count] = 0
    low[count] = 0
    high[count] = width
    first = layout.unit[u]
    last = layout.unit[u + 1]
    tip = count * size
    rows[: 2 * (last - first), : tip + width] = 0.0
    for c in range(first, last):
        i = 2 * (c - first)
        for k in range(layout.begin[c], layout.begin[c + 1]):
            t = layout.pair[k]
            x = base.corners[c, 0]
            y = base.corners[c, 1]
            r0, r1, _, _, _ = differentiate(layout, base.table, k, x, y, jacobian)
            couple(jacobian, floored(weigh(base, r0 * r0 + r1 * r1)), w, 0)
            frame = layout.frame[t % layout.moments]
            a = place[frame // tiles.per_tile]
            within = frame % tiles.per_tile * states
            low[a] = min(low[a], within)
            high[a] = max(high[a], within + states)
            column = a * size + within
            for p in range(6):
                for s in range(states):
                    rows[i, column + s] += w[0, p] * by_state[t, p * states + s]
                    rows[i + 1, column + s] += w[0, 6 + p] * by_state[t, p * states + s]
            add_camera(w, 0, clock, t, unknowns, rows, i, tip + t // layout.moments * unknowns)


@twin("adjust.subtract_frames")
@kernel
def subtract_frames(
    begin: int,
    end: int,
    layout: Layout,
    base: Base,
    tiles: TileMap,
    by_state: FloatArray,
    clock: FloatArray,
    unknowns: int,
    marks: IntArray,
    scratch: Scratch,
    values: FloatArray,
) -> None:
    """Subtract B'B of all corners from columns ``begin`` to ``end`` of the reduced system's ``values``.

    Every column is summed in the same order, for any division among threads. ``by_state`` (P, 6 S) and
    ``clock`` (P, 6 Q) are the pairs' left tangents by frame states and clock offsets; a camera has ``each``
    unknowns. ``marks`` (5, G + 1), initially -1, is scratch: its last two rows are the nonzero columns of
    each touched tile and of the tip.
    """
    size = tiles.size
    touched = marks[2]
    low = marks[3]
    high = marks[4]
    rows = scratch.rows
    for u in range(len(layout.unit) - 1):
        if layout.is_kept[u]:
            continue
        count = _touch(layout, u, tiles, marks)
        is_wanted = False
        for a in range(count):
            is_wanted |= begin <= tiles.position[touched[a]] < end
        if not is_wanted:
            continue
        _fill_rows(u, count, layout, base, tiles, by_state, clock, unknowns, marks, scratch)
        for a in range(count + 1):
            solve_unit_rows(layout, base, u, rows, a * size + low[a], a * size + high[a])
        height = 2 * (layout.unit[u + 1] - layout.unit[u])
        _subtract_products(begin, end, tiles, marks, count, rows[:height], values)
