"""The reduced system of frame states, kept corners and cameras, other corners eliminated, in tiles.

S = U - B' B (:mod:`v2hdm.adjust.whitening`). Vectors of reduced unknowns hold the tiles in elimination order,
padded to whole tiles, then the cameras' unknowns. A tile holds frames along the route, or *kept* corners:
eliminating corners shared by several drives would couple the frames of all drives, so it is cheaper to
eliminate each drive's frames first. The corners' block V is factorised in blocks of 2 x 2, or larger where
known lengths join corners.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, Run
from v2hdm.adjust.tiles import TIP, Pattern, TiledCholesky, TiledMatrix, factorise_tiles
from v2hdm.errors import AdjustError

CORNER_FLOOR = 1e-10  # information, 1 / m^2, that keeps V definite for a corner running to the horizon
PIVOT_FLOOR = 1e-12  # least pivot of a corner's second coordinate, as a fraction of its information

INSEPARABLE = "corners joined by known lengths cannot be solved for together: increase their sigma_m"
"""Error message for a block that is not positive definite."""


@dataclass(frozen=True)
class Joint:
    """Groups of ``corners`` corners each, contiguous from ``begin`` (m,); lower factors (m, 2g, 2g)."""

    begin: Tensor
    corners: int
    factor: Tensor

    @property
    def index(self) -> Tensor:
        """Corners (m, g) of the groups."""
        return self.begin[:, None] + torch.arange(self.corners, device=self.begin.device)


@dataclass(frozen=True)
class CornerFactor:
    """L of the block-diagonal V = L L': ``lower`` (3, n), xx, yx, yy, of corners without joined ones."""

    lower: Tensor
    joint: tuple[Joint, ...]

    def part(self, corners: slice) -> CornerFactor:
        """The factor of a range of corners that are joined to no others."""
        inside = []
        for group in self.joint:
            chosen = (group.begin >= corners.start) & (group.begin < corners.stop)
            if bool(chosen.any()):
                inside.append(Joint(group.begin[chosen] - corners.start, group.corners, group.factor[chosen]))
        return CornerFactor(self.lower[:, corners], tuple(inside))

    def take(self, corners: Tensor) -> CornerFactor:
        """The factor of corners (n,), ascending, including all joined ones."""
        inside = []
        for group in self.joint:
            place = torch.searchsorted(corners, group.begin).clamp(max=len(corners) - 1)
            chosen = corners[place] == group.begin
            if bool(chosen.any()):
                inside.append(Joint(place[chosen], group.corners, group.factor[chosen]))
        return CornerFactor(self.lower[:, corners], tuple(inside))

    def solve(self, right: Tensor) -> Tensor:
        """L^-1 b for b (n, 2, ...)."""
        first, below, last = self.lower.reshape(3, -1, *[1] * (right.ndim - 2))
        top = right[:, 0] / first
        out = torch.stack([top, (right[:, 1] - below * top) / last], dim=1)
        return self._solve_joint(right, out, transposed=False)

    def solve_transposed(self, right: Tensor) -> Tensor:
        """L^-T b for b (n, 2, ...)."""
        first, below, last = self.lower.reshape(3, -1, *[1] * (right.ndim - 2))
        low = right[:, 1] / last
        out = torch.stack([(right[:, 0] - below * low) / first, low], dim=1)
        return self._solve_joint(right, out, transposed=True)

    def _solve_joint(self, right: Tensor, out: Tensor, transposed: bool) -> Tensor:
        for group in self.joint:
            index = group.index
            factor = group.factor.mT if transposed else group.factor
            stacked = right[index].reshape(*factor.shape[:2], -1)
            solved = torch.linalg.solve_triangular(factor, stacked, upper=transposed)
            out[index] = solved.reshape(*index.shape, *right.shape[1:])
        return out


