"""The report's charts as SVG; the page's style replaces their colours in its light and dark themes."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from v2hdm.records import TWO_SIDED_95, FloatArray
from v2hdm.report.page.facts import Facts, GroundResiduals, Route
from v2hdm.report.style import OKABE_ITO, RC, draw_arrows

INK = "#1b1e21"
MUTED = "#5c646b"
GRID = "#dde1e5"
PAPER = "#fdfdfd"
"""Colours of text, axes, grid and background, which ``page.css`` replaces by its theme's."""

_ORDER = ("blue", "vermillion", "green", "purple", "orange", "sky")
# Dashes of the series in matplotlib's words: lengths of ink and gap, in widths of the line.
_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.6)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)), "-", "--")
_MARKERS = ("o", "s", "^", "D", "v", "P")

CELLS = (9, 16)  # rows and columns of the cells for mean residuals
_SINGLE_IN = 5.0  # width of a chart alone in its row: legible on a phone
_LEAST_IN_CELL = 10  # least number of observations of a mean, whose error is then a third of a single one's

# Style of the charts beside that of all figures; sizes in points.
_RC: dict[Any, Any] = RC | {
    "axes.titleweight": "normal",
    "svg.fonttype": "none",
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.linewidth": 0.8,
    "axes.titlesize": 9.5,
    "axes.titlecolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "legend.labelcolor": INK,
    "lines.linewidth": 1.6,
    "patch.linewidth": 1.2,
}


@contextmanager
def drawn_chart(name: str, width_in: float, height_in: float) -> Iterator[tuple[Figure, list[str]]]:
    """A figure, and the list that receives its SVG at the end of the block."""
    out: list[str] = []
    with mpl.rc_context({**_RC, "svg.hashsalt": name}):
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        canvas: Any = FigureCanvasSVG(figure)
        figure.patch.set(facecolor="none", edgecolor="none")
        yield figure, out
        text = io.StringIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        canvas.print_svg(text, metadata=nothing)  # savefig draws twice, the layout first
    svg = text.getvalue()
    out.append(svg[svg.index("<svg") :])


def _look(number: int) -> dict[str, Any]:
    """Colour and dashes of series ``number``, distinguishable without colour."""
    return {"color": OKABE_ITO[_ORDER[number % len(_ORDER)]], "linestyle": _DASHES[number % len(_DASHES)]}


def residual_charts(facts: Facts, residuals: GroundResiduals) -> dict[str, str]:
    """Charts of residuals: histogram, over the image, over range, along the route."""
    infos = {name: camera.calibration.info for name, camera in facts.cameras.items()}
    sizes = {name: (info.width, info.height) for name, info in infos.items()}
    assert facts.route is not None
    return {
        "histogram": _histogram_chart(residuals),
        "field": _field_chart(residuals, sizes),
        "range": _range_chart(residuals),
        "route": _route_chart(facts.route, residuals),
    }


def _histogram_chart(residuals: GroundResiduals) -> str:
    """Residuals in px, and in standard deviations with their distribution under the noise model."""
    with (
        drawn_chart("histogram", 3.5, 2.5) as (figure, first),
        drawn_chart("histogram in sigmas", 3.5, 2.5) as (other, second),
    ):
        left = figure.subplots()
        right = other.subplots()
        size_px = residuals.size_px[residuals.is_point]
        edges_px = np.linspace(0, max(float(np.percentile(size_px, 99)) if len(size_px) else 1.0, 0.1), 41)
        edges_sigma = np.linspace(0, 5, 41)
        for number, name in enumerate(residuals.cameras):
            in_camera = residuals.camera == number
            lengths = residuals.size_px[in_camera & residuals.is_point]
            _steps(left, lengths, edges_px, f"{name} ({len(lengths)})", number)
            _steps(right, residuals.distance_sigma[in_camera], edges_sigma, name, number)
        ideal = edges_sigma * np.exp(-0.5 * edges_sigma**2)
        right.plot(edges_sigma, ideal, color=MUTED, lw=1.0, label="stated noise model")
        left.set(xlabel="reprojection error (px)", ylabel="fraction of corners per px")
        right.set_xlabel("reprojection error (σ)")
        for axes in (left, right):
            axes.set_ylim(bottom=0)
            axes.set_xlim(left=0)
            axes.grid(axis="y")
            axes.legend(loc="upper right", fontsize=8.5)
    return first[0] + second[0]


