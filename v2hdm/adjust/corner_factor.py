"""The corners' own block of the Hessian, factorised: 2 x 2, or as many as known lengths join."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.errors import AdjustError

CORNER_FLOOR = 1e-10
"""Information, 1 / m^2, that keeps a corner factorable which runs off to the horizon."""

PIVOT_FLOOR = 1e-12
"""Least pivot of a corner's second coordinate, as a share of its own information."""

INSEPARABLE = "corners joined by known lengths cannot be solved for together: state their sigma_m larger"
"""What a block is reported as that has no factor."""


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

    @classmethod
    def side_by_side(cls, factors: list[CornerFactor]) -> CornerFactor:
        """One factor of several runs' corners, in their order."""
        groups: dict[int, list[Joint]] = {}
        offset = 0
        for one in factors:
            for group in one.joint:
                moved = Joint(group.begin + offset, group.corners, group.factor)
                groups.setdefault(group.corners, []).append(moved)
            offset += one.lower.shape[1]
        joint = (
            Joint(torch.cat([g.begin for g in same]), each, torch.cat([g.factor for g in same]))
            for each, same in groups.items()
        )
        return cls(torch.cat([one.lower for one in factors], dim=1), tuple(joint))

    def part(self, corners: slice) -> CornerFactor:
        """That of some corners, which are joined to no others."""
        inside = []
        for group in self.joint:
            chosen = (group.begin >= corners.start) & (group.begin < corners.stop)
            if bool(chosen.any()):
                inside.append(Joint(group.begin[chosen] - corners.start, group.corners, group.factor[chosen]))
        return CornerFactor(self.lower[:, corners], tuple(inside))

    def take(self, corners: Tensor) -> CornerFactor:
        """That of corners (n,), ascending, with all that they are joined to."""
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


def factorise_corners(
    arrays: Arrays, corners: slice, blocks: Tensor, by_length: Tensor, damping: float
) -> CornerFactor:
    """Factorise what the observations, the survey and the known lengths say about ``corners``.

    Args:
        arrays: the problem.
        corners: which; those that lengths join are all of them among these.
        blocks: the observations' part (3, n): xx, yx, yy.
        by_length: derivatives (M, 2) of the lengths' residuals by their first corners.
        damping: added to the diagonal, relative to it.
    """
    surveyed = arrays.control_information[corners]
    xx, yx, yy = blocks[0] + surveyed[:, 0], blocks[1], blocks[2] + surveyed[:, 1]
    grow = 1 + damping
    lower = cholesky_2x2(xx * grow + CORNER_FLOOR, yx, yy * grow + CORNER_FLOOR)
    joined = arrays.joined[corners]
    if not bool(joined.any()):
        return CornerFactor(lower, ())
    begin = (~joined).nonzero()[:, 0]
    size = torch.diff(begin, append=begin.new_tensor([len(joined)]))
    groups = []
    for corners_each in torch.unique(size[size > 1]).tolist():
        group = Joint(begin[size == corners_each], corners_each, lower)
        matrix = _group_blocks(group, torch.stack([xx, yx, yy]))
        _add_lengths(arrays, corners.start, group, by_length, matrix)
        matrix.diagonal(dim1=1, dim2=2).mul_(grow).add_(CORNER_FLOOR)
        factor, failed = torch.linalg.cholesky_ex(matrix)
        if bool(failed.any()):
            raise AdjustError(INSEPARABLE)
        groups.append(Joint(group.begin, corners_each, factor))
    return CornerFactor(lower, tuple(groups))


def _group_blocks(group: Joint, blocks: Tensor) -> Tensor:
    """The corners' own blocks on the diagonals (m, 2g, 2g)."""
    count, each = group.index.shape
    matrix = blocks.new_zeros(count, each, 2, each, 2)
    k = torch.arange(each, device=blocks.device)
    own = blocks[:, group.index]
    matrix[:, k, :, k, :] = (
        torch.stack([own[0], own[1], own[1], own[2]], dim=-1).reshape(count, each, 2, 2).transpose(0, 1)
    )
    return matrix.reshape(count, 2 * each, 2 * each)


def _add_lengths(arrays: Arrays, offset: int, group: Joint, by_length: Tensor, matrix: Tensor) -> None:
    """Add J'J of the lengths within the groups."""
    first, second = arrays.lengths.first - offset, arrays.lengths.second - offset
    which = torch.searchsorted(group.begin, first, right=True) - 1
    inside = (which >= 0) & (first < group.begin[which.clamp(min=0)] + group.corners)
    which, by_first = which[inside], by_length[inside]
    view = matrix.view(len(matrix), group.corners, 2, group.corners, 2)
    outer = by_first[:, :, None] * by_first[:, None, :]
    places = [end[inside] - group.begin[which] for end in (first, second)]
    for row, by_row in zip(places, (1, -1), strict=True):
        for column, by_column in zip(places, (1, -1), strict=True):
            view.permute(0, 1, 3, 2, 4).index_put_(
                (which, row, column), by_row * by_column * outer, accumulate=True
            )


def cholesky_2x2(xx: Tensor, yx: Tensor, yy: Tensor) -> Tensor:
    """Lower factors (3, n) of symmetric 2 x 2 blocks, by hand: one call per block would be slow."""
    first = xx.sqrt()
    below = yx / first
    last = (yy - below.square()).clamp(min=PIVOT_FLOOR * yy).sqrt()
    return torch.stack([first, below, last])
