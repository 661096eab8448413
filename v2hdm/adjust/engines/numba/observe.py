"""Where corners start, and what the report says of each observation."""

from __future__ import annotations

import math
from typing import NamedTuple

from v2hdm.adjust.engines.numba.inline import floored, see, weigh, whiten
from v2hdm.adjust.engines.numba.layout import Base, Layout
from v2hdm.adjust.engines.numba.linearise import couple, differentiate
from v2hdm.adjust.model import MIN_DEPRESSION_SINE
from v2hdm.compiled import kernel
from v2hdm.geometry.tensors import NEAR_M
from v2hdm.records import BoolArray, FloatArray, IntArray


@kernel
def back_project(
    begin: int, end: int, layout: Layout, table: FloatArray, corners: FloatArray, fixed: BoolArray
) -> None:
    """Start the corners (N, 2) of chunks ``begin`` to ``end``, and say which (N,) a ray fixes."""
    for c in range(layout.unit[layout.chunk[begin]], layout.unit[layout.chunk[end]]):
        xx = yx = yy = x = y = 0.0
        for k in range(layout.begin[c], layout.begin[c + 1]):
            t = layout.pair[k]
            u, v = layout.measured[0, k], layout.measured[1, k]
            # The ray and the camera's centre in the map, by the transposed rotation.
            dx = table[t, 0] * u + table[t, 4] * v + table[t, 8]
            dy = table[t, 1] * u + table[t, 5] * v + table[t, 9]
            dz = table[t, 2] * u + table[t, 6] * v + table[t, 10]
            least = MIN_DEPRESSION_SINE * MIN_DEPRESSION_SINE * (dx * dx + dy * dy + dz * dz)
            if not (dz < 0 and dz * dz > least):
                continue
            sx, sy, sz = table[t, 3], table[t, 7], table[t, 11]
            reach = (table[t, 2] * sx + table[t, 6] * sy + table[t, 10] * sz) / dz
            gx = reach * dx - (table[t, 0] * sx + table[t, 4] * sy + table[t, 8] * sz)
            gy = reach * dy - (table[t, 1] * sx + table[t, 5] * sy + table[t, 9] * sz)
            px, py, _, inverse, slope, _, _ = see(layout, table, k, gx, gy)
            xu = inverse * table[t, 0] + slope * px * table[t, 8]
            yu = inverse * table[t, 1] + slope * px * table[t, 9]
            xv = inverse * table[t, 4] + slope * py * table[t, 8]
            yv = inverse * table[t, 5] + slope * py * table[t, 9]
            j0, j2 = whiten(layout, k, xu, xv)
            j1, j3 = whiten(layout, k, yu, yv)
            a, b, d = j0 * j0 + j2 * j2, j0 * j1 + j2 * j3, j1 * j1 + j3 * j3
            xx, yx, yy = xx + a, yx + b, yy + d
            x, y = x + a * gx + b * gy, y + b * gx + d * gy
        fixed[c] = xx > 0
        if not xx > 0:
            corners[c, 0] = corners[c, 1] = 0.0
            continue
        first = math.sqrt(xx)
        below = yx / first
        rest, least = yy - below * below, 1e-12 * yy
        last = math.sqrt(least if rest < least else rest)
        top = x / first
        low = (y - below * top) / last / last
        corners[c, 0], corners[c, 1] = (top - below * low) / first, low


class Report(NamedTuple):
    """The report on the problem's observations (K,), in its order: see :class:`v2hdm.adjust.Solution`."""

    residual_px: FloatArray
    mahalanobis2: FloatArray
    behind: BoolArray


@kernel
def report(
    begin: int,
    end: int,
    layout: Layout,
    table: FloatArray,
    corners: FloatArray,
    order: IntArray,
    focal: FloatArray,
    out: Report,
) -> None:
    """Report on chunks ``begin`` to ``end``; ``order`` (K,) is the problem's, ``focal`` (C, 2) in px."""
    for c in range(layout.unit[layout.chunk[begin]], layout.unit[layout.chunk[end]]):
        x, y = corners[c, 0], corners[c, 1]
        for k in range(layout.begin[c], layout.begin[c + 1]):
            _, _, pz, _, _, u, v = see(layout, table, k, x, y)
            r0, r1 = whiten(layout, k, u, v)
            row, camera = order[k], layout.pair[k] // layout.moments
            out.residual_px[row, 0] = u * focal[camera, 0]
            out.residual_px[row, 1] = v * focal[camera, 1]
            out.mahalanobis2[row] = r0 * r0 + r1 * r1
            out.behind[row] = pz <= NEAR_M


@kernel
def residuals(
    begin: int, end: int, layout: Layout, table: FloatArray, corners: FloatArray, out: FloatArray
) -> None:
    """Whitened residuals (2, K) of the observations of chunks ``begin`` to ``end``."""
    for c in range(layout.unit[layout.chunk[begin]], layout.unit[layout.chunk[end]]):
        x, y = corners[c, 0], corners[c, 1]
        for k in range(layout.begin[c], layout.begin[c + 1]):
            _, _, _, _, _, u, v = see(layout, table, k, x, y)
            out[0, k], out[1, k] = whiten(layout, k, u, v)


@kernel
def pull(
    layout: Layout,
    table: FloatArray,
    corners: FloatArray,
    by_residual: FloatArray,
    jacobian: FloatArray,
    wrench: FloatArray,
    by_corner: FloatArray,
) -> None:
    """Add the gradients by the pairs (P, 6) and by corner (N, 2), from that by the residuals (2, K)."""
    for c in range(len(corners)):
        for k in range(layout.begin[c], layout.begin[c + 1]):
            differentiate(layout, table, k, corners[c, 0], corners[c, 1], jacobian)
            r0, r1 = by_residual[0, k], by_residual[1, k]
            by_corner[c, 0] += jacobian[12] * r0 + jacobian[14] * r1
            by_corner[c, 1] += jacobian[13] * r0 + jacobian[15] * r1
            for p in range(6):
                wrench[layout.pair[k], p] += jacobian[p] * r0 + jacobian[6 + p] * r1


@kernel
def couplings(layout: Layout, base: Base, corner: IntArray, jacobian: FloatArray, out: FloatArray) -> None:
    """Write W' (k, 12) of the layout's observations, of the base's corners, numbered by ``corner``."""
    for k in range(len(corner)):
        x, y = base.corners[corner[k], 0], base.corners[corner[k], 1]
        r0, r1, _, _, _ = differentiate(layout, base.table, k, x, y, jacobian)
        couple(jacobian, floored(weigh(base, r0 * r0 + r1 * r1)), out, k)
