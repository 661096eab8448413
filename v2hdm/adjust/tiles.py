"""Sparse Cholesky factorisation in dense tiles of a matrix with arrow structure.

Frames, in tiles along the route, couple to neighbours and to tiles of earlier laps; extrinsics couple to
everything and come last, as the *tip*. Tiles are ordered by reverse Cuthill-McKee or, where many couple, by
least degree, and their fill is found beforehand (the elimination tree: George and Liu, Computer Solution of
Large Sparse Positive Definite Systems, 1981): time and memory grow linearly with the route.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import heapify, heappop, heappush
from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee
from torch import Tensor

from v2hdm.adjust.kernels import are_compiled

if TYPE_CHECKING:
    from v2hdm.adjust.kernels.substitute import Flat

TIP = -1  # the row of the tiles that border the others, and row and column of the last one


class Product(NamedTuple):
    """A product of tiles below a column's diagonal, numbered from 0, that is subtracted from a later column.

    Tiles that lie one below the other in both columns are one product: one tile is too small for a fast one.
    """

    right: int  # the right factor, and among the column's rows the later column
    left: int  # the first tile of the left factor
    tiles: int | None  # of the left factor; None for all from there on, with the tip
    at: int  # the tile of the later column, its diagonal counted, from which it is subtracted


@dataclass(frozen=True)
class Pattern:
    """The nonzero tiles."""

    position: tuple[int, ...]  # elimination order of each tile along the route
    below: tuple[tuple[int, ...], ...]  # rows below each column's diagonal, fill included, ascending

    @cached_property
    def products(self) -> tuple[tuple[Product, ...], ...]:
        """By column, what its elimination changes in other columns."""
        return tuple(tuple(self._products(column)) for column in range(len(self.below)))

    def _products(self, column: int) -> Iterator[Product]:
        below = self.below[column]
        for right, first in enumerate(below):
            place = {row: number for number, row in enumerate((first, *self.below[first]))}
            places = [*(place[row] for row in below[right:]), len(place)]  # the tip comes last in both
            begin = 0
            for end in range(1, len(places)):
                if places[end] != places[end - 1] + 1:
                    yield Product(right, right + begin, end - begin, places[begin])
                    begin = end
            yield Product(right, right + begin, None, places[begin])

    def multiplications(self, size: int, tip: int) -> float:
        """Multiplications of a factorisation, in tiles of ``size`` rows and a tip of ``tip``."""
        heights = np.array([len(below) for below in self.below], dtype=float) * size + tip
        return float(np.sum(size**3 / 6 + heights * size**2 / 2 + heights**2 * size / 2))


def find_pattern(
    tile_count: int,
    cliques: Iterable[Sequence[int]],
    least_degree: bool = False,
    last: Sequence[int] = (),
) -> Pattern:
    """Pattern of the factor of a matrix that couples all tiles of each clique, some eliminated ``last``."""
    edges = {pair for clique in cliques for pair in combinations(sorted(clique), 2)}
    position = np.arange(tile_count)
    if edges:
        order = _least_degree(tile_count, edges) if least_degree else _cuthill_mckee(tile_count, edges)
        position[order] = np.arange(tile_count)
    if len(last):
        is_last = np.isin(np.arange(tile_count), last)
        position[np.lexsort((position, is_last))] = np.arange(tile_count)
    below: list[set[int]] = [set() for _ in range(tile_count)]
    for first_tile, second_tile in edges:
        low, high = sorted((int(position[first_tile]), int(position[second_tile])))
        below[low].add(high)
    for rows in below:
        if rows:
            parent = min(rows)
            below[parent] |= rows - {parent}
    return Pattern(tuple(position.tolist()), tuple(tuple(sorted(rows)) for rows in below))


def _cuthill_mckee(tile_count: int, edges: set[tuple[int, int]]) -> NDArray[Any]:
    first, second = np.array(sorted(edges)).T
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(tile_count, tile_count)).tocsr()
    order: NDArray[Any] = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
    return order


def _least_degree(tile_count: int, edges: set[tuple[int, int]]) -> list[int]:
    """Elimination order by least degree; eliminating a tile couples all its neighbours."""
    neighbours: list[set[int]] = [set() for _ in range(tile_count)]
    for first, second in edges:
        neighbours[first].add(second)
        neighbours[second].add(first)
    queue = [(len(tiles), tile) for tile, tiles in enumerate(neighbours)]
    heapify(queue)
    order: list[int] = []
    done = [False] * tile_count
    while queue:
        degree, tile = heappop(queue)
        if done[tile] or degree != len(neighbours[tile]):
            continue
        done[tile] = True
        order.append(tile)
        for other in neighbours[tile]:
            neighbours[other] |= neighbours[tile]
            neighbours[other] -= {tile, other}
            heappush(queue, (len(neighbours[other]), other))
    return order


@dataclass(frozen=True)
class TiledMatrix:
    """Lower tiles of a symmetric matrix, in the layout of the factor that overwrites them."""

    pattern: Pattern  # of nonzero tiles
    values: Tensor  # all numbers; the following are views of them
    columns: tuple[Tensor, ...]  # by column, the tip's excepted, stacked in elimination order, its rows last
    tip: Tensor  # last diagonal tile
    tiles: Mapping[tuple[int, int], Tensor]  # by (row, column) in elimination order, or :data:`TIP`
    # of the columns' tiles, ascending: column * (G + 1) + row, with G for the tip; ``at`` is their offset
    keys: NDArray[np.int64]
    at: NDArray[np.int64]

    @classmethod
    def zeros(cls, pattern: Pattern, size: int, tip: int, like: Tensor) -> TiledMatrix:
        """Tiles of ``size`` rows and columns and a tip of ``tip``, of the type of ``like``."""
        count = len(pattern.below)
        areas = [size * (size + size * len(below) + tip) for below in pattern.below]
        values = like.new_zeros(sum(areas) + tip * tip)
        *stacked, last = torch.split(values, [*areas, tip * tip])
        columns = tuple(part.view(-1, size) for part in stacked)
        tiles = {(TIP, TIP): last.view(tip, tip)}
        keys = []
        at = []
        for column, (part, below) in enumerate(zip(columns, pattern.below, strict=True)):
            rows = (column, *below, TIP)
            parts = torch.split(part, [size] * (len(rows) - 1) + [tip])
            tiles.update(zip(((row, column) for row in rows), parts, strict=True))
            keys += [column * (count + 1) + row % (count + 1) for row in rows]
            at += [tile.storage_offset() for tile in parts]
        return cls(pattern, values, columns, tiles[TIP, TIP], tiles, np.array(keys), np.array(at))


@dataclass(frozen=True)
class TiledCholesky:
    """L of a positive definite matrix in tiles of ``size``, the tip last."""

    diagonal: tuple[Tensor, ...]  # lower factors of the diagonal tiles (G, size, size)
    panels: tuple[Tensor, ...]  # tiles below each, stacked, the tip's rows last
    rows: tuple[Tensor, ...]  # rows of the vector that each panel acts on
    tip: Tensor  # lower factor of the tip; the identity if held
    values: Tensor  # memory of all of these but the tip
    held: Tensor | None = None  # Schur complement of a held tip

    @property
    def size(self) -> int:
        """Number of rows."""
        return sum(len(tile) for tile in self.diagonal) + len(self.tip)

    def pivots(self) -> Tensor:
        """Squares of L's diagonal."""
        return torch.cat([tile.diagonal() for tile in (*self.diagonal, self.tip)]).square()

    def tail(self, tiles: int) -> TiledCholesky:
        """The factor of the last tiles and the tip, all before them eliminated."""
        begin = len(self.diagonal) - tiles
        offset = sum(len(tile) for tile in self.diagonal[:begin])
        rows = tuple(of_panel - offset for of_panel in self.rows[begin:])
        return replace(self, diagonal=self.diagonal[begin:], panels=self.panels[begin:], rows=rows)

    @cached_property
    def _flat(self) -> Flat:
        from v2hdm.adjust.kernels.substitute import Flat

        return Flat(
            values=self.values.numpy(),
            at=np.array([tile.storage_offset() for tile in self.diagonal]),
            rows=torch.cat(self.rows).numpy(),
            begin=np.cumsum([0, *map(len, self.rows)]),
            size=len(self.diagonal[0]),
            tip=np.ascontiguousarray(self.tip.numpy()),
        )

    def _substitute(self, right: Tensor, transposed: bool) -> Tensor:
        """Solve for one column by a kernel: Python's loop over tiles takes ten times as long."""
        from v2hdm.adjust.kernels.substitute import backward, forward

        out = right[:, 0].clone(memory_format=torch.contiguous_format)
        (backward if transposed else forward)(self._flat, out.numpy())
        return out[:, None]

    def _is_for_kernel(self, right: Tensor) -> bool:
        return right.shape[1] == 1 and bool(self.diagonal) and not right.is_cuda and are_compiled()

    def solve(self, right: Tensor) -> Tensor:
        """L^-1 b for b (size, n)."""
        if self._is_for_kernel(right):
            return self._substitute(right, transposed=False)
        out = right.clone()
        begin = 0
        # Rows above the first nonzero one stay zero.
        first = int(right.any(dim=1).to(torch.uint8).argmax()) if self.diagonal else 0
        for tile, panel, rows in zip(self.diagonal, self.panels, self.rows, strict=True):
            if begin + len(tile) > first:
                part = out[begin : begin + len(tile)]
                # Nothing reaches most tiles of other laps.
                if bool(part.any()):
                    part.copy_(torch.linalg.solve_triangular(tile, part, upper=False))
                    out.index_add_(0, rows, panel @ part, alpha=-1)
            begin += len(tile)
        out[begin:] = torch.linalg.solve_triangular(self.tip, out[begin:], upper=False)
        return out

    def solve_transposed(self, right: Tensor) -> Tensor:
        """L^-T b for b (size, n)."""
        if self._is_for_kernel(right):
            return self._substitute(right, transposed=True)
        out = right.clone()
        end = self.size - len(self.tip)
        out[end:] = torch.linalg.solve_triangular(self.tip.mT, out[end:], upper=True)
        for tile, panel, rows in zip(self.diagonal[::-1], self.panels[::-1], self.rows[::-1], strict=True):
            begin = end - len(tile)
            remainder = out[begin:end] - panel.mT @ out.index_select(0, rows)
            out[begin:end] = torch.linalg.solve_triangular(tile.mT, remainder, upper=True)
            end = begin
        return out


