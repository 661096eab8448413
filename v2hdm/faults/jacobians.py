"""A solution's observations as sparse matrices: the whitened normal equations for many right sides at once.

What one column costs is Python and memory traffic; a factor and a Jacobian that are read once for thirty
columns cost little more than for one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.model import Gradient
from v2hdm.adjust.reduced import from_tiles, to_tiles
from v2hdm.adjust.whitening import Whitening
from v2hdm.geometry.tensors import NEAR_M
from v2hdm.records import FloatArray


class Whitened(NamedTuple):
    """Columns by the whitened unknowns."""

    reduced: Tensor  # (D, n)
    corners: Tensor  # (N, 2, n), 0 of kept ones


class Steps(NamedTuple):
    """Steps of the unknowns, by column."""

    extrinsic: Tensor  # (C, 6, n)
    frame_state: Tensor  # (J, S, n)
    clock_s: Tensor  # (C, Q, n)
    tangents: Tensor  # (C, M, 6, n) left tangents of the pairs
    corners_map: Tensor  # (N, 2, n)


@dataclass(frozen=True)
class Jacobians:
    """Derivatives of a solution's weighted residuals (2 K), all those along u before those along v."""

    whitening: Whitening
    by_pair: csr_array  # (2 K, 6 P) by the left tangents of the pairs
    by_corner: csr_array  # (2 K, 2 N)
    coupling: csr_array  # (2 N, 6 P) W', whose weights have the solver's floor

    @classmethod
    def of(cls, whitening: Whitening, root: Tensor, poses: Tensor, points: Tensor) -> Jacobians:
        """At ``poses`` (K, 4, 4) and ``points`` (K, 3) in the cameras, with the ``root`` (K,) of weights."""
        arrays = whitening.engine.arrays
        a, b, c = arrays.root_information * root
        x, y = points[:, :2].T
        depth = points[:, 2].clamp(min=NEAR_M)
        of_u = torch.stack([a / depth, torch.zeros_like(a), -a * x / depth.square()], dim=1)
        of_v = torch.stack([b / depth, c / depth, -(b * x + c * y) / depth.square()], dim=1)
        by_point = torch.stack([of_u, of_v])
        by_tangent = torch.cat([by_point, torch.linalg.cross(points.expand_as(by_point), by_point)], dim=2)
        coupled = whitening.linearised.coupling(arrays.whole(), whitening.estimate.corners_map).clone()
        if len(whitening.plan.kept_corners):
            coupled[torch.isin(arrays.corner.long(), whitening.plan.kept_corners)] = 0.0
        return cls(
            whitening,
            _matrix(by_tangent, arrays.pair, 6, arrays.pair_count),
            _matrix(
                (by_point[:, :, None] @ poses[:, :3, :2])[:, :, 0], arrays.corner, 2, arrays.corner_count
            ),
            _coupling_matrix(arrays, coupled),
        )

    def whiten(self, columns: FloatArray | csr_array, of_priors: Sequence[Gradient | None]) -> Whitened:
        """Inner products with the whitened unknowns of columns (2 K, n) and of those of the priors."""
        whitening = self.whitening
        factor = whitening.linearised.corner_factor
        like = whitening.estimate.corners_map
        by_corner = torch.as_tensor(_dense(self.by_corner.T @ columns)).to(like).view(len(like), 2, -1)
        for number, gradient in enumerate(of_priors):
            if gradient is not None:
                by_corner[:, :, number] += gradient.corners_map
        corners = factor.solve(by_corner)
        eliminated = factor.solve_transposed(corners).flatten(0, 1)
        by_pair = _dense(self.by_pair.T @ columns) - self.coupling.T @ eliminated.cpu().numpy()
        states, cameras = self._gathered(torch.as_tensor(by_pair).to(like))
        for number, gradient in enumerate(of_priors):
            if gradient is not None:
                states[:, :, number] += gradient.frame_state
                cameras[:, :, number] += torch.cat([gradient.extrinsic, gradient.clock_s], dim=1)
        reduced = cameras.flatten(0, 1)
        if whitening.plan.tile_count:
            tiles = to_tiles(whitening.plan, states, corners[whitening.plan.kept_corners])
            reduced = torch.cat([tiles, reduced])
        if len(whitening.plan.kept_corners):
            corners = corners.index_fill(0, whitening.plan.kept_corners, 0.0)
        return Whitened(whitening.reduced_factor.solve(reduced), corners)

    def _gathered(self, by_pair: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients (6 P, n) by the pairs' tangents, carried to frames (J, S, n), cameras (C, 6 + Q, n)."""
        arrays = self.whitening.engine.arrays
        spread = self.whitening.spread
        by_pair = by_pair.view(arrays.camera_count, arrays.moment_count, 6, -1)
        by_clock = torch.einsum("cmpq,cmpn->cqn", spread.clock, by_pair)
        cameras = torch.cat([by_pair.sum(1), by_clock], dim=1)
        if not arrays.states:
            return by_pair.new_zeros(arrays.frame_count, 0, by_pair.shape[-1]), cameras
        return arrays.over_moments(torch.einsum("cmps,cmpn->msn", spread.state, by_pair)), cameras

    def steps(self, whitened: Whitened) -> Steps:
        """The steps of whitened variables, the corners following."""
        whitening = self.whitening
        arrays = whitening.engine.arrays
        plan = whitening.plan
        tip = len(whitening.reduced_factor.tip)
        solved = whitening.reduced_factor.solve_transposed(whitened.reduced)
        states, kept_steps = from_tiles(plan, solved[:-tip], arrays.frame_count, len(arrays.states))
        by_camera = solved[-tip:].reshape(arrays.camera_count, arrays.camera_unknowns, -1)
        extrinsic = by_camera[:, :6]
        clock = by_camera[:, 6:]
        tangents = extrinsic[:, None].expand(-1, arrays.moment_count, -1, -1)
        if arrays.states:
            by_moment = arrays.at_moments(states)
            tangents = tangents + torch.einsum("cmps,msn->cmpn", whitening.spread.state, by_moment)
        if clock.shape[1]:
            tangents = tangents + torch.einsum("cmpq,cqn->cmpn", whitening.spread.clock, clock)
        corners = whitened.corners
        if len(plan.kept_corners):
            corners = corners.index_copy(0, plan.kept_corners, kept_steps)
        factor = whitening.linearised.corner_factor
        push = torch.as_tensor(self.coupling @ _matrix_of(tangents)).to(corners).view_as(corners)
        corners = factor.solve_transposed(corners - factor.solve(push))
        return Steps(extrinsic, states, clock, tangents, corners)

    def along(self, steps: Steps) -> FloatArray:
        """Derivatives (2 K, n) of the weighted residuals along steps."""
        of_corners = steps.corners_map.flatten(0, 1).cpu().numpy()
        return np.asarray(self.by_pair @ _matrix_of(steps.tangents) + self.by_corner @ of_corners)

    def along_tangents(self, tangents: Tensor) -> Tensor:
        """Derivatives (2, K) along left tangents (C, M, 6) of the pairs."""
        out = self.by_pair @ tangents.reshape(-1).cpu().numpy()
        return torch.as_tensor(out).to(tangents).view(2, -1)


def _dense(product: FloatArray | csr_array) -> FloatArray:
    return product if isinstance(product, np.ndarray) else np.asarray(product.toarray())


def _matrix_of(tangents: Tensor) -> FloatArray:
    """Tangents (C, M, 6, n) as a matrix (6 P, n)."""
    return np.ascontiguousarray(tangents.flatten(0, 2).cpu().numpy())


def _matrix(blocks: Tensor, index: Tensor, size: int, count: int) -> csr_array:
    """Blocks (2, K, size) at the ``index`` (K,) of what they are derivatives by, as a matrix (2 K, ...)."""
    rows = blocks.shape[1]
    columns = size * index.cpu().numpy().astype(np.int64)[:, None] + np.arange(size)
    begin = size * np.arange(2 * rows + 1)
    numbers = blocks.reshape(-1).cpu().numpy()
    return csr_array((numbers, np.tile(columns.ravel(), 2), begin), shape=(2 * rows, size * count))


def _coupling_matrix(arrays: Arrays, coupled: Tensor) -> csr_array:
    """W' of all observations (K, 2, 6), ascending by corner, as a matrix (2 N, 6 P)."""
    corner = arrays.corner.cpu().numpy()
    pair = arrays.pair.cpu().numpy().astype(np.int64)
    sightings = np.bincount(corner, minlength=arrays.corner_count)  # observations of each corner
    # A corner's row along x has all of its observations, then that along y.
    order = np.argsort(np.concatenate([2 * corner, 2 * corner + 1]), kind="stable")
    blocks = coupled.transpose(0, 1).reshape(-1, 6).cpu().numpy()[order]
    columns = 6 * np.tile(pair, 2)[order, None] + np.arange(6)
    begin = 6 * np.concatenate([[0], np.cumsum(np.repeat(sightings, 2))])
    shape = (2 * arrays.corner_count, 6 * arrays.pair_count)
    return csr_array((blocks.ravel(), columns.ravel(), begin), shape=shape)
