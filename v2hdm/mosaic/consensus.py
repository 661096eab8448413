"""Which images show the ground, place by place: it looks alike from everywhere, what stands does not.

Images are warped onto the plane of the ground. What lies there stays where it is; a point ``h`` above it
moves by ``h`` times the change of its direction, distance on the ground over the camera's height. Blocks of
ground are compared between images by their patterns. A block is ground where images agree on its pattern from
directions that are far enough apart, and an image shows it where it agrees with them. A block without a
pattern is what the nearest block with one is.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from v2hdm.executor import HERE, Executor
from v2hdm.geometry.ipm import apply_homography
from v2hdm.mosaic.views import Canvas, Lens, Shot
from v2hdm.mosaic.warp import TILE_PX, Area, SheetPlan, Sources, Warp, over_sheets, plan_sheets, sample
from v2hdm.native import kernels
from v2hdm.progress import Progress, Steps
from v2hdm.records import BoolArray, FloatArray

_log = logging.getLogger(__name__)

CELL_M = 0.04  # side of a cell in which patterns are compared, m; chosen
BLOCK_PX = 8  # side of a block, cells: 0.32 m; chosen
BLOCK_M = BLOCK_PX * CELL_M  # side of a block, m
_BLOCKS = TILE_PX // BLOCK_PX  # blocks along a side of a tile
_NODE_PX = BLOCK_PX // 2  # distance of the nodes of a tile, cells: a block has one in its middle
_SHEET_PX = 1024  # side of a sheet, cells: 41 m, whose patches take some 120 MB

_TEXTURE = 2.5  # standard deviation of grey values in a block that is more than an image's noise; chosen
_AGREES = 0.4  # least correlation of an image's pattern with that of the others; chosen
_COARSEST = 0.1  # least px of an image that a cell covers, for its pattern to be compared; chosen

# Chosen on rendered port 2: of the ground that is shown, .4 % of the blocks show what stands.
_FEWEST = 5  # least number of images that agree on ground
_SPREAD = 2.5  # least difference of their directions, m of shift for a metre of height
_MAJORITY = 0.5  # least share of them among images with a pattern, by weight
_CONTRADICTED = 0.7  # share below which a block that is not ground stands
_PATTERNED = 0.3  # least share, by weight, of images with a pattern where a block has one
_SEEN_BY = 3  # least number of images of a block
_AROUND = 5  # side, blocks, of the neighbourhood that decides on the block in its middle
_VOTES = 3.0  # least number of blocks in it that are ground or stand
_OUTVOTED = 3.0  # ground must be so many times what stands in it
_REACH_BLOCKS = 10.0  # distance, blocks, up to which a block that nothing decides on follows another
_LEAST_STANDING = 4  # size, blocks, up to which what stands alone amid ground is some of it
_LEAST_GROUND = 20  # size, blocks, up to which ground alone amid what stands is none

UNSEEN, PLAIN, GROUND, STANDING = range(4)  # what a block is; of plain ones nothing is known


@dataclass(frozen=True)
class Shown:
    """The blocks of which one image shows the ground, from ``(row, column)`` on."""

    row: int
    column: int
    shows: np.ndarray  # (rows, columns) float32, 0 or 1


@dataclass(frozen=True)
class Consensus:
    """Where images show the ground: by image, in blocks of a canvas with north above."""

    canvas: Canvas
    kinds: np.ndarray  # (rows, columns) of all blocks
    by_shot: Mapping[int, Shown]

    def shown(self, index: int, points_map: FloatArray) -> np.ndarray:
        """Whether the image ``index`` shows the ground at points (T, side, side, 2), linear between blocks.

        From 0 to 1, (T, side, side) float32; see :func:`share_of`.
        """
        shown = self.by_shot.get(index)
        if shown is None:
            return np.zeros(points_map.shape[:-1], dtype=np.float32)
        west_m, north_m = self.canvas.corner_map
        column = (points_map[..., 0] - west_m) / BLOCK_M - 0.5 - shown.column
        row = (north_m - points_map[..., 1]) / BLOCK_M - 0.5 - shown.row
        return sample(shown.shows, column.astype(np.float32), row.astype(np.float32))


def share_of(shown: np.ndarray) -> np.ndarray:
    """How far an image counts that shows the ground so: nothing beyond the border of a block that does."""
    return (2 * shown - 1).clip(min=0)


def find_consensus(
    shots: Sequence[Shot],
    lenses: Mapping[str, Lens],
    canvas: Canvas,
    area: Area | None = None,
    progress: Steps | None = None,
    executor: Executor = HERE,
) -> Consensus | None:
    """Compare all images with each other on a canvas of cells of :data:`CELL_M`.

    None where images are too few, or too near together, to tell ground anywhere. Raises DriveError where an
    image cannot be read; ``progress`` and other errors: see :func:`v2hdm.mosaic.warp.over_sheets`.
    """
    rows = -(-canvas.rows // TILE_PX) * _BLOCKS
    columns = -(-canvas.columns // TILE_PX) * _BLOCKS
    kinds = np.full((rows, columns), UNSEEN, dtype=np.uint8)
    agreed: dict[int, list[tuple[int, int, BoolArray]]] = defaultdict(list)
    plan = plan_sheets(canvas, shots, lenses, area, _SHEET_PX)
    for compared in over_sheets(_Comparison(shots, lenses, canvas), plan, progress, executor):
        for tile in compared:
            kinds[tile.row : tile.row + _BLOCKS, tile.column : tile.column + _BLOCKS] = tile.kinds
            for index, shows in zip(tile.indices, tile.shows, strict=True):
                agreed[index].append((tile.row, tile.column, shows))
    is_ground = ground_of(kinds)
    if not is_ground.any():
        _log.warning("the mosaic may show what stands: no images look at the same ground from two sides")
        return None
    if area is not None:
        is_ground[is_ground] = area.holds(_centres(canvas, is_ground))
    return Consensus(canvas, kinds, {index: _joined(parts, is_ground) for index, parts in agreed.items()})


def _centres(canvas: Canvas, chosen: BoolArray) -> FloatArray:
    """The centres (N, 2) of the chosen blocks, m in the map."""
    row, column = np.nonzero(chosen)
    return canvas.corner_map + BLOCK_M * np.column_stack([column + 0.5, -(row + 0.5)])


def _joined(parts: Sequence[tuple[int, int, BoolArray]], is_ground: BoolArray) -> Shown:
    """One image's blocks, a raster of those of its tiles."""
    tops = [top for top, _, _ in parts]
    lefts = [left for _, left, _ in parts]
    row = min(tops)
    column = min(lefts)
    shows = np.zeros((max(tops) - row + _BLOCKS, max(lefts) - column + _BLOCKS), dtype=np.float32)
    for top, left, flags in parts:
        is_there = is_ground[top : top + _BLOCKS, left : left + _BLOCKS]
        shows[top - row : top - row + _BLOCKS, left - column : left - column + _BLOCKS] = flags & is_there
    return Shown(row, column, shows)


