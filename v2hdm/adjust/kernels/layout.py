"""The constants of a solve as kernels read them: :class:`~v2hdm.adjust.arrays.Arrays` in chunks.

A *unit* is a set of corners joined by known lengths, mostly one corner. A *chunk*, the work item of a thread,
is a run of units with some thousand observations. Sums are taken per chunk and then over chunks in order, so
that results do not depend on the number of threads; sums by pair run over a chunk's pairs alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from v2hdm.adjust.arrays import Arrays
from v2hdm.compiled import kernel, twin
from v2hdm.records import BoolArray, FloatArray, IntArray

LOSS_CODES = {"none": 0, "huber": 1, "cauchy": 2, "geman_mcclure": 3}
"""Codes of the losses of :data:`v2hdm.adjust.problem.LOSSES`."""


class Layout(NamedTuple):
    """K observations of N corners in M units and Q chunks."""

    pair: IntArray  # (K,) this and the next two as in :class:`~v2hdm.adjust.arrays.Arrays`
    measured: FloatArray
    root: FloatArray
    moments: int  # M
    frame: IntArray  # (M,) frame of each moment
    begin: IntArray  # (N + 1,) first observation of each corner
    unit: IntArray  # (M + 1,) first corner of each unit
    joint_at: IntArray  # (M,) offset of the factor of a unit of several corners
    chunk: IntArray  # (Q + 1,) first unit of each chunk
    touched: IntArray  # pairs of each chunk, ascending; chunks begin at ``touched_at`` (Q + 1,)
    touched_at: IntArray
    control: FloatArray  # this and the next as in Arrays
    control_root: FloatArray
    length_at: IntArray  # (M + 1,) first known length of each unit
    length_first: IntArray  # this and the next three are the lengths, sorted by unit
    length_second: IntArray
    length_m: FloatArray
    length_root: FloatArray
    most_seen: int  # largest number of observations, and of corners, of a unit
    most_joined: int
    is_kept: BoolArray  # (M,) units that are not eliminated: their factor is 1, and nothing couples to them


def make_layout(arrays: Arrays) -> Layout:
    """The layout of arrays in the processor's memory."""
    begin = np.searchsorted(arrays.corner.numpy(), np.arange(arrays.corner_count + 1, dtype=np.int32))
    unit = arrays.units.numpy()
    chunk = np.searchsorted(unit, [corner for _, corner in arrays.run_bounds])
    pair = arrays.pair.numpy()
    touched = [_distinct(pair[start:end], arrays.pair_count) for start, end in pairwise(begin[unit[chunk]])]
    joined = np.diff(unit)
    lengths = arrays.lengths
    of_length = np.searchsorted(unit, lengths.first.numpy(), side="right") - 1
    order = np.argsort(of_length, kind="stable")
    return Layout(
        pair=pair,
        measured=arrays.measured.numpy(),
        root=arrays.root_information.numpy(),
        moments=arrays.moment_count,
        frame=_frame_of_moment(arrays),
        begin=begin,
        unit=unit,
        joint_at=joint_offsets(joined),
        chunk=chunk,
        touched=np.concatenate(touched),
        touched_at=np.cumsum([0, *(len(part) for part in touched)]),
        control=arrays.control.numpy(),
        control_root=arrays.control_root.numpy(),
        length_at=np.searchsorted(of_length[order], np.arange(len(joined) + 1)),
        length_first=lengths.first.numpy()[order],
        length_second=lengths.second.numpy()[order],
        length_m=lengths.length_m.numpy()[order],
        length_root=lengths.information_root.numpy()[order],
        most_seen=int(np.diff(begin[unit]).max()),
        most_joined=int(joined.max()),
        is_kept=np.zeros(len(joined), dtype=np.bool_),
    )


def _frame_of_moment(arrays: Arrays) -> IntArray:
    """The frame (M,) of each moment."""
    moments = arrays.frame_of_moment
    return np.arange(arrays.moment_count) if moments is None else np.asarray(moments.numpy())


def _distinct(pair: IntArray, pairs: int) -> IntArray:
    """The distinct pairs of a chunk, by a mask over all pairs, which is faster than sorting."""
    is_touched = np.zeros(pairs, dtype=np.bool_)
    is_touched[pair] = True
    return np.flatnonzero(is_touched).astype(np.int32)


def joint_offsets(joined: IntArray) -> IntArray:
    """Offsets (M,) of the factors (2g, 2g) of units of g > 1 corners; equal sizes are contiguous."""
    out = np.zeros(len(joined), dtype=np.int64)
    if joined.max(initial=1) == 1:
        return out
    begin = 0
    for size in np.unique(joined[joined > 1]):
        same = np.flatnonzero(joined == size)
        out[same] = begin + 4 * size * size * np.arange(len(same))
        begin += 4 * size * size * len(same)
    return out


class Base(NamedTuple):
    """The point of linearisation, and the factors of V there."""

    table: FloatArray  # of the pairs (P, 16)
    corners: FloatArray  # (N, 2)
    code: int  # this and the next are the loss
    scale: float
    lower: FloatArray  # L (3, N) of single corners; ``joint`` is that of larger units, concatenated
    joint: FloatArray
    rows: FloatArray  # L^-1 W' (2 N, D) if frames have no states; else (0, D), recomputed by observation


