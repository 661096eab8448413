"""Which images show the ground, place by place: it looks alike from everywhere, what stands does not.

Images are warped onto the plane of the ground. What lies there stays where it is; a point ``h`` above it
moves by ``h`` times the change of its direction, distance on the ground over the camera's height. Blocks of
ground are compared between images by their patterns. A block is ground where images agree on its pattern from
directions that are far enough apart, and an image shows it where it agrees with them. A block without a
pattern is what the nearest block with one is.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from kornia.geometry.transform import remap
from scipy import ndimage
from torch import Tensor

from v2hdm.geometry.ipm import apply_homography
from v2hdm.mosaic.views import Canvas, Lens, Shot
from v2hdm.mosaic.warp import TILE_PX, Area, Source, Warp, plan_sheets, sources
from v2hdm.progress import Steps
from v2hdm.records import BoolArray, FloatArray

_log = logging.getLogger(__name__)

CELL_M = 0.04  # side of a cell in which patterns are compared, m; chosen
BLOCK_PX = 8  # side of a block, cells: 0.32 m; chosen
BLOCK_M = BLOCK_PX * CELL_M  # side of a block, m
_BLOCKS = TILE_PX // BLOCK_PX  # blocks along a side of a tile

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
    shows: Tensor  # (rows, columns) of 0 or 1


@dataclass(frozen=True)
class Consensus:
    """Where images show the ground: by image, in blocks of a canvas with north above."""

    canvas: Canvas
    kinds: np.ndarray  # (rows, columns) of all blocks
    by_shot: Mapping[int, Shown]

    def share(self, index: int, points_map: FloatArray) -> Tensor:
        """How far the image ``index`` shows the ground at points (..., 2): 0 to 1, smooth between blocks."""
        shown = self.by_shot.get(index)
        if shown is None:
            return torch.zeros(points_map.shape[:-1])
        offset_m = points_map - self.canvas.corner_map
        x = offset_m[..., 0] / BLOCK_M - 0.5 - shown.column
        y = -offset_m[..., 1] / BLOCK_M - 0.5 - shown.row
        x_px, y_px = (
            torch.from_numpy(np.ascontiguousarray(part)).float().reshape(1, 1, -1) for part in (x, y)
        )
        share: Tensor = remap(shown.shows[None, None], x_px, y_px, align_corners=True)
        # Nothing beyond the border of a block that shows the ground.
        return (2 * share.reshape(points_map.shape[:-1]) - 1).clamp(min=0)


def find_consensus(
    shots: Sequence[Shot],
    lenses: Mapping[str, Lens],
    canvas: Canvas,
    device: str,
    area: Area | None = None,
    progress: Steps | None = None,
) -> Consensus | None:
    """Compare all images with each other on a canvas of cells of :data:`CELL_M`.

    None where images are too few, or too near together, to tell ground anywhere.
    """
    rows = -(-canvas.rows // TILE_PX) * _BLOCKS
    columns = -(-canvas.columns // TILE_PX) * _BLOCKS
    kinds = np.full((rows, columns), UNSEEN, dtype=np.uint8)
    agreed: dict[int, list[tuple[int, int, BoolArray]]] = {}
    plan = plan_sheets(canvas, shots, lenses, area)
    order = [index for _, views in plan for index, _ in views]
    images = sources(shots, lenses, device, order)
    done = 0
    for (row, column), views in plan:
        map_from_sheet = canvas.window(row, column, canvas.rows, canvas.columns).map_from_canvas
        sheet = _Sheet(device)
        for index, tiles in views:
            sheet.add(index, shots[index], next(images), map_from_sheet, tiles)
            done += 1
            if progress:
                progress(done, len(order))
        for (tile_column, tile_row), patches in sheet.patches.items():
            top = row // BLOCK_PX + tile_row * _BLOCKS
            left = column // BLOCK_PX + tile_column * _BLOCKS
            block_kinds, shows = _compare(patches)
            kinds[top : top + _BLOCKS, left : left + _BLOCKS] = block_kinds
            for patch, flags in zip(patches, shows, strict=True):
                agreed.setdefault(patch.index, []).append((top, left, flags))
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
    return Shown(row, column, torch.from_numpy(shows))


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


@dataclass(frozen=True)
class _Patch:
    """One tile in one image: grey values, and by block how fine it is, and the camera's direction."""

    index: int
    grey: np.ndarray  # (TILE_PX, TILE_PX) float16
    density: FloatArray  # (blocks, blocks) px of the image a cell; 0 where not all of it is trusted
    direction: FloatArray  # (blocks, blocks, 2) from the camera, over its height


