"""The motion of a few cameras: :func:`~v2hdm.geometry.rigid.exp` and its derivative.

A tensor of six numbers costs torch as much as a thousand observations cost the kernels.
"""

from __future__ import annotations

import numpy as np

from v2hdm.compiled import exact_kernel, inlined, kernel
from v2hdm.geometry.rigid import EXP_SERIES, LEFT_JACOBIAN_SERIES
from v2hdm.records import FloatArray

_EXP = np.ascontiguousarray(EXP_SERIES, dtype=np.float64)
_LEFT_JACOBIAN = np.ascontiguousarray(LEFT_JACOBIAN_SERIES, dtype=np.float64)


def move(tangents: FloatArray, dst_from_src: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``exp(tangents) @ dst_from_src`` (C, 4, 4) and the left Jacobian (C, 6, 6) of the tangents (C, 6)."""
    moved, jacobian = np.zeros((len(tangents), 4, 4)), np.empty((len(tangents), 6, 6))
    _move(tangents, dst_from_src, _EXP, _LEFT_JACOBIAN, np.empty((5, 6, 6)), moved, jacobian)
    return moved, jacobian


def compose(cameras: FloatArray, vehicle_from_map: FloatArray) -> FloatArray:
    """Products (C, M, 4, 4) of cameras (C, M or 1, 4, 4) with transforms (M, 4, 4)."""
    out = np.empty((len(cameras), *vehicle_from_map.shape))
    _compose(np.ascontiguousarray(cameras), np.ascontiguousarray(vehicle_from_map), out)
    return out


@exact_kernel
def _compose(cameras: FloatArray, vehicle_from_map: FloatArray, out: FloatArray) -> None:
    for c in range(len(cameras)):
        for m in range(len(vehicle_from_map)):
            left = cameras[c, m if cameras.shape[1] > 1 else 0]
            for i in range(4):
                for j in range(4):
                    total = 0.0
                    for k in range(4):
                        total += left[i, k] * vehicle_from_map[m, k, j]
                    out[c, m, i, j] = total


@inlined
def _series(terms: FloatArray, column: int, x: float) -> float:
    """A power series by Horner's rule."""
    total = terms[len(terms) - 1, column]
    for n in range(len(terms) - 2, -1, -1):
        total = terms[n, column] + total * x
    return float(total)


@inlined
def _hat(out: FloatArray, i: int, j: int, x: float, y: float, z: float) -> None:
    """Write the skew matrix of a vector from row i and column j on."""
    out[i, j], out[i, j + 1], out[i, j + 2] = 0.0, -z, y
    out[i + 1, j], out[i + 1, j + 1], out[i + 1, j + 2] = z, 0.0, -x
    out[i + 2, j], out[i + 2, j + 1], out[i + 2, j + 2] = -y, x, 0.0


@inlined
def _product(left: FloatArray, right: FloatArray, size: int, out: FloatArray) -> None:
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += left[i, k] * right[k, j]
            out[i, j] = total


@kernel
def _move(
    tangents: FloatArray,
    dst_from_src: FloatArray,
    exp_series: FloatArray,
    jacobian_series: FloatArray,
    room: FloatArray,
    moved: FloatArray,
    jacobian: FloatArray,
) -> None:
    ad, inner, product, omega, square = room[0], room[1], room[2], room[3], room[4]
    for c in range(len(tangents)):
        wx, wy, wz = tangents[c, 3], tangents[c, 4], tangents[c, 5]
        x = -(wx * wx + wy * wy + wz * wz)
        sine, cosine, third = (
            _series(exp_series, 0, x),
            _series(exp_series, 1, x),
            _series(exp_series, 2, x),
        )
        _hat(omega, 0, 0, wx, wy, wz)
        _product(omega, omega, 3, square)
        for i in range(3):
            shift = tangents[c, i]
            for j in range(3):
                turned = cosine * omega[i, j] + third * square[i, j]
                shift += turned * tangents[c, j]
                rotation = sine * omega[i, j] + cosine * square[i, j] + (1.0 if i == j else 0.0)
                for k in range(4):
                    moved[c, i, k] += rotation * dst_from_src[c, j, k]
            moved[c, i, 3] += shift
        moved[c, 3, 3] = 1.0
        ad[:, :] = 0.0
        _hat(ad, 0, 0, wx, wy, wz)
        _hat(ad, 3, 3, wx, wy, wz)
        _hat(ad, 0, 3, tangents[c, 0], tangents[c, 1], tangents[c, 2])
        inner[:, :] = 0.0
        for i in range(6):
            inner[i, i] = _series(jacobian_series, 3, x)
        for n in range(3, -1, -1):
            _product(ad, inner, 6, product)
            last = 1.0 if n == 0 else _series(jacobian_series, n - 1, x)
            for i in range(6):
                for j in range(6):
                    inner[i, j] = product[i, j] + (last if i == j else 0.0)
        for i in range(6):
            for j in range(6):
                jacobian[c, i, j] = inner[i, j]
