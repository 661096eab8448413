"""Substitution of one column in a factor of tiles (:mod:`v2hdm.adjust.tiles`)."""

from __future__ import annotations

from typing import NamedTuple

from v2hdm.compiled import kernel
from v2hdm.records import FloatArray, IntArray


class Flat(NamedTuple):
    """A factor as kernels read it."""

    values: FloatArray  # all tiles but the tip
    at: IntArray  # (G,) offset of each column among the values
    rows: IntArray  # rows of the vector that the panels act on
    begin: IntArray  # (G + 1,) first of each panel among ``rows``
    size: int  # rows and columns of a tile
    tip: FloatArray


@kernel
def forward(factor: Flat, out: FloatArray) -> None:
    """Overwrite b with L^-1 b."""
    values, at, rows, begin, size, tip = factor
    for g in range(len(at)):
        own = g * size
        for i in range(size):
            row = at[g] + i * size
            rest = out[own + i]
            for j in range(i):
                rest -= values[row + j] * out[own + j]
            out[own + i] = rest / values[row + i]
        for k in range(begin[g], begin[g + 1]):
            row = at[g] + (size + k - begin[g]) * size
            rest = 0.0
            for j in range(size):
                rest += values[row + j] * out[own + j]
            out[rows[k]] -= rest
    own = len(out) - len(tip)
    for i in range(len(tip)):
        rest = out[own + i]
        for j in range(i):
            rest -= tip[i, j] * out[own + j]
        out[own + i] = rest / tip[i, i]


@kernel
def backward(factor: Flat, out: FloatArray) -> None:
    """Overwrite b with L^-T b."""
    values, at, rows, begin, size, tip = factor
    own = len(out) - len(tip)
    for i in range(len(tip) - 1, -1, -1):
        out[own + i] /= tip[i, i]
        for j in range(i):
            out[own + j] -= tip[i, j] * out[own + i]
    for g in range(len(at) - 1, -1, -1):
        own = g * size
        for k in range(begin[g], begin[g + 1]):
            row = at[g] + (size + k - begin[g]) * size
            known = out[rows[k]]
            for j in range(size):
                out[own + j] -= values[row + j] * known
        for i in range(size - 1, -1, -1):
            row = at[g] + i * size
            out[own + i] /= values[row + i]
            for j in range(i):
                out[own + j] -= values[row + j] * out[own + i]
