"""The surveyed points in the image, over a metric grid, and on the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from v2hdm.calibration.fit import Fit
from v2hdm.calibration.residuals import Residuals
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import FloatArray
from v2hdm.report import style
from v2hdm.report.photos import project_line, project_outline

_HEIGHT_IN = 6.4
_ARROW_SHARE = 0.06  # length of the longest arrow of a right point, as a share of the picture's width
_SHORTEST = 1e-4  # arrows shorter than this share of the width are not magnified further
_GRID_LINES = 14  # grid lines at most each way; their spacing is the least of _SPACINGS_M that needs no more
_SPACINGS_M = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
_MARGIN = 0.25  # how far the grid reaches beyond the points, as a share of their extent
_LABELS_APART = 0.04  # distance between labels of the grid, as a share of the image's width
_RIGHT, _WRONG, _GRID, _ROI = style.METHOD["Opt"], style.METHOD["ENI"], "#3b6fb6", style.METHOD["CNI"]
_HALO: Any = [patheffects.withStroke(linewidth=2.2, foreground="white")]


@dataclass(frozen=True)
class _Scene:
    """The content of both panels; ``low`` and ``high`` (2,) are the corners of the ground in them, m."""

    labels: Sequence[str]
    fit: Fit
    residuals: Residuals
    roi_vehicle: FloatArray
    low: FloatArray
    high: FloatArray


def save_picture(
    path: Path,
    image: np.ndarray | None,
    labels: Sequence[str],
    fit: Fit,
    residuals: Residuals,
    roi_vehicle: FloatArray,
) -> None:
    """Draw points and residuals on an image (H, W, 3) BGR, or blank paper of its size, and on the ground."""
    points = fit.seen.points_vehicle
    margin = _MARGIN * np.ptp(points, axis=0).max()
    extent = (points.min(axis=0) - margin, points.max(axis=0) + margin)
    scene = _Scene(labels, fit, residuals, roi_vehicle, *extent)
    low, high = _plan_limits(scene)
    view_in = _HEIGHT_IN * fit.seen.info.width / fit.seen.info.height
    plan_in = _HEIGHT_IN * float(np.clip((high - low)[1] / (high - low)[0], 0.4, 1.4)) + 0.6
    with style.figure(path, view_in + plan_in, _HEIGHT_IN) as figure:
        view, plan = figure.subplots(1, 2, width_ratios=[view_in, plan_in])
        _draw_view(view, image, scene)
        _draw_plan(plan, scene)


def _plan_limits(scene: _Scene) -> tuple[FloatArray, FloatArray]:
    """The corners of the plan, which shows the camera, too, m."""
    centre = camera_centre(scene.fit.cam_from_vehicle)[:2]
    room = 0.08 * (scene.high - scene.low).max()
    return np.minimum(scene.low, centre - room), np.maximum(scene.high, centre + room)


def _draw_view(axes: Axes, image: np.ndarray | None, scene: _Scene) -> None:
    info, mounting = scene.fit.seen.info, scene.fit.cam_from_vehicle
    if image is not None:
        axes.imshow(image[..., ::-1], interpolation="lanczos")
    labelled: list[FloatArray] = []
    for along in (0, 1):
        for mark in _marks(scene.low[along], scene.high[along]):
            line = np.empty((200, 2))
            line[:, along] = mark
            line[:, 1 - along] = np.linspace(scene.low[1 - along], scene.high[1 - along], 200)
            for piece in project_line(info, mounting, line):
                axes.plot(*piece.T, color="white", lw=1.6, alpha=0.5)
                axes.plot(*piece.T, color=_GRID, lw=0.8)
                _label_line(axes, f"{'xy'[along]} {mark:g} m", piece, labelled, (info.width, info.height))
    for piece in project_outline(info, mounting, scene.roi_vehicle):
        axes.plot(*piece.T, color=_ROI, lw=1.5)
    style.set_image_axes(axes, -0.5, info.width - 0.5, info.height - 0.5, -0.5)
    axes.set_aspect("equal")
    _draw_residuals(axes, scene, scene.fit.seen.points_px, -scene.residuals.off_px, info.width, "px")
    axes.set_title(f"{info.name}: grid of the ground, ROI, arrows from the clicked to the predicted pixel")


def _marks(low: float, high: float) -> FloatArray:
    spacing = next((s for s in _SPACINGS_M if (high - low) / s <= _GRID_LINES), _SPACINGS_M[-1])
    return spacing * np.arange(np.ceil(low / spacing), np.floor(high / spacing) + 1)


def _label_line(
    axes: Axes, text: str, piece: FloatArray, labelled: list[FloatArray], size: tuple[int, int]
) -> None:
    """Write ``text`` where the image shows the left or near end of a line, unless another label is there."""
    apart = _LABELS_APART * size[0]
    inside = piece[((piece > (4, 8)) & (piece < (size[0] - apart, size[1] - 4))).all(axis=1)]
    if not len(inside):
        return
    at = inside[-1] if text.startswith("x") else inside[0]
    if all(np.hypot(*(at - other)) > apart for other in labelled):
        axes.annotate(text, (at[0], at[1]), color=_GRID, fontsize=8, path_effects=_HALO)
        labelled.append(at)


def _draw_plan(axes: Axes, scene: _Scene) -> None:
    """Forward is up, left is left: the axes show y to the left and x upward."""
    fit, points = scene.fit, scene.fit.seen.points_vehicle
    low, high = _plan_limits(scene)
    span = float((high - low).max())
    centre, view = camera_centre(fit.cam_from_vehicle)[:2], fit.cam_from_vehicle[2, :2]
    tip = centre + 0.12 * span * view / max(float(np.hypot(*view)), 1e-9)
    axes.add_patch(Polygon(scene.roi_vehicle[:, ::-1], closed=True, fill=False, ec=_ROI, lw=1.5, label="ROI"))
    axes.plot(centre[1], centre[0], "s", color="k", ms=5, label="camera")
    axes.annotate(
        "", (tip[1], tip[0]), (centre[1], centre[0]), arrowprops={"arrowstyle": "-|>", "color": "k"}
    )
    axes.set_xlabel("y, left (m)")
    factor = _draw_residuals(axes, scene, points, scene.residuals.off_m, span, "cm")
    angles = np.linspace(0, 2 * np.pi, 60)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    for place, radius in zip(points, 2 * factor * scene.residuals.known_m, strict=True):
        if radius < span:
            axes.plot(*(place + radius * circle).T[::-1], color="#9aa4ad", lw=0.8)
    axes.set(xlim=(high[1], low[1]), ylim=(low[0], high[0]), aspect="equal", axisbelow=True)
    axes.grid(color=style.GRID, lw=0.6)
    axes.set(ylabel="x, forward (m)", title="from above; circles: 2 sigmas")
    axes.legend(loc="upper right", fontsize=8)


def _draw_residuals(
    axes: Axes, scene: _Scene, at: FloatArray, off: FloatArray, size: float, unit: str
) -> float:
    """Draw points and residuals, those of right points magnified by the factor that is returned.

    The label of the first axis says so.
    """
    right = scene.fit.is_right
    length = np.hypot(*off.T)
    longest = float(np.nanmax(length[right], initial=0.0))
    factor = _ARROW_SHARE * size / max(longest, _SHORTEST * size)
    for k, (label, is_right) in enumerate(zip(scene.labels, right.tolist(), strict=True)):
        # That of a wrong point may be as long as the picture: it is drawn true to scale.
        tip = at[k] + (factor if is_right else 1.0) * off[k]
        (a, b), (c, d) = (at[k], tip) if unit == "px" else (at[k, ::-1], tip[::-1])
        colour = _RIGHT if is_right else _WRONG
        sign = "o" if is_right else "x"
        axes.plot(a, b, sign, ms=6 if is_right else 9, mfc="none", mec=colour, mew=1.8, path_effects=_HALO)
        look: dict[str, Any] = {"color": colour, "fontsize": 8, "path_effects": _HALO}
        axes.annotate(label, (a, b), (6, -10), textcoords="offset points", **look)
        if np.isfinite(tip).all():
            arrow = {"arrowstyle": "->", "color": colour, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", (c, d), (a, b), arrowprops=arrow, annotation_clip=True)
    if unit == "cm":
        words = f"arrows and circles {factor:.0f} times as large; longest {100 * longest:.1f} cm"
    else:
        words = f"arrows {factor:.0f} times as long; the longest is {longest:.2f} px"
    if not right.all():
        words += f"; crosses {'contradict the others, ' if unit == 'px' else ''}true to scale"
    axes.set_xlabel(f"{axes.get_xlabel()}\n{words}")
    return factor