def ground_of(kinds: np.ndarray) -> BoolArray:
    """Which blocks (rows, columns) are ground, from what they are one by one.

    The neighbourhood of a block decides on it, and where it has no pattern, the nearest one that has. Beside
    what stands a block is none.
    """
    window = np.ones((_AROUND, _AROUND))
    for_ground = ndimage.convolve((kinds == GROUND).astype(np.float64), window, mode="constant")
    against = ndimage.convolve((kinds == STANDING).astype(np.float64), window, mode="constant")
    is_decided = for_ground + against >= _VOTES
    if not is_decided.any():
        return np.zeros(kinds.shape, dtype=np.bool_)
    distance, (row, column) = ndimage.distance_transform_edt(~is_decided, return_indices=True)
    follows_ground = (for_ground > _OUTVOTED * against)[row, column] & (distance <= _REACH_BLOCKS)
    is_seen = kinds != UNSEEN
    is_standing = _larger_than(_LEAST_STANDING, is_seen & ~follows_ground)
    beside = ndimage.binary_dilation(is_standing, np.ones((3, 3), dtype=np.bool_))
    return _larger_than(_LEAST_GROUND, is_seen & ~beside)


def _larger_than(size: int, flags: BoolArray) -> BoolArray:
    """The flags without groups of up to ``size``."""
    labels, _ = ndimage.label(flags)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.asarray(sizes[labels] > size)


