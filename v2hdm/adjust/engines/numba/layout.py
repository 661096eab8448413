"""The constants of a solve as the kernels read them: :class:`~v2hdm.adjust.arrays.Arrays` in chunks.

A *unit* is corners that known lengths join, mostly one. A *chunk* is neighbouring units with some thousand
observations. Sums over all observations are added up chunk by chunk and then over the chunks in their order,
so that they do not depend on the number of threads; those by pair only over the pairs that a chunk touches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from v2hdm.adjust.arrays import Arrays
from v2hdm.records import BoolArray, FloatArray, IntArray

LOSS_CODES = {"none": 0, "huber": 1, "cauchy": 2, "geman_mcclure": 3}
"""Codes of the losses of :data:`v2hdm.adjust.problem.LOSSES`."""


class Layout(NamedTuple):
    """K observations of N corners in M units and Q chunks."""

    # as in :class:`~v2hdm.adjust.arrays.Arrays`
    pair: IntArray
    measured: FloatArray
    root: FloatArray
    moments: int  # M
    frame: IntArray  # (M,) of each moment
    begin: IntArray  # (N + 1,) where each corner's observations begin
    unit: IntArray  # (M + 1,) where each unit's corners begin
    joint_at: IntArray  # (M,) where the factor of a unit of several corners begins among those of all
    chunk: IntArray  # (Q + 1,) where each chunk's units begin
    # the pairs that chunks touch, ascending in each, and (Q + 1,) where they begin
    touched: IntArray
    touched_at: IntArray
    # as in Arrays
    control: FloatArray
    control_root: FloatArray
    length_at: IntArray  # (M + 1,) where each unit's known lengths begin
    # the lengths, sorted by unit
    length_first: IntArray
    length_second: IntArray
    length_m: FloatArray
    length_root: FloatArray
    # observations and corners of a unit, at most
    most_seen: int
    most_joined: int
    # (M,) units that are not eliminated: their factor is the identity, and nothing couples to them
    kept: BoolArray


def make_layout(arrays: Arrays) -> Layout:
    """The layout of arrays that lie in the processor's memory."""
    begin = np.searchsorted(arrays.corner.numpy(), np.arange(arrays.corner_count + 1, dtype=np.int32))
    unit = arrays.units.numpy()
    chunk = np.searchsorted(unit, [corner for _, corner in arrays.run_bounds])
    pair = arrays.pair.numpy()
    touched = [_distinct(part, arrays.pair_count) for part in np.split(pair, begin[unit[chunk[1:-1]]])]
    joined = np.diff(unit)
    known = arrays.lengths
    of_length = np.searchsorted(unit, known.first.numpy(), side="right") - 1
    order = np.argsort(of_length, kind="stable")
    return Layout(
        pair=pair,
        measured=arrays.measured.numpy(),
        root=arrays.root_information.numpy(),
        moments=arrays.moment_count,
        frame=arrays.frame_of(torch.arange(arrays.moment_count)).numpy(),
        begin=begin,
        unit=unit,
        joint_at=joint_offsets(joined),
        chunk=chunk,
        touched=np.concatenate(touched),
        touched_at=np.cumsum([0, *(len(part) for part in touched)]),
        control=arrays.control.numpy(),
        control_root=arrays.control_root.numpy(),
        length_at=np.searchsorted(of_length[order], np.arange(len(joined) + 1)),
        length_first=known.first.numpy()[order],
        length_second=known.second.numpy()[order],
        length_m=known.length_m.numpy()[order],
        length_root=known.information_root.numpy()[order],
        most_seen=int(np.diff(begin[unit]).max()),
        most_joined=int(joined.max()),
        kept=np.zeros(len(joined), dtype=np.bool_),
    )


def _distinct(pair: IntArray, pairs: int) -> IntArray:
    """The different ones among a chunk's pairs: by a mask of them all, which takes less than to sort."""
    there = np.zeros(pairs, dtype=np.bool_)
    there[pair] = True
    return np.flatnonzero(there).astype(np.int32)


def joint_offsets(joined: IntArray) -> IntArray:
    """Where the factors (2g, 2g) of units of g > 1 corners begin (M,), those of a size side by side."""
    out, begin = np.zeros(len(joined), dtype=np.int64), 0
    for size in np.unique(joined[joined > 1]):
        same = np.flatnonzero(joined == size)
        out[same] = begin + 4 * size * size * np.arange(len(same))
        begin += 4 * size * size * len(same)
    return out


class Base(NamedTuple):
    """Where a problem is linearised, and the factors of V there."""

    table: FloatArray  # of the pairs (P, 16)
    corners: FloatArray  # (N, 2)
    # of the loss
    code: int
    scale: float
    # L of corners that stand alone (3, N), and of units of several, one after the other
    lower: FloatArray
    joint: FloatArray
    # L^-1 W' (2 N, D) where frames have no states; else (0, D): it is computed anew, by observation
    rows: FloatArray


class Scratch(NamedTuple):
    """A workspace: numbers of pairs (P,), and what belongs to one observation or to those of a unit."""

    slot: IntArray
    jacobian: FloatArray
    coupling: FloatArray
    known: FloatArray
    block: FloatArray
    step: FloatArray
    gradient: FloatArray
    rows: FloatArray

    @classmethod
    def of(cls, layout: Layout, pairs: int, width: int = 0) -> Scratch:
        """Room for any unit, and rows of ``width`` columns."""
        n = 2 * layout.most_joined
        sizes = (16,), (layout.most_seen, 12), (layout.most_seen, 8), (n, n), (n,), (n,), (n, width)
        return cls(np.empty(pairs, dtype=np.int32), *(np.empty(size) for size in sizes))