def factorise_corners(arrays: Arrays, blocks: Tensor, by_length: tuple[Tensor, Tensor]) -> CornerFactor:
    """Factorise V from J'J (N, 2, 2) by corner and derivatives (M, 2) of the lengths by both corners.

    Raises AdjustError if a block of joined corners is singular.
    """
    xx = blocks[:, 0, 0]
    yx = blocks[:, 1, 0]
    yy = blocks[:, 1, 1]
    lower = cholesky_2x2(xx + CORNER_FLOOR, yx, yy + CORNER_FLOOR)
    units = arrays.units
    size = torch.diff(units)
    groups = []
    for corners in torch.unique(size[size > 1]).tolist():
        group = Joint(units[:-1][size == corners], corners, lower)
        matrix = blocks.new_zeros(len(group.begin), corners, 2, corners, 2)
        k = torch.arange(corners, device=blocks.device)
        matrix[:, k, :, k, :] = blocks[group.index].transpose(0, 1)
        _add_lengths(arrays, group, by_length, matrix)
        matrix = matrix.view(len(matrix), 2 * corners, 2 * corners)
        matrix.diagonal(dim1=1, dim2=2).add_(CORNER_FLOOR)
        factor, failed = torch.linalg.cholesky_ex(matrix)
        if bool(failed.any()):
            raise AdjustError(INSEPARABLE)
        groups.append(Joint(group.begin, corners, factor))
    return CornerFactor(lower, tuple(groups))


def _add_lengths(arrays: Arrays, group: Joint, by_length: tuple[Tensor, Tensor], matrix: Tensor) -> None:
    """Add J'J of the lengths within the groups to their blocks (m, g, 2, g, 2)."""
    lengths = arrays.lengths
    which = torch.searchsorted(group.begin, lengths.first, right=True) - 1
    inside = (which >= 0) & (lengths.first < group.begin[which.clamp(min=0)] + group.corners)
    which = which[inside]
    ends = [
        (end[inside] - group.begin[which], by[inside])
        for end, by in zip((lengths.first, lengths.second), by_length, strict=True)
    ]
    for row, by_row in ends:
        for column, by_column in ends:
            outer = by_row[:, :, None] * by_column[:, None, :]
            matrix.permute(0, 1, 3, 2, 4).index_put_((which, row, column), outer, accumulate=True)


def cholesky_2x2(xx: Tensor, yx: Tensor, yy: Tensor) -> Tensor:
    """Lower factors (3, n) of symmetric 2 x 2 blocks, in closed form: one call per block would be slow."""
    first = xx.sqrt()
    below = yx / first
    last = (yy - below.square()).clamp(min=PIVOT_FLOOR * yy).sqrt()
    return torch.stack([first, below, last])


_TILE_ROWS = 96  # approximate rows of a tile: fast products, yet small against a corner's span of frames


