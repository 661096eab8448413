"""Start and motion of corners, cost and gradient, back-propagation, and the report on observations."""

from __future__ import annotations

import math
from typing import NamedTuple

from v2hdm.adjust.engine import Report
from v2hdm.adjust.kernels.inline import (
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
from v2hdm.adjust.kernels.layout import Base, Layout, Scratch
from v2hdm.adjust.kernels.linearise import couple, differentiate
from v2hdm.adjust.model import MIN_DEPRESSION_SINE
from v2hdm.adjust.reduced import PIVOT_FLOOR
from v2hdm.compiled import inlined, kernel, twin
from v2hdm.geometry.tensors import NEAR_M
from v2hdm.records import BoolArray, FloatArray, IntArray


class Evaluation(NamedTuple):
    """Output of :func:`evaluate`, as in :class:`~v2hdm.adjust.kernels.linearise.Linearisation`.

    ``corners`` (N, 2) have moved; ``whitened`` (2 N,) is the gradient by their whitened variables.
    """

    costs: FloatArray
    wrench: FloatArray
    coupled: FloatArray
    carried: FloatArray
    corners: FloatArray
    whitened: FloatArray


@inlined
def _oppose(observed: FloatArray, i: int, mx: float, my: float, mz: float) -> tuple[float, float, float]:
    """Force with which the observation in row i of ``known`` opposes a motion of its point."""
    along = observed[i, 4] * mz
    x = mx * observed[i, 3] + observed[i, 0] * along
    y = my * observed[i, 3] + observed[i, 1] * along
    fu = observed[i, 5] * x + observed[i, 6] * y
    fv = observed[i, 6] * x + observed[i, 7] * y
    return (
        fu * observed[i, 3],
        fv * observed[i, 3],
        (fu * observed[i, 0] + fv * observed[i, 1]) * observed[i, 4],
    )


@inlined
def _recall(layout: Layout, base: Base, k: int, c: int, observed: FloatArray, i: int) -> None:
    """Write a linearised observation (8,): point, inverse depth, slope, weighted information at depth 1."""
    px, py, pz, inverse, slope, u, v = see(layout, base.table, k, base.corners[c, 0], base.corners[c, 1])
    a = layout.root[0, k]
    b = layout.root[1, k]
    d = layout.root[2, k]
    weight = 1.0
    if base.code:
        r0, r1 = whiten(layout, k, u, v)
        weight = floored(weigh(base, r0 * r0 + r1 * r1))
    observed[i, 0] = px
    observed[i, 1] = py
    observed[i, 2] = pz
    observed[i, 3] = inverse
    observed[i, 4] = slope
    observed[i, 5] = (a * a + b * b) * weight
    observed[i, 6] = b * d * weight
    observed[i, 7] = d * d * weight


@inlined
def _carry(
    layout: Layout, base: Base, q: int, u: int, coupled: bool, scratch: Scratch, out: Evaluation
) -> None:
    """Whiten the gradient of unit u of chunk q, and add W V^-1 g to the pairs' or to the cameras'."""
    slot, _, _, observed, _, _, gradient, _ = scratch
    first = layout.unit[u]
    last = layout.unit[u + 1]
    solve_unit(layout, base, u, gradient)
    for i in range(2 * (last - first)):
        out.whitened[2 * first + i] = gradient[i]
        for p in range(base.rows.shape[1] if len(base.rows) else 0):
            out.carried[q, p] += base.rows[2 * first + i, p] * gradient[i]
    if not coupled:
        return
    solve_unit_transposed(layout, base, u, gradient)
    for c in range(first, last):
        x = gradient[2 * (c - first)]
        y = gradient[2 * (c - first) + 1]
        for k in range(layout.begin[c], layout.begin[c + 1]):
            j = k - layout.begin[first]
            t = layout.pair[k]
            mx = base.table[t, 0] * x + base.table[t, 1] * y
            my = base.table[t, 4] * x + base.table[t, 5] * y
            mz = base.table[t, 8] * x + base.table[t, 9] * y
            fx, fy, fz = _oppose(observed, j, mx, my, mz)
            add_force(out.coupled, slot[t], observed[j, 0], observed[j, 1], observed[j, 2], fx, fy, fz)


@twin("adjust.carry")
@kernel
def carry(
    begin: int, end: int, layout: Layout, base: Base, by_corner: FloatArray, scratch: Scratch, out: Evaluation
) -> None:
    """Whiten a gradient (N, 2) by the corners of chunks ``begin`` to ``end``; see :func:`evaluate`."""
    for q in range(begin, end):
        number_touched(layout, q, scratch.slot)
        for u in range(layout.chunk[q], layout.chunk[q + 1]):
            first = layout.unit[u]
            coupled = len(base.rows) == 0 and not layout.is_kept[u]
            for c in range(first, layout.unit[u + 1]):
                i = 2 * (c - first)
                scratch.gradient[i] = by_corner[c, 0]
                scratch.gradient[i + 1] = by_corner[c, 1]
                for k in range(layout.begin[c], layout.begin[c + 1] if coupled else layout.begin[c]):
                    _recall(layout, base, k, c, scratch.observed, k - layout.begin[first])
            _carry(layout, base, q, u, coupled, scratch, out)


@inlined
def _pushed(
    layout: Layout,
    base: Base,
    c: int,
    coupled: bool,
    motion: FloatArray,
    cameras: FloatArray,
    first: int,
    observed: FloatArray,
) -> tuple[float, float]:
    """Unwhitened push of a step of cameras and frames on corner c; its unit begins at ``first``."""
    sx = sy = 0.0
    for p in range(len(cameras) if len(base.rows) else 0):
        sx += base.rows[2 * c, p] * cameras[p]
        sy += base.rows[2 * c + 1, p] * cameras[p]
    for k in range(layout.begin[c], layout.begin[c + 1] if coupled else layout.begin[c]):
        j = k - layout.begin[first]
        t = layout.pair[k]
        _recall(layout, base, k, c, observed, j)
        mx = motion[t, 0] + motion[t, 4] * observed[j, 2] - motion[t, 5] * observed[j, 1]
        my = motion[t, 1] + motion[t, 5] * observed[j, 0] - motion[t, 3] * observed[j, 2]
        mz = motion[t, 2] + motion[t, 3] * observed[j, 1] - motion[t, 4] * observed[j, 0]
        ax, ay = along_axes(base.table, t, *_oppose(observed, j, mx, my, mz))
        sx += ax
        sy += ay
    return sx, sy


@inlined
def _at_corner(
    layout: Layout,
    base: Base,
    table: FloatArray,
    c: int,
    slot: IntArray,
    out: Evaluation,
    total: float,
    product: float,
) -> tuple[float, float, float, float]:
    """Gradient at corner c's new position, and the loss so far; adds to the pairs' gradients."""
    gx = gy = 0.0
    for k in range(layout.begin[c], layout.begin[c + 1]):
        px, py, pz, inverse, slope, du, dv = see(layout, table, k, out.corners[c, 0], out.corners[c, 1])
        r0, r1 = whiten(layout, k, du, dv)
        squared = r0 * r0 + r1 * r1
        total, product = add_loss(base, squared, total, product)
        weight = weigh(base, squared)
        w0 = weight * r0
        w1 = weight * r1
        fu = layout.root[0, k] * w0 + layout.root[1, k] * w1
        fv = layout.root[2, k] * w1
        fx = fu * inverse
        fy = fv * inverse
        fz = (fu * px + fv * py) * slope
        ax, ay = along_axes(table, layout.pair[k], fx, fy, fz)
        gx += ax
        gy += ay
        add_force(out.wrench, slot[layout.pair[k]], px, py, pz, fx, fy, fz)
    return gx, gy, total, product


@twin("adjust.evaluate")
@kernel
def evaluate(
    begin: int,
    end: int,
    layout: Layout,
    base: Base,
    table: FloatArray,
    motion: FloatArray,
    cameras: FloatArray,
    whitened: FloatArray,
    scratch: Scratch,
    out: Evaluation,
) -> None:
    """Evaluate chunks ``begin`` to ``end`` after a step from the whitening's estimate.

    ``table`` (P, 16) is of the pairs after the step; ``motion`` (P, 6) is the step as their left tangents, if
    frames have states, ``cameras`` (D,) that of the cameras' unknowns, ``own`` (2 N,) the corners' whitened
    variables.
    """
    step = scratch.step
    gradient = scratch.gradient
    states = len(base.rows) == 0
    for q in range(begin, end):
        number_touched(layout, q, scratch.slot)
        total = 0.0
        product = 1.0
        for u in range(layout.chunk[q], layout.chunk[q + 1]):
            first = layout.unit[u]
            last = layout.unit[u + 1]
            coupled = states and not layout.is_kept[u]
            for c in range(first, last):
                i = 2 * (c - first)
                step[i], step[i + 1] = _pushed(
                    layout, base, c, coupled, motion, cameras, first, scratch.observed
                )
            if coupled:
                solve_unit(layout, base, u, step)
            for i in range(2 * (last - first)):
                step[i] = whitened[2 * first + i] - step[i]
            solve_unit_transposed(layout, base, u, step)
            for c in range(first, last):
                i = 2 * (c - first)
                out.corners[c, 0] = base.corners[c, 0] + step[i]
                out.corners[c, 1] = base.corners[c, 1] + step[i + 1]
                gradient[i], gradient[i + 1], total, product = _at_corner(
                    layout, base, table, c, scratch.slot, out, total, product
                )
            add_corner_priors(layout, u, out.corners, gradient, out.costs[q])
            _carry(layout, base, q, u, coupled, scratch, out)
        if base.code == 2:
            total += base.scale * base.scale * math.log(product)
        out.costs[q, 0] = total / 2


@twin("adjust.meet_ground")
@kernel
def meet_ground(
    begin: int, end: int, layout: Layout, homographies: FloatArray, corners: FloatArray, determined: BoolArray
) -> None:
    """Start the corners (N, 2) of chunks ``begin`` to ``end`` where their rays meet the ground.

    ``homographies`` (P, 9) are the pairs' :func:`v2hdm.adjust.model.ground_from_ray`; ``determined`` (N,) are
    corners with such a ray.
    """
    for c in range(layout.unit[layout.chunk[begin]], layout.unit[layout.chunk[end]]):
        xx = yx = yy = x = y = 0.0
        for k in range(layout.begin[c], layout.begin[c + 1]):
            ground = homographies[layout.pair[k]]
            u = layout.measured[0, k]
            v = layout.measured[1, k]
            drop = ground[6] * u + ground[7] * v + ground[8]
            least = MIN_DEPRESSION_SINE * MIN_DEPRESSION_SINE * (1 + u * u + v * v)
            if not (drop > 0 and drop * drop > least):
                continue
            gx = (ground[0] * u + ground[1] * v + ground[2]) / drop
            gy = (ground[3] * u + ground[4] * v + ground[5]) / drop
            xu = ground[0] - gx * ground[6]
            xv = ground[1] - gx * ground[7]
            yu = ground[3] - gy * ground[6]
            yv = ground[4] - gy * ground[7]
            share = drop / (xu * yv - xv * yu)
            j0, j2 = whiten(layout, k, share * yv, -share * yu)
            j1, j3 = whiten(layout, k, -share * xv, share * xu)
            a = j0 * j0 + j2 * j2
            b = j0 * j1 + j2 * j3
            d = j1 * j1 + j3 * j3
            xx += a
            yx += b
            yy += d
            x += a * gx + b * gy
            y += b * gx + d * gy
        determined[c] = xx > 0
        if not xx > 0:
            corners[c, 0] = corners[c, 1] = 0.0
            continue
        first = math.sqrt(xx)
        below = yx / first
        remainder = yy - below * below
        least = PIVOT_FLOOR * yy
        last = math.sqrt(least if remainder < least else remainder)
        top = x / first
        low = (y - below * top) / last / last
        corners[c, 0] = (top - below * low) / first
        corners[c, 1] = low


@twin("adjust.report")
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
        x = corners[c, 0]
        y = corners[c, 1]
        for k in range(layout.begin[c], layout.begin[c + 1]):
            _, _, pz, _, _, u, v = see(layout, table, k, x, y)
            r0, r1 = whiten(layout, k, u, v)
            row = order[k]
            camera = layout.pair[k] // layout.moments
            out.residual_px[row, 0] = u * focal[camera, 0]
            out.residual_px[row, 1] = v * focal[camera, 1]
            out.mahalanobis2[row] = r0 * r0 + r1 * r1
            out.behind[row] = pz <= NEAR_M


@twin("adjust.residuals")
@kernel
def residuals(
    begin: int, end: int, layout: Layout, table: FloatArray, corners: FloatArray, out: FloatArray
) -> None:
    """Whitened residuals (2, K) of the observations of chunks ``begin`` to ``end``."""
    for c in range(layout.unit[layout.chunk[begin]], layout.unit[layout.chunk[end]]):
        x = corners[c, 0]
        y = corners[c, 1]
        for k in range(layout.begin[c], layout.begin[c + 1]):
            _, _, _, _, _, u, v = see(layout, table, k, x, y)
            out[0, k], out[1, k] = whiten(layout, k, u, v)


@twin("adjust.pull")
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
    """Add the gradients by pairs (P, 6) and corners (N, 2) from that by the residuals (2, K)."""
    for c in range(len(corners)):
        for k in range(layout.begin[c], layout.begin[c + 1]):
            differentiate(layout, table, k, corners[c, 0], corners[c, 1], jacobian)
            r0 = by_residual[0, k]
            r1 = by_residual[1, k]
            by_corner[c, 0] += jacobian[12] * r0 + jacobian[14] * r1
            by_corner[c, 1] += jacobian[13] * r0 + jacobian[15] * r1
            for p in range(6):
                wrench[layout.pair[k], p] += jacobian[p] * r0 + jacobian[6 + p] * r1


@twin("adjust.couplings")
@kernel
def couplings(layout: Layout, base: Base, corner: IntArray, jacobian: FloatArray, out: FloatArray) -> None:
    """Write W' (k, 12) of the layout's observations of the base's corners, numbered by ``corner``."""
    for k in range(len(corner)):
        x = base.corners[corner[k], 0]
        y = base.corners[corner[k], 1]
        r0, r1, _, _, _ = differentiate(layout, base.table, k, x, y, jacobian)
        couple(jacobian, floored(weigh(base, r0 * r0 + r1 * r1)), out, k)
