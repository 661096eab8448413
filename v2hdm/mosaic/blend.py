"""All images of a drive on one canvas: the mean of what they show, weighted by how finely they show it.

An image counts with the square of the number of its pixels that a pixel of the canvas covers, so that the
nearest and steepest decide: ``det(H) / w^3``, H the homography from canvas to image and ``w`` the third
coordinate of the mapped point, which is proportional to its depth. What the image is trusted for is warped
with its colours, in one pass, and counts as far as the image shows the ground by
:mod:`v2hdm.mosaic.consensus`. The canvas is done in sheets, so that memory does not grow with the drive, and
each in tiles of which an image touches only those that it shows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from kornia.geometry.transform import remap
from torch import Tensor

from v2hdm.geometry.ipm import apply_homography
from v2hdm.mosaic.consensus import Consensus
from v2hdm.mosaic.views import Canvas, Lens, Shot
from v2hdm.mosaic.warp import SHEET_PX, TILE_PX, Area, Source, Views, Warp, plan_sheets, sources
from v2hdm.progress import Steps
from v2hdm.records import FloatArray


@dataclass(frozen=True)
class Sheet:
    """A finished part of a canvas, its first pixel at (``row``, ``column``)."""

    row: int
    column: int
    # (rows, columns, 4) uint8; alpha 255 where ground is shown as finely as any is trusted for
    rgba: np.ndarray


def whole(
    canvas: Canvas,
    shots: Sequence[Shot],
    lenses: Mapping[str, Lens],
    device: str = "cpu",
    consensus: Consensus | None = None,
) -> np.ndarray:
    """A canvas in one piece: (rows, columns, 4) uint8 RGBA."""
    out = np.zeros((canvas.rows, canvas.columns, 4), dtype=np.uint8)
    for sheet in blend(canvas, shots, lenses, device, None, consensus):
        rows, columns = sheet.rgba.shape[:2]
        out[sheet.row : sheet.row + rows, sheet.column : sheet.column + columns] = sheet.rgba
    return out


def blend(
    canvas: Canvas,
    shots: Sequence[Shot],
    lenses: Mapping[str, Lens],
    device: str = "cpu",
    progress: Steps | None = None,
    consensus: Consensus | None = None,
    area: Area | None = None,
) -> Iterator[Sheet]:
    """The sheets of a canvas that any image shows, in driving order; DriveError where one cannot be read.

    Of each image counts what shows the ground by the ``consensus`` of all, everything without one.
    """
    plan = plan_sheets(canvas, shots, lenses, area)
    full_weight = _full_weight(canvas, shots, lenses)
    order = [index for _, views in plan for index, _ in views]
    images = sources(shots, lenses, device, order)
    done = 0
    for (row, column), views in plan:
        rows = min(SHEET_PX, canvas.rows - row)
        columns = min(SHEET_PX, canvas.columns - column)
        sums = _Sums((rows, columns), views, device, consensus, full_weight)
        map_from_sheet = canvas.window(row, column, rows, columns).map_from_canvas
        for index, tiles in views:
            sums.add(index, shots[index], next(images), map_from_sheet, tiles)
            done += 1
            if progress:
                progress(done, len(order))
        yield Sheet(row, column, sums.mean())


def _full_weight(canvas: Canvas, shots: Sequence[Shot], lenses: Mapping[str, Lens]) -> float:
    """The least weight of ground that an image is trusted for: in px of the image a px of the canvas."""
    least = []
    for shot in {shot.camera: shot for shot in shots}.values():
        px_from_canvas = shot.pinhole_px_from_map @ canvas.map_from_canvas
        outline = apply_homography(canvas.canvas_from_map, shot.outline_map(lenses[shot.camera]))
        third = outline @ px_from_canvas[2, :2] + px_from_canvas[2, 2]
        least.append(float((np.linalg.det(px_from_canvas) / third**3).min()))
    return min(least, default=1.0)


class _Sums:
    """The sums (tiles, 5, side, side) of weighted colours, weights and opacities on one sheet."""

    def __init__(
        self,
        shape: tuple[int, int],
        views: Views,
        device: str,
        consensus: Consensus | None,
        full_weight: float,
    ):
        self._shape = shape
        self._device = device
        self._tiles = np.unique(np.concatenate([tiles for _, tiles in views]), axis=0)
        self._at = {(int(c), int(r)): k for k, (c, r) in enumerate(self._tiles)}
        self._sums = torch.zeros((len(self._tiles), 5, TILE_PX, TILE_PX), device=device)
        self._full_weight = full_weight
        self._warp = Warp(device)
        self._consensus = consensus

    def add(
        self, index: int, shot: Shot, source: Source, map_from_sheet: FloatArray, tiles: np.ndarray
    ) -> None:
        """Add the image ``index`` to the tiles (T, 2) of (column, row) that it shows."""
        x, y, density = self._warp(source, shot, map_from_sheet, tiles)
        image = source.values.expand(len(tiles), -1, -1, -1)
        values: Tensor = remap(image, x, y, align_corners=True, normalized_coordinates=True)
        trust = values[:, 3]
        if self._consensus is not None:
            share = self._consensus.share(index, _points_of(tiles, map_from_sheet))
            trust = trust * share.to(trust)
        weight = trust * density**2
        # As opaque as the ground is trusted, wherever it is shown finely enough.
        opacity = trust * (density / self._full_weight).clamp(max=1)
        values = torch.cat([values[:, :3] * weight[:, None], weight[:, None], opacity[:, None]], dim=1)
        at = torch.tensor([self._at[int(c), int(r)] for c, r in tiles], device=self._device)
        self._sums.index_add_(0, at, values)

    def mean(self) -> np.ndarray:
        """The sheet as (rows, columns, 4) uint8 RGBA."""
        weight = self._sums[:, 3:4]
        colours = self._sums[:, [2, 1, 0]] / weight.where(weight > 0, torch.ones_like(weight))
        alpha = (255 * self._sums[:, 4:]).clamp(max=255)
        rgba = torch.cat([colours, alpha], dim=1).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()
        (rows, columns) = self._shape
        side = TILE_PX
        down = -(-rows // side)
        across = -(-columns // side)
        out = np.zeros((down, side, across, side, 4), dtype=np.uint8)
        out[self._tiles[:, 1], :, self._tiles[:, 0]] = rgba
        return out.reshape(down * side, -1, 4)[:rows, :columns]


def _points_of(tiles: np.ndarray, map_from_sheet: FloatArray) -> FloatArray:
    """The places (T, side, side, 2) of the pixels of tiles (T, 2) of (column, row)."""
    at = np.arange(TILE_PX)
    pixels = np.stack(np.meshgrid(at, at), axis=-1) + TILE_PX * tiles[:, None, None]
    points = apply_homography(map_from_sheet, pixels.reshape(-1, 2).astype(np.float64))
    return points.reshape(*pixels.shape)
