"""Substitution of one column in a factor of tiles (:mod:`v2hdm.adjust.tiles`)."""

from __future__ import annotations

from typing import NamedTuple

from v2hdm.compiled import kernel, twin
from v2hdm.records import FloatArray, IntArray


class Flat(NamedTuple):
    """A factor as kernels read it."""

    values: FloatArray  # all tiles but the tip
    at: IntArray  # (G,) offset of each column among the values
    rows: IntArray  # rows of the vector that the panels act on
    begin: IntArray  # (G + 1,) first of each panel among ``rows``
    size: int  # rows and columns of a tile
    tip: FloatArray


@twin("adjust.forward")
@kernel
def forward(factor: Flat, out: FloatArray) -> None:
    """Overwrite b with L^-1 b."""
    values, at, rows, begin, size, tip = factor
    for g in range(len(at)):
        first_row = g * size
        for i in range(size):
            row = at[g] + i * size
            remainder = out[first_row + i]
            for j in range(i):
                remainder -= values[row + j] * out[first_row + j]
            out[first_row + i] = remainder / values[row + i]
        for k in range(begin[g], begin[g + 1]):
            row = at[g] + (size + k - begin[g]) * size
            remainder = 0.0
            for j in range(size):
                remainder += values[row + j] * out[first_row + j]
            out[rows[k]] -= remainder
    first_row = len(out) - len(tip)
    for i in range(len(tip)):
        remainder = out[first_row + i]
        for j in range(i):
            remainder -= tip[i, j] * out[first_row + j]
        out[first_row + i] = remainder / tip[i, i]


@twin("adjust.backward")
@kernel
def backward(factor: Flat, out: FloatArray) -> None:
    """Overwrite b with L^-T b."""
    values, at, rows, begin, size, tip = factor
    first_row = len(out) - len(tip)
    for i in range(len(tip) - 1, -1, -1):
        out[first_row + i] /= tip[i, i]
        for j in range(i):
            out[first_row + j] -= tip[i, j] * out[first_row + i]
    for g in range(len(at) - 1, -1, -1):
        first_row = g * size
        for k in range(begin[g], begin[g + 1]):
            row = at[g] + (size + k - begin[g]) * size
            solved = out[rows[k]]
            for j in range(size):
                out[first_row + j] -= values[row + j] * solved
        for i in range(size - 1, -1, -1):
            row = at[g] + i * size
            out[first_row + i] /= values[row + i]
            for j in range(i):
                out[first_row + j] -= values[row + j] * out[first_row + i]
