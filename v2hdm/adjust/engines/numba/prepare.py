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
        uneven = xy - yx
        if not uneven * uneven <= symmetric_to * symmetric_to * xx * yy:
            return k
        u = (seen.pinhole_px[k, 0] - seen.intrinsic[c, 2]) / seen.intrinsic[c, 0]
        v = (seen.pinhole_px[k, 1] - seen.intrinsic[c, 3]) / seen.intrinsic[c, 1]
        if not (abs(u) <= max_slope and abs(v) <= max_slope):
            return k
    return -1


@kernel
def sort_observations(
    seen: Seen,
    rank: IntArray,
    frames: int,
    at: IntArray,
    order: NDArray[np.int32],
    sorted_corner: NDArray[np.int32],
    pair: NDArray[np.int32],
) -> int:
    """Sort observations (K,) by the rank (N,) of their corner, camera and frame; ``at`` (N + 1,) is 0.

    Returns a place in that order, of an observation that is the same as the one before it, or -1.
    """
    count = len(seen.corner)
    for k in range(count):
        at[rank[seen.corner[k]]] += 1
    total = 0
    for n in range(len(at)):
        total, at[n] = total + at[n], total
    for k in range(count):
        n = rank[seen.corner[k]]
        i = at[n]
        at[n] += 1
        order[i] = k
        sorted_corner[i] = n
        pair[i] = seen.camera[k] * frames + seen.frame[k]
    begin, again = 0, -1
    for n in range(len(at) - 1):
        end = at[n]
        # Shell's sort, which is a pass where the order is right already.
        gap = 1
        while 3 * gap < end - begin and gap < 64:
            gap = 3 * gap + 1
        while gap > 0:
            for i in range(begin + gap, end):
                row, key, j = order[i], pair[i], i
                while j >= begin + gap and pair[j - gap] > key:
                    order[j], pair[j] = order[j - gap], pair[j - gap]
                    j -= gap
                order[j], pair[j] = row, key
            gap //= 3
        for i in range(begin + 1, end):
            if pair[i] == pair[i - 1] and again < 0:
                again = i
        begin = end
    return again


@kernel
def whiten_observations(seen: Seen, order: NDArray[np.int32], measured: FloatArray, root: FloatArray) -> None:
    """Write ``measured`` (2, K) and ``root_information`` (3, K) of :class:`~v2hdm.adjust.arrays.Arrays`."""
    for i in range(len(order)):
        k = order[i]
        c = seen.camera[k]
        fx, fy = seen.intrinsic[c, 0], seen.intrinsic[c, 1]
        measured[0, i] = (seen.pinhole_px[k, 0] - seen.intrinsic[c, 2]) / fx
        measured[1, i] = (seen.pinhole_px[k, 1] - seen.intrinsic[c, 3]) / fy
        first = math.sqrt(seen.covariance_px[k, 0, 0])
        below = seen.covariance_px[k, 1, 0] / first
        last = math.sqrt(seen.covariance_px[k, 1, 1] - below * below)
        root[0, i], root[1, i], root[2, i] = fx / first, -below * fx / (first * last), fy / last
