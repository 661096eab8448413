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
from v2hdm.adjust.reduced import Plan, Spread, from_tiles, held_hessian, subtract_corners, to_tiles
from v2hdm.adjust.residuals import (
    Estimate,
    Gradient,
    jacobians,
    observe,
    pair_from_clock,
    pair_from_state,
    pair_table,
)
from v2hdm.adjust.tiles import TIP, TiledCholesky, factorise_tiles

# Keeps a corner factorable whose sightings a robust loss has all but switched off.
_WEIGHT_FLOOR = 1e-6
# Information, 1 / m^2, that keeps a corner factorable which runs off to the horizon.
_CORNER_FLOOR = 1e-10
# Below this a pivot is what rounding left of zero.
_SINGULAR_PIVOT = 1e-13


@dataclass(frozen=True)
class Whitening:
    """The factorised Hessian at one estimate.

    Attributes:
        arrays: the problem it belongs to.
        plan: the tiles of its reduced system.
        corner_factor: L_i, lower, (N, 2, 2).
        coupling: parts of B_i by pair and observation, (2, 6, K).
        spread: how the pairs move with frames and cameras.
        reduced_factor: L_S.
        smallest_pivot: least share of an unknown's own information that the others leave it.
    """

    arrays: Arrays
    plan: Plan
    corner_factor: Tensor
    coupling: Tensor
    spread: Spread
    reduced_factor: TiledCholesky
    smallest_pivot: float

    @property
    def is_singular(self) -> bool:
        """Whether the observations and priors leave a direction of the reduced unknowns free."""
        return self.reduced_factor.damping > 0 or self.smallest_pivot < _SINGULAR_PIVOT

    @property
    def size(self) -> int:
        """Number of whitened variables: the reduced ones, then 2 N."""
        return self.reduced_factor.size + 2 * self.arrays.corner_count

    def step(self, whitened: Tensor) -> Gradient:
        """The step x, by block, of whitened variables y (size,)."""
        arrays, (reduced, corners) = self.arrays, self._split(whitened)
        solved = self.reduced_factor.solve_transposed(reduced[:, None])[:, 0]
        states, extrinsics, clock = self._split_reduced(solved)
        by_pair = extrinsics[:, None] + (self.spread.state @ states[None, ..., None])[..., 0]
        by_pair = by_pair + (self.spread.clock @ clock[:, None, :, None])[..., 0]
        by_pair, rest = by_pair.reshape(-1, 6), corners.T.contiguous()
        for run, part in arrays.parts():
            moved = by_pair.index_select(0, part.pair).T.contiguous()
            coupled = (self.coupling[:, :, run] * moved).sum(1)
            rest.index_add_(1, part.corner, coupled, alpha=-1)
        return Gradient(extrinsics, states, solve_lower_transposed(self.corner_factor, rest.T), clock)

    def whiten(self, gradient: Gradient) -> Tensor:
        """The gradient by y of a gradient by x."""
        arrays = self.arrays
        corners = solve_lower(self.corner_factor, gradient.corners_map)
        by_corner, by_pair = corners.T.contiguous(), corners.new_zeros(6, arrays.pair_count)
        for run, part in arrays.parts():
            first, second = by_corner.index_select(1, part.corner)
            coupling = self.coupling[:, :, run]
            by_pair.index_add_(1, part.pair, torch.addcmul(coupling[0] * first, coupling[1], second))
        by_pair = by_pair.T.reshape(arrays.camera_count, arrays.frame_count, 6)
        by_state = gradient.frame_state - (self.spread.state.mT @ by_pair[..., None])[..., 0].sum(0)
        by_clock = gradient.clock_s - (self.spread.clock.mT @ by_pair[..., None])[..., 0].sum(1)
        by_camera = torch.cat([gradient.extrinsic - by_pair.sum(1), by_clock], dim=1)
        rest = torch.cat([to_tiles(self.plan, by_state), by_camera.flatten()])
        return torch.cat([self.reduced_factor.solve(rest[:, None])[:, 0], corners.flatten()])

    def _split(self, whitened: Tensor) -> tuple[Tensor, Tensor]:
        size = self.reduced_factor.size
        return whitened[:size], whitened[size:].reshape(-1, 2)

    def _split_reduced(self, reduced: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Frame states (J, S), extrinsics (C, 6), clock offsets (C, Q)."""
        arrays, tip = self.arrays, self.arrays.camera_unknowns * self.arrays.camera_count
        states = from_tiles(self.plan, reduced[:-tip], arrays.frame_count, len(arrays.states))
        by_camera = reduced[-tip:].reshape(arrays.camera_count, -1)
        return states, by_camera[:, :6], by_camera[:, 6:]


def factorise(
    arrays: Arrays, plan: Plan, estimate: Estimate, weight: Tensor, damping: float = 0.0
) -> Whitening:
    """Whitening at ``estimate`` under observation weights (K,).

    ``damping`` is added to the diagonal of the Hessian, relative to it (Levenberg-Marquardt).
    """
    table, root = pair_table(arrays, estimate), weight.clamp(min=_WEIGHT_FLOOR).sqrt()[:, None, None]
    corner_blocks = table.new_zeros(arrays.corner_count, 2, 2)
    pair_blocks = table.new_zeros(arrays.pair_count, 6, 6)
    coupling = table.new_empty(2, 6, len(arrays.pair))
    for run, part in arrays.parts():
        by_pair, by_corner = jacobians(part, observe(part, estimate, table))
        by_pair, by_corner = by_pair * root[run], by_corner * root[run]
        corner_blocks.index_add_(0, part.corner, by_corner.mT @ by_corner)
        pair_blocks.index_add_(0, part.pair, by_pair.mT @ by_pair)
        coupling[:, :, run] = (by_corner.mT @ by_pair).permute(1, 2, 0)
    corner_blocks.diagonal(dim1=1, dim2=2).add_(arrays.control_information[:, None])
    corner_blocks.diagonal(dim1=1, dim2=2).mul_(1 + damping).add_(_CORNER_FLOOR)
    corner_factor = cholesky_2x2(corner_blocks)
    for run, part in arrays.parts():
        held = coupling[:, :, run].permute(2, 0, 1)
        coupling[:, :, run] = solve_lower_matrix(corner_factor[part.corner], held).permute(1, 2, 0)
    spread = Spread(pair_from_state(arrays, estimate), pair_from_clock(arrays, estimate))
    tiles = held_hessian(arrays, plan, estimate, pair_blocks, spread)
    square = [(k, k) for k in range(plan.tile_count)] + [(TIP, TIP)]
    for key in square:
        tiles[key].diagonal().mul_(1 + damping)
    own = torch.cat([tiles[key].diagonal().clone() for key in square])
    subtract_corners(arrays, plan, coupling, spread, tiles)
    factor = factorise_tiles(tiles, plan.pattern)
    smallest = float((factor.pivots() / own).min())
    return Whitening(arrays, plan, corner_factor, coupling, spread, factor, smallest)


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