class Scratch(NamedTuple):
    """A workspace for the pairs' numbers (P,), one observation, and the observations of a unit."""

    slot: IntArray
    jacobian: FloatArray
    coupling: FloatArray
    observed: FloatArray
    block: FloatArray
    step: FloatArray
    gradient: FloatArray
    rows: FloatArray

    @classmethod
    def of(cls, layout: Layout, pairs: int, width: int = 0) -> Scratch:
        """A workspace for any unit, with rows of ``width`` columns."""
        n = 2 * layout.most_joined
        sizes = (16,), (layout.most_seen, 12), (layout.most_seen, 8), (n, n), (n,), (n,), (n, width)
        return cls(np.empty(pairs, dtype=np.int32), *(np.empty(size) for size in sizes))


class Seen(NamedTuple):
    """K observations, and the cameras' intrinsics, as kernels read them."""

    camera: IntArray
    frame: IntArray
    corner: IntArray
    pinhole_px: FloatArray
    covariance_px: FloatArray
    intrinsic: FloatArray

    @classmethod
    def of(cls, columns: Iterable[NDArray[Any]], intrinsic: FloatArray) -> Seen:
        """From columns in this order, copied only to change type or layout."""
        typed = zip((*columns, intrinsic), 3 * (np.int64,) + 3 * (np.float64,), strict=True)
        contiguous: list[Any] = [np.ascontiguousarray(values, dtype=kind) for values, kind in typed]
        return cls(*contiguous)


@twin("adjust.first_unsound")
@kernel
def first_unsound(
    observations: Seen,
    frames: int,
    symmetric_to: float,
    max_slope: float,
    by_corner: IntArray,
    by_camera: IntArray,
) -> int:
    """Index of the first unsound observation, or -1; counts the observations of each corner and camera."""
    for k in range(len(observations.camera)):
        c = observations.camera[k]
        n = observations.corner[k]
        if not (0 <= c < len(by_camera) and 0 <= observations.frame[k] < frames and 0 <= n < len(by_corner)):
            return k
        by_corner[n] += 1
        by_camera[c] += 1
        xx = observations.covariance_px[k, 0, 0]
        xy = observations.covariance_px[k, 0, 1]
        yx = observations.covariance_px[k, 1, 0]
        yy = observations.covariance_px[k, 1, 1]
        if not (xx > 0 and xx * yy > yx * yx and xx * yy < math.inf):
            return k
        if not (xy - yx) * (xy - yx) <= symmetric_to * symmetric_to * xx * yy:
            return k
        for axis in range(2):
            focal = observations.intrinsic[c, axis]
            centre = observations.intrinsic[c, 2 + axis]
            if not abs((observations.pinhole_px[k, axis] - centre) / focal) <= max_slope:
                return k
    return -1


@twin("adjust.arrange")
@kernel
def arrange(
    observations: Seen,
    rank: IntArray,
    frames: int,
    by_pair: NDArray[np.int32],
    pair_at: IntArray,
    corner_at: IntArray,
    order: NDArray[np.int32],
    corner: NDArray[np.int32],
    pair: NDArray[np.int32],
) -> int:
    """Sort observations (K,) by the rank of their corner, then by pair, each time by counting those before.

    ``by_pair`` (K,) is room, and ``pair_at`` (P + 1,) and ``corner_at`` (N + 1,) are zeros. Returns the
    position of a duplicate of the one before, or -1.
    """
    for k in range(len(order)):
        pair_at[observations.camera[k] * frames + observations.frame[k] + 1] += 1
        corner_at[rank[observations.corner[k]] + 1] += 1
    for p in range(1, len(pair_at)):
        pair_at[p] += pair_at[p - 1]
    for c in range(1, len(corner_at)):
        corner_at[c] += corner_at[c - 1]
    for k in range(len(order)):
        p = observations.camera[k] * frames + observations.frame[k]
        by_pair[pair_at[p]] = k
        pair_at[p] += 1
    for i in range(len(order)):
        k = by_pair[i]
        c = rank[observations.corner[k]]
        at = corner_at[c]
        corner_at[c] += 1
        order[at] = k
        corner[at] = c
        pair[at] = observations.camera[k] * frames + observations.frame[k]
    for i in range(1, len(order)):
        if corner[i] == corner[i - 1] and pair[i] == pair[i - 1]:
            return i
    return -1


@twin("adjust.lay_out")
@kernel
def lay_out(observations: Seen, order: NDArray[np.int32], measured: FloatArray, root: FloatArray) -> None:
    """Write observations in an order (K,): where at depth 1, and their root information."""
    for i in range(len(order)):
        k = order[i]
        c = observations.camera[k]
        fx = observations.intrinsic[c, 0]
        fy = observations.intrinsic[c, 1]
        measured[0, i] = (observations.pinhole_px[k, 0] - observations.intrinsic[c, 2]) / fx
        measured[1, i] = (observations.pinhole_px[k, 1] - observations.intrinsic[c, 3]) / fy
        first = math.sqrt(observations.covariance_px[k, 0, 0])
        below = observations.covariance_px[k, 1, 0] / first
        last = math.sqrt(observations.covariance_px[k, 1, 1] - below * below)
        root[0, i] = fx / first
        root[1, i] = -below * fx / (first * last)
        root[2, i] = fy / last
