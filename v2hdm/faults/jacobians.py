"""A solution's observations as sparse matrices: the whitened normal equations for many right sides at once.

What one column costs is Python and memory traffic; a factor and a Jacobian that are read once for thirty
columns cost little more than for one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array, vstack
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.model import Estimate, by_ground_planes
from v2hdm.adjust.reduced import from_tiles, to_tiles
from v2hdm.adjust.whitening import Whitening
from v2hdm.geometry.tensors import NEAR_M
from v2hdm.records import FloatArray, IntArray


class Whitened(NamedTuple):
    """Columns by the whitened unknowns."""

    reduced: Tensor  # (D, n)
    corners: Tensor  # (N, 2, n), 0 of kept ones


class _Pulled(NamedTuple):
    """The priors' part of columns, by the unknowns."""

    extrinsic: Tensor  # (C, 6, n)
    frame_state: Tensor  # (J, S, n)
    corners_map: Tensor  # (N, 2, n)
    clock_s: Tensor  # (C, Q, n)


class Steps(NamedTuple):
    """Steps of the unknowns, by column."""

    extrinsic: Tensor  # (C, 6, n)
    frame_state: Tensor  # (J, S, n)
    clock_s: Tensor  # (C, Q, n)
    tangents: Tensor  # (C, M, 6, n) left tangents of the pairs
    corners_map: Tensor  # (N, 2, n)


@dataclass(frozen=True)
class Jacobians:
    """Derivatives of a solution's weighted residuals (2 K), all those along u before those along v.

    The Q residuals of priors are those of :func:`v2hdm.adjust.model.prior_residuals`, in this order; their U
    unknowns are extrinsics, frame states, corners and clocks.
    """

    whitening: Whitening
    by_pair: csr_array  # (2 K, 6 P) by the left tangents of the pairs
    by_corner: csr_array  # (2 K, 2 N)
    coupling: csr_array  # (2 N, 6 P) W', whose weights have the solver's floor
    of_priors: csr_array  # (Q, U)

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
            priors_by_unknowns(arrays, whitening.estimate),
        )

    def whiten(self, columns: FloatArray | csr_array, of_priors: FloatArray | None = None) -> Whitened:
        """Inner products with the whitened unknowns of columns (2 K, n) and of those of the priors (Q, n)."""
        whitening = self.whitening
        factor = whitening.linearised.corner_factor
        like = whitening.estimate.corners_map
        by_corner = torch.as_tensor(_dense(self.by_corner.T @ columns)).to(like).view(len(like), 2, -1)
        pulled = None if of_priors is None else self._pulled(of_priors)
        if pulled is not None:
            by_corner += pulled.corners_map
        corners = factor.solve(by_corner)
        eliminated = factor.solve_transposed(corners).flatten(0, 1)
        by_pair = _dense(self.by_pair.T @ columns) - self.coupling.T @ eliminated.cpu().numpy()
        states, cameras = self._gathered(torch.as_tensor(by_pair).to(like))
        if pulled is not None:
            states += pulled.frame_state
            cameras += torch.cat([pulled.extrinsic, pulled.clock_s], dim=1)
        reduced = cameras.flatten(0, 1)
        if whitening.plan.tile_count:
            tiles = to_tiles(whitening.plan, states, corners[whitening.plan.kept_corners])
            reduced = torch.cat([tiles, reduced])
        if len(whitening.plan.kept_corners):
            corners = corners.index_fill(0, whitening.plan.kept_corners, 0.0)
        return Whitened(whitening.reduced_factor.solve(reduced), corners)

    def _pulled(self, of_priors: FloatArray) -> _Pulled:
        """Inner products of the priors' columns (Q, n) with their derivatives by the unknowns."""
        estimate = self.whitening.estimate
        flat = torch.as_tensor(self.of_priors.T @ of_priors).to(estimate.corners_map)
        tangent = estimate.clock_s.new_empty(len(estimate.cam_from_vehicle), 6)
        unknowns = (tangent, estimate.frame_state, estimate.corners_map, estimate.clock_s)
        parts = torch.split(flat, [unknown.numel() for unknown in unknowns])
        return _Pulled(
            *(part.view(*unknown.shape, flat.shape[1]) for part, unknown in zip(parts, unknowns, strict=True))
        )

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

    def priors_along(self, steps: Steps) -> FloatArray:
        """Derivatives (Q, n) of the priors' residuals along steps."""
        parts = (steps.extrinsic, steps.frame_state, steps.corners_map, steps.clock_s)
        flat = torch.cat([part.flatten(0, 1) for part in parts])
        return np.asarray(self.of_priors @ flat.cpu().numpy())

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


