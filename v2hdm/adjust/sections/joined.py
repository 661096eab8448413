"""Covariances of a part that was joined with others.

If all parts together give the border b = W'y of a part (:mod:`v2hdm.adjust.sections.summary`) the covariance
C, all else inherits C - W'W through its regression on the border (the law of total covariance).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import one_hot

from v2hdm.adjust.covariance import Covariance
from v2hdm.adjust.reduced import to_tiles
from v2hdm.adjust.sections.pairs import PairCovariances
from v2hdm.adjust.sections.summary import Border, Columns, border_columns, chunks_of, corner_columns
from v2hdm.adjust.whitening import Whitening
from v2hdm.records import FloatArray, IntArray

_FRAMES_AT_ONCE = 64  # frames whose columns are computed together


class _Solved(NamedTuple):
    """The columns of n corners of a part, from ``begin`` to before ``end`` of those in question."""

    begin: int
    end: int
    is_used: Tensor  # (D,) reduced variables where a column is not zero: often few
    reduced: Tensor  # the columns there (U, 2 n)
    unshared: Tensor  # the columns (2 n, 2 n) at the corners' variables
    regression: Tensor  # (b, 2 n) inner products with the columns of the part's border
    gained: Tensor  # (b, 2 n) what the border gained by the join, times these

    def covariance(self, other: _Solved) -> FloatArray:
        """Covariances (n, 2, m, 2) with the m corners of another one, or this."""
        in_both = self.is_used & other.is_used
        out = self.reduced[in_both[self.is_used]].mT @ other.reduced[in_both[other.is_used]]
        out += self.regression.mT @ other.gained
        if other is self:
            out += self.unshared.mT @ self.unshared
        by_corner = out.view(self.end - self.begin, 2, other.end - other.begin, 2)
        return np.asarray(by_corner.cpu().numpy())


@dataclass(frozen=True)
class JoinedCovariance(Covariance):
    """Covariances of a part that was joined with others; ``joint`` (n, n) is that of its ``border``.

    Those of ``pairs`` of corners are known already.
    """

    border: Border | None = None
    joint: FloatArray | None = None
    pairs: PairCovariances | None = None

    @cached_property
    def _columns(self) -> Columns:
        assert self.border is not None
        return border_columns(self.whitening, self.border)

    @cached_property
    def _gained(self) -> Tensor:
        """(W'W)^-1 (C - W'W) (W'W)^-1."""
        alone = self._columns.covariance
        difference = torch.as_tensor(self.joint, dtype=alone.dtype, device=alone.device) - alone
        factor = torch.linalg.cholesky(alone)
        return torch.cholesky_solve(torch.cholesky_solve(difference, factor).mT, factor)

    def slopes(self, reduced: Tensor, corners: Tensor) -> FloatArray:
        """Slopes (b, n) of the cost by the border's step under n errors, all else following both.

        The errors are columns by the whitened unknowns: ``reduced`` (D, n) and of ``corners`` (N, 2, n).
        """
        return np.asarray(self._in_border(self._pulled(reduced, corners)).cpu().numpy())

    def followed(self, reduced: Tensor, corners: Tensor, steps: FloatArray) -> tuple[Tensor, Tensor]:
        """Whitened steps under n errors, as in :meth:`slopes`, where the border makes ``steps`` (b, n)."""
        assert self.border is not None
        pulled = self._pulled(reduced, corners)
        last, of_border = self._columns.pushed(self._in_border(torch.as_tensor(steps).to(pulled) + pulled))
        moved = -reduced
        moved[len(moved) - len(last) :] += last
        moved_corners = -corners
        if len(of_border):
            moved_corners[self.border.corners] += of_border
        return moved, moved_corners

    def _pulled(self, reduced: Tensor, corners: Tensor) -> Tensor:
        """Inner products (b, n) of the border's columns and others."""
        assert self.border is not None
        return self._columns.pulled(reduced, corners[self.border.corners])

    def _in_border(self, columns: Tensor) -> Tensor:
        """(W'W)^-1 times columns (b, n)."""
        return torch.cholesky_solve(columns, torch.linalg.cholesky(self._columns.covariance))

    def _cameras(self) -> list[FloatArray]:
        """Covariances (6 + Q, 6 + Q) of each camera's unknowns."""
        assert self.joint is not None
        count = self.whitening.engine.arrays.camera_unknowns
        tip = len(self.whitening.reduced_factor.tip)
        return [self.joint[k : k + count, k : k + count] for k in range(0, tip, count)]

    def camera_information(self) -> FloatArray:
        """Marginal information (C (6 + Q), C (6 + Q)) of the cameras' left tangents and clock offsets."""
        assert self.joint is not None
        tip = len(self.whitening.reduced_factor.tip)
        return np.asarray(np.linalg.inv(self.joint[:tip, :tip]), dtype=np.float64)

    def poses(self) -> FloatArray:
        """Variances (J, 6) of the frames' tangents; 0 without states."""
        assert self.border is not None
        whitening = self.whitening
        if len(self.border.corners) == len(whitening.plan.kept_corners):
            return self._poses(self._tail())
        out = self._poses(None)
        arrays = whitening.engine.arrays
        axes = torch.tensor(arrays.states, dtype=torch.int64, device=arrays.centre.device)
        acts = one_hot(axes, 6).to(torch.float64)
        for begin in range(0, arrays.frame_count if arrays.states else 0, _FRAMES_AT_ONCE):
            frames = torch.arange(begin, min(begin + _FRAMES_AT_ONCE, arrays.frame_count), device=axes.device)
            of_frames = _frame_columns(whitening, frames, acts)
            regression = self._columns.reduced.mT @ of_frames[len(of_frames) - len(self._columns.reduced) :]
            gained = ((self._gained @ regression) * regression).sum(0).view(-1, 6)
            out[begin : begin + len(gained)] += gained.cpu().numpy()
        return out

    def _tail(self) -> Tensor:
        """The joint covariance at the tiles of the border and the tip."""
        tail = self.whitening.reduced_factor.tail(self.whitening.plan.border_tiles)
        root = tail.solve(torch.eye(tail.size, dtype=tail.tip.dtype, device=tail.tip.device))
        by_border = root.mT @ self._columns.reduced[-tail.size :]
        return root.mT @ root + by_border @ self._gained @ by_border.mT

    def with_pairs(self, first: IntArray, second: IntArray) -> JoinedCovariance:
        """The same that knows the covariances of corners (P,) with others (P,), each column solved for once.

        Groups of :meth:`corners` share most columns, and would solve for these again. Where known lengths
        join corners, nothing is known before it is asked for.
        """
        arrays = self.whitening.engine.arrays
        if bool(arrays.joined.any()) or not len(first):
            return self
        pairs = PairCovariances.places(arrays.corner_count, first, second)
        rank = torch.argsort(arrays.corner_order).cpu().numpy()
        in_order = np.unique(rank[pairs])
        # Where the corners of each pair are in that order, the earlier one first.
        places = np.searchsorted(in_order, rank[pairs])
        blocks = self._of_places(
            torch.as_tensor(in_order, device=arrays.centre.device), np.sort(places, axis=0)
        )
        is_turned = places[0] > places[1]
        blocks[is_turned] = blocks[is_turned].swapaxes(1, 2)
        return replace(self, pairs=PairCovariances.of(arrays.corner_count, pairs, blocks))

    def _of_places(self, corners: Tensor, places: IntArray) -> FloatArray:
        """Covariances (P, 2, 2) of pairs of corners (n,), ascending, at their ascending places (2, P)."""
        early, late = places
        blocks = np.empty((len(early), 2, 2))
        waited_for: list[_Solved] = []
        for begin, end in chunks_of(self.whitening, corners):
            solved = self._solved(corners[begin:end], begin)
            waited_for.append(solved)
            is_late = (late >= begin) & (late < end)
            for before in waited_for:
                rows = np.flatnonzero(is_late & (early >= before.begin) & (early < before.end))
                if len(rows):
                    covariance = before.covariance(solved)
                    blocks[rows] = covariance[early[rows] - before.begin, :, late[rows] - begin]
            waiting = early[late >= end]
            waited_for = [before for before in waited_for if (waiting < before.end).any()]
        return blocks

    def _solved(self, corners: Tensor, begin: int) -> _Solved:
        """The columns of corners (n,), of which ``begin`` come before."""
        columns = corner_columns(self.whitening, corners)
        regression = self._regression(corners, columns)
        is_used = columns.reduced.any(dim=1)
        return _Solved(
            begin=begin,
            end=begin + len(corners),
            is_used=is_used,
            reduced=columns.reduced[is_used],
            unshared=columns.own,
            regression=regression,
            gained=self._gained @ regression,
        )

    def corners(self, groups: NDArray[np.int64]) -> FloatArray:
        """See :meth:`Covariance.corners`."""
        if self.pairs is None:
            return super().corners(groups)
        known = self.pairs.of_groups(groups)
        out = known.covariances
        if not known.is_known.all():
            missing = replace(self, pairs=None, held=None)
            out[~known.is_known] = missing.corners(groups[~known.is_known])
        return self._with_held(out, groups)

    def _corners(self, groups: NDArray[np.int64]) -> FloatArray:
        assert self.border is not None
        arrays = self.whitening.engine.arrays
        rank = torch.argsort(arrays.corner_order)
        chosen = rank[torch.as_tensor(groups, device=rank.device)]
        unit = (~arrays.joined).cumsum(0)
        corners = torch.isin(unit, unit[chosen.flatten()]).nonzero()[:, 0]
        columns = corner_columns(self.whitening, corners)
        regression = self._regression(corners, columns)
        place = _axes(torch.searchsorted(corners, chosen.contiguous()))
        covariance = columns.covariance + regression.mT @ self._gained @ regression
        return np.asarray(covariance[place[:, :, None], place[:, None, :]].cpu().numpy())

    def _regression(self, corners: Tensor, columns: Columns) -> Tensor:
        """Inner products (b, 2 n) of the border's columns and those of corners (n,)."""
        assert self.border is not None
        # Corners of the border have their own variables in common with it.
        on_border = columns.own.new_zeros(2 * len(self.border.corners), columns.own.shape[1])
        is_shared = torch.isin(corners, self.border.corners)
        places = torch.searchsorted(self.border.corners, corners[is_shared])
        on_border[_axes(places)] = columns.own[_axes(is_shared.nonzero()[:, 0])]
        return self._columns.pulled(
            columns.reduced, on_border.view(len(self.border.corners), 2, on_border.shape[1])
        )


def _frame_columns(whitening: Whitening, frames: Tensor, acts: Tensor) -> Tensor:
    """Reduced columns (D, b n) of ``acts`` (S, n) on the states of frames (b,)."""
    arrays = whitening.engine.arrays
    selected = acts.new_zeros(arrays.frame_count, len(acts), len(frames), acts.shape[1])
    selected[frames, :, torch.arange(len(frames), device=frames.device)] = acts
    tiles = to_tiles(whitening.plan, selected.flatten(2))
    tip = tiles.new_zeros(len(whitening.reduced_factor.tip), tiles.shape[1])
    return whitening.reduced_factor.solve(torch.cat([tiles, tip]))


def _axes(index: Tensor) -> Tensor:
    """Rows (..., 2 n) of x and y of points (..., n)."""
    return torch.stack([2 * index, 2 * index + 1], dim=-1).flatten(-2)