def factorise_tiles(matrix: TiledMatrix, hold_tip: bool = False) -> TiledCholesky | None:
    """Factorise in place, right-looking, the tip too unless held; None if not positive definite."""
    diagonal = []
    panels = []
    rows = []
    tip = matrix.tip
    size = matrix.columns[0].shape[1] if matrix.columns else 0
    index = torch.arange(size * len(matrix.columns) + len(tip), device=tip.device)
    for column, below in enumerate(matrix.pattern.below):
        diagonal_tile = matrix.tiles[column, column]
        panel = matrix.columns[column][size:]
        if not _factorise_tile(diagonal_tile):
            return None
        panel.copy_(torch.linalg.solve_triangular(diagonal_tile, panel.mT, upper=False).mT)
        for target, left, right in _updates(matrix, column):
            target.addmm_(left, right.mT, alpha=-1)
        diagonal.append(diagonal_tile)
        panels.append(panel)
        tiles = [index[tile * size : (tile + 1) * size] for tile in below]
        rows.append(torch.cat([*tiles, index[-len(tip) :]]))
    held = tip if hold_tip else None
    if hold_tip:
        tip = torch.eye(len(tip), dtype=tip.dtype, device=tip.device)
    elif not _factorise_tile(tip):
        return None
    return TiledCholesky(tuple(diagonal), tuple(panels), tuple(rows), tip, matrix.values, held)


def _updates(matrix: TiledMatrix, column: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """A column's changes in later ones: views of the target, and of the left and right factors."""
    size = matrix.columns[column].shape[1]
    panel = matrix.columns[column][size:]
    below = matrix.pattern.below[column]
    for product in matrix.pattern.products[column]:
        left = panel[product.left * size :]
        if product.tiles is not None:
            left = left[: product.tiles * size]
        at = product.at * size
        target = matrix.columns[below[product.right]][at : at + len(left)]
        yield target, left, panel[product.right * size : (product.right + 1) * size]
    bottom = panel[len(below) * size :]
    yield matrix.tip, bottom, bottom


def _factorise_tile(tile: Tensor) -> bool:
    """Replace a tile by its lower factor; False if it has none."""
    factor, info = torch.linalg.cholesky_ex(tile)
    tile.copy_(factor)
    return int(info) == 0
