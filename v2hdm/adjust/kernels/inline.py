"""Common parts of the kernels: an observation, a loss, the factor of a unit's corners.

They are the closed forms of :mod:`~v2hdm.adjust.model` and :mod:`~v2hdm.adjust.reduced`, tested against them.
A pair's table is its ``cam_from_map``, row by row (16,).
"""

from __future__ import annotations

import math

from v2hdm.adjust.engine import WEIGHT_FLOOR
from v2hdm.adjust.kernels.layout import Base, Layout
from v2hdm.adjust.reduced import CORNER_FLOOR, PIVOT_FLOOR
from v2hdm.compiled import inlined
from v2hdm.geometry.tensors import NEAR_M
from v2hdm.records import FloatArray, IntArray

_Seen = tuple[float, float, float, float, float, float, float]

_LARGE = 1e150  # above it the Cauchy loss takes the logarithm of its product, before that overflows


@inlined
def see(layout: Layout, table: FloatArray, k: int, x: float, y: float) -> _Seen:
    """Observation k of ground point x, y: point in the camera, inverse depth and its slope, and residual."""
    t = layout.pair[k]
    px = table[t, 0] * x + table[t, 1] * y + table[t, 3]
    py = table[t, 4] * x + table[t, 5] * y + table[t, 7]
    pz = table[t, 8] * x + table[t, 9] * y + table[t, 11]
    at_least = pz if not pz < NEAR_M else NEAR_M
    reciprocal = 1.0 / at_least
    slope = -reciprocal * reciprocal
    inverse = reciprocal + slope * (pz - at_least)
    u = px * inverse - layout.measured[0, k]
    v = py * inverse - layout.measured[1, k]
    return px, py, pz, inverse, slope, u, v


@inlined
def whiten(layout: Layout, k: int, u: float, v: float) -> tuple[float, float]:
    """The whitened residual of observation k."""
    return layout.root[0, k] * u, layout.root[1, k] * u + layout.root[2, k] * v


@inlined
def weigh(base: Base, squared: float) -> float:
    """Derivative of the loss."""
    if base.code == 0:
        return 1.0
    cut = base.scale * base.scale
    if base.code == 1:
        return 1.0 if squared <= cut else base.scale / math.sqrt(squared)
    weight = cut / (cut + squared)
    return weight if base.code == 2 else weight * weight


@inlined
def floored(weight: float) -> float:
    """A weight with the Hessian's floor."""
    return WEIGHT_FLOOR if weight < WEIGHT_FLOOR else weight


@inlined
def add_loss(base: Base, squared: float, total: float, product: float) -> tuple[float, float]:
    """Add the loss to a total; the Cauchy loss to a product instead: one logarithm for many terms."""
    if base.code == 0:
        return total + squared, product
    cut = base.scale * base.scale
    if base.code == 1:
        return total + (squared if squared <= cut else 2 * base.scale * math.sqrt(squared) - cut), product
    ratio = squared / cut
    if base.code == 3:
        return total + squared / (1 + ratio), product
    if not ratio < _LARGE:
        return total + cut * math.log1p(ratio), product
    product *= 1 + ratio
    if product > _LARGE:
        return total + cut * math.log(product), 1.0
    return total, product


@inlined
def add_force(
    out: FloatArray, at: int, px: float, py: float, pz: float, fx: float, fy: float, fz: float
) -> None:
    """Add a force at a point to row ``at`` of wrenches (n, 6)."""
    out[at, 0] += fx
    out[at, 1] += fy
    out[at, 2] += fz
    out[at, 3] += py * fz - pz * fy
    out[at, 4] += pz * fx - px * fz
    out[at, 5] += px * fy - py * fx


@inlined
def add_corner_priors(
    layout: Layout, u: int, corners: FloatArray, gradient: FloatArray, costs: FloatArray
) -> None:
    """Add a unit's survey and known lengths to its gradient (2g,), and to ``costs[1]`` and ``costs[2]``."""
    first = layout.unit[u]
    for c in range(first, layout.unit[u + 1]):
        x = layout.control_root[c, 0]
        y = layout.control_root[c, 2]
        if x > 0 or y > 0:
            yx = layout.control_root[c, 1]
            dx = corners[c, 0] - layout.control[c, 0]
            top = x * dx
            low = yx * dx + y * (corners[c, 1] - layout.control[c, 1])
            gradient[2 * (c - first)] += x * top + yx * low
            gradient[2 * (c - first) + 1] += y * low
            costs[1] += (top * top + low * low) / 2
    for m in range(layout.length_at[u], layout.length_at[u + 1]):
        residual, jx, jy = length_residual(layout, m, corners)
        a = 2 * (layout.length_first[m] - first)
        b = 2 * (layout.length_second[m] - first)
        gradient[a] += jx * residual
        gradient[a + 1] += jy * residual
        gradient[b] -= jx * residual
        gradient[b + 1] -= jy * residual
        costs[2] += residual * residual / 2


@inlined
def length_residual(layout: Layout, m: int, corners: FloatArray) -> tuple[float, float, float]:
    """Whitened residual of a known length, and its derivative by the first corner."""
    a = layout.length_first[m]
    b = layout.length_second[m]
    dx = corners[a, 0] - corners[b, 0]
    dy = corners[a, 1] - corners[b, 1]
    distance = math.sqrt(dx * dx + dy * dy)
    root = layout.length_root[m]
    over = root / distance if distance > 0 else 0.0
    return (distance - layout.length_m[m]) * root, dx * over, dy * over


