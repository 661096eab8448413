"""Variables in which the problem looks round: the Gauss-Newton Hessian becomes the identity.

With V_i the Hessian block (2 x 2) of corner i, W_i its coupling to the reduced unknowns r (frame
states, then extrinsics) and U theirs,

    L_i L_i' = V_i,   B_i = L_i^-1 W_i',   S = U - sum_i B_i' B_i = L_S L_S',

the change of variables x_r = L_S^-T y_r, x_i = L_i^-T (y_i - B_i x_r) turns the Hessian into the
identity: a block Cholesky factorisation of the whole, corners eliminated first. A gradient follows as
g_yi = L_i^-1 g_i, g_yr = L_S^-1 (g_r - sum_i B_i' g_yi). One gradient step of length 1 in y is then
the Gauss-Newton step in x, and |g_y|^2 / 2 the decrease that it predicts.

Each B_i is kept as the observations' parts by *pair* (2 x 6), and spread to extrinsics and frames on
the small table of pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.residuals import Estimate, Gradient, jacobians, observe, pair_from_state

# Corners per dense block of the Schur complement: neighbours on the route share their frames.
_BLOCK_CORNERS = 64
# Keeps a corner factorable whose sightings a robust loss has all but switched off.
_WEIGHT_FLOOR = 1e-6
# Below this a pivot is what rounding left of zero.
_SINGULAR_PIVOT = 1e-13
_DAMPING_STEPS = (0.0, 1e-12, 1e-9, 1e-6, 1e-3)


@dataclass(frozen=True)
class Whitening:
    """The factorised Hessian at one estimate.

    Attributes:
        arrays: the problem it belongs to.
        corner_factor: L_i, lower, (N, 2, 2).
        coupling: parts of B_i by observation and pair, (K, 2, 6).
        pair_from_state: (C, J, 6, S).
        reduced_factor: L_S, lower, (J S + 6 C) squared.
        damping: relative diagonal that had to be added to factorise; above 0 a direction is free.
        smallest_pivot: least share of an unknown's own information that the others leave it.
    """

    arrays: Arrays
    corner_factor: Tensor
    coupling: Tensor
    pair_from_state: Tensor
    reduced_factor: Tensor
    damping: float
    smallest_pivot: float

    @property
    def is_singular(self) -> bool:
        """Whether the observations and priors leave a direction of the reduced unknowns free."""
        return self.damping > 0 or self.smallest_pivot < _SINGULAR_PIVOT

    @property
    def size(self) -> int:
        """Number of unknowns, J S + 6 C + 2 N."""
        return len(self.reduced_factor) + 2 * self.arrays.corner_count

    def step(self, whitened: Tensor) -> Gradient:
        """The step x, by block, of whitened variables y (J S + 6 C + 2 N,)."""
        arrays, (reduced, corners) = self.arrays, self._split(whitened)
        solved = torch.linalg.solve_triangular(self.reduced_factor.mT, reduced[:, None], upper=True)[:, 0]
        states, extrinsics = self._split_reduced(solved)
        by_pair = extrinsics[:, None] + (self.pair_from_state @ states[None, ..., None])[..., 0]
        moved = by_pair.reshape(-1, 6).index_select(0, arrays.pair)
        coupled = (self.coupling @ moved[..., None])[..., 0]
        rest = corners - torch.zeros_like(corners).index_add_(0, arrays.corner, coupled)
        return Gradient(extrinsics, states, solve_lower_transposed(self.corner_factor, rest))

    def whiten(self, gradient: Gradient) -> Tensor:
        """The gradient by y of a gradient by x."""
        arrays = self.arrays
        corners = solve_lower(self.corner_factor, gradient.corners_map)
        coupled = (self.coupling.mT @ corners.index_select(0, arrays.corner)[..., None])[..., 0]
        by_pair = coupled.new_zeros(arrays.pair_count, 6).index_add_(0, arrays.pair, coupled)
        by_pair = by_pair.reshape(arrays.camera_count, arrays.frame_count, 6)
        by_state = (self.pair_from_state.mT @ by_pair[..., None])[..., 0].sum(0)
        rest = torch.cat(
            [(gradient.frame_state - by_state).flatten(), (gradient.extrinsic - by_pair.sum(1)).flatten()]
        )
        reduced = torch.linalg.solve_triangular(self.reduced_factor, rest[:, None], upper=False)[:, 0]
        return torch.cat([reduced, corners.flatten()])

    def _split(self, whitened: Tensor) -> tuple[Tensor, Tensor]:
        reduced, corners = whitened.split([len(self.reduced_factor), 2 * self.arrays.corner_count])
        return reduced, corners.reshape(-1, 2)

    def _split_reduced(self, reduced: Tensor) -> tuple[Tensor, Tensor]:
        frames = self.arrays.frame_count * len(self.arrays.states)
        return reduced[:frames].reshape(self.arrays.frame_count, -1), reduced[frames:].reshape(-1, 6)


def factorise(arrays: Arrays, estimate: Estimate, weight: Tensor, damping: float = 0.0) -> Whitening:
    """Whitening at ``estimate`` under observation weights (K,).

    ``damping`` is added to the diagonal of the Hessian, relative to it (Levenberg-Marquardt).
    """
    by_pair, by_corner = jacobians(arrays, observe(arrays, estimate))
    root = weight.clamp(min=_WEIGHT_FLOOR).sqrt()[:, None, None]
    by_pair, by_corner = by_pair * root, by_corner * root
    blocks = by_corner.new_zeros(arrays.corner_count, 2, 2)
    blocks.index_add_(0, arrays.corner, by_corner.mT @ by_corner)
    corner_factor = cholesky_2x2(_damped(blocks, damping))
    coupling = solve_lower_matrix(corner_factor[arrays.corner], by_corner.mT @ by_pair)
    spread = pair_from_state(arrays, estimate)
    own = _damped(_reduced_hessian(arrays, estimate, by_pair, spread), damping)
    factor, added = _factor_damped(own - _corner_information(arrays, coupling, spread))
    pivots = factor.diagonal().square() / own.diagonal()
    return Whitening(arrays, corner_factor, coupling, spread, factor, added, float(pivots.min()))


def _damped(blocks: Tensor, damping: float) -> Tensor:
    return blocks + damping * torch.diag_embed(blocks.diagonal(dim1=-2, dim2=-1)) if damping else blocks


def _factor_damped(matrix: Tensor) -> tuple[Tensor, float]:
    """Cholesky factor, with the smallest relative damping that makes it exist."""
    diagonal = matrix.diagonal().abs().clamp(min=torch.finfo(matrix.dtype).tiny)
    for damping in _DAMPING_STEPS:
        factor, info = torch.linalg.cholesky_ex(matrix + torch.diag(damping * diagonal))
        if int(info) == 0:
            return factor, damping
    return torch.diag(diagonal.sqrt()), 1.0


def _reduced_hessian(arrays: Arrays, estimate: Estimate, by_pair: Tensor, spread: Tensor) -> Tensor:
    """U (J S + 6 C squared): of frame states and extrinsics, priors included, corners held."""
    cameras, frames, states = arrays.camera_count, arrays.frame_count, len(arrays.states)
    blocks = by_pair.new_zeros(arrays.pair_count, 6, 6).index_add_(0, arrays.pair, by_pair.mT @ by_pair)
    blocks = blocks.reshape(cameras, frames, 6, 6)
    size = frames * states
    hessian = by_pair.new_zeros(size + 6 * cameras, size + 6 * cameras)
    by_frame = (spread.mT @ blocks @ spread).sum(0)
    within = hessian[:size, :size].view(frames, states, frames, states) if states else None
    if within is not None:
        index = torch.arange(frames, device=hessian.device)
        root, memory = arrays.state_information_root, arrays.state_memory
        own = root.square()
        own[:-1] += (memory * root)[1:].square()
        within[index, :, index, :] = by_frame + torch.diag_embed(own)
        across = torch.diag_embed(-(memory * root.square())[1:])
        within[index[1:], :, index[:-1], :] += across
        within[index[:-1], :, index[1:], :] += across
    tip = hessian[size:, size:].view(cameras, 6, cameras, 6)
    border = (spread.mT @ blocks).permute(1, 2, 0, 3).reshape(size, 6 * cameras)
    hessian[:size, size:] = border
    hessian[size:, :size] = border.T
    rotation, root = estimate.cam_from_vehicle[:, :3, :3], arrays.centre_information_root
    information = rotation * root.square()[:, None] @ rotation.mT
    for camera in range(cameras):
        tip[camera, :, camera] = blocks[camera].sum(0)
        tip[camera, :3, camera, :3] += information[camera]
    return hessian


def _corner_information(arrays: Arrays, coupling: Tensor, spread: Tensor) -> Tensor:
    """sum_i B_i' B_i, in dense blocks of corners that share their frames."""
    cameras, frames, states = arrays.camera_count, arrays.frame_count, len(arrays.states)
    size = frames * states
    total = coupling.new_zeros(size + 6 * cameras, size + 6 * cameras)
    camera, frame = arrays.pair // frames, arrays.pair % frames
    by_frame = coupling @ spread.reshape(arrays.pair_count, 6, states)[arrays.pair]
    starts = torch.arange(0, arrays.corner_count, _BLOCK_CORNERS, device=coupling.device)
    bounds = torch.searchsorted(arrays.corner, starts).tolist() + [len(arrays.corner)]
    for begin, end in zip(bounds[:-1], bounds[1:], strict=True):
        part = slice(begin, end)
        touched, local = torch.unique(frame[part], return_inverse=True)
        row = arrays.corner[part] - arrays.corner[begin]
        rows = int(row[-1]) + 1
        dense_frames = coupling.new_zeros(rows, len(touched), 2, states)
        dense_frames.index_put_((row, local), by_frame[part], accumulate=True)
        dense_cameras = coupling.new_zeros(rows, cameras, 2, 6)
        dense_cameras.index_put_((row, camera[part]), coupling[part], accumulate=True)
        dense = torch.cat(
            [
                dense_frames.permute(0, 2, 1, 3).reshape(2 * rows, -1),
                dense_cameras.permute(0, 2, 1, 3).reshape(2 * rows, -1),
            ],
            dim=1,
        )
        columns = (touched[:, None] * states + torch.arange(states, device=touched.device)).flatten()
        columns = torch.cat([columns, torch.arange(size, size + 6 * cameras, device=touched.device)])
        total.index_put_((columns[:, None], columns[None]), dense.T @ dense, accumulate=True)
    return total