def _steps(axes: Axes, values: FloatArray, edges: FloatArray, label: str, number: int) -> None:
    if len(values):
        share = np.histogram(values, edges)[0] / (len(values) * np.diff(edges))
        axes.stairs(share, edges, label=label, baseline=None, **_look(number))


def _field_chart(residuals: GroundResiduals, sizes: Mapping[str, tuple[int, int]]) -> str:
    """Mean residual over each camera's image; ``sizes`` are (width, height), px."""
    names = residuals.cameras
    fields = [_field(residuals, number, sizes[name]) for number, name in enumerate(names)]
    longest = max([float(np.linalg.norm(mean, axis=1).max()) for _, mean in fields if len(mean)] or [0.1])
    panel_in = _SINGLE_IN if len(names) == 1 else 3.5
    charts = ""
    for number, name in enumerate(names):
        width_px, height_px = sizes[name]
        with drawn_chart(f"field {name}", panel_in, 0.84 * panel_in * height_px / width_px + 0.75) as (
            figure,
            out,
        ):
            axes = figure.subplots()
            # The longest arrow spans one and a half cells.
            span = 1.5 * width_px / CELLS[1]
            colour = OKABE_ITO[_ORDER[number % len(_ORDER)]]
            places_px, means_px = fields[number]
            draw_arrows(axes, places_px, means_px, longest, span, color=colour, width=0.005, headwidth=3.6)
            axes.set(
                xlim=(0, width_px), ylim=(height_px, 0), xlabel="u (px)", ylabel="v (px)", aspect="equal"
            )
            axes.set_title(name, pad=14)  # room for the arrows' key, which the layout ignores
            for side in ("top", "right"):
                axes.spines[side].set_visible(True)
        charts += out[0]
    return charts


