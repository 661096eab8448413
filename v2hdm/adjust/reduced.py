"""The reduced system of frame states and extrinsics, corners eliminated, in tiles along the route.

S = U - B' B (see :mod:`v2hdm.adjust.whitening`). Vectors of the reduced unknowns hold the
frame states, tile by tile in elimination order and padded to whole tiles, then the extrinsics.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, Run
from v2hdm.adjust.corner_factor import CornerFactor
from v2hdm.adjust.linear import PAIR_BLOCK
from v2hdm.adjust.residuals import Estimate, earlier_markings, of_each
from v2hdm.adjust.tiles import (
    TIP,
    Pattern,
    TiledCholesky,
    TiledMatrix,
    factorise_above_tip,
    factorise_tiles,
    find_pattern,
)

# Rows of a tile, about: large enough for fast products, small against a corner's span of frames.
_TILE_ROWS = 96
# Corners whose part of the Schur complement is one dense product: neighbours share their frames.
_BLOCK_CORNERS = 32


@dataclass(frozen=True)
class Block:
    """Some corners of a run and their observations, counted within it, and the tiles that they touch."""

    observations: slice
    corners: slice
    tiles: tuple[int, ...]


@dataclass(frozen=True)
class Plan:
    """How a problem's reduced system is cut into tiles; depends on who saw what, not on numbers.

    ``blocks`` are those of each run; where frames have no states, or kernels need none, there are none.
    ``most_tiles`` is how many a unit of the kernels touches at most.
    """

    frames_per_tile: int
    pattern: Pattern
    blocks: tuple[tuple[Block, ...], ...]
    most_tiles: int = 0

    @property
    def tile_count(self) -> int:
        """G."""
        return len(self.pattern.below)


def make_plan(arrays: Arrays) -> Plan:
    """Cut the frames into tiles and the corners into blocks, and find the factor's pattern."""
    if not arrays.states:
        return Plan(arrays.frame_count, find_pattern(0, []), tuple(() for _ in arrays.runs()))
    per_tile = max(_TILE_ROWS // len(arrays.states), 1)
    count, most_tiles = -(-arrays.frame_count // per_tile), 0
    blocks: tuple[tuple[Block, ...], ...] = tuple(() for _ in arrays.runs())
    if arrays.passes is not None:
        cliques, most_tiles = arrays.passes.coupled_tiles(per_tile, count)
    else:
        blocks = tuple(tuple(_blocks(arrays, run, per_tile)) for run in arrays.runs())
        cliques = [list(block.tiles) for of_run in blocks for block in of_run]
    if bool(arrays.state_transition.any()):
        cliques += [[tile, tile + 1] for tile in range(count - 1)]
    return Plan(per_tile, find_pattern(count, cliques), blocks, most_tiles)


def _blocks(arrays: Arrays, run: Run, per_tile: int) -> list[Block]:
    """Cut a run; corners that are joined are not parted."""
    units, begins = arrays.unit_bounds
    wanted = torch.arange(run.corners.start, run.corners.stop + _BLOCK_CORNERS, _BLOCK_CORNERS)
    wanted = wanted.clamp(max=run.corners.stop).to(units.device)
    cuts = torch.unique(torch.searchsorted(units, wanted))
    bounds = zip(
        (begins[cuts] - run.observations.start).tolist(),
        (units[cuts] - run.corners.start).tolist(),
        strict=True,
    )
    tile = run.pair % arrays.frame_count // per_tile
    return [
        Block(slice(begin, end), slice(first, last), tuple(torch.unique(tile[begin:end]).tolist()))
        for (begin, first), (end, last) in pairwise(bounds)
    ]


def to_tiles(plan: Plan, by_frame: Tensor) -> Tensor:
    """Values by frame (J, S, ...) as rows of the reduced vector (G F S, ...), padded with zeros."""
    states = by_frame.shape[1]
    if not states:
        return by_frame.new_zeros(0, *by_frame.shape[2:])
    shape = (plan.tile_count, plan.frames_per_tile, *by_frame.shape[1:])
    padded = by_frame.new_zeros(shape)
    padded.flatten(0, 1)[: len(by_frame)] = by_frame
    ordered = torch.empty_like(padded)
    ordered[list(plan.pattern.position)] = padded
    return ordered.flatten(0, 2)


def from_tiles(plan: Plan, rows: Tensor, frame_count: int, states: int) -> Tensor:
    """Inverse of :func:`to_tiles` for vectors: (G F S,) to (J, S)."""
    if not states:
        return rows.new_zeros(frame_count, 0)
    ordered = rows.reshape(plan.tile_count, plan.frames_per_tile, states)
    return ordered[list(plan.pattern.position)].flatten(0, 1)[:frame_count]


@dataclass(frozen=True)
class Spread:
    """How pairs move with what they belong to: derivatives of their left tangents.

    ``state`` (C, J, 6, S) by the states of the frame; ``clock`` (C, J, 6, Q) by the camera's clock offset. By
    the camera's extrinsic it is the identity.
    """

    state: Tensor
    clock: Tensor

    @property
    def camera(self) -> Tensor:
        """(C, J, 6, 6 + Q): by all unknowns of the camera."""
        identity = torch.eye(6, dtype=self.clock.dtype, device=self.clock.device)
        return torch.cat([identity.expand(*self.clock.shape[:2], 6, 6), self.clock], dim=-1)

    def gather(self, by_pair: Tensor) -> Coupled:
        """What a gradient (C, J, 6) by the pairs' tangents is by the unknowns that they move with."""
        by_state, by_camera = by_pair.new_zeros(by_pair.shape[1], 0), by_pair.sum(1)
        if self.state.shape[-1]:
            by_state = (self.state.mT @ by_pair[..., None])[..., 0].sum(0)
        if self.clock.shape[-1]:
            by_clock = (self.clock.mT @ by_pair[..., None])[..., 0].sum(1)
            by_camera = torch.cat([by_camera, by_clock], dim=1)
        return Coupled(by_state, by_camera)


@dataclass(frozen=True)
class Coupled:
    """A gradient by the reduced unknowns: by frame state (J, S) and by the cameras' unknowns (C, 6 + Q)."""

    frame_state: Tensor
    camera: Tensor


class ReducedSystem:
    """S while it is put together: U is summed up and the corners' part comes off, run by run."""

    def __init__(self, arrays: Arrays, plan: Plan, spread: Spread) -> None:
        self.arrays, self.plan, self.spread = arrays, plan, spread
        self._state_table = spread.state.reshape(arrays.pair_count, -1).T.contiguous()
        # U by pair; where no pair moves but with its camera, by camera.
        self.by_pair = bool(arrays.states) or arrays.camera_unknowns > 6
        self._own = arrays.centre.new_zeros(21, arrays.pair_count if self.by_pair else arrays.camera_count)
        tip = arrays.camera_count * arrays.camera_unknowns
        size = plan.frames_per_tile * len(arrays.states)
        self.matrix = TiledMatrix.zeros(plan.pattern, size, tip, arrays.centre)
        self._tiles = self.matrix.tiles

    def add(self, run: Run, blocks: Tensor) -> None:
        """Add U of a run, ``blocks`` (21, k) by observation."""
        if self.by_pair:
            self._own.index_add_(1, run.pair, blocks)
        else:
            cameras = torch.arange(self.arrays.camera_count, device=run.pair.device)
            belongs = run.pair[:, None] // self.arrays.frame_count == cameras
            self._own.addmm_(blocks, belongs.to(blocks.dtype))

    def add_all(self, own: Tensor, tip: Tensor) -> None:
        """Add U of all runs, by pair or camera (21, n), and take off the cameras' B' B, a lower triangle."""
        self._own += own
        self._tiles[TIP, TIP] -= tip + tip.tril(-1).mT

    def subtract(self, number: int, run: Run, coupling: Tensor, factor: CornerFactor) -> None:
        """Take B' B of run ``number`` off; ``coupling`` (2, 6, k) is W' by observation."""
        by_camera = factor.solve(coupling_by_camera(self.arrays, self.spread, run, coupling))
        tip = by_camera.flatten(0, 1)
        self._tiles[TIP, TIP].addmm_(tip.mT, tip, alpha=-1)
        blocks = self.plan.blocks[number]
        by_state = self._by_state(run, coupling) if blocks else coupling
        for block in blocks:
            columns = factor.part(block.corners).solve(self._by_frame(block, run, by_state)).flatten(0, 1)
            self._subtract_block(block, columns, by_camera[block.corners].flatten(0, 1))

    def _by_state(self, run: Run, coupling: Tensor) -> Tensor:
        """W' by the states of each observation's frame, (2, S, k)."""
        states = len(self.arrays.states)
        spread = of_each(self._state_table, run.pair).view(6, states, -1)
        out = coupling[:, :1] * spread[0]
        for row in range(1, 6):
            out.addcmul_(coupling[:, row : row + 1], spread[row])
        return out

    def _by_frame(self, block: Block, run: Run, by_state: Tensor) -> Tensor:
        """W' of a block by the states of the frames of its tiles, (n, 2, tiles * F * S)."""
        per_tile, states = self.plan.frames_per_tile, len(self.arrays.states)
        part, corners = block.observations, block.corners.stop - block.corners.start
        tiles = torch.tensor(block.tiles, device=run.pair.device)
        frame, slots = run.pair[part] % self.arrays.frame_count, per_tile * len(block.tiles)
        slot = torch.searchsorted(tiles, frame // per_tile) * per_tile + frame % per_tile
        rows = by_state.new_zeros(2 * states, corners * slots)
        place = (run.corner[part] - block.corners.start) * slots + slot
        rows.index_add_(1, place, by_state[:, :, part].reshape(2 * states, -1))
        by_frame = rows.view(2, states, corners, slots).permute(2, 0, 3, 1)
        return by_frame.reshape(corners, 2, -1)

    def _subtract_block(self, block: Block, columns: Tensor, tip: Tensor) -> None:
        """Take off the products of a block's frames (2 n, tiles * F * S) with each other and the cameras."""
        parts = columns.chunk(len(block.tiles), dim=1)
        placed = sorted((self.plan.pattern.position[tile], part) for part, tile in enumerate(block.tiles))
        for n, (column, first) in enumerate(placed):
            self._tiles[TIP, column].addmm_(tip.mT, parts[first], alpha=-1)
            for row, second in placed[n:]:
                self._tiles[row, column].addmm_(parts[second].mT, parts[first], alpha=-1)

    def factorise(self, estimate: Estimate, damping: float) -> tuple[TiledCholesky, float] | None:
        """Put it together and factorise; the factor takes its place.

        ``damping`` is added to U's diagonal, relative to it. Returns the factor and the smallest pivot as a
        share of U's diagonal; None where S cannot be factorised.
        """
        diagonal = self._add_own(estimate)
        keys = [*((k, k) for k in range(self.plan.tile_count)), (TIP, TIP)]
        for key, values in zip(keys, diagonal, strict=True):
            self._tiles[key].diagonal().add_(values, alpha=damping)
        factor = factorise_tiles(self.matrix)
        if factor is None:
            return None
        return factor, float((factor.pivots() / (1 + damping) / torch.cat(diagonal)).min())

    def eliminate_frames(self, estimate: Estimate) -> tuple[TiledCholesky, Tensor] | None:
        """Put it together and eliminate the frames; the factor's tip is what they leave of the cameras.

        Returns the factor and the diagonal of what was known of the cameras before; None where a frame's own
        part cannot be factorised.
        """
        own = self._add_own(estimate)[-1].clone()
        factor = factorise_above_tip(self.matrix)
        return None if factor is None else (factor, own)

    def _add_own(self, estimate: Estimate) -> list[Tensor]:
        """Add U and the priors; returns their diagonal, by tile and of the tip."""
        return [*self._add_frames(), self._add_cameras(estimate)]

    def _add_cameras(self, estimate: Estimate) -> Tensor:
        """Add the cameras' own information and priors; returns its diagonal."""
        arrays, each = self.arrays, self.arrays.camera_unknowns
        by_pair = _symmetric(self._own.reshape(21, arrays.camera_count, -1))
        if each > 6:
            by_pair = self.spread.camera.mT @ by_pair @ self.spread.camera
        by_camera = by_pair.sum(1)
        rotation, root = estimate.cam_from_vehicle[:, :3, :3], arrays.centre_information_root
        by_camera[:, :3, :3] += rotation * root.square()[:, None] @ rotation.mT
        by_camera.diagonal(dim1=1, dim2=2)[:, 6:] += arrays.clock_information_root**2
        tip = torch.block_diag(*by_camera)  # type: ignore[no-untyped-call]
        if arrays.camera_prior is not None:
            tip = tip + earlier_markings(arrays, estimate, arrays.camera_prior).hessian
        self._tiles[TIP, TIP] += tip
        return torch.diagonal(tip)

    def _add_frames(self) -> list[Tensor]:
        """Add the frames' own information, prior and coupling to the cameras; returns the diagonals."""
        arrays, plan, spread = self.arrays, self.plan, self.spread
        if not arrays.states:
            return []
        blocks = _symmetric(self._own.reshape(21, arrays.camera_count, -1))
        by_state = blocks @ spread.state
        by_frame = (spread.state.mT @ by_state).sum(0)
        border = (by_state.mT @ spread.camera).permute(1, 2, 0, 3).flatten(2)
        for column, part in enumerate(to_tiles(plan, border).chunk(plan.tile_count)):
            self._tiles[TIP, column] += part.mT
        root, transition = arrays.state_information_root, arrays.state_transition
        carried = root[..., None] * transition
        by_frame += torch.diag_embed(root.square())
        by_frame[:-1] += (carried.mT @ carried)[1:]
        across = -root[..., None] * carried
        diagonal = [root.new_empty(0)] * plan.tile_count
        for tile, begin in enumerate(range(0, arrays.frame_count, plan.frames_per_tile)):
            frames = slice(begin, begin + plan.frames_per_tile)
            place = plan.pattern.position[tile]
            matrix = _along_route(by_frame[frames], across[frames], plan.frames_per_tile)
            self._tiles[place, place] += matrix
            diagonal[place] = matrix.diagonal()
            if tile and bool(across[begin].any()):
                self._add_between(place, plan.pattern.position[tile - 1], across[begin])
        return diagonal

    def _add_between(self, later: int, earlier: int, coupling: Tensor) -> None:
        """Couple the first frame of one tile with the last of the one before it on the route."""
        states = len(coupling)
        if later > earlier:
            self._tiles[later, earlier][:states, -states:] += coupling
        else:
            self._tiles[earlier, later][-states:, :states] += coupling.mT


def coupling_by_camera(arrays: Arrays, spread: Spread, run: Run, coupling: Tensor) -> Tensor:
    """W' of a run by the unknowns of the cameras, (n, 2, C (6 + Q)), from that by observation (2, 6, k)."""
    each, cameras = arrays.camera_unknowns, arrays.camera_count
    if each > 6:
        clock = of_each(spread.clock.reshape(arrays.pair_count, -1).T, run.pair).view(6, each - 6, -1)
        coupling = torch.cat([coupling, (coupling[:, :, None] * clock).sum(1)], dim=1)
    place = run.corner * cameras + run.pair // arrays.frame_count
    rows = coupling.new_zeros(2 * each, run.corner_count * cameras)
    rows.index_add_(1, place, coupling.flatten(0, 1))
    by_camera = rows.view(2, each, run.corner_count, cameras).permute(2, 0, 3, 1)
    return by_camera.reshape(run.corner_count, 2, -1)


def reduced_coupling(arrays: Arrays, plan: Plan, spread: Spread, run: Run, coupling: Tensor) -> Tensor:
    """W (D, 2 n) of a run's n corners by all reduced unknowns, from W' by observation (2, 6, k)."""
    states = len(arrays.states)
    by_state = coupling.permute(2, 0, 1) @ spread.state.reshape(arrays.pair_count, 6, states)[run.pair]
    by_frame = coupling.new_zeros(arrays.frame_count, states, run.corner_count, 2)
    place = (run.pair % arrays.frame_count, run.corner)
    by_frame.permute(0, 2, 1, 3).index_put_(place, by_state.mT, accumulate=True)
    by_camera = coupling_by_camera(arrays, spread, run, coupling)
    return torch.cat([to_tiles(plan, by_frame.flatten(2)), by_camera.permute(2, 0, 1).flatten(1)])


def _symmetric(entries: Tensor) -> Tensor:
    """Full blocks (..., 6, 6) of their 21 entries (21, ...)."""
    row, column = PAIR_BLOCK
    blocks = entries.new_empty(*entries.shape[1:], 6, 6)
    blocks[..., row, column] = entries.movedim(0, -1)
    blocks[..., column, row] = entries.movedim(0, -1)
    return blocks


def _along_route(by_frame: Tensor, across: Tensor, per_tile: int) -> Tensor:
    """A tile of frames' blocks (n, S, S) on the diagonal and the couplings to the frame before beside it."""
    count, states = by_frame.shape[:2]
    matrix = by_frame.new_zeros(per_tile, states, per_tile, states)
    index = torch.arange(per_tile, device=by_frame.device)
    # Frames that only fill up the last tile are fixed at 0.
    matrix[index, :, index, :] = torch.eye(states, dtype=by_frame.dtype, device=by_frame.device)
    matrix[index[:count], :, index[:count], :] = by_frame
    matrix[index[1:count], :, index[: count - 1], :] = across[1:]
    matrix[index[: count - 1], :, index[1:count], :] = across[1:].mT
    return matrix.view(per_tile * states, -1)
