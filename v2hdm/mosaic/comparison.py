"""The same ground before and after the optimisation, side by side, where its paint tells most."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes

from v2hdm.mosaic.blend import whole
from v2hdm.mosaic.canvas import Canvas
from v2hdm.mosaic.sharpness import PaintSides
from v2hdm.mosaic.shots import Lens, Shot
from v2hdm.records import Drive, FloatArray
from v2hdm.report import style

AHEAD_M, ACROSS_M = 12.0, 8.0
"""Length and width of the ground that is compared."""

_CELL_M = 0.01
_PANEL_IN = 5.2
_BAR_M = 2.0


def richest_place(drive: Drive, sides: PaintSides, contrast: FloatArray) -> FloatArray:
    """The pose (4, 4) about which the most paint edges are to be seen, and were seen most often.

    Each image's pose is a candidate, its place the ground about it. Its worth is the sum, over the sides that
    lie on it whole, of their contrast in the mosaic times the number of images that they were found in.

    Args:
        drive: the poses.
        sides: of the map.
        contrast: theirs (S,) in the mosaic, nan where it does not show them whole.
    """
    worth = np.nan_to_num(contrast) * sides.sightings
    poses = np.stack([image.map_from_vehicle for image in drive.images])
    of_place = []
    for pose in poses:
        offset = (sides.ends_map - pose[:2, 3]) @ pose[:2, :2]
        inside = (np.abs(offset) <= [AHEAD_M / 2, ACROSS_M / 2]).all(axis=(1, 2))
        of_place.append(worth[inside].sum())
    return np.asarray(poses[int(np.argmax(of_place))])


def close_up_canvas(map_from_vehicle: FloatArray) -> Canvas:
    """The ground about a pose, the vehicle's way pointing up."""
    ahead = map_from_vehicle[:2, 0] / np.linalg.norm(map_from_vehicle[:2, 0])
    right = np.array([ahead[1], -ahead[0]])
    corner = map_from_vehicle[:2, 3] + ahead * AHEAD_M / 2 - right * ACROSS_M / 2
    rows, columns = round(AHEAD_M / _CELL_M), round(ACROSS_M / _CELL_M)
    return Canvas(corner, _CELL_M, rows, columns, (float(right[0]), float(right[1])))


def save_comparison(
    path: Path,
    map_from_vehicle: FloatArray,
    shots: Mapping[str, Sequence[Shot]],
    lenses: Mapping[str, Lens],
    captions: Mapping[str, str],
    device: str,
) -> None:
    """Draw the ground about a pose as several sets of shots show it, with a caption under each.

    Args:
        path: where the PNG goes.
        map_from_vehicle: the pose (4, 4).
        shots: by title.
        lenses: of the cameras.
        captions: by title.
        device: of torch.
    """
    canvas = close_up_canvas(map_from_vehicle)
    panels = {title: whole(canvas, own, lenses, device) for title, own in shots.items()}
    levels = _levels(list(panels.values())[-1])
    height_in = _PANEL_IN * AHEAD_M / ACROSS_M + 0.8
    with style.figure(path, _PANEL_IN * len(panels) + 0.1, height_in) as fig:
        for axes, (title, rgba) in zip(
            np.atleast_1d(fig.subplots(1, len(panels))), panels.items(), strict=True
        ):
            axes.imshow(
                _brightened(rgba, levels), extent=(0, ACROSS_M, 0, AHEAD_M), interpolation="antialiased"
            )
            axes.set_title(title)
            axes.set_xlabel(captions[title])
            axes.set(xticks=[], yticks=[])
            for spine in axes.spines.values():
                spine.set_visible(False)
            _scale_bar(axes)


def _scale_bar(axes: Axes) -> None:
    left, low = 0.4, 0.4
    axes.plot([left, left + _BAR_M], [low, low], color="white", lw=3, solid_capstyle="butt")
    axes.text(left + _BAR_M / 2, low + 0.12, f"{_BAR_M:g} m", color="white", ha="center", va="bottom")


def _levels(rgba: np.ndarray) -> tuple[float, float]:
    """Grey values of the darkest and the brightest ground."""
    grey = cv2.cvtColor(np.ascontiguousarray(rgba[..., :3]), cv2.COLOR_RGB2GRAY)[rgba[..., 3] > 0]
    low, high = np.percentile(grey, (0.2, 99.8)) if grey.size else (0.0, 255.0)
    return float(low), float(max(high, low + 1))


def _brightened(rgba: np.ndarray, levels: tuple[float, float]) -> np.ndarray:
    """The picture with its levels stretched; white where nothing was seen."""
    low, high = levels
    stretched = np.clip((rgba[..., :3].astype(np.float32) - 0.5 * low) / (high - 0.5 * low), 0, 1)
    seen = rgba[..., 3:].astype(np.float32) / 255
    return np.asarray(1 - seen * (1 - stretched))
