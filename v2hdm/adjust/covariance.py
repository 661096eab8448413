"""How sure the estimate is: blocks of the inverse Hessian, computed on demand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v2hdm.adjust.reduced import spread_to_cameras, to_tiles
from v2hdm.adjust.whitening import Whitening
from v2hdm.records import FloatArray

# Right-hand sides solved for together: enough for fast products, few enough to stay small.
_CORNERS_AT_ONCE = 256


@dataclass(frozen=True)
class Covariance:
    """Marginal covariances at the solution, of whatever was estimated beside marginalised out.

    With the factors of :mod:`v2hdm.adjust.whitening`, the reduced unknowns have S^-1 and corners
    L_i^-T (delta_ij + B_i S^-1 B_j') L_j^-1.
    """

    whitening: Whitening

    def extrinsic(self) -> FloatArray:
        """Of each camera's left tangent (C, 6, 6): translation m, rotation rad."""
        # The extrinsics come last, so the tip of L_S is the factor of their marginal information.
        joint = torch.cholesky_inverse(self.whitening.reduced_factor.tip)
        each = self.whitening.arrays.camera_unknowns
        starts = range(0, len(joint), each)
        return np.stack([joint[k : k + 6, k : k + 6].cpu().numpy() for k in starts])

    def clock_s2(self) -> FloatArray:
        """Variance (C,) of each camera's clock offset, s^2; 0 where it is not estimated."""
        arrays = self.whitening.arrays
        joint = torch.cholesky_inverse(self.whitening.reduced_factor.tip)
        variance = joint.diagonal().reshape(arrays.camera_count, -1)[:, 6:]
        return np.asarray(variance.sum(1).cpu().numpy())

    def corners(self, groups: NDArray[np.int64]) -> FloatArray:
        """Joint covariance (M, 2 n, 2 n), m^2, within each of M groups (M, n) of corners of the problem."""
        parts = np.array_split(groups, max(-(-groups.size // _CORNERS_AT_ONCE), 1))
        return np.concatenate([self._corners(part) for part in parts])

    def _corners(self, groups: NDArray[np.int64]) -> FloatArray:
        count, each = groups.shape
        rank = torch.argsort(self.whitening.arrays.corner_order)
        chosen = rank[torch.as_tensor(groups.flatten(), device=rank.device)]
        root = _reduced_root(self.whitening, chosen).reshape(-1, count, 2 * each).transpose(0, 1)
        middle = root.mT @ root + torch.eye(2 * each, dtype=root.dtype, device=root.device)
        blocks = middle.new_zeros(count, each, 2, each, 2)
        index = torch.arange(each, device=rank.device)
        inverse = torch.linalg.inv(self.whitening.corner_factor[chosen]).reshape(count, each, 2, 2)
        blocks[:, index, :, index, :] = inverse.transpose(0, 1)
        spread = blocks.reshape(count, 2 * each, 2 * each)
        return np.asarray((spread.mT @ middle @ spread).cpu().numpy())


def _reduced_root(whitening: Whitening, chosen: Tensor) -> Tensor:
    """L_S^-1 [B_1' B_2' ...] (D, 2 n) for n chosen corners."""
    arrays, plan = whitening.arrays, whitening.plan
    frames, states, columns = arrays.frame_count, len(arrays.states), 2 * len(chosen)
    by_frame = whitening.coupling.new_zeros(frames, states, len(chosen), 2)
    by_camera = whitening.coupling.new_zeros(arrays.camera_count, arrays.camera_unknowns, len(chosen), 2)
    spread = whitening.spread.state.reshape(arrays.pair_count, 6, states)
    bounds = torch.searchsorted(arrays.corner, torch.stack([chosen, chosen + 1]))
    for n, (begin, end) in enumerate(bounds.T.tolist()):
        pair, part = arrays.pair[begin:end], whitening.coupling[:, :, begin:end].permute(2, 0, 1)
        by_frame[:, :, n].index_add_(0, pair % frames, (part @ spread[pair]).mT)
        of_camera = spread_to_cameras(arrays, whitening.spread, part, pair)
        by_camera[:, :, n].index_add_(0, pair // frames, of_camera.mT)
    top = to_tiles(plan, by_frame.reshape(frames, states, columns))
    return whitening.reduced_factor.solve(torch.cat([top, by_camera.reshape(-1, columns)]))
