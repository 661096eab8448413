"""The corners' own block of the Hessian, factorised: 2 x 2, or as many as known lengths join."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.errors import AdjustError

CORNER_FLOOR = 1e-10  # information, 1 / m^2, that keeps a corner factorable which runs off to the horizon

PIVOT_FLOOR = 1e-12  # least pivot of a corner's second coordinate, as a share of its own information

INSEPARABLE = "corners joined by known lengths cannot be solved for together: state their sigma_m larger"
"""The error of a block that has no factor."""


@dataclass(frozen=True)
class Joint:
    """Groups of ``corners`` corners each, side by side from ``begin`` (m,); lower factors (m, 2g, 2g)."""

    begin: Tensor
    corners: int
    factor: Tensor

    @property
    def index(self) -> Tensor:
        """The groups' corners (m, g)."""
        return self.begin[:, None] + torch.arange(self.corners, device=self.begin.device)


@dataclass(frozen=True)
class CornerFactor:
    """L of the block-diagonal V = L L': ``lower`` (3, n), xx, yx, yy, where a corner stands alone."""

    lower: Tensor
    joint: tuple[Joint, ...]

    def part(self, corners: slice) -> CornerFactor:
        """The factor of some corners, which are joined to no others."""
        inside = []
        for group in self.joint:
            chosen = (group.begin >= corners.start) & (group.begin < corners.stop)
            if bool(chosen.any()):
                inside.append(Joint(group.begin[chosen] - corners.start, group.corners, group.factor[chosen]))
        return CornerFactor(self.lower[:, corners], tuple(inside))

    def take(self, corners: Tensor) -> CornerFactor:
        """The factor of corners (n,), ascending, with all that they are joined to."""
        inside = []
        for group in self.joint:
            place = torch.searchsorted(corners, group.begin).clamp(max=len(corners) - 1)
            chosen = corners[place] == group.begin
            if bool(chosen.any()):
                inside.append(Joint(place[chosen], group.corners, group.factor[chosen]))
        return CornerFactor(self.lower[:, corners], tuple(inside))

    def solve(self, right: Tensor) -> Tensor:
        """L^-1 b for b (n, 2, ...)."""
        first, below, last = self.lower.reshape(3, -1, *[1] * (right.ndim - 2))
        top = right[:, 0] / first
        out = torch.stack([top, (right[:, 1] - below * top) / last], dim=1)
        return self._solve_joint(right, out, transposed=False)

    def solve_transposed(self, right: Tensor) -> Tensor:
        """L^-T b for b (n, 2, ...)."""
        first, below, last = self.lower.reshape(3, -1, *[1] * (right.ndim - 2))
        low = right[:, 1] / last
        out = torch.stack([(right[:, 0] - below * low) / first, low], dim=1)
        return self._solve_joint(right, out, transposed=True)

    def _solve_joint(self, right: Tensor, out: Tensor, transposed: bool) -> Tensor:
        for group in self.joint:
            index, factor = group.index, group.factor.mT if transposed else group.factor
            stacked = right[index].reshape(*factor.shape[:2], -1)
            solved = torch.linalg.solve_triangular(factor, stacked, upper=transposed)
            out[index] = solved.reshape(*index.shape, *right.shape[1:])
        return out


def factorise_corners(arrays: Arrays, blocks: Tensor, by_length: tuple[Tensor, Tensor]) -> CornerFactor:
    """Factorise V of (N, 2, 2) J'J by corner, and derivatives (M, 2) of the lengths by both their corners.

    Raises AdjustError where corners that lengths join cannot be solved for together.
    """
    xx, yx, yy = blocks[:, 0, 0], blocks[:, 1, 0], blocks[:, 1, 1]
    lower = cholesky_2x2(xx + CORNER_FLOOR, yx, yy + CORNER_FLOOR)
    units = arrays.units
    size, groups = torch.diff(units), []
    for corners in torch.unique(size[size > 1]).tolist():
        group = Joint(units[:-1][size == corners], corners, lower)
        matrix = blocks.new_zeros(len(group.begin), corners, 2, corners, 2)
        k = torch.arange(corners, device=blocks.device)
        matrix[:, k, :, k, :] = blocks[group.index].transpose(0, 1)
        _add_lengths(arrays, group, by_length, matrix)
        matrix = matrix.view(len(matrix), 2 * corners, 2 * corners)
        matrix.diagonal(dim1=1, dim2=2).add_(CORNER_FLOOR)
        factor, failed = torch.linalg.cholesky_ex(matrix)
        if bool(failed.any()):
            raise AdjustError(INSEPARABLE)
        groups.append(Joint(group.begin, corners, factor))
    return CornerFactor(lower, tuple(groups))


def _add_lengths(arrays: Arrays, group: Joint, by_length: tuple[Tensor, Tensor], matrix: Tensor) -> None:
    """Add J'J of the lengths within the groups to their blocks (m, g, 2, g, 2)."""
    known = arrays.lengths
    which = torch.searchsorted(group.begin, known.first, right=True) - 1
    inside = (which >= 0) & (known.first < group.begin[which.clamp(min=0)] + group.corners)
    which = which[inside]
    ends = [
        (end[inside] - group.begin[which], by[inside])
        for end, by in zip((known.first, known.second), by_length, strict=True)
    ]
    for row, by_row in ends:
        for column, by_column in ends:
            outer = by_row[:, :, None] * by_column[:, None, :]
            matrix.permute(0, 1, 3, 2, 4).index_put_((which, row, column), outer, accumulate=True)


def cholesky_2x2(xx: Tensor, yx: Tensor, yy: Tensor) -> Tensor:
    """Lower factors (3, n) of symmetric 2 x 2 blocks, by hand: one call per block would be slow."""
    first = xx.sqrt()
    below = yx / first
    last = (yy - below.square()).clamp(min=PIVOT_FLOOR * yy).sqrt()
    return torch.stack([first, below, last])
