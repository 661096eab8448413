"""How sharp the paint of a mosaic is: the width of its edges, wherever they lie.

Across every side of every mapped marking a profile of grey values is taken, the mean over the side's middle
part. The width of an edge is the paint's contrast over the steepest slope of that profile: the distance over
which a ramp of that slope rises from ground to paint. Slopes are taken over one pixel of the mosaic.

The steepest slope is looked for within :data:`REACH_M` to either side, so that paint which is out of place is
not held to be blurred. Where paint appears twice, each image of it has half the contrast and half the slope,
and the width says so, for all mosaics that are compared share one contrast: the largest that any of them
shows there. Blending only ever lowers it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.geometry.ipm import apply_homography
from v2hdm.mosaic.blend import whole
from v2hdm.mosaic.shots import Canvas, Lens, Shot
from v2hdm.records import Drive, FloatArray, HdMap
from v2hdm.report import style

REACH_M = 0.75  # half of the length of a profile, m: misplaced paint is found within it
_MIDDLE = (0.2, 0.8)  # part of a side over which its profile is averaged: without its corners
_SAMPLES = 12  # places along a side's middle part
_LEAST_SIDE_M = 0.4  # shorter sides have no middle part that pixels of some centimetres would resolve, m
_SEEN_ALPHA = 128  # alpha from which the mosaic counts as showing the ground


@dataclass(frozen=True)
class Edges:
    """The largest ``slope`` (S,), grey values per m, and ``contrast`` (S,), grey values, of S paint sides.

    Both are nan where the mosaic does not show the whole profile.
    """

    slope: FloatArray
    contrast: FloatArray

    def with_those_of(self, other: Edges) -> Edges:
        """These edges, completed by those of another part of the same mosaic."""
        known = np.isfinite(self.slope)
        return Edges(np.where(known, self.slope, other.slope), np.where(known, self.contrast, other.contrast))


@dataclass(frozen=True)
class PaintSides:
    """S sides of markings and symbols: ``ends_map`` (S, 2, 2), m, and the ``sightings`` (S,) of each."""

    ends_map: FloatArray
    sightings: FloatArray


def paint_sides(hd_map: HdMap) -> PaintSides:
    """The sides of a map's markings and symbols that are long enough to be measured."""
    painted = [(m.corners_map, m.sightings) for m in hd_map.markings]
    painted += [(s.outline_map, s.sightings) for s in hd_map.symbols]
    ends = [np.stack([outline, np.roll(outline, -1, axis=0)], axis=1) for outline, _ in painted]
    all_ends = np.concatenate([np.empty((0, 2, 2)), *ends])
    sightings = np.repeat([float(seen) for _, seen in painted], [len(own) for own in ends])
    long = np.linalg.norm(all_ends[:, 1] - all_ends[:, 0], axis=1) >= _LEAST_SIDE_M
    return PaintSides(all_ends[long], sightings[long])


def no_edges(count: int) -> Edges:
    """Edges of ``count`` sides that no mosaic has shown yet."""
    return Edges(np.full(count, np.nan), np.full(count, np.nan))


def measure_edges(rgba: np.ndarray, canvas: Canvas, sides: FloatArray) -> Edges:
    """The edges across sides (S, 2, 2), m, in a mosaic (rows, columns, 4)."""
    out = no_edges(len(sides))
    points = apply_homography(canvas.canvas_from_map, _profiles(sides, canvas.cell_m / 2))
    low, high = points.min(axis=(1, 2)), points.max(axis=(1, 2))
    inside = (low >= 0).all(axis=1) & (high <= [canvas.columns - 1, canvas.rows - 1]).all(axis=1)
    if not inside.any():
        return out
    grey = cv2.cvtColor(np.ascontiguousarray(rgba[..., :3]), cv2.COLOR_RGB2GRAY).astype(np.float32)
    seen = rgba[..., 3].astype(np.float32)
    for k in np.flatnonzero(inside):
        x, y = points[k].astype(np.float32).transpose(2, 0, 1)
        if cv2.remap(seen, x, y, cv2.INTER_NEAREST).min() < _SEEN_ALPHA:
            continue
        profile = cv2.remap(grey, x, y, cv2.INTER_LINEAR).mean(axis=0)
        out.slope[k] = np.abs(profile[2:] - profile[:-2]).max() / canvas.cell_m
        out.contrast[k] = np.ptp(profile)
    return out


