"""Sparse Cholesky factorisation in dense blocks of unequal sizes, and the blocks of the inverse within it.

The summaries of sections couple few large blocks: the corners that the same sections see, and the cameras,
which all do. Eliminated by least degree, blocks fill in as cliques, and within these the inverse follows from
the factor alone (Takahashi, Fagan and Chen, Formation of a sparse bus impedance matrix, 1973).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from v2hdm.errors import AdjustError
from v2hdm.records import FloatArray


@dataclass(frozen=True)
class BlockPattern:
    """The blocks' elimination ``order``, and for each the later ones that it couples to, fill included."""

    sizes: tuple[int, ...]
    order: tuple[int, ...]
    later: tuple[tuple[int, ...], ...]  # by block, ascending in the order

    @classmethod
    def of(cls, sizes: Sequence[int], cliques: Sequence[Sequence[int]], last: int) -> BlockPattern:
        """The pattern of a matrix that couples all blocks of each clique; block ``last`` comes last."""
        neighbours: list[set[int]] = [set() for _ in sizes]
        for clique in cliques:
            for block in clique:
                neighbours[block] |= set(clique) - {block}
        left = set(range(len(sizes))) - {last}
        order: list[int] = []
        later: list[set[int]] = [set() for _ in sizes]
        while left:
            block = min(left, key=lambda block: (sum(sizes[other] for other in neighbours[block]), block))
            left.remove(block)
            order.append(block)
            later[block] = set(neighbours[block])
            for other in neighbours[block]:
                neighbours[other] |= neighbours[block]
                neighbours[other] -= {block, other}
        order.append(last)
        place = {block: number for number, block in enumerate(order)}
        ordered = tuple(tuple(sorted(blocks, key=place.__getitem__)) for blocks in later)
        return cls(tuple(sizes), tuple(order), ordered)


@dataclass
class BlockMatrix:
    """A symmetric matrix under assembly: ``blocks`` by (row, column), the row later in the order."""

    pattern: BlockPattern
    blocks: dict[tuple[int, int], FloatArray]

    @classmethod
    def zeros(cls, pattern: BlockPattern) -> BlockMatrix:
        """A matrix of zeros."""
        sizes = pattern.sizes
        blocks = {
            (row, column): np.zeros((sizes[row], sizes[column]))
            for column in pattern.order
            for row in (column, *pattern.later[column])
        }
        return cls(pattern, blocks)

    def factorise(self) -> BlockCholesky:
        """Factorise in place; raises AdjustError where it is not positive definite."""
        pattern = self.pattern
        for column in pattern.order:
            try:
                lower = cholesky(self.blocks[column, column], lower=True)
            except np.linalg.LinAlgError:
                raise AdjustError(
                    "the sections together leave a direction free: they share too few markings, or a drive "
                    "has none; make sections longer, or leave that drive out"
                ) from None
            self.blocks[column, column] = lower
            later = pattern.later[column]
            for row in later:
                panel = self.blocks[row, column]
                self.blocks[row, column] = solve_triangular(lower, panel.T, lower=True).T
            for number, first in enumerate(later):
                for second in later[number:]:
                    self.blocks[second, first] -= self.blocks[second, column] @ self.blocks[first, column].T
        return BlockCholesky(pattern, self.blocks)


@dataclass(frozen=True)
class BlockCholesky:
    """The factor L of a positive definite matrix, in blocks."""

    pattern: BlockPattern
    blocks: dict[tuple[int, int], FloatArray]

    def solve(self, right: Sequence[FloatArray]) -> list[FloatArray]:
        """The solution, by block, for a right-hand side by block."""
        out = [np.array(part, dtype=np.float64) for part in right]
        for column in self.pattern.order:
            out[column] = solve_triangular(self.blocks[column, column], out[column], lower=True)
            for row in self.pattern.later[column]:
                out[row] -= self.blocks[row, column] @ out[column]
        for column in reversed(self.pattern.order):
            for row in self.pattern.later[column]:
                out[column] -= self.blocks[row, column].T @ out[row]
            out[column] = solve_triangular(self.blocks[column, column], out[column], lower=True, trans="T")
        return out

    def inverse(self) -> dict[tuple[int, int], FloatArray]:
        """The blocks of the inverse where the factor has blocks, keyed like these."""
        out: dict[tuple[int, int], FloatArray] = {}
        for column in reversed(self.pattern.order):
            lower = self.blocks[column, column]
            later = self.pattern.later[column]
            diagonal = cho_solve((lower, True), np.eye(len(lower)))
            gains = {
                row: solve_triangular(lower, self.blocks[row, column].T, lower=True, trans="T").T
                for row in later
            }
            for row in later:
                total = np.zeros((self.pattern.sizes[row], len(lower)))
                for other in later:
                    block = out[row, other] if (row, other) in out else out[other, row].T
                    total -= block @ gains[other]
                out[row, column] = total
            for row in later:
                diagonal = diagonal - gains[row].T @ out[row, column]
            out[column, column] = diagonal
        return out