class _Patch(NamedTuple):
    """One tile in one image."""

    shot: int  # its number
    grey: np.ndarray  # (TILE_PX, TILE_PX) float32
    density: np.ndarray  # (blocks, blocks) px of the image a cell; 0 where not all of it is trusted


class _Tile(NamedTuple):
    """The kinds of a tile's blocks, the first at (``row``, ``column``), and who shows each."""

    row: int
    column: int
    kinds: np.ndarray  # (blocks, blocks)
    indices: Sequence[int]  # of the images that show some of it
    shows: BoolArray  # (images, blocks, blocks), which of the blocks each shows


class _Comparison:
    """Compares the images of one sheet after the other."""

    def __init__(self, shots: Sequence[Shot], lenses: Mapping[str, Lens], canvas: Canvas) -> None:
        if any(shot.centre_map is None for shot in shots):
            raise ValueError("an image of which no camera's place is known shows no parallax")
        self._shots = shots
        self._lenses = lenses
        self._canvas = canvas
        self._sources = Sources(shots, lenses, is_grey=True)
        self._trusted = {
            name: np.where(lens.trusted_part > 0, np.uint8(255), np.uint8(0)) for name, lens in lenses.items()
        }

    def __call__(self, plan: SheetPlan, progress: Progress) -> list[_Tile]:
        map_from_sheet = self._canvas.window(plan.row, plan.column, _SHEET_PX, _SHEET_PX).map_from_canvas
        warp = Warp(map_from_sheet, _NODE_PX)
        patches: dict[tuple[int, int], list[_Patch]] = defaultdict(list)
        images = self._sources.in_order([index for index, _ in plan.views])
        for (index, tiles), pixels in zip(plan.views, images, strict=True):
            for (column, row), patch in self._patches(index, tiles, pixels, warp):
                patches[column, row].append(patch)
        first_row = plan.row // BLOCK_PX
        first_column = plan.column // BLOCK_PX
        compared = []
        for (column, row), of_tile in patches.items():
            kinds, shows = _compare(of_tile, self._directions(of_tile, map_from_sheet, column, row))
            indices = [patch.shot for patch in of_tile]
            place = (first_row + row * _BLOCKS, first_column + column * _BLOCKS)
            compared.append(_Tile(*place, kinds, indices, shows))
        return compared

    def _patches(
        self, index: int, tiles: np.ndarray, pixels: np.ndarray, warp: Warp
    ) -> Iterator[tuple[tuple[int, int], _Patch]]:
        """By (column, row) the patches of those tiles (T, 2) of which an image shows something."""
        shot = self._shots[index]
        lens = self._lenses[shot.camera]
        nodes = warp.nodes(shot, lens, tiles)
        trusted = self._trusted[shot.camera]
        compiled = kernels()
        # As decimals, since whole grey values would add to the pattern of asphalt.
        if compiled is None:
            where = warp.pixels(nodes)
            greys = sample(pixels.astype(np.float32), where.x_px, where.y_px)
            is_trusted = sample(trusted, where.x_px, where.y_px) > 0
        else:
            greys, is_trusted = compiled.ground.look(nodes, pixels, trusted)
        density = nodes.density[:, 1::2, 1::2] * _all_of_block(is_trusted)  # in the middle of blocks
        density[density < _COARSEST] = 0
        for tile, grey, fineness in zip(tiles, greys, density.astype(np.float32), strict=True):
            if fineness.any():
                yield (int(tile[0]), int(tile[1])), _Patch(index, grey, fineness)

    def _directions(
        self, patches: Sequence[_Patch], map_from_sheet: FloatArray, column: int, row: int
    ) -> FloatArray:
        """The directions (blocks, blocks, N, 2) of blocks of a tile from cameras, over their heights."""
        at = (np.arange(_BLOCKS) + 0.5) * BLOCK_PX - 0.5
        centres_px = np.stack(np.meshgrid(at + column * TILE_PX, at + row * TILE_PX), axis=-1)
        centres_map = apply_homography(map_from_sheet, centres_px)
        cameras_map = np.array([self._shots[patch.shot].centre_map for patch in patches], dtype=np.float64)
        return (centres_map[:, :, None] - cameras_map[:, :2]) / cameras_map[:, 2:]


