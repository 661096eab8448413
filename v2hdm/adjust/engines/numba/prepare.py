"""Passes over a problem's observations before a solve: their check, and the layout."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from v2hdm.compiled import kernel
from v2hdm.records import FloatArray, IntArray


class Seen(NamedTuple):
    """K observations, and the intrinsics of the cameras, as kernels read them."""

    camera: IntArray
    frame: IntArray
    corner: IntArray
    pinhole_px: FloatArray
    covariance_px: FloatArray
    intrinsic: FloatArray

    @classmethod
    def of(cls, columns: Iterable[NDArray[Any]], intrinsic: FloatArray) -> Seen:
        """Of columns in this order, copied only where their kind or layout is another."""
        kinds = 3 * (np.int64,) + 3 * (np.float64,)
        both = zip((*columns, intrinsic), kinds, strict=True)
        made: list[Any] = [np.ascontiguousarray(values, dtype=kind) for values, kind in both]
        return cls(*made)


@kernel
def first_unsound(
    seen: Seen, frames: int, symmetric_to: float, max_slope: float, by_corner: IntArray, by_camera: IntArray
) -> int:
    """The first observation that is unsound, or -1; adds up how often each corner and camera is seen."""
    for k in range(len(seen.camera)):
        c, n = seen.camera[k], seen.corner[k]
        if not (0 <= c < len(by_camera) and 0 <= seen.frame[k] < frames and 0 <= n < len(by_corner)):
            return k
        by_corner[n] += 1
        by_camera[c] += 1
        xx, xy = seen.covariance_px[k, 0, 0], seen.covariance_px[k, 0, 1]
        yx, yy = seen.covariance_px[k, 1, 0], seen.covariance_px[k, 1, 1]
        if not (xx > 0 and xx * yy > yx * yx and xx * yy < math.inf):
            return k
        if not (xy - yx) * (xy - yx) <= symmetric_to * symmetric_to * xx * yy:
            return k
        for axis in range(2):
            focal, centre = seen.intrinsic[c, axis], seen.intrinsic[c, 2 + axis]
            if not abs((seen.pinhole_px[k, axis] - centre) / focal) <= max_slope:
                return k
    return -1


@kernel
def lay_out(
    seen: Seen,
    rank: IntArray,
    frames: int,
    order: IntArray,
    corner: NDArray[np.int32],
    pair: NDArray[np.int32],
    measured: FloatArray,
    root: FloatArray,
) -> int:
    """Write observations in an order (K,); returns a place there that repeats the one before, or -1."""
    again = -1
    for i in range(len(order)):
        k = order[i]
        c = seen.camera[k]
        corner[i], pair[i] = rank[seen.corner[k]], c * frames + seen.frame[k]
        if i and corner[i] == corner[i - 1] and pair[i] == pair[i - 1] and again < 0:
            again = i
        fx, fy = seen.intrinsic[c, 0], seen.intrinsic[c, 1]
        measured[0, i] = (seen.pinhole_px[k, 0] - seen.intrinsic[c, 2]) / fx
        measured[1, i] = (seen.pinhole_px[k, 1] - seen.intrinsic[c, 3]) / fy
        first = math.sqrt(seen.covariance_px[k, 0, 0])
        below = seen.covariance_px[k, 1, 0] / first
        last = math.sqrt(seen.covariance_px[k, 1, 1] - below * below)
        root[0, i], root[1, i], root[2, i] = fx / first, -below * fx / (first * last), fy / last
    return again
