"""The reduced system of frame states and extrinsics, corners eliminated, in tiles along the route.

S = U - sum_i B_i' B_i (see :mod:`v2hdm.adjust.whitening`). Vectors of the reduced unknowns hold the
frame states, tile by tile in elimination order and padded to whole tiles, then the extrinsics.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.residuals import Estimate
from v2hdm.adjust.tiles import TIP, Pattern, Tiles, find_pattern

# Rows of a tile, about: large enough for fast products, small against a corner's span of frames.
_TILE_ROWS = 96
# Corners whose part of the Schur complement is one dense product: neighbours share their frames.
_BLOCK_CORNERS = 32


@dataclass(frozen=True)
class Block:
    """A run of corners: their observations [begin, end), the tiles they touch, and its place there.

    ``row`` is each observation's corner, counted within the block; ``slot`` its frame, counted
    over the touched tiles.
    """

    begin: int
    end: int
    tiles: tuple[int, ...]
    row: Tensor
    slot: Tensor


@dataclass(frozen=True)
class Plan:
    """How a problem's reduced system is cut into tiles; depends on who saw what, not on numbers."""

    frames_per_tile: int
    pattern: Pattern
    blocks: tuple[Block, ...]

    @property
    def tile_count(self) -> int:
        """G."""
        return len(self.pattern.below)


