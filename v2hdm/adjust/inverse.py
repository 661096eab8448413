"""Diagonal tiles of the inverse of a factorised matrix, from its last tiles backwards.

Within the factor's pattern the inverse follows from the factor alone (Takahashi, Fagan and Chen, Formation of
a sparse bus impedance matrix, 1973): twice the work of a factorisation gives what solves for all columns of
the identity would.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from v2hdm.adjust.tiles import Pattern, TiledCholesky


class _Columns(NamedTuple):
    """Columns of the inverse at the rows of the factor's: its diagonal tile, those below, the tip."""

    pattern: Pattern
    size: int
    parts: list[Tensor]  # by column; those that are not known yet are empty
    tip: Tensor  # the inverse at the tip

    def times(self, tiles: tuple[int, ...], right: Tensor) -> Tensor:
        """The inverse at tiles that the pattern couples, and at the tip, times ``right`` (M, n).

        Its blocks are taken one after the other: all of them at once would not fit in the processor's cache.
        """
        size = self.size
        out = right.new_zeros(right.shape)
        end = len(tiles) * size
        out[end:] = self.tip @ right[end:]
        for number, tile in enumerate(tiles):
            part = self._rows(tile, tiles[number:])
            begin = number * size
            out[begin:].addmm_(part, right[begin : begin + size])
            out[begin : begin + size].addmm_(part[size:].mT, right[begin + size :])
        return out

    def _rows(self, tile: int, tiles: tuple[int, ...]) -> Tensor:
        """The rows of a column that lie in given tiles, its own first, and in the tip."""
        stacked = tile, *self.pattern.below[tile]
        part = self.parts[tile]
        if tiles == stacked:
            return part
        place = {row: number * self.size for number, row in enumerate(stacked)}
        blocks = [part[place[row] : place[row] + self.size] for row in tiles]
        return torch.cat([*blocks, part[len(stacked) * self.size :]])


def inverse_diagonal(factor: TiledCholesky, pattern: Pattern, tail: Tensor | None = None) -> Tensor:
    """Diagonal tiles (G, size, size) of the inverse, in elimination order.

    ``tail`` (T, T) replaces the inverse at the last tiles, which the pattern couples, and at the tip, where
    more may be known: all else follows through its regression on these. By default it is that of the tip.
    """
    if tail is None:
        tail = torch.cholesky_inverse(factor.tip)
    if not factor.diagonal:
        return tail.new_zeros(0, 0, 0)
    size = len(factor.diagonal[0])
    tip = len(factor.tip)
    count = len(factor.diagonal)
    first = count - (len(tail) - tip) // size
    columns = _Columns(
        pattern, size, [tail.new_zeros(0, 0)] * count, tail[len(tail) - tip :, len(tail) - tip :]
    )
    for column in reversed(range(count)):
        if column >= first:
            begin = (column - first) * size
            columns.parts[column] = tail[begin:, begin : begin + size]
            continue
        diagonal = factor.diagonal[column]
        gain = torch.linalg.solve_triangular(diagonal, factor.panels[column], upper=False, left=False)
        lower = -columns.times(pattern.below[column], gain)
        diagonal_block = torch.cholesky_inverse(diagonal) - gain.mT @ lower
        columns.parts[column] = torch.cat([diagonal_block, lower])
    return torch.stack([part[:size] for part in columns.parts])
