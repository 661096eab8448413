"""Uncertainty of the estimate: blocks of the inverse Hessian, computed on demand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.descent import Descent
from v2hdm.adjust.inverse import inverse_diagonal
from v2hdm.adjust.reduced import reduced_coupling, to_tiles
from v2hdm.adjust.whitening import Whitening
from v2hdm.records import FloatArray

_CORNERS_AT_ONCE = 256  # corners whose right-hand sides are solved together: enough for fast products
_NUMBERS_AT_ONCE = 1 << 25  # most numbers, of 8 bytes, in the right-hand sides that are solved together
_NUMBERS_KEPT = 1 << 23  # most numbers, of 8 bytes, that are kept of solved right-hand sides: 67 MB; chosen


@dataclass(frozen=True)
class Moves:
    """Changes of the solution per standard deviation of B independent errors of quantities held fixed."""

    corners: FloatArray  # (N, 2, B) m
    extrinsic: FloatArray  # (C, 6, B) left tangents
    poses: FloatArray  # (J, 6, B) tangents

    def beside(self, other: Moves | None) -> Moves:
        """These errors and independent ``other`` ones."""
        if other is None:
            return self
        return Moves(
            np.concatenate([other.corners, self.corners], axis=2),
            np.concatenate([other.extrinsic, self.extrinsic], axis=2),
            np.concatenate([other.poses, self.poses], axis=2),
        )


class _Roots:
    """The columns of :func:`reduced_root` that were solved for so far: each is asked for several times.

    As many are kept as memory allows, each from its first number on that is not zero: often the second half.
    """

    def __init__(self) -> None:
        self._by_corner: dict[int, Tensor] = {}  # (2, D - first) each
        self._numbers = 0

    def of(self, whitening: Whitening, corners: Tensor) -> Tensor:
        """The rows (2 n, D) of n corners, ascending."""
        numbers = corners.tolist()
        is_missing = torch.tensor([number not in self._by_corner for number in numbers])
        rows = whitening.reduced_factor.tip.new_zeros(len(corners), 2, whitening.reduced_factor.size)
        if is_missing.any():
            solved = reduced_root(whitening, corners[is_missing]).mT.reshape(-1, *rows.shape[1:])
            rows[is_missing] = solved
            self._keep(corners[is_missing].tolist(), solved)
        for row, number in zip(rows, numbers, strict=True):
            columns = self._by_corner.get(number)
            if columns is not None:
                row[:, row.shape[1] - columns.shape[1] :] = columns
        return rows.flatten(0, 1)

    def _keep(self, numbers: list[int], rows: Tensor) -> None:
        first = (rows != 0).any(dim=1).to(torch.uint8).argmax(dim=1).tolist()
        for number, begin, row in zip(numbers, first, rows, strict=True):
            size = row[:, begin:].numel()
            if self._numbers + size <= _NUMBERS_KEPT:
                self._by_corner[number] = row[:, begin:].clone()
                self._numbers += size


@dataclass(frozen=True)
class Covariance:
    """Marginal covariances at the solution.

    With the factors of :mod:`v2hdm.adjust.whitening`, that of the reduced unknowns is S^-1, that of the
    corners V^-1 + V^-1 W' S^-1 W V^-1.
    """

    descent: Descent
    held: Moves | None = None  # the part of quantities held fixed, but uncertain
    roots: _Roots = field(default_factory=_Roots, repr=False)  # whatever is held fixed

    @property
    def whitening(self) -> Whitening:
        """The factors, computed on first use."""
        return self.descent.whitening

    def extrinsic(self) -> FloatArray:
        """Covariance (C, 6, 6) of each camera's left tangent: translation m, rotation rad."""
        of_cameras = np.stack([block[:6, :6] for block in self._cameras()])
        if self.held is None:
            return of_cameras
        return of_cameras + self.held.extrinsic @ self.held.extrinsic.swapaxes(1, 2)

    def clock_s2(self) -> FloatArray:
        """Variances (C, Q), s^2, of clock offsets by session and, if estimated, last the read-out time."""
        return np.stack([block.diagonal()[6:] for block in self._cameras()])

    def _cameras(self) -> list[FloatArray]:
        """Covariances (6 + Q, 6 + Q) of each camera's unknowns."""
        # Cameras come last: the tip of L_S is the factor of their marginal information matrix.
        joint = torch.cholesky_inverse(self.whitening.reduced_factor.tip).cpu().numpy()
        count = self.whitening.engine.arrays.camera_unknowns
        return [joint[k : k + count, k : k + count] for k in range(0, len(joint), count)]

    def poses(self) -> FloatArray:
        """Variances (J, 6) of the frames' tangents; 0 without states."""
        out = self._poses(None)
        return out if self.held is None else out + np.square(self.held.poses).sum(axis=2)

    def _poses(self, tail: Tensor | None) -> FloatArray:
        """Variances (J, 6) of the frames' tangents, with ``tail`` as of :func:`inverse_diagonal`."""
        whitening = self.whitening
        plan = whitening.plan
        arrays = whitening.engine.arrays
        states = len(arrays.states)
        if not states:
            return np.zeros((arrays.frame_count, 6))
        tiles = inverse_diagonal(whitening.reduced_factor, plan.pattern, tail)[
            plan.position[: plan.frame_tiles]
        ]
        per_tile = plan.frames_per_tile
        by_place = tiles.view(plan.frame_tiles, per_tile, states, per_tile, states)
        # White errors and drifts add up to an axis of the tangent.
        axes = torch.tensor(arrays.states, dtype=torch.int64, device=tiles.device)
        acts = torch.nn.functional.one_hot(axes, 6).to(tiles.dtype)
        of_frames = torch.einsum("tpaqb,ak,bk->tpqk", by_place, acts, acts).diagonal(dim1=1, dim2=2)
        variances = of_frames.permute(0, 2, 1).flatten(0, 1)[: arrays.frame_count]
        return np.asarray(variances.cpu().numpy())

    def camera_information(self) -> FloatArray:
        """Marginal information (C (6 + Q), C (6 + Q)) of the cameras' left tangents and clock offsets."""
        tip = self.whitening.reduced_factor.tip
        return np.asarray((tip @ tip.mT).cpu().numpy())

    def corners(self, groups: NDArray[np.int64]) -> FloatArray:
        """Joint covariances (M, 2 n, 2 n), m^2, of M groups (M, n) of corners."""
        of_corners = np.empty((len(groups), 2 * groups.shape[1], 2 * groups.shape[1]))
        for part in self._parts(groups):
            of_corners[part] = self._corners(groups[part])
        return self._with_held(of_corners, groups)

    def _with_held(self, of_corners: FloatArray, groups: NDArray[np.int64]) -> FloatArray:
        """Joint covariances (M, 2 n, 2 n) of groups (M, n) with the part of quantities held fixed."""
        if self.held is None:
            return of_corners
        moved = self.held.corners[groups].reshape(*of_corners.shape[:2], -1)
        return of_corners + moved @ moved.swapaxes(1, 2)

    def _parts(self, groups: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
        """Indices of groups that are looked at together: neighbours, which share most of their corners."""
        rank = torch.argsort(self.whitening.engine.arrays.corner_order).cpu().numpy()
        most_corners = max(_at_once(self.whitening), groups.shape[1])
        numbers = 2 * groups.shape[1] * self.whitening.reduced_factor.size
        most_groups = max(_NUMBERS_AT_ONCE // numbers, 1)
        part: list[int] = []
        corners: set[int] = set()
        for number in np.argsort(np.median(rank[groups], axis=1), kind="stable").tolist():
            joined = corners | set(groups[number].tolist())
            if part and (len(joined) > most_corners or len(part) == most_groups):
                yield np.array(part)
                part = []
                joined = set(groups[number].tolist())
            part.append(number)
            corners = joined
        if part:
            yield np.array(part)

    def _corners(self, groups: NDArray[np.int64]) -> FloatArray:
        arrays = self.whitening.engine.arrays
        rank = torch.argsort(arrays.corner_order)
        chosen = rank[torch.as_tensor(groups, device=rank.device)]
        # Known lengths couple V^-1 of corners to others outside their group.
        joined = _with_joined(arrays, chosen)
        corners = torch.unique(joined)
        root = self.roots.of(self.whitening, corners)
        # Of what is eliminated before the corners' frames the columns are zero: often half of them.
        by_near = root[:, root.any(dim=0)][_columns(corners, joined)]
        # V^-1 of the corners and all joined ones; 1 for kept corners.
        unit = torch.eye(2 * len(corners), dtype=torch.float64, device=corners.device)
        factor = self.whitening.linearised.corner_factor.take(corners)
        inverse = factor.solve_transposed(factor.solve(unit.view(len(corners), 2, -1))).flatten(0, 1)
        of_factor = inverse.clone()
        of_factor[torch.isin(corners, self.whitening.plan.kept_corners).repeat_interleave(2)] = 0.0
        rows = _columns(corners, chosen)
        once = ~(joined[:, :, None] == joined[:, None, :]).tril(-1).any(2).repeat_interleave(2, dim=1)
        spread = inverse[rows[:, :, None], _columns(corners, joined)[:, None, :]] * once[:, None]
        of_factor = of_factor[rows[:, :, None], rows[:, None, :]]
        return np.asarray((of_factor + spread @ (by_near @ by_near.mT) @ spread.mT).cpu().numpy())


class Dropped(Covariance):
    """The covariances of a solution whose factors were dropped: nobody may ask for them."""

    def __init__(self) -> None:
        """Without a descent, there are no factors."""

    @property
    def whitening(self) -> Whitening:
        """Raise AssertionError: a solution without factors was asked for its covariances."""
        raise AssertionError("the factors of this solution were dropped; solve again for its covariances")


def corner_gain(whitening: Whitening) -> FloatArray:
    """Regression (N, 2, C (6 + Q)) of corners on cameras: a change e of the cameras moves them by -gain e.

    Frames follow too: e changes the reduced unknowns by x = L_S^-T (0, L_tip' e), column by column, so that
    W' x = (L_S^-1 W)' (0, L_tip' e).
    """
    arrays = whitening.engine.arrays
    tip = whitening.reduced_factor.tip
    out = np.empty((arrays.corner_count, 2, len(tip)))
    by_cameras = whitening.linearised.by_cameras()
    if by_cameras is not None:
        gain = whitening.linearised.corner_factor.solve_transposed(by_cameras)
        out[arrays.corner_order.numpy()] = gain.numpy()
        return out
    begin = 0
    at_once = _at_once(whitening)
    for end in arrays.units.tolist()[1:]:
        if end - begin < at_once and end < arrays.corner_count:
            continue
        corners = torch.arange(begin, end, device=tip.device)
        follow = (tip @ reduced_root(whitening, corners)[-len(tip) :]).mT
        factor = whitening.linearised.corner_factor.part(slice(begin, end))
        gain = factor.solve_transposed(factor.solve(follow.reshape(end - begin, 2, -1)))
        out[arrays.corner_order[begin:end].cpu().numpy()] = gain.cpu().numpy()
        begin = end
    return out


def _at_once(whitening: Whitening) -> int:
    """Number of corners whose right-hand sides are solved together."""
    most = _NUMBERS_AT_ONCE // (2 * whitening.reduced_factor.size)
    return min(max(most, 1), _CORNERS_AT_ONCE)


def _with_joined(arrays: Arrays, chosen: Tensor) -> Tensor:
    """Groups (M, n) of corners with all that lengths join to them (M, m); shorter rows repeat the last."""
    if not bool(arrays.joined.any()):
        return chosen
    unit = (~arrays.joined).cumsum(0)
    groups = [torch.isin(unit, unit[group]).nonzero()[:, 0] for group in chosen]
    longest = max(len(group) for group in groups)
    return torch.stack([torch.cat([g, g[-1:].expand(longest - len(g))]) for g in groups])


def _columns(corners: Tensor, chosen: Tensor) -> Tensor:
    """Columns (M, 2 m) of x and y of the corners ``wanted`` (M, m) among ``corners``, ascending."""
    place = 2 * torch.searchsorted(corners, chosen.contiguous())
    return torch.stack([place, place + 1], dim=-1).flatten(1)


def reduced_root(whitening: Whitening, corners: Tensor) -> Tensor:
    """L_S^-1 W (D, 2 n) for n corners, ascending; -L_S^-1 E, with the selection E, for kept ones."""
    return whitening.reduced_factor.solve(coupled_to(whitening, corners))


def coupled_to(whitening: Whitening, corners: Tensor) -> Tensor:
    """W (D, 2 n) for n corners, ascending; -E, with the selection E, for kept ones."""
    plan = whitening.plan
    estimate = whitening.estimate
    arrays = whitening.engine.arrays
    run = arrays.whole() if len(corners) == arrays.corner_count else arrays.gather(corners)
    coupling = whitening.linearised.coupling(run, estimate.corners_map[corners])
    if not len(plan.kept_corners):
        return reduced_coupling(plan, whitening.spread, run, coupling)
    is_kept = torch.isin(corners, plan.kept_corners)
    coupling[is_kept[run.corner]] = 0.0
    right = reduced_coupling(plan, whitening.spread, run, coupling)
    number = torch.searchsorted(plan.kept_corners, corners[is_kept])
    picked = right.new_zeros(len(plan.kept_corners), 2, len(corners), 2)
    for axis in range(2):
        picked[number, axis, is_kept.nonzero()[:, 0], axis] = -1.0
    frames = right.new_zeros(0, len(arrays.states), right.shape[1])
    right[: len(right) - len(whitening.reduced_factor.tip)] += to_tiles(plan, frames, picked.flatten(2))
    return right