def _field(residuals: GroundResiduals, camera: int, size: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Centres (N, 2) of image cells with enough observations, and mean residuals (N, 2), px."""
    is_used = (residuals.camera == camera) & residuals.is_point
    place = residuals.observed_px[is_used]
    off = residuals.residual_px[is_used]
    rows, columns = CELLS
    column, row = np.floor(place / size * (columns, rows)).astype(np.int64).T
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    cell = (row * columns + column)[inside]
    count = np.bincount(cell, minlength=rows * columns)
    enough = np.flatnonzero(count >= _LEAST_IN_CELL)
    mean = np.column_stack([np.bincount(cell, off[inside, a], rows * columns) for a in (0, 1)])
    u = (enough % columns + 0.5) * size[0] / columns
    v = (enough // columns + 0.5) * size[1] / rows
    return np.column_stack([u, v]), mean[enough] / count[enough][:, None]


def _range_chart(residuals: GroundResiduals) -> str:
    """RMS residual by range, in the image and on the ground."""
    with (
        drawn_chart("range", 3.5, 2.5) as (figure, first),
        drawn_chart("range on the ground", 3.5, 2.5) as (other, second),
    ):
        left = figure.subplots()
        right = other.subplots()
        on_ground_m = residuals.range_m[np.isfinite(residuals.range_m)]
        farthest = float(np.ceil(on_ground_m.max(initial=1.0)))
        edges = np.linspace(0, farthest, max(2, min(int(farthest), 24)) + 1)
        ground_cm = 100 * np.linalg.norm(residuals.ground_m, axis=1)
        for number, name in enumerate(residuals.cameras):
            is_used = (residuals.camera == number) & residuals.is_point & np.isfinite(ground_cm)
            look = {**_look(number), "marker": _MARKERS[number % len(_MARKERS)], "ms": 3.5}
            for axes, values in ((left, residuals.size_px), (right, ground_cm)):
                middles_m, rms = _rms_by(residuals.range_m[is_used], values[is_used], edges)
                axes.plot(middles_m, rms, label=name, **look)
        left.set_ylabel("RMS residual (px)")
        right.set_ylabel("RMS ground residual (cm)")
        for axes in (left, right):
            axes.set_xlabel("distance from the camera (m)")
            axes.set_ylim(bottom=0)
            axes.grid(axis="y")
            axes.legend(loc="best", fontsize=8.5)
    return first[0] + second[0]


def _rms_by(place: FloatArray, values: FloatArray, edges: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres of bins with enough values, and their RMS."""
    bin_of = np.clip(np.searchsorted(edges, place, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(bin_of, minlength=len(edges) - 1)
    squared = np.bincount(bin_of, values**2, len(edges) - 1)
    enough = count >= _LEAST_IN_CELL
    middle = 0.5 * (edges[1:] + edges[:-1])
    return middle[enough], np.sqrt(squared[enough] / count[enough])


def _route_chart(route: Route, residuals: GroundResiduals) -> str:
    """Residuals, and corrections of the recorded poses, along the route."""
    rows = 1 if route.recorded is None else 2
    with drawn_chart("route", _SINGLE_IN, 1.7 * rows + 0.3) as (figure, out):
        panels = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
        way_m = route.way_m
        fit = panels[0]
        total = max(float(way_m[-1]), 1.0)
        edges = np.linspace(0, total, int(np.clip(total / 5, 4, 80)) + 1)
        taken_m = np.interp(residuals.taken_s, route.stamp_s, way_m)
        for number, name in enumerate(residuals.cameras):
            is_used = (residuals.camera == number) & residuals.is_point
            middles_m, rms_px = _rms_by(taken_m[is_used], residuals.size_px[is_used], edges)
            fit.plot(middles_m, rms_px, label=name, lw=1.1, **_look(number))
        fit.set_ylabel("RMS residual (px)")
        fit.set_ylim(bottom=0)
        _legend_above(fit)
        if route.recorded is not None:
            moved_cm = 100 * (np.linalg.inv(route.recorded) @ route.map_from_vehicle)[:, :2, 3]
            for axis, name in enumerate(("forward", "left")):
                shift = moved_cm[:, axis]
                band = TWO_SIDED_95 * 100 * route.sigma[:, axis]
                look = _look(axis)
                shade = {"color": look["color"], "alpha": 0.15, "lw": 0}
                panels[1].fill_between(way_m, shift - band, shift + band, **shade)
                panels[1].plot(way_m, shift, label=name, lw=1.1, **look)
            panels[1].axhline(0, color=MUTED, lw=0.6)
            panels[1].set_ylabel("correction (cm)")
            _legend_above(panels[1])
        for axes in panels:
            axes.grid(axis="y")
            axes.set_xlim(0, total)
        panels[-1].set_xlabel("distance driven (m)")
    return out[0]


def _legend_above(axes: Axes) -> None:
    """Name the lines above the axes, where the legend covers none of them."""
    count = len(axes.get_legend_handles_labels()[0])
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=count, fontsize=8.5, borderaxespad=0)


def radius_chart(radii_cm: Mapping[str, FloatArray]) -> str:
    """Cumulative distribution of corners and markings by their 95 % radius."""
    with drawn_chart("radius", _SINGLE_IN, 2.2) as (figure, out):
        axes = figure.subplots()
        top = max((float(values.max(initial=0.0)) for values in radii_cm.values()), default=1.0)
        for number, (name, values) in enumerate(radii_cm.items()):
            order = np.sort(values)
            share = 100 * np.arange(1, len(order) + 1) / max(len(order), 1)
            axes.step(
                np.concatenate([[0], order, [top]]), np.concatenate([[0], share, [100]]), where="post",
                label=name, **_look(number),
            )  # fmt: skip
        axes.set(xlabel="95 % radius (cm)", xlim=(0, max(top, 1e-3)))
        axes.set(ylabel="share (%)", ylim=(0, 102))
        axes.grid()
        axes.legend(loc="lower right", fontsize=8.5)
    return out[0]