def priors_by_unknowns(arrays: Arrays, estimate: Estimate) -> csr_array:
    """Derivatives (Q, U) of all residuals except those of observations, as :class:`Jacobians` has them."""
    cameras = len(estimate.cam_from_vehicle)
    frames, states = estimate.frame_state.shape
    sizes = [6 * cameras, frames * states, estimate.corners_map.numel(), estimate.clock_s.numel()]
    of_camera, of_frame, of_corner, of_clock, end = np.cumsum([0, *sizes]).tolist()
    camera = of_camera + np.arange(6 * cameras).reshape(cameras, 6)
    frame = of_frame + np.arange(frames * states).reshape(frames, states)
    corner = of_corner + np.arange(sizes[2]).reshape(-1, 2)
    clock = of_clock + np.arange(sizes[3]).reshape(-1, 1)
    # The first frame has none before it: its derivative is 0.
    before = np.concatenate([frame[:1], frame[:-1]])
    lengths = arrays.lengths
    first = lengths.first.cpu().numpy()
    second = lengths.second.cpu().numpy()
    parts = (
        (_centres_by_tangent(arrays, estimate), camera),
        (arrays.ground_root @ by_ground_planes(estimate.cam_from_vehicle), camera),
        (_states_by_neighbours(arrays), np.concatenate([frame, before], axis=1)),
        (arrays.clock_information_root.expand_as(estimate.clock_s).reshape(-1, 1, 1), clock),
        (_controls_by_corner(arrays), corner),
        (_lengths_by_corners(arrays, estimate), np.concatenate([corner[first], corner[second]], axis=1)),
    )
    return csr_array(vstack([_rows(blocks, columns, end) for blocks, columns in parts]))


def _centres_by_tangent(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Derivatives (C, 3, 6) of the centres' residuals by left tangents: turns leave a centre in place."""
    by_shift = -estimate.cam_from_vehicle[:, :3, :3].mT * arrays.centre_information_root[..., None]
    return torch.cat([by_shift, torch.zeros_like(by_shift)], dim=2)


def _states_by_neighbours(arrays: Arrays) -> Tensor:
    """Derivatives (J, S, 2 S) of the innovations by a frame's states and those of the frame before."""
    by_before = -arrays.state_transition.clone()
    by_before[:1] = 0.0
    by_frame = torch.eye(by_before.shape[1]).to(by_before).expand_as(by_before)
    return torch.cat([by_frame, by_before], dim=2) * arrays.state_information_root[..., None]


def _controls_by_corner(arrays: Arrays) -> Tensor:
    """Derivatives (N, 2, 2) of the surveyed points' residuals by their corners."""
    a, b, c = arrays.control_root.unbind(1)
    return torch.stack([torch.stack([a, torch.zeros_like(a)], dim=1), torch.stack([b, c], dim=1)], dim=1)


def _lengths_by_corners(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Derivatives (M, 1, 4) of the lengths' residuals by their first and second corners."""
    lengths = arrays.lengths
    off = estimate.corners_map[lengths.first] - estimate.corners_map[lengths.second]
    ahead = torch.nn.functional.normalize(off, dim=1) * lengths.information_root[:, None]
    return torch.cat([ahead, -ahead], dim=1)[:, None]


def _rows(blocks: Tensor, columns: IntArray, width: int) -> csr_array:
    """Blocks (k, r, s), each at its ``columns`` (k, s), below each other in a matrix (k r, width)."""
    count, rows, size = blocks.shape
    begin = size * np.arange(count * rows + 1)
    indices = np.repeat(columns, rows, axis=0).ravel()
    return csr_array((blocks.reshape(-1).cpu().numpy(), indices, begin), shape=(count * rows, width))