def _all_of_block(flags: BoolArray) -> BoolArray:
    """Which blocks (T, blocks, blocks) have all of their cells (T, TILE_PX, TILE_PX) flagged."""
    count = len(flags)
    by_column = flags.reshape(count, _BLOCKS, BLOCK_PX, TILE_PX).all(axis=2)
    return np.asarray(by_column.reshape(count, _BLOCKS, _BLOCKS, BLOCK_PX).all(axis=3))


def _compare(patches: Sequence[_Patch], directions: FloatArray) -> tuple[np.ndarray, BoolArray]:
    """The kinds of the blocks of a tile, and which of them each patch shows (N, blocks, blocks).

    ``directions`` (blocks, blocks, N, 2) are those from the cameras.
    """
    grey = np.stack([patch.grey for patch in patches])
    by_block = grey.reshape(-1, _BLOCKS, BLOCK_PX, _BLOCKS, BLOCK_PX).transpose(1, 3, 0, 2, 4)
    pattern = by_block.reshape(_BLOCKS, _BLOCKS, len(patches), -1)
    pattern -= pattern.mean(axis=-1, keepdims=True)
    power = np.einsum("...i,...i->...", pattern, pattern)
    weight = np.stack([patch.density for patch in patches], axis=-1)
    is_valid = weight > 0
    has_texture = is_valid & (power > (_TEXTURE * BLOCK_PX) ** 2)
    trusted = weight * has_texture
    for _ in range(2):
        correlation = _correlation(pattern, power, trusted)
        trusted = weight * has_texture * np.maximum(correlation, 0.05) ** 2
    agrees = has_texture & (correlation > _AGREES)
    spread = _spread(directions, agrees)
    textured = (weight * has_texture).sum(axis=-1)
    share = (weight * agrees).sum(axis=-1) / np.maximum(textured, 1e-9)
    is_ground = (agrees.sum(axis=-1) >= _FEWEST) & (spread >= _SPREAD) & (share >= _MAJORITY)
    has_pattern = textured >= _PATTERNED * weight.sum(axis=-1)
    is_standing = has_pattern & (share < _CONTRADICTED)
    kinds = np.where(is_ground, GROUND, np.where(is_standing, STANDING, PLAIN))
    kinds = np.where(is_valid.sum(axis=-1) >= _SEEN_BY, kinds, UNSEEN)
    shows = is_valid & (agrees | ~has_texture)
    return kinds.astype(np.uint8), np.moveaxis(shows, -1, 0)


def _correlation(pattern: np.ndarray, power: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Correlation (..., N) of each pattern (..., N, cells) with the weighted mean of the others.

    ``power`` (..., N) are sums of the squares of patterns. The others are all less the pattern itself.
    """
    total = weight[..., None, :] @ pattern
    with_total = (pattern @ np.swapaxes(total, -1, -2))[..., 0].astype(np.float64)
    with_itself = weight * power.astype(np.float64)
    power_of_total = np.square(total, dtype=np.float64).sum(axis=-1)
    with_others = with_total - with_itself
    power_of_others = power_of_total - 2 * weight * with_total + weight * with_itself
    # Nothing is left of float32 below a thousandth of all.
    power_of_others = np.maximum(power_of_others, 1e-6 * power_of_total)
    return np.asarray(with_others / np.maximum(np.sqrt(power_of_others * power), 1e-9))


def _spread(directions: FloatArray, agrees: BoolArray) -> FloatArray:
    """How far apart the directions (..., N, 2) of those that agree (..., N) are."""
    high = np.where(agrees[..., None], directions, -np.inf).max(axis=-2)
    low = np.where(agrees[..., None], directions, np.inf).min(axis=-2)
    return np.asarray(np.where(agrees.any(axis=-1), np.hypot(*np.moveaxis(high - low, -1, 0)), 0.0))
