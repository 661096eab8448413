"""Corners moved, cost and gradient, and the gradient carried back, in one pass."""

from __future__ import annotations

import math
from typing import NamedTuple

from v2hdm.adjust.engines.numba.inline import (
    add_corner_priors,
    add_force,
    add_loss,
    along_axes,
    floored,
    number_touched,
    see,
    solve_unit,
    solve_unit_transposed,
    weigh,
    whiten,
)
from v2hdm.adjust.engines.numba.layout import Base, Layout, Scratch
from v2hdm.compiled import inlined, kernel
from v2hdm.records import FloatArray


class Evaluation(NamedTuple):
    """The output of :func:`evaluate`, as in :class:`~v2hdm.adjust.engines.numba.linearise.Linearisation`.

    ``corners`` (N, 2) are those moved; ``whitened`` (2 N,) is the gradient by their whitened variables.
    """

    costs: FloatArray
    wrench: FloatArray
    coupled: FloatArray
    carried: FloatArray
    corners: FloatArray
    whitened: FloatArray


@inlined
def _oppose(known: FloatArray, i: int, mx: float, my: float, mz: float) -> tuple[float, float, float]:
    """The force with which the observation in row i of ``known`` opposes a motion of its point."""
    along = known[i, 4] * mz
    x, y = mx * known[i, 3] + known[i, 0] * along, my * known[i, 3] + known[i, 1] * along
    fu, fv = known[i, 5] * x + known[i, 6] * y, known[i, 6] * x + known[i, 7] * y
    return fu * known[i, 3], fv * known[i, 3], (fu * known[i, 0] + fv * known[i, 1]) * known[i, 4]


@inlined
def _recall(layout: Layout, base: Base, k: int, c: int, known: FloatArray, i: int) -> None:
    """Write a linearised observation (8,): point, inverse depth, slope, weighted information at depth 1."""
    px, py, pz, inverse, slope, u, v = see(layout, base.table, k, base.corners[c, 0], base.corners[c, 1])
    a, b, d = layout.root[0, k], layout.root[1, k], layout.root[2, k]
    weight = 1.0
    if base.code:
        r0, r1 = whiten(layout, k, u, v)
        weight = floored(weigh(base, r0 * r0 + r1 * r1))
    known[i, 0], known[i, 1], known[i, 2], known[i, 3], known[i, 4] = px, py, pz, inverse, slope
    known[i, 5], known[i, 6], known[i, 7] = (a * a + b * b) * weight, b * d * weight, d * d * weight


@inlined
def _carry(
    layout: Layout, base: Base, q: int, u: int, coupled: bool, scratch: Scratch, out: Evaluation
) -> None:
    """Whiten the gradient of unit u of chunk q, and add W V^-1 g to the pairs' or to the cameras'."""
    slot, _, _, known, _, _, gradient, _ = scratch
    first, last = layout.unit[u], layout.unit[u + 1]
    solve_unit(layout, base, u, gradient)
    for i in range(2 * (last - first)):
        out.whitened[2 * first + i] = gradient[i]
        for p in range(base.rows.shape[1] if len(base.rows) else 0):
            out.carried[q, p] += base.rows[2 * first + i, p] * gradient[i]
    if not coupled:
        return
    solve_unit_transposed(layout, base, u, gradient)
    for c in range(first, last):
        x, y = gradient[2 * (c - first)], gradient[2 * (c - first) + 1]
        for k in range(layout.begin[c], layout.begin[c + 1]):
            j, t = k - layout.begin[first], layout.pair[k]
            fx, fy, fz = _oppose(
                known,
                j,
                base.table[t, 0] * x + base.table[t, 1] * y,
                base.table[t, 4] * x + base.table[t, 5] * y,
                base.table[t, 8] * x + base.table[t, 9] * y,
            )
            add_force(out.coupled, slot[t], known[j, 0], known[j, 1], known[j, 2], fx, fy, fz)