class _Sheet:
    """The patches of all images on one sheet, by tile."""

    def __init__(self, device: str) -> None:
        self._warp = Warp(device)
        self.patches: dict[tuple[int, int], list[_Patch]] = {}

    def add(
        self, index: int, shot: Shot, source: Source, map_from_sheet: FloatArray, tiles: np.ndarray
    ) -> None:
        """Add the image ``index`` to the tiles (T, 2) of (column, row) that it shows."""
        centre_map = shot.centre_map
        if centre_map is None:
            raise ValueError("an image of which no camera's place is known shows no parallax")
        where = self._warp(source, shot, map_from_sheet, tiles)
        image = source.values
        grey = torch.stack([0.114 * image[0] + 0.587 * image[1] + 0.299 * image[2], image[3]])
        values: Tensor = remap(
            grey.expand(len(tiles), -1, -1, -1),
            where.x,
            where.y,
            align_corners=True,
            normalized_coordinates=True,
        )
        blocks = (len(tiles), _BLOCKS, BLOCK_PX, _BLOCKS, BLOCK_PX)
        trust = values[:, 1].reshape(blocks).amin(dim=(2, 4))
        mean_density = where.density.reshape(blocks).mean(dim=(2, 4)) * (trust > 0)
        density = (mean_density * (mean_density >= _COARSEST)).cpu().numpy()
        greys = values[:, 0].half().cpu().numpy()
        at = (np.arange(_BLOCKS) + 0.5) * BLOCK_PX - 0.5
        for number, (column, row) in enumerate(tiles.tolist()):
            if not density[number].any():
                continue
            centres = np.stack(np.meshgrid(at + column * TILE_PX, at + row * TILE_PX), axis=-1)
            points_map = apply_homography(map_from_sheet, centres.reshape(-1, 2)).reshape(_BLOCKS, _BLOCKS, 2)
            direction = (points_map - centre_map[:2]) / centre_map[2]
            patch = _Patch(index, greys[number], density[number], direction)
            self.patches.setdefault((column, row), []).append(patch)


def _compare(patches: Sequence[_Patch]) -> tuple[np.ndarray, np.ndarray]:
    """The kinds of the blocks of a tile, and which of them each patch shows (N, blocks, blocks)."""
    grey = np.stack([patch.grey for patch in patches]).astype(np.float32)
    pattern = grey.reshape(-1, _BLOCKS, BLOCK_PX, _BLOCKS, BLOCK_PX).swapaxes(2, 3)
    pattern = pattern.reshape(len(patches), _BLOCKS, _BLOCKS, -1)
    pattern = pattern - pattern.mean(axis=-1, keepdims=True)
    size = np.sqrt((pattern**2).sum(axis=-1))
    weight = np.stack([patch.density for patch in patches])
    is_valid = weight > 0
    has_texture = is_valid & (size > _TEXTURE * BLOCK_PX)
    trusted = weight * has_texture
    for _ in range(2):
        correlation = _correlation(pattern, size, trusted)
        trusted = weight * has_texture * np.maximum(correlation, 0.05) ** 2
    agrees = has_texture & (correlation > _AGREES)
    direction = np.stack([patch.direction for patch in patches])
    spread = _spread(direction, agrees)
    textured = (weight * has_texture).sum(axis=0)
    share = (weight * agrees).sum(axis=0) / np.maximum(textured, 1e-9)
    is_ground = (agrees.sum(axis=0) >= _FEWEST) & (spread >= _SPREAD) & (share >= _MAJORITY)
    has_pattern = textured >= _PATTERNED * weight.sum(axis=0)
    is_standing = has_pattern & (share < _CONTRADICTED)
    kinds = np.where(is_ground, GROUND, np.where(is_standing, STANDING, PLAIN))
    kinds = np.where(is_valid.sum(axis=0) >= _SEEN_BY, kinds, UNSEEN)
    shows = is_valid & (agrees | ~has_texture)
    return kinds.astype(np.uint8), shows


def _correlation(pattern: np.ndarray, size: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Correlation (N, ...) of each pattern with the weighted mean of the others."""
    weighted = weight[..., None] * pattern
    others = weighted.sum(axis=0) - weighted
    norm = np.sqrt((others**2).sum(axis=-1)) * size
    return np.asarray((others * pattern).sum(axis=-1) / np.maximum(norm, 1e-9))


def _spread(direction: FloatArray, agrees: BoolArray) -> FloatArray:
    """How far apart the directions (N, ..., 2) of those that agree are."""
    high = np.where(agrees[..., None], direction, -np.inf).max(axis=0)
    low = np.where(agrees[..., None], direction, np.inf).min(axis=0)
    return np.asarray(np.where(agrees.any(axis=0), np.hypot(*np.moveaxis(high - low, -1, 0)), 0.0))