@inlined
def unit_of(layout: Layout, u: int) -> tuple[int, int, int]:
    """Twice a unit's number of corners, its first corner, and the offset of its factor if joined."""
    first = layout.unit[u]
    return 2 * (layout.unit[u + 1] - first), first, layout.joint_at[u]


@inlined
def factorise_unit(layout: Layout, base: Base, u: int, block: FloatArray) -> bool:
    """Factorise a unit's block (2g, 2g) into ``base.lower``, or ``base.joint`` for joined corners."""
    (n, c, at) = unit_of(layout, u)
    lower = base.lower
    joint = base.joint
    for i in range(n):
        block[i, i] += CORNER_FLOOR
    if n == 2:
        first = math.sqrt(block[0, 0])
        below = block[1, 0] / first
        remainder = block[1, 1] - below * below
        least = PIVOT_FLOOR * block[1, 1]
        lower[0, c] = first
        lower[1, c] = below
        lower[2, c] = math.sqrt(least if remainder < least else remainder)
        return True
    for i in range(n // 2):
        lower[0, c + i] = 1.0
        lower[1, c + i] = 0.0
        lower[2, c + i] = 1.0
    for i in range(n):
        for j in range(i + 1):
            remainder = block[i, j]
            for m in range(j):
                remainder -= joint[at + i * n + m] * joint[at + j * n + m]
            if j < i:
                joint[at + i * n + j] = remainder / joint[at + j * n + j]
            elif remainder > 0:
                joint[at + i * n + i] = math.sqrt(remainder)
            else:
                return False
        for j in range(i + 1, n):
            joint[at + i * n + j] = 0.0
    return True


@inlined
def keep_unit(layout: Layout, base: Base, u: int, block: FloatArray) -> None:
    """Write a unit's block, unfactorised, in place of its factor."""
    n, c, at = unit_of(layout, u)
    for i in range(n):
        block[i, i] += CORNER_FLOOR
    if n == 2:
        base.lower[0, c] = block[0, 0]
        base.lower[1, c] = block[1, 0]
        base.lower[2, c] = block[1, 1]
        return
    for i in range(n):
        for j in range(n):
            base.joint[at + i * n + j] = block[i, j] if j <= i else 0.0


@inlined
def solve_unit(layout: Layout, base: Base, u: int, right: FloatArray) -> None:
    """Replace b (2g,) by L^-1 b."""
    (n, c, at) = unit_of(layout, u)
    lower = base.lower
    joint = base.joint
    if n == 2:
        right[0] /= lower[0, c]
        right[1] = (right[1] - lower[1, c] * right[0]) / lower[2, c]
        return
    for i in range(n):
        remainder = right[i]
        for m in range(i):
            remainder -= joint[at + i * n + m] * right[m]
        right[i] = remainder / joint[at + i * n + i]


@inlined
def solve_unit_transposed(layout: Layout, base: Base, u: int, right: FloatArray) -> None:
    """Replace b (2g,) by L^-T b."""
    (n, c, at) = unit_of(layout, u)
    lower = base.lower
    joint = base.joint
    if n == 2:
        right[1] /= lower[2, c]
        right[0] = (right[0] - lower[1, c] * right[1]) / lower[0, c]
        return
    for i in range(n - 1, -1, -1):
        remainder = right[i]
        for m in range(i + 1, n):
            remainder -= joint[at + m * n + i] * right[m]
        right[i] = remainder / joint[at + i * n + i]


@inlined
def solve_unit_rows(layout: Layout, base: Base, u: int, rows: FloatArray, begin: int, end: int) -> None:
    """Replace b (2g, end - begin), columns ``begin`` to ``end`` of ``rows``, by L^-1 b."""
    (n, c, at) = unit_of(layout, u)
    lower = base.lower
    joint = base.joint
    if n == 2:
        first = lower[0, c]
        below = lower[1, c]
        last = lower[2, c]
        for p in range(begin, end):
            rows[0, p] /= first
            rows[1, p] = (rows[1, p] - below * rows[0, p]) / last
        return
    for i in range(n):
        for m in range(i):
            factor = joint[at + i * n + m]
            for p in range(begin, end):
                rows[i, p] -= factor * rows[m, p]
        pivot = joint[at + i * n + i]
        for p in range(begin, end):
            rows[i, p] /= pivot


@inlined
def along_axes(table: FloatArray, t: int, fx: float, fy: float, fz: float) -> tuple[float, float]:
    """Gradient by a corner from the gradient f by its point in pair t."""
    return (
        table[t, 0] * fx + table[t, 4] * fy + table[t, 8] * fz,
        table[t, 1] * fx + table[t, 5] * fy + table[t, 9] * fz,
    )


@inlined
def number_touched(layout: Layout, q: int, slot: IntArray) -> None:
    """Number the pairs of chunk q in ``slot`` (P,)."""
    begin = layout.touched_at[q]
    for i in range(begin, layout.touched_at[q + 1]):
        slot[layout.touched[i]] = i