def edge_widths_m(mosaics: Sequence[Edges]) -> list[FloatArray]:
    """The widths, m, of those edges that all mosaics show, for each mosaic: contrast over slope."""
    contrast = np.max([one.contrast for one in mosaics], axis=0)
    shown = np.all([np.isfinite(one.slope) & (one.slope > 0) for one in mosaics], axis=0)
    return [contrast[shown] / one.slope[shown] for one in mosaics]


def _profiles(sides: FloatArray, step_m: float) -> FloatArray:
    """Points (S, along, across, 2), m, of the profiles across sides (S, 2, 2)."""
    along = sides[:, 1] - sides[:, 0]
    unit = along / np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    at = np.linspace(*_MIDDLE, _SAMPLES)
    across = np.linspace(-REACH_M, REACH_M, round(2 * REACH_M / step_m) + 1)
    middle = sides[:, 0, None] + at[:, None] * along[:, None]
    return np.asarray(middle[:, :, None] + across[:, None] * normal[:, None, None])


AHEAD_M, ACROSS_M = 12.0, 8.0  # length and width of the ground that is compared
_CELL_M = 0.01
_PANEL_IN = 5.2
_BAR_M = 2.0


def richest_place(drive: Drive, sides: PaintSides, contrast: FloatArray) -> FloatArray:
    """The image's pose (4, 4) about which the most paint edges are to be seen, and were seen most often.

    Its worth is the sum, over the sides that lie whole on the ground about it, of their ``contrast`` (S,) in
    the mosaic, nan where it does not show them, times the number of images that they were found in.
    """
    worth = np.nan_to_num(contrast) * sides.sightings

    def of_place(pose: FloatArray) -> float:
        offset = (sides.ends_map - pose[:2, 3]) @ pose[:2, :2]
        inside = (np.abs(offset) <= [AHEAD_M / 2, ACROSS_M / 2]).all(axis=(1, 2))
        return float(worth[inside].sum())

    return max((image.map_from_vehicle for image in drive.images), key=of_place)


def close_up_canvas(map_from_vehicle: FloatArray) -> Canvas:
    """The ground about a pose, the vehicle's way pointing up."""
    ahead = map_from_vehicle[:2, 0] / np.linalg.norm(map_from_vehicle[:2, 0])
    right = np.array([ahead[1], -ahead[0]])
    corner = map_from_vehicle[:2, 3] + ahead * AHEAD_M / 2 - right * ACROSS_M / 2
    rows, columns = round(AHEAD_M / _CELL_M), round(ACROSS_M / _CELL_M)
    return Canvas(corner, _CELL_M, rows, columns, (float(right[0]), float(right[1])))


class Panel(NamedTuple):
    """One of the pictures that are compared."""

    title: str
    caption: str
    shots: Sequence[Shot]


def save_comparison(
    path: Path, map_from_vehicle: FloatArray, panels: Sequence[Panel], lenses: Mapping[str, Lens], device: str
) -> None:
    """Draw the ground about a pose (4, 4) as several sets of shots show it, side by side, as PNG."""
    canvas = close_up_canvas(map_from_vehicle)
    pictures = [whole(canvas, panel.shots, lenses, device) for panel in panels]
    last = pictures[-1]
    grey = cv2.cvtColor(np.ascontiguousarray(last[..., :3]), cv2.COLOR_RGB2GRAY)[last[..., 3] > 0]
    low, high = np.percentile(grey, (0.2, 99.8)) if grey.size else (0.0, 255.0)
    height_in = _PANEL_IN * AHEAD_M / ACROSS_M + 0.8
    with style.figure(path, _PANEL_IN * len(panels) + 0.1, height_in) as fig:
        every = np.atleast_1d(fig.subplots(1, len(panels)))
        for axes, panel, rgba in zip(every, panels, pictures, strict=True):
            shown = _brightened(rgba, low, max(high, low + 1))
            axes.imshow(shown, extent=(0, ACROSS_M, 0, AHEAD_M), interpolation="antialiased")
            axes.set(title=panel.title, xlabel=panel.caption, xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
            axes.plot([0.4, 0.4 + _BAR_M], [0.4, 0.4], color="white", lw=3, solid_capstyle="butt")
            axes.text(0.4 + _BAR_M / 2, 0.52, f"{_BAR_M:g} m", color="white", ha="center", va="bottom")


def _brightened(rgba: np.ndarray, low: float, high: float) -> np.ndarray:
    """The picture with its levels stretched; white where nothing was seen."""
    stretched = np.clip((rgba[..., :3].astype(np.float32) - 0.5 * low) / (high - 0.5 * low), 0, 1)
    seen = rgba[..., 3:].astype(np.float32) / 255
    return np.asarray(1 - seen * (1 - stretched))
