"""All images of a drive on one canvas: the mean of what they show, weighted by how finely they show it.

An image counts with the square of the number of its pixels that a pixel of the canvas covers, so that the
nearest and steepest decide: ``det(H) / w^3``, H the homography from canvas to image and ``w`` the third
coordinate of the mapped point, which is proportional to its depth. What the image is trusted for is warped
with its colours, in one pass, and counts as far as the image shows the ground by
:mod:`v2hdm.mosaic.consensus`. The canvas is done in sheets, so that memory does not grow with the drive, and
each in tiles of which an image touches only those for which :mod:`v2hdm.mosaic.choice` has chosen it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.executor import HERE, Executor
from v2hdm.geometry.ipm import apply_homography
from v2hdm.mosaic.choice import Candidate, chosen
from v2hdm.mosaic.consensus import Consensus, share_of
from v2hdm.mosaic.views import Canvas, Lens, Shot
from v2hdm.mosaic.warp import (
    TILE_PX,
    Area,
    Pixels,
    SheetPlan,
    Sources,
    Views,
    Warp,
    over_sheets,
    plan_sheets,
    sample,
)
from v2hdm.native import kernels
from v2hdm.progress import Progress, Steps

SHEET_PX = 2048  # side of a sheet, px of the canvas: 84 MB of weighted sums where all of it is seen
_NODE_PX = 4  # largest distance of the nodes of a tile, px of the canvas
_NODE_M = 0.08  # largest distance of the nodes of a tile, m: a quarter of a block of the consensus
_FINEST = 1e6  # largest density that counts, in that of the coarsest ground; larger ones are in no image
_COARSER = 2  # distance of the nodes by which images are chosen, in distances of those of the warp


@dataclass(frozen=True)
class Sheet:
    """A finished part of a canvas, its first pixel at (``row``, ``column``)."""

    row: int
    column: int
    # (rows, columns, 4) uint8; alpha 255 where ground is shown as finely as any is trusted for
    rgba: np.ndarray


def whole(
    canvas: Canvas, shots: Sequence[Shot], lenses: Mapping[str, Lens], consensus: Consensus | None = None
) -> np.ndarray:
    """A canvas in one piece: (rows, columns, 4) uint8 RGBA."""
    out = np.zeros((canvas.rows, canvas.columns, 4), dtype=np.uint8)
    for sheet in blend(canvas, shots, lenses, None, consensus):
        rows, columns = sheet.rgba.shape[:2]
        out[sheet.row : sheet.row + rows, sheet.column : sheet.column + columns] = sheet.rgba
    return out


def blend(
    canvas: Canvas,
    shots: Sequence[Shot],
    lenses: Mapping[str, Lens],
    progress: Steps | None = None,
    consensus: Consensus | None = None,
    area: Area | None = None,
    executor: Executor = HERE,
) -> Iterator[Sheet]:
    """The sheets of a canvas that any image shows, as they are done; DriveError where one cannot be read.

    Of each image counts what shows the ground by the ``consensus`` of all, everything without one.
    ``progress`` and errors: see :func:`v2hdm.mosaic.warp.over_sheets`.
    """
    plan = plan_sheets(canvas, shots, lenses, area, SHEET_PX)
    yield from over_sheets(_Blend(canvas, shots, lenses, consensus), plan, progress, executor)


class _Blend:
    """Blends the images of one sheet after the other."""

    def __init__(
        self,
        canvas: Canvas,
        shots: Sequence[Shot],
        lenses: Mapping[str, Lens],
        consensus: Consensus | None,
    ) -> None:
        self._canvas = canvas
        self._shots = shots
        self._lenses = lenses
        self._consensus = consensus
        self._full_density = _full_density(canvas, shots, lenses)
        self._alphas = {
            name: np.rint(255 * lens.trusted_part).astype(np.uint8) for name, lens in lenses.items()
        }
        self._sources = Sources(shots, lenses)

    def __call__(self, plan: SheetPlan, progress: Progress) -> Sheet:
        rows = min(SHEET_PX, self._canvas.rows - plan.row)
        columns = min(SHEET_PX, self._canvas.columns - plan.column)
        map_from_sheet = self._canvas.window(plan.row, plan.column, rows, columns).map_from_canvas
        step_px = _node_step_px(self._canvas.cell_m)
        views = self._chosen(plan.views, Warp(map_from_sheet, _COARSER * step_px))
        sums = _Sums(np.concatenate([tiles for _, tiles in plan.views]))
        warp = Warp(map_from_sheet, step_px)
        images = self._sources.in_order([index for index, _ in views])
        for (index, tiles), pixels in zip(views, images, strict=True):
            self._add(sums, index, tiles, pixels, warp)
        return Sheet(plan.row, plan.column, sums.mean(rows, columns))

    def _chosen(self, views: Views, warp: Warp) -> Views:
        """The views that leave all pixels as all of them would."""
        candidates = []
        for index, tiles in views:
            shot = self._shots[index]
            lens = self._lenses[shot.camera]
            nodes = warp.nodes(shot, lens, tiles)
            places_px = (nodes.x_px.astype(np.float32), nodes.y_px.astype(np.float32))
            trust = sample(lens.trusted_part, *places_px) * share_of(self._shown(index, tiles, warp))
            counts = self._counts(trust, nodes.density.astype(np.float32))
            flat = (len(tiles), -1)
            candidates.append(
                Candidate(index, tiles, counts.weight.reshape(flat), counts.opacity.reshape(flat))
            )
        return chosen(candidates)

    def _shown(self, index: int, tiles: np.ndarray, warp: Warp) -> np.ndarray:
        """How far an image shows the ground at the nodes (T, side, side) of tiles (T, 2), float32."""
        nodes_map = warp.nodes_map(tiles)
        if self._consensus is None:
            return np.ones(nodes_map.shape[:-1], dtype=np.float32)
        return self._consensus.shown(index, nodes_map)

    def _add(self, sums: _Sums, index: int, tiles: np.ndarray, pixels: np.ndarray, warp: Warp) -> None:
        """Add what an image shows to the sums of tiles (T, 2)."""
        shot = self._shots[index]
        nodes = warp.nodes(shot, self._lenses[shot.camera], tiles)
        shown = self._shown(index, tiles, warp)
        alpha = self._alphas[shot.camera]
        compiled = kernels()
        if compiled is None:
            bgra = np.dstack([pixels, alpha])
            sums.add(tiles, self._contribution(bgra, warp.pixels(nodes), warp.between(shown)))
            return
        fullness = 1 / self._full_density
        compiled.ground.add(sums.sums, sums.slots(tiles), nodes, shown, pixels, alpha, fullness, _FINEST)

    def _contribution(self, bgra: np.ndarray, where: Pixels, shown: np.ndarray) -> list[np.ndarray]:
        """The five addends (T, pixels) of an image that shows the ground so far at pixels of tiles."""
        count = len(shown)
        *colours, alpha = cv2.split(sample(bgra, where.x_px, where.y_px).reshape(count, -1, 4))
        trust = alpha * np.float32(1 / 255) * share_of(shown).reshape(count, -1)
        counts = self._counts(trust, where.density.reshape(trust.shape))
        weighted = [colour * counts.weight for colour in colours]
        return [*weighted, counts.weight, counts.opacity]

    def _counts(self, trust: np.ndarray, density: np.ndarray) -> _Counts:
        """How much an image counts where it is trusted so far and shows the ground so finely."""
        fineness = (density * np.float32(1 / self._full_density)).clip(max=_FINEST)
        # As opaque as the ground is trusted, wherever it is shown finely enough.
        return _Counts(trust * np.square(fineness), trust * fineness.clip(max=1))


class _Counts(NamedTuple):
    """How much an image counts, place by place."""

    weight: np.ndarray
    opacity: np.ndarray


def _node_step_px(cell_m: float) -> int:
    """The distance of the nodes on a canvas."""
    step_px = _NODE_PX
    while step_px > 1 and step_px * cell_m > _NODE_M:
        step_px //= 2
    return step_px


def _full_density(canvas: Canvas, shots: Sequence[Shot], lenses: Mapping[str, Lens]) -> float:
    """The least density of ground that an image is trusted for: px of the image in a px of the canvas."""
    least = []
    for shot in {shot.camera: shot for shot in shots}.values():
        px_from_canvas = shot.pinhole_px_from_map @ canvas.map_from_canvas
        outline = apply_homography(canvas.canvas_from_map, shot.outline_map(lenses[shot.camera]))
        third = outline @ px_from_canvas[2, :2] + px_from_canvas[2, 2]
        least.append(float((np.linalg.det(px_from_canvas) / third**3).min()))
    return min(least, default=1.0)


class _Sums:
    """The sums of weighted colours (B, G, R), weights and opacities of the pixels of some tiles."""

    def __init__(self, tiles: np.ndarray) -> None:
        is_there = np.zeros(tiles.max(axis=0) + 1, dtype=np.bool_)
        is_there[tiles[:, 0], tiles[:, 1]] = True
        self._tiles = np.argwhere(is_there)
        self._slots = np.cumsum(is_there).reshape(is_there.shape) - 1
        self.sums = np.zeros((5, len(self._tiles), TILE_PX**2), dtype=np.float32)

    def slots(self, tiles: np.ndarray) -> np.ndarray:
        """The places (T,) of tiles (T, 2) of (column, row) among those of :attr:`sums`."""
        return np.asarray(self._slots[tiles[:, 0], tiles[:, 1]])

    def add(self, tiles: np.ndarray, contribution: Sequence[np.ndarray]) -> None:
        """Add what an image contributes, five times (T, pixels), to tiles (T, 2) of (column, row)."""
        slots = self.slots(tiles)
        for total, addend in zip(self.sums, contribution, strict=True):
            total[slots] += addend

    def mean(self, rows: int, columns: int) -> np.ndarray:
        """The sheet as (rows, columns, 4) uint8 RGBA."""
        side = TILE_PX
        down = -(-rows // side)
        across = -(-columns // side)
        out = np.zeros((down, side, across, side, 4), dtype=np.uint8)
        out[self._tiles[:, 1], :, self._tiles[:, 0]] = self._rgba().reshape(-1, side, side, 4)
        return out.reshape(down * side, -1, 4)[:rows, :columns]

    def _rgba(self) -> np.ndarray:
        """Colours and alpha of all tiles, their last axis."""
        compiled = kernels()
        if compiled is not None:
            return np.asarray(compiled.ground.mean(self.sums))
        weight = self.sums[3]
        colours = self.sums[2::-1] / np.where(weight > 0, weight, 1)
        alpha = (255 * self.sums[4:]).clip(max=255)
        return np.moveaxis(np.rint(np.concatenate([colours, alpha])).astype(np.uint8), 0, -1)