def cholesky_2x2(blocks: Tensor) -> Tensor:
    """Lower factors (N, 2, 2) of symmetric 2 x 2 blocks, by hand: one call per block would be slow."""
    first = blocks[:, 0, 0].sqrt()
    below = blocks[:, 1, 0] / first
    last = (blocks[:, 1, 1] - below.square()).clamp(min=1e-12 * blocks[:, 1, 1]).sqrt()
    return torch.stack([first, torch.zeros_like(first), below, last], dim=-1).reshape(-1, 2, 2)


def solve_lower(factor: Tensor, right: Tensor) -> Tensor:
    """L^-1 b for lower factors (N, 2, 2) and b (N, 2)."""
    first = right[:, 0] / factor[:, 0, 0]
    return torch.stack([first, (right[:, 1] - factor[:, 1, 0] * first) / factor[:, 1, 1]], dim=-1)


def solve_lower_transposed(factor: Tensor, right: Tensor) -> Tensor:
    """L^-T b for lower factors (N, 2, 2) and b (N, 2)."""
    last = right[:, 1] / factor[:, 1, 1]
    return torch.stack([(right[:, 0] - factor[:, 1, 0] * last) / factor[:, 0, 0], last], dim=-1)


def solve_lower_matrix(factor: Tensor, right: Tensor) -> Tensor:
    """L^-1 B for lower factors (N, 2, 2) and B (N, 2, m)."""
    first = right[:, 0] / factor[:, 0, 0, None]
    last = (right[:, 1] - factor[:, 1, 0, None] * first) / factor[:, 1, 1, None]
    return torch.stack([first, last], dim=1)
