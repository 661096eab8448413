"""Passes over a problem's observations before and after a solve: checks, the layout, verdicts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from v2hdm.adjust.engines.numba.build import kernel
from v2hdm.records import BoolArray, FloatArray, IntArray


def are_sound(
    camera: IntArray,
    frame: IntArray,
    corner: IntArray,
    pinhole_px: FloatArray,
    covariance_px: FloatArray,
    intrinsic: FloatArray,
    frames: int,
    corners: int,
    symmetric_to: float,
    max_slope: float,
) -> bool:
    """Whether no check of an observation by itself finds fault; which, and with what, this does not tell."""
    counts = np.zeros(corners + len(intrinsic), dtype=np.int64)
    seen = _index(camera), _index(frame), _index(corner), _real(pinhole_px), _real(covariance_px)
    limits = frames, corners, symmetric_to, max_slope
    return bool(_are_sound(*seen, _real(intrinsic), *limits, counts)) and bool(counts.all())


def first_frames(corner: IntArray, frame: IntArray, corners: int, frames: int) -> IntArray:
    """The first frame (N,) that saw each corner, J where there is none."""
    out = np.full(corners, frames)
    _first_frames(_index(corner), _index(frame), out)
    return out


def sorted_observations(
    rank: IntArray, camera: IntArray, frame: IntArray, corner: IntArray, frames: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], int]:
    """Observations (K,) by the rank (N,) of their corner, camera and frame; the rank and pair of each.

    The last is a place in that order, of an observation that is the same as the one before it, or -1.
    """
    order, ranked, pair = (np.empty(len(corner), dtype=np.int32) for _ in range(3))
    at = np.zeros(len(rank) + 1, dtype=np.int64)
    seen = _index(camera), _index(frame), _index(corner)
    again: int = _sort(rank, *seen, frames, at, order, ranked, pair)
    return order, ranked, pair, again


def whitened(
    order: NDArray[np.int32],
    camera: IntArray,
    pinhole_px: FloatArray,
    covariance_px: FloatArray,
    intrinsic: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """``measured`` (2, K) and ``root_information`` (3, K) of :class:`~v2hdm.adjust.arrays.Arrays`."""
    measured, root = np.empty((2, len(order))), np.empty((3, len(order)))
    seen = _index(camera), _real(pinhole_px), _real(covariance_px), _real(intrinsic)
    _whiten(order, *seen, measured, root)
    return measured, root


def on_line(covariance_px: FloatArray, excess: float) -> BoolArray:
    """Which covariances (K, 2, 2) have a squared trace of more than ``excess`` times the determinant."""
    out = np.empty(len(covariance_px), dtype=np.bool_)
    _on_line(_real(covariance_px), excess, out)
    return out


def _index(values: IntArray) -> IntArray:
    return np.ascontiguousarray(values, dtype=np.int64)


def _real(values: FloatArray) -> FloatArray:
    return np.ascontiguousarray(values, dtype=np.float64)


@kernel
def _are_sound(
    camera: IntArray,
    frame: IntArray,
    corner: IntArray,
    pinhole_px: FloatArray,
    covariance_px: FloatArray,
    intrinsic: FloatArray,
    frames: int,
    corners: int,
    symmetric_to: float,
    max_slope: float,
    counts: IntArray,
) -> bool:
    for k in range(len(camera)):
        c, n = camera[k], corner[k]
        if not (0 <= c < len(intrinsic) and 0 <= frame[k] < frames and 0 <= n < corners):
            return False
        counts[n] += 1
        counts[corners + c] += 1
        xx, xy = covariance_px[k, 0, 0], covariance_px[k, 0, 1]
        yx, yy = covariance_px[k, 1, 0], covariance_px[k, 1, 1]
        if not (xx > 0 and xx * yy > yx * yx and xx * yy < math.inf):
            return False
        uneven = xy - yx
        if not uneven * uneven <= symmetric_to * symmetric_to * xx * yy:
            return False
        u = (pinhole_px[k, 0] - intrinsic[c, 2]) / intrinsic[c, 0]
        v = (pinhole_px[k, 1] - intrinsic[c, 3]) / intrinsic[c, 1]
        if not (abs(u) <= max_slope and abs(v) <= max_slope):
            return False
    return True


@kernel
def _first_frames(corner: IntArray, frame: IntArray, out: IntArray) -> None:
    for k in range(len(corner)):
        if frame[k] < out[corner[k]]:
            out[corner[k]] = frame[k]


@kernel
def _sort(
    rank: IntArray,
    camera: IntArray,
    frame: IntArray,
    corner: IntArray,
    frames: int,
    at: IntArray,
    order: NDArray[np.int32],
    sorted_corner: NDArray[np.int32],
    pair: NDArray[np.int32],
) -> int:
    count = len(corner)
    for k in range(count):
        at[rank[corner[k]]] += 1
    total = 0
    for n in range(len(at)):
        total, at[n] = total + at[n], total
    for k in range(count):
        n = rank[corner[k]]
        i = at[n]
        at[n] += 1
        order[i] = k
        sorted_corner[i] = n
        pair[i] = camera[k] * frames + frame[k]
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
def _whiten(
    order: NDArray[np.int32],
    camera: IntArray,
    pinhole_px: FloatArray,
    covariance_px: FloatArray,
    intrinsic: FloatArray,
    measured: FloatArray,
    root: FloatArray,
) -> None:
    for i in range(len(order)):
        k = order[i]
        c = camera[k]
        fx, fy = intrinsic[c, 0], intrinsic[c, 1]
        measured[0, i] = (pinhole_px[k, 0] - intrinsic[c, 2]) / fx
        measured[1, i] = (pinhole_px[k, 1] - intrinsic[c, 3]) / fy
        first = math.sqrt(covariance_px[k, 0, 0])
        below = covariance_px[k, 1, 0] / first
        last = math.sqrt(covariance_px[k, 1, 1] - below * below)
        root[0, i], root[1, i], root[2, i] = fx / first, -below * fx / (first * last), fy / last


@kernel
def _on_line(covariance_px: FloatArray, excess: float, out: BoolArray) -> None:
    for k in range(len(out)):
        xx, yx, yy = covariance_px[k, 0, 0], covariance_px[k, 1, 0], covariance_px[k, 1, 1]
        out[k] = (xx + yy) * (xx + yy) > (xx * yy - yx * yx) * excess
