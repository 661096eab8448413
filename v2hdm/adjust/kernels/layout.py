"""The constants of a solve as kernels read them: :class:`~v2hdm.adjust.arrays.Arrays` in chunks.

A *unit* is a set of corners joined by known lengths, mostly one corner. A *chunk*, the work item of a thread,
is a run of units with some thousand observations. Sums are taken per chunk and then over chunks in order, so
that results do not depend on the number of threads; sums by pair run over a chunk's pairs alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from v2hdm.adjust.arrays import Arrays
from v2hdm.compiled import inlined, kernel, twin
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
    begin = arrays.begin.numpy()
    unit = arrays.units.numpy()
    joined = unit[1:] - unit[:-1]
    first_observation = begin[unit]
    chunk = _chunks(arrays, unit)
    pair = arrays.pair.numpy()
    touched_at = np.empty(len(chunk), dtype=np.int64)
    touched = np.empty_like(pair)
    is_touched = np.zeros(arrays.pair_count, dtype=np.uint8)
    touched_count = find_touched(pair, first_observation[chunk], is_touched, touched, touched_at)
    lengths = _lengths(arrays, unit)
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
        touched=touched[:touched_count].copy(),
        touched_at=touched_at,
        control=arrays.control.numpy(),
        control_root=arrays.control_root.numpy(),
        length_at=lengths.at,
        length_first=lengths.first,
        length_second=lengths.second,
        length_m=lengths.length_m,
        length_root=lengths.root,
        most_seen=int((first_observation[1:] - first_observation[:-1]).max()),
        most_joined=int(joined.max()),
        is_kept=np.zeros(len(joined), dtype=np.bool_),
    )


def _chunks(arrays: Arrays, unit: IntArray) -> IntArray:
    """First units (Q + 1,) of the runs, and the end."""
    if len(arrays.run_bounds) == 2:  # one run, of all units
        return np.array([0, len(unit) - 1])
    return np.searchsorted(unit, [corner for _, corner in arrays.run_bounds])


class _Lengths(NamedTuple):
    """The known lengths by unit, as in :class:`Layout`."""

    at: IntArray
    first: IntArray
    second: IntArray
    length_m: FloatArray
    root: FloatArray


def _lengths(arrays: Arrays, unit: IntArray) -> _Lengths:
    """The known lengths, sorted by the units (M + 1,) that they are in."""
    lengths = arrays.lengths
    first, second, length_m, root = (
        column.numpy()
        for column in (lengths.first, lengths.second, lengths.length_m, lengths.information_root)
    )
    if not len(first):
        return _Lengths(np.zeros(len(unit), dtype=np.int64), first, second, length_m, root)
    of_length = np.searchsorted(unit, first, side="right") - 1
    order = np.argsort(of_length, kind="stable")
    at = np.searchsorted(of_length[order], np.arange(len(unit)))
    return _Lengths(at, first[order], second[order], length_m[order], root[order])


def _frame_of_moment(arrays: Arrays) -> IntArray:
    """The frame (M,) of each moment."""
    moments = arrays.frame_of_moment
    return np.arange(arrays.moment_count) if moments is None else np.asarray(moments.numpy())


@twin("adjust.find_touched")
@kernel
def find_touched(
    pair: IntArray, chunk: IntArray, is_touched: NDArray[np.uint8], touched: IntArray, touched_at: IntArray
) -> int:
    """Number of pairs that chunks touch, which are written in turn, ascending, and where those of each begin.

    ``chunk`` (Q + 1,) are the observations at which chunks begin; ``is_touched`` (P,) are zeros.
    """
    count = 0
    for q in range(len(chunk) - 1):
        touched_at[q] = count
        lowest = len(is_touched)
        highest = -1
        for k in range(chunk[q], chunk[q + 1]):
            is_touched[pair[k]] = 1
            lowest = min(lowest, pair[k])
            highest = max(highest, pair[k])
        for p in range(lowest, highest + 1):
            if is_touched[p]:
                touched[count] = p
                count += 1
            is_touched[p] = 0
    touched_at[len(chunk) - 1] = count
    return count


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
            if not abs(observations.pinhole_px[k, axis] - centre) <= max_slope * focal:
                return k
    return -1


@twin("adjust.first_not_rigid")
@kernel
def first_not_rigid(transforms: FloatArray, orthonormal_to: float) -> int:
    """Index of the first of transforms (n, 4, 4) that is not rigid, or -1."""
    for k in range(len(transforms)):
        turn = transforms[k]
        for i in range(3):
            for j in range(i + 1):
                off = turn[i, 0] * turn[j, 0] + turn[i, 1] * turn[j, 1] + turn[i, 2] * turn[j, 2]
                if not abs(off - (1.0 if i == j else 0.0)) <= orthonormal_to:
                    return k
        determinant = turn[0, 0] * (turn[1, 1] * turn[2, 2] - turn[1, 2] * turn[2, 1])
        determinant += turn[0, 1] * (turn[1, 2] * turn[2, 0] - turn[1, 0] * turn[2, 2])
        determinant += turn[0, 2] * (turn[1, 0] * turn[2, 1] - turn[1, 1] * turn[2, 0])
        if not determinant > 0:
            return k
        if turn[3, 0] != 0 or turn[3, 1] != 0 or turn[3, 2] != 0 or turn[3, 3] != 1:
            return k
    return -1


@inlined
def _sort_run(pair: NDArray[np.int32], order: NDArray[np.int32], begin: int, end: int) -> None:
    """Shell's sort of a corner's observations by pair and number, which needs no room."""
    gap = 1
    while gap < (end - begin) // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(begin + gap, end):
            moved_pair = pair[i]
            number = order[i]
            at = i
            while at - gap >= begin and (
                moved_pair < pair[at - gap] or (moved_pair == pair[at - gap] and number < order[at - gap])
            ):
                pair[at] = pair[at - gap]
                order[at] = order[at - gap]
                at -= gap
            pair[at] = moved_pair
            order[at] = number
        gap //= 3


@twin("adjust.arrange")
@kernel
def arrange(
    observations: Seen,
    rank: IntArray,
    frames: int,
    corner_at: IntArray,
    order: NDArray[np.int32],
    corner: NDArray[np.int32],
    pair: NDArray[np.int32],
) -> int:
    """Sort observations (K,) by the rank of their corner, counting those before, then by pair.

    ``corner_at`` (N + 1,) are zeros. Returns the position of a duplicate of the one before, or -1.
    """
    for k in range(len(order)):
        corner_at[rank[observations.corner[k]] + 1] += 1
    for c in range(1, len(corner_at)):
        corner_at[c] += corner_at[c - 1]
    for k in range(len(order)):
        c = rank[observations.corner[k]]
        at = corner_at[c]
        corner_at[c] += 1
        order[at] = k
        corner[at] = c
        pair[at] = observations.camera[k] * frames + observations.frame[k]
    begin = 0
    for i in range(1, len(order) + 1):
        if i == len(order) or corner[i] != corner[begin]:
            _sort_run(pair, order, begin, i)
            begin = i
    for i in range(1, len(order)):
        if corner[i] == corner[i - 1] and pair[i] == pair[i - 1]:
            return i
    return -1


@twin("adjust.lay_out")
@kernel
def lay_out(
    observations: Seen,
    order: NDArray[np.int32],
    pair: NDArray[np.int32],
    frames: int,
    line_excess: float,
    measured: FloatArray,
    root: FloatArray,
) -> int:
    """Write observations in an order (K,): where at depth 1, and their root information.

    ``pair`` (K,) are their cameras and frames in this order. Returns how many are of lines, by the
    ``line_excess`` of their covariances.
    """
    lines = 0
    for i in range(len(order)):
        k = order[i]
        c = pair[i] // frames
        fx = observations.intrinsic[c, 0]
        fy = observations.intrinsic[c, 1]
        xx = observations.covariance_px[k, 0, 0]
        yx = observations.covariance_px[k, 1, 0]
        yy = observations.covariance_px[k, 1, 1]
        measured[0, i] = (observations.pinhole_px[k, 0] - observations.intrinsic[c, 2]) / fx
        measured[1, i] = (observations.pinhole_px[k, 1] - observations.intrinsic[c, 3]) / fy
        first = math.sqrt(xx)
        below = yx / first
        last = math.sqrt(yy - below * below)
        root[0, i] = fx / first
        root[1, i] = -below * fx / (first * last)
        root[2, i] = fy / last
        if (xx + yy) * (xx + yy) > (xx * yy - yx * yx) * line_excess:
            lines += 1
    return lines


_ACCEPTED = 0  # a Verdict of v2hdm.adjust.solution; numba knows no enumerations
_CONTRADICTS = 1  # a Verdict
_UNCONFIRMED = 2  # a Verdict
_BEHIND_CAMERA = 3  # a Verdict


@twin("adjust.classify")
@kernel
def classify(
    corner: IntArray,
    mahalanobis2: FloatArray,
    behind: BoolArray,
    gate: float,
    verdict: NDArray[np.int8],
    sightings: IntArray,
    accepted: IntArray,
) -> None:
    """Write a verdict on each observation (K,), and each corner's number of them and of accepted ones (N,).

    Both numbers are zeros before.
    """
    for k in range(len(corner)):
        c = corner[k]
        sightings[c] += 1
        if behind[k]:
            verdict[k] = _BEHIND_CAMERA
        elif mahalanobis2[k] > gate:
            verdict[k] = _CONTRADICTS
        else:
            verdict[k] = _ACCEPTED
            accepted[c] += 1
    for k in range(len(corner)):
        c = corner[k]
        if verdict[k] == _ACCEPTED and accepted[c] == 1 and sightings[c] > 1:
            verdict[k] = _UNCONFIRMED
