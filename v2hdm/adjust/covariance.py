"""How sure the estimate is: blocks of the inverse Hessian, computed on demand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v2hdm.adjust.whitening import Whitening
from v2hdm.records import FloatArray


@dataclass(frozen=True)
class Covariance:
    """Marginal covariances at the solution, of whatever was estimated beside marginalised out.

    With the factors of :mod:`v2hdm.adjust.whitening`, the reduced unknowns have S^-1 and corners
    L_i^-T (delta_ij + B_i S^-1 B_j') L_j^-1.
    """

    whitening: Whitening

    def extrinsic(self) -> FloatArray:
        """Of each camera's left tangent (C, 6, 6): translation m, rotation rad."""
        size = 6 * self.whitening.arrays.camera_count
        # The extrinsics come last, so the tip of L_S is the factor of their marginal information.
        tip = self.whitening.reduced_factor[-size:, -size:]
        joint = torch.cholesky_inverse(tip).reshape(-1, 6, self.whitening.arrays.camera_count, 6)
        return np.stack([joint[c, :, c].cpu().numpy() for c in range(len(joint))])

    def corners(self, indices: NDArray[np.int64]) -> FloatArray:
        """Joint covariance (2 n, 2 n), m^2, of corners (n,) by their index in the problem."""
        rank = torch.argsort(self.whitening.arrays.corner_order)
        chosen = rank[torch.as_tensor(indices, device=rank.device)]
        factor = self.whitening.corner_factor[chosen]
        root = _reduced_root(self.whitening, chosen)
        middle = root.T @ root + torch.eye(2 * len(chosen), dtype=root.dtype, device=root.device)
        blocks = torch.block_diag(*torch.linalg.inv(factor))
        return np.asarray((blocks.T @ middle @ blocks).cpu().numpy())


def _reduced_root(whitening: Whitening, chosen: Tensor) -> Tensor:
    """L_S^-1 [B_i' ...] (D, 2 n) for chosen corners."""
    arrays = whitening.arrays
    frames, states = arrays.frame_count, len(arrays.states)
    size = frames * states
    right = whitening.coupling.new_zeros(len(chosen), 2, size + 6 * arrays.camera_count)
    spread = whitening.pair_from_state.reshape(arrays.pair_count, 6, states)
    bounds = torch.searchsorted(arrays.corner, torch.stack([chosen, chosen + 1]))
    for row, (begin, end) in enumerate(bounds.T.tolist()):
        pair, part = arrays.pair[begin:end], whitening.coupling[begin:end]
        by_frame = right[row, :, :size].view(2, frames, states)
        by_frame.index_add_(1, pair % frames, (part @ spread[pair]).transpose(0, 1))
        by_camera = right[row, :, size:].view(2, arrays.camera_count, 6)
        by_camera.index_add_(1, pair // frames, part.transpose(0, 1))
    flat = right.reshape(-1, right.shape[-1]).T
    return torch.linalg.solve_triangular(whitening.reduced_factor, flat, upper=False)