@kernel
def carry(
    begin: int, end: int, layout: Layout, base: Base, by_corner: FloatArray, scratch: Scratch, out: Evaluation
) -> None:
    """Whiten a gradient (N, 2) by the corners of chunks ``begin`` to ``end``; see :func:`evaluate`."""
    for q in range(begin, end):
        number_touched(layout, q, scratch.slot)
        for u in range(layout.chunk[q], layout.chunk[q + 1]):
            first = layout.unit[u]
            coupled = len(base.rows) == 0 and not layout.kept[u]
            for c in range(first, layout.unit[u + 1]):
                i = 2 * (c - first)
                scratch.gradient[i], scratch.gradient[i + 1] = by_corner[c, 0], by_corner[c, 1]
                for k in range(layout.begin[c], layout.begin[c + 1] if coupled else layout.begin[c]):
                    _recall(layout, base, k, c, scratch.known, k - layout.begin[first])
            _carry(layout, base, q, u, coupled, scratch, out)


@kernel
def evaluate(
    begin: int,
    end: int,
    layout: Layout,
    base: Base,
    table: FloatArray,
    motion: FloatArray,
    cameras: FloatArray,
    own: FloatArray,
    scratch: Scratch,
    out: Evaluation,
) -> None:
    """Evaluate chunks ``begin`` to ``end`` at a step from where the whitening was made.

    ``table`` (P, 16) is of the pairs after the step, ``motion`` (P, 6) the step as their left tangents, where
    frames have states, ``cameras`` (D,) that of the cameras' unknowns, ``own`` (2 N,) the corners' whitened
    variables.
    """
    slot, _, _, known, _, step, gradient, _ = scratch
    states = len(base.rows) == 0
    for q in range(begin, end):
        number_touched(layout, q, slot)
        total, product = 0.0, 1.0
        for u in range(layout.chunk[q], layout.chunk[q + 1]):
            first, last = layout.unit[u], layout.unit[u + 1]
            coupled = states and not layout.kept[u]
            for c in range(first, last):
                sx = sy = 0.0
                if not states:
                    for p in range(len(cameras)):
                        sx += base.rows[2 * c, p] * cameras[p]
                        sy += base.rows[2 * c + 1, p] * cameras[p]
                for k in range(layout.begin[c], layout.begin[c + 1] if coupled else layout.begin[c]):
                    j, t = k - layout.begin[first], layout.pair[k]
                    _recall(layout, base, k, c, known, j)
                    fx, fy, fz = _oppose(
                        known,
                        j,
                        motion[t, 0] + motion[t, 4] * known[j, 2] - motion[t, 5] * known[j, 1],
                        motion[t, 1] + motion[t, 5] * known[j, 0] - motion[t, 3] * known[j, 2],
                        motion[t, 2] + motion[t, 3] * known[j, 1] - motion[t, 4] * known[j, 0],
                    )
                    ax, ay = along_axes(base.table, t, fx, fy, fz)
                    sx += ax
                    sy += ay
                i = 2 * (c - first)
                step[i], step[i + 1] = sx, sy
            if coupled:
                solve_unit(layout, base, u, step)
            for i in range(2 * (last - first)):
                step[i] = own[2 * first + i] - step[i]
            solve_unit_transposed(layout, base, u, step)
            for c in range(first, last):
                i = 2 * (c - first)
                x, y = base.corners[c, 0] + step[i], base.corners[c, 1] + step[i + 1]
                out.corners[c, 0], out.corners[c, 1] = x, y
                gx = gy = 0.0
                for k in range(layout.begin[c], layout.begin[c + 1]):
                    px, py, pz, inverse, slope, du, dv = see(layout, table, k, x, y)
                    r0, r1 = whiten(layout, k, du, dv)
                    squared = r0 * r0 + r1 * r1
                    total, product = add_loss(base, squared, total, product)
                    weight = weigh(base, squared)
                    w0, w1 = weight * r0, weight * r1
                    fu = layout.root[0, k] * w0 + layout.root[1, k] * w1
                    fv = layout.root[2, k] * w1
                    fx, fy, fz = fu * inverse, fv * inverse, (fu * px + fv * py) * slope
                    ax, ay = along_axes(table, layout.pair[k], fx, fy, fz)
                    gx += ax
                    gy += ay
                    add_force(out.wrench, slot[layout.pair[k]], px, py, pz, fx, fy, fz)
                gradient[i], gradient[i + 1] = gx, gy
            add_corner_priors(layout, u, out.corners, gradient, out.costs[q])
            _carry(layout, base, q, u, coupled, scratch, out)
        if base.code == 2:
            total += base.scale * base.scale * math.log(product)
        out.costs[q, 0] = total / 2
