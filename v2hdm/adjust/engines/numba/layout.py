"""The constants of a solve as the kernels read them: :class:`~v2hdm.adjust.arrays.Arrays` in chunks.

A *unit* is corners that known lengths join, mostly one. A *chunk* is neighbouring units with some thousand
observations. Sums over all observations are added up chunk by chunk and then over the chunks in their order,
so that they do not depend on the number of threads; those by pair only over the pairs that a chunk touches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.engines.numba.build import kernel
from v2hdm.records import BoolArray, FloatArray, IntArray

LOSS_CODES = {"none": 0, "huber": 1, "cauchy": 2, "geman_mcclure": 3}
"""Codes of the losses of :data:`v2hdm.adjust.problem.LOSSES`."""


class Layout(NamedTuple):
    """K observations of N corners in M units and Q chunks.

    Attributes:
        pair, measured, root: as in :class:`~v2hdm.adjust.arrays.Arrays`.
        frames: J.
        begin: (N + 1,) where each corner's observations begin.
        unit: (M + 1,) where each unit's corners begin.
        joint_at: (M,) where the factor of a unit of several corners begins among those of all.
        chunk: (Q + 1,) where each chunk's units begin.
        touched, touched_at: the pairs that chunks touch, as they come, and (Q + 1,) where they begin.
        control, control_information: as in Arrays.
        length_at: (M + 1,) where each unit's known lengths begin.
        length_first, length_second, length_m, length_root: the lengths, sorted by unit.
        most_seen, most_joined: observations and corners of a unit, at most.
        kept: (M,) units that are not eliminated: their factor is the identity, and nothing couples to them.
    """

    pair: IntArray
    measured: FloatArray
    root: FloatArray
    frames: int
    begin: IntArray
    unit: IntArray
    joint_at: IntArray
    chunk: IntArray
    touched: IntArray
    touched_at: IntArray
    control: FloatArray
    control_information: FloatArray
    length_at: IntArray
    length_first: IntArray
    length_second: IntArray
    length_m: FloatArray
    length_root: FloatArray
    most_seen: int
    most_joined: int
    kept: BoolArray


def make_layout(arrays: Arrays) -> Layout:
    """The layout of arrays that lie in the processor's memory."""
    begin = np.searchsorted(arrays.corner.numpy(), np.arange(arrays.corner_count + 1, dtype=np.int32))
    unit = arrays.unit_bounds[0].numpy()
    chunk = np.searchsorted(unit, [corner for _, corner in arrays.run_bounds])
    pair = arrays.pair.numpy()
    touched, touched_at = _touched(pair, begin[unit[chunk]], arrays.pair_count)
    joined = np.diff(unit)
    known = arrays.lengths
    of_length = np.searchsorted(unit, known.first.numpy(), side="right") - 1
    order = np.argsort(of_length, kind="stable")
    return Layout(
        pair=pair,
        measured=arrays.measured.numpy(),
        root=arrays.root_information.numpy(),
        frames=arrays.frame_count,
        begin=begin,
        unit=unit,
        joint_at=joint_offsets(joined),
        chunk=chunk,
        touched=touched,
        touched_at=touched_at,
        control=arrays.control.numpy(),
        control_information=arrays.control_information.numpy(),
        length_at=np.searchsorted(of_length[order], np.arange(len(joined) + 1)),
        length_first=known.first.numpy()[order],
        length_second=known.second.numpy()[order],
        length_m=known.length_m.numpy()[order],
        length_root=known.information_root.numpy()[order],
        most_seen=int(np.diff(begin[unit]).max()),
        most_joined=int(joined.max()),
        kept=np.zeros(len(joined), dtype=np.bool_),
    )


def joint_offsets(joined: IntArray) -> IntArray:
    """Where the factors (2g, 2g) of units of g > 1 corners begin (M,), those of a size side by side."""
    out = np.zeros(len(joined), dtype=np.int64)
    if joined.max() == 1:
        return out
    begin = 0
    for size in np.unique(joined[joined > 1]):
        same = np.flatnonzero(joined == size)
        out[same] = begin + 4 * size * size * np.arange(len(same))
        begin += 4 * size * size * len(same)
    return out


def _touched(pair: IntArray, bounds: IntArray, pairs: int) -> tuple[IntArray, IntArray]:
    """The pairs that each chunk of observations touches, as they come, and where those of each begin."""
    touched_at = np.zeros(len(bounds), dtype=np.int64)
    _count_touched(pair, bounds, np.full(pairs, -1, dtype=np.int32), touched_at)
    touched = np.empty(touched_at[-1], dtype=np.int32)
    _list_touched(pair, bounds, np.full(pairs, -1, dtype=np.int32), touched_at, touched)
    return touched, touched_at


@kernel
def _count_touched(pair: IntArray, bounds: IntArray, last: IntArray, touched_at: IntArray) -> None:
    for q in range(len(bounds) - 1):
        count = 0
        for k in range(bounds[q], bounds[q + 1]):
            if last[pair[k]] != q:
                last[pair[k]] = q
                count += 1
        touched_at[q + 1] = touched_at[q] + count


@kernel
def _list_touched(
    pair: IntArray, bounds: IntArray, last: IntArray, touched_at: IntArray, touched: IntArray
) -> None:
    for q in range(len(bounds) - 1):
        at = touched_at[q]
        for k in range(bounds[q], bounds[q + 1]):
            if last[pair[k]] != q:
                last[pair[k]] = q
                touched[at] = pair[k]
                at += 1