def make_plan(arrays: Arrays) -> Plan:
    """Cut the frames into tiles and the corners into blocks, and find the factor's pattern."""
    states = len(arrays.states)
    per_tile = max(_TILE_ROWS // states, 1) if states else arrays.frame_count
    count = -(-arrays.frame_count // per_tile) if states else 0
    frame = arrays.pair % arrays.frame_count
    starts = torch.arange(0, arrays.corner_count, _BLOCK_CORNERS, device=frame.device)
    bounds = [*torch.searchsorted(arrays.corner, starts).tolist(), len(frame)]
    blocks = []
    for begin, end in pairwise(bounds):
        touched = torch.unique(frame[begin:end] // per_tile)
        slot = torch.searchsorted(touched, frame[begin:end] // per_tile) * per_tile
        blocks.append(
            Block(
                begin,
                end,
                tuple(touched.tolist()) if states else (),
                arrays.corner[begin:end] - arrays.corner[begin],
                slot + frame[begin:end] % per_tile,
            )
        )
    cliques = [list(block.tiles) for block in blocks]
    if bool(arrays.state_transition.any()):
        cliques += [[tile, tile + 1] for tile in range(count - 1)]
    return Plan(per_tile, find_pattern(count, cliques), tuple(blocks))


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


def held_hessian(arrays: Arrays, plan: Plan, estimate: Estimate, blocks: Tensor, spread: Spread) -> Tiles:
    """U: the Hessian of frame states and extrinsics, priors included, with the corners held.

    Args:
        arrays: the problem.
        plan: its tiles.
        estimate: where.
        blocks: the pairs' own, (P, 6, 6).
        spread: how the pairs move with frames and cameras.
    """
    cameras, states, each = arrays.camera_count, len(arrays.states), arrays.camera_unknowns
    blocks = blocks.reshape(cameras, arrays.frame_count, 6, 6)
    of_camera = spread.camera
    by_camera = blocks @ of_camera
    tiles = _empty_tiles(plan, states, cameras * each, blocks)
    if states:
        _add_frames(arrays, plan, (spread.state.mT @ blocks @ spread.state).sum(0), tiles)
        border = to_tiles(plan, (spread.state.mT @ by_camera).permute(1, 2, 0, 3).flatten(2))
        for column, part in enumerate(border.chunk(plan.tile_count)):
            tiles[TIP, column] = part.mT.contiguous()
    tip = tiles[TIP, TIP].view(cameras, each, cameras, each)
    rotation, root = estimate.cam_from_vehicle[:, :3, :3], arrays.centre_information_root
    information = rotation * root.square()[:, None] @ rotation.mT
    for camera in range(cameras):
        tip[camera, :, camera] = (of_camera[camera].mT @ by_camera[camera]).sum(0)
        tip[camera, :3, camera, :3] += information[camera]
        tip[camera, :, camera].diagonal()[6:] += arrays.clock_information_root**2
    return tiles


def _empty_tiles(plan: Plan, states: int, tip: int, like: Tensor) -> Tiles:
    size = plan.frames_per_tile * states
    tiles = {(TIP, TIP): like.new_zeros(tip, tip)}
    for column, below in enumerate(plan.pattern.below):
        tiles[TIP, column] = like.new_zeros(tip, size)
        for row in (column, *below):
            tiles[row, column] = like.new_zeros(size, size)
    return tiles


def _add_frames(arrays: Arrays, plan: Plan, by_frame: Tensor, tiles: Tiles) -> None:
    """Each frame's own information and prior, and the prior's coupling to the frame before."""
    root, transition = arrays.state_information_root, arrays.state_transition
    carried = root[..., None] * transition
    own = torch.diag_embed(root.square())
    own[:-1] += (carried.mT @ carried)[1:]
    across = -root[..., None] * carried
    per_tile, position, states = plan.frames_per_tile, plan.pattern.position, root.shape[1]
    by_frame = by_frame + own
    for tile, begin in enumerate(range(0, arrays.frame_count, per_tile)):
        part, coupling = by_frame[begin : begin + per_tile], across[begin : begin + per_tile]
        count = len(part)
        view = tiles[position[tile], position[tile]].view(per_tile, states, per_tile, states)
        index = torch.arange(per_tile, device=root.device)
        # Frames that only fill up the last tile are fixed at 0.
        view[index, :, index, :] = torch.eye(states, dtype=root.dtype, device=root.device)
        view[index[:count], :, index[:count], :] = part
        view[index[1:count], :, index[: count - 1], :] = coupling[1:]
        view[index[: count - 1], :, index[1:count], :] = coupling[1:].mT
        if tile and bool(coupling[0].any()):
            _add_between(tiles, position[tile], position[tile - 1], coupling[0])


def _add_between(tiles: Tiles, later: int, earlier: int, coupling: Tensor) -> None:
    """Couple the first frame of one tile with the last of the one before it on the route."""
    states = len(coupling)
    if later > earlier:
        tiles[later, earlier][:states, -states:] += coupling
    else:
        tiles[earlier, later][-states:, :states] += coupling.mT


def subtract_corners(arrays: Arrays, plan: Plan, coupling: Tensor, spread: Spread, tiles: Tiles) -> None:
    """Take sum_i B_i' B_i off, block by block; ``coupling`` (2, 6, K) holds B_i by observation."""
    states, cameras, each = len(arrays.states), arrays.camera_count, arrays.camera_unknowns
    camera = arrays.pair // arrays.frame_count
    by_state = spread.state.reshape(arrays.pair_count, 6, states)
    for block in plan.blocks:
        part, rows = slice(block.begin, block.end), int(block.row[-1]) + 1
        own = coupling[:, :, part].permute(2, 0, 1)
        by_camera = coupling.new_zeros(rows, cameras, 2, each)
        of_camera = spread_to_cameras(arrays, spread, own, arrays.pair[part])
        by_camera.index_put_((block.row, camera[part]), of_camera, accumulate=True)
        tip = by_camera.permute(0, 2, 1, 3).reshape(2 * rows, -1)
        tiles[TIP, TIP].addmm_(tip.mT, tip, alpha=-1)
        if not states:
            continue
        frames = coupling.new_zeros(rows, len(block.tiles) * plan.frames_per_tile, 2, states)
        by_frame = own @ by_state[arrays.pair[part]]
        frames.index_put_((block.row, block.slot), by_frame, accumulate=True)
        columns = frames.permute(0, 2, 1, 3).reshape(2 * rows, -1).chunk(len(block.tiles), dim=1)
        placed = sorted((plan.pattern.position[tile], k) for k, tile in enumerate(block.tiles))
        for n, (column, first) in enumerate(placed):
            tiles[TIP, column].addmm_(tip.mT, columns[first], alpha=-1)
            for row, second in placed[n:]:
                tiles[row, column].addmm_(columns[second].mT, columns[first], alpha=-1)


def spread_to_cameras(arrays: Arrays, spread: Spread, by_pair: Tensor, pair: Tensor) -> Tensor:
    """Derivatives (M, 2, 6 + Q) by the unknowns of the cameras, from those (M, 2, 6) by ``pair`` (M,)."""
    if arrays.camera_unknowns == 6:
        return by_pair
    clock = spread.clock.reshape(arrays.pair_count, 6, -1)
    return torch.cat([by_pair, by_pair @ clock[pair]], dim=-1)