@dataclass(frozen=True)
class Plan:
    """The division of a reduced system into tiles; depends on the structure alone, not on numbers."""

    frames_per_tile: int  # frames per tile
    size: int  # rows per tile
    frame_tiles: int  # number of frame tiles; those of kept corners follow
    pattern: Pattern  # nonzero tiles and their elimination order
    kept_corners: Tensor  # (n,) corners not eliminated before the frames, ascending
    most_tiles: int = 0  # largest number of tiles that the observations of a unit of corners touch
    border_tiles: int = 0  # number of tiles, the last in the elimination order, that a border is in

    @property
    def tile_count(self) -> int:
        """Number of tiles, G."""
        return len(self.pattern.below)

    @property
    def kept_tiles(self) -> int:
        """Number of tiles of kept corners."""
        return self.tile_count - self.frame_tiles

    @cached_property
    def position(self) -> Tensor:
        """Position of each tile in the elimination order."""
        return torch.tensor(self.pattern.position, dtype=torch.int64, device=self.kept_corners.device)

    def kept_rows(self, number: Tensor) -> Tensor:
        """Rows (..., 2) of kept corners, by their numbers."""
        per_tile = self.size // 2
        first = self.position[self.frame_tiles + number // per_tile] * self.size + number % per_tile * 2
        return first[..., None] + torch.arange(2, device=number.device)

    def frame_rows(self, frame: Tensor, states: int) -> Tensor:
        """Rows (n, S) of the states of frames (n,)."""
        begin = self.position[frame // self.frames_per_tile] * self.size
        within = frame % self.frames_per_tile * states
        return (begin + within)[:, None] + torch.arange(states, device=frame.device)


def frames_per_tile(arrays: Arrays) -> int:
    """Number of frames per tile."""
    return max(_TILE_ROWS // max(len(arrays.states), 1), 1)


def to_tiles(plan: Plan, by_frame: Tensor, by_kept: Tensor | None = None) -> Tensor:
    """Values by frame (J, S, ...) and by kept corner (n, 2, ...) as rows of tiles (G size, ...)."""
    trailing = by_frame.shape[2:]
    out = by_frame.new_zeros(plan.tile_count, plan.size, *trailing)
    if not plan.tile_count:
        return out.flatten(0, 1)
    frames = by_frame.new_zeros(plan.frame_tiles, plan.frames_per_tile, *by_frame.shape[1:])
    frames.flatten(0, 1)[: len(by_frame)] = by_frame
    out[plan.position[: plan.frame_tiles]] = frames.flatten(1, 2)
    if by_kept is not None and plan.kept_tiles:
        per_tile = plan.size // 2
        corners = by_kept.new_zeros(plan.kept_tiles, per_tile, 2, *trailing)
        corners.flatten(0, 1)[: len(by_kept)] = by_kept
        padded = by_kept.new_zeros(plan.kept_tiles, plan.size, *trailing)
        padded[:, : 2 * per_tile] = corners.flatten(1, 2)
        out[plan.position[plan.frame_tiles :]] = padded
    return out.flatten(0, 1)


def from_tiles(plan: Plan, rows: Tensor, frame_count: int, states: int) -> tuple[Tensor, Tensor]:
    """Inverse of :func:`to_tiles` for rows (G size, ...): by frame (J, S, ...), kept corner (n, 2, ...)."""
    trailing = rows.shape[1:]
    if not plan.tile_count:
        return rows.new_zeros(frame_count, states, *trailing), rows.new_zeros(0, 2, *trailing)
    tiles = rows.view(plan.tile_count, plan.size, *trailing)[plan.position]
    frames = tiles[: plan.frame_tiles].reshape(-1, states, *trailing)[:frame_count]
    corners = tiles[plan.frame_tiles :, : plan.size // 2 * 2].reshape(-1, 2, *trailing)
    return frames, corners[: len(plan.kept_corners)]


@dataclass(frozen=True)
class Coupled:
    """A gradient by the reduced unknowns: frame states (J, S), and cameras (C, 6 + Q)."""

    frame_state: Tensor
    camera: Tensor


@dataclass(frozen=True)
class Spread:
    """Jacobians of the pairs' left tangents; that by the camera's extrinsic is the identity."""

    arrays: Arrays
    state: Tensor  # (C, M, 6, S) by the frame's states
    clock: Tensor  # (C, M, 6, Q) by the camera's clock offsets

    @property
    def camera(self) -> Tensor:
        """Jacobian (C, M, 6, 6 + Q) by all unknowns of the camera."""
        identity = torch.eye(6, dtype=self.clock.dtype, device=self.clock.device)
        return torch.cat([identity.expand(*self.clock.shape[:2], 6, 6), self.clock], dim=-1)

    def gather(self, by_pair: Tensor) -> Coupled:
        """A gradient (C, M, 6) by the pairs' tangents, carried back to the reduced unknowns."""
        by_state = by_pair.new_zeros(self.arrays.frame_count, 0)
        by_camera = by_pair.sum(1)
        if self.state.shape[-1]:
            by_state = self.arrays.over_moments((self.state.mT @ by_pair[..., None])[..., 0].sum(0))
        if self.clock.shape[-1]:
            by_clock = (self.clock.mT @ by_pair[..., None])[..., 0].sum(1)
            by_camera = torch.cat([by_camera, by_clock], dim=1)
        return Coupled(by_state, by_camera)

    def by_state(self, run: Run, coupling: Tensor) -> Tensor:
        """W' (k, 2, S) by the states of each observation's frame, from that by pair (k, 2, 6)."""
        return coupling @ self.state.flatten(0, 1)[run.pair]

    def by_camera(self, run: Run, coupling: Tensor) -> Tensor:
        """W' (n, 2, C (6 + Q)) of a run's corners by the cameras' unknowns."""
        cameras, _, _, clocks = self.clock.shape
        if clocks:
            coupling = torch.cat([coupling, coupling @ self.clock.flatten(0, 1)[run.pair]], dim=2)
        out = coupling.new_zeros(run.corner_count * cameras, *coupling.shape[1:])
        out.index_add_(0, run.corner * cameras + self.arrays.camera_of(run.pair), coupling)
        return out.view(run.corner_count, cameras, 2, -1).transpose(1, 2).flatten(2)


@dataclass(frozen=True)
class PriorBlocks:
    """Hessian of the priors: of cameras (C (6 + Q), C (6 + Q)) and of frame states (J, S, S).

    ``across`` (J, S, S) couples each frame's states to the previous frame's.
    """

    camera: Tensor
    frame: Tensor
    across: Tensor


class ReducedSystem:
    """S under assembly: U is accumulated, the corners' part subtracted."""

    def __init__(self, arrays: Arrays, plan: Plan, spread: Spread) -> None:
        self.arrays = arrays
        self.plan = plan
        self.spread = spread
        # U by pair, or by camera where pairs move with their camera alone.
        self.by_pair = bool(arrays.states) or arrays.camera_unknowns > 6
        self.tip = arrays.camera_count * arrays.camera_unknowns
        self.matrix = TiledMatrix.zeros(plan.pattern, plan.size, self.tip, arrays.centre)
        self._of_pairs = arrays.centre.new_zeros(0)
        # U's diagonal; rows that pad a tile are 0 until they are fixed.
        self._diagonal = arrays.centre.new_zeros(plan.tile_count * plan.size)

    def add(self, of_pairs: Tensor, cameras: Tensor) -> None:
        """Add U of all observations, (C, M or 1, 6, 6), and subtract the cameras' B' B."""
        self._of_pairs = of_pairs
        self.matrix.tiles[TIP, TIP].sub_(cameras)

    def add_kept(self, run: Run, coupling: Tensor, index: Tensor, blocks: Tensor) -> None:
        """Add the information on kept corners, whose observations are ``run``.

        ``coupling`` (k, 2, 6) is their W', ``blocks`` (m, 2, 2) the part of V at ``index`` (2, m), lower
        triangle.
        """
        plan = self.plan
        by_state = self.spread.by_state(run, coupling)
        rows = plan.kept_rows(run.corner)
        columns = plan.frame_rows(self.arrays.frame_of(run.pair), len(self.arrays.states))
        self._scatter(rows, columns, by_state)
        first, second = plan.kept_rows(index)
        self._scatter(first, second, blocks)
        on_diagonal = index[0] == index[1]
        self._diagonal[first[on_diagonal]] = blocks[on_diagonal].diagonal(dim1=1, dim2=2)
        border = self.spread.by_camera(run, coupling).flatten(0, 1)
        for tile, part in enumerate(torch.split(border, plan.size // 2 * 2)):
            place = plan.pattern.position[plan.frame_tiles + tile]
            self.matrix.tiles[TIP, place][:, : len(part)] += part.mT

    def _scatter(self, rows: Tensor, columns: Tensor, values: Tensor) -> None:
        """Add values (n, r, c) at rows (n, r), columns (n, c), mirrored to the lower triangle.

        The rows of an item lie in one tile, and so do its columns.
        """
        size = self.plan.size
        row_tile = rows[:, 0] // size
        column_tile = columns[:, 0] // size
        later = torch.maximum(row_tile, column_tile)
        earlier = torch.minimum(row_tile, column_tile)
        keys = torch.as_tensor(self.matrix.keys, device=values.device)
        at = torch.as_tensor(self.matrix.at, device=values.device)
        begin = at[torch.searchsorted(keys, earlier * (self.plan.tile_count + 1) + later)]
        # Of a tile that lies above, the mirrored one is known, whose rows are its columns.
        is_above = row_tile < column_tile
        by_row = torch.where(is_above, 1, size)
        by_column = torch.where(is_above, size, 1)
        inside_row = rows - row_tile[:, None] * size
        inside_column = columns - column_tile[:, None] * size
        first = begin[:, None] + inside_row * by_row[:, None]
        places = first[:, :, None] + (inside_column * by_column[:, None])[:, None, :]
        on_diagonal = (row_tile == column_tile).nonzero()[:, 0]
        if len(on_diagonal):
            high = torch.maximum(inside_row[on_diagonal, :, None], inside_column[on_diagonal, None, :])
            low = torch.minimum(inside_row[on_diagonal, :, None], inside_column[on_diagonal, None, :])
            places[on_diagonal] = begin[on_diagonal, None, None] + high * size + low
        self.matrix.values.index_add_(0, places.flatten(), values.flatten())

    def factorise(
        self, priors: PriorBlocks, jitter: float, hold_cameras: bool
    ) -> tuple[TiledCholesky, float] | None:
        """Factor in place, and least relative pivot; None if indefinite. ``jitter`` inflates U's diagonal."""
        self._add_frames(priors)
        diagonal = [*self._diagonal.view(self.plan.tile_count, self.plan.size), self._add_cameras(priors)]
        keys = [*((k, k) for k in range(self.plan.tile_count)), (TIP, TIP)]
        for key, values in zip(keys, diagonal, strict=True):
            self.matrix.tiles[key].diagonal().add_(values, alpha=jitter)
        factor = factorise_tiles(self.matrix, hold_cameras)
        if factor is None:
            return None
        return factor, float((factor.pivots() / (1 + jitter) / torch.cat(diagonal)).min())

    def _add_cameras(self, priors: PriorBlocks) -> Tensor:
        """Add the cameras' own information and priors; returns its diagonal."""
        by_pair = self._of_pairs
        if self.arrays.camera_unknowns > 6:
            by_pair = self.spread.camera.mT @ by_pair @ self.spread.camera
        tip = priors.camera.clone()
        unknowns = self.arrays.camera_unknowns
        for begin, of_camera in zip(range(0, len(tip), unknowns), by_pair.sum(1), strict=True):
            tip[begin : begin + unknowns, begin : begin + unknowns] += of_camera
        self.matrix.tiles[TIP, TIP].add_(tip)
        return torch.diagonal(tip)

    def _add_frames(self, priors: PriorBlocks) -> None:
        """Add the frames' information, prior and coupling to the cameras."""
        arrays = self.arrays
        plan = self.plan
        spread = self.spread
        if not arrays.states:
            return
        by_state = self._of_pairs @ spread.state
        by_frame = arrays.over_moments((spread.state.mT @ by_state).sum(0)) + priors.frame
        border = arrays.over_moments((by_state.mT @ spread.camera).permute(1, 2, 0, 3).flatten(2))
        for column, part in enumerate(to_tiles(plan, border).chunk(plan.tile_count)):
            self.matrix.tiles[TIP, column].add_(part.mT)
        rows = plan.frame_rows(torch.arange(arrays.frame_count, device=border.device), len(arrays.states))
        self._scatter(rows, rows, by_frame.tril())
        if bool(priors.across.any()):
            self._scatter(rows[1:], rows[:-1], priors.across[1:])
        self._diagonal[rows] = by_frame.diagonal(dim1=1, dim2=2)
        unused = (self._diagonal == 0).to(border.dtype)
        self._diagonal += unused
        for tile, pad in enumerate(unused.view(plan.tile_count, -1)):
            self.matrix.tiles[tile, tile].diagonal().add_(pad)


def reduced_coupling(plan: Plan, spread: Spread, run: Run, coupling: Tensor) -> Tensor:
    """W (D, 2 n) of a run's n corners by all reduced unknowns, from W' by observation (k, 2, 6)."""
    by_camera = spread.by_camera(run, coupling).permute(2, 0, 1).flatten(1)
    if not spread.arrays.states:
        return by_camera
    by_state = spread.by_state(run, coupling)
    frame = spread.arrays.frame_of(run.pair)
    by_frame = coupling.new_zeros(spread.arrays.frame_count, by_state.shape[2], run.corner_count, 2)
    by_frame.permute(0, 2, 3, 1).index_put_((frame, run.corner), by_state, accumulate=True)
    return torch.cat([to_tiles(plan, by_frame.flatten(2)), by_camera])
