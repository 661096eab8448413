"""The figures: naive maps against each other, and the corner errors along the route."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from v2hdm.experiment.drive import Matched, Measured
from v2hdm.records import FloatArray, Truth
from v2hdm.report import style

Caption = Mapping[str, Any]  # the values in a figure's caption, by their names in the template figures.md


def save_figures(
    folder: Path,
    records: Sequence[Mapping[str, Any]],
    measured: Sequence[Measured],
    progress: Callable[[int, int], None],
) -> dict[str, tuple[str, Caption]]:
    """Draw all figures into a folder; figures of single drives show the first seed of each port.

    ``progress`` is called with how many figures are drawn, of how many.

    Returns:
        By file name the kind and the caption of each figure that could be drawn.
    """
    firsts: dict[str, int] = {}
    for number, drive in enumerate(measured):
        firsts.setdefault(drive.port, number)
    work: dict[str, tuple[str, Callable[[Path], Caption | None]]] = {}
    for port, number in firsts.items():
        draw = partial(_save_shift, record=records[number], measured=measured[number])
        work[f"eni_oni_{port}.png"] = ("eni_oni", draw)
    first_drives = [measured[number] for number in firsts.values()]
    work["corners.png"] = ("corners", partial(_save_boxes, firsts=first_drives))
    captions = {}
    for done, (name, (kind, save)) in enumerate(work.items()):
        progress(done, len(work))
        caption = save(folder / name)
        if caption is not None:
            captions[name] = kind, caption
    progress(len(work), len(work))
    return captions


_HEIGHT_IN = 7.6  # of a panel, inches
_BESIDE_ROUTE_M = 12.0  # ground that the site's panel shows around the route
_CLOSE_UP_M = 6.0  # half the width of the close-up on where most markings stand together


def _save_shift(path: Path, record: Mapping[str, Any], measured: Measured) -> Caption | None:
    """Draw ENI against ONI with corner correspondences."""
    cameras, by_method = list(measured.matched.items())[-1]
    before = by_method.get("ENI")
    after = by_method.get("ONI")
    if before is None or after is None:
        return None
    common, rows, columns = np.intersect1d(before.true, after.true, return_indices=True)
    if not len(common):
        return None
    truth: Truth = record["truth"]
    true = np.array([marking.corners_map for marking in truth.map.markings])[common]
    moved = {"ENI": true + before.errors_m[rows], "ONI": true + after.errors_m[columns]}
    links = np.stack([corners.reshape(-1, 2) for corners in moved.values()], axis=1)
    polygons = [marking.corners_map for marking in truth.map.markings]
    lanes = [lane.points_map for lane in truth.map.lanes]
    with _site_and_detail(path, np.array(record["route"])) as (site, detail):
        for axes, width in ((site, 0.7), (detail, 1.5)):
            paint: dict[str, Any] = {"facecolors": style.PAINT, "edgecolors": style.TRUTH, "label": "truth"}
            axes.add_collection(PolyCollection(polygons, lw=0.4, **paint))
            axes.add_collection(LineCollection(lanes, colors=style.PAINT, lw=2.2))
            for method, corners in moved.items():
                outline: dict[str, Any] = {"facecolors": "none", "edgecolors": style.METHOD[method]}
                outlines = PolyCollection(list(corners), lw=width, zorder=3, label=method, **outline)
                axes.add_collection(outlines)
            dashes: dict[str, Any] = {"colors": "k", "ls": (0, (3, 2)), "label": "the same corner"}
            axes.add_collection(LineCollection(list(links), lw=width, zorder=4, **dashes))
        site.set_title(f"{measured.title}: ENI against ONI, {cameras}")
        centres = true.mean(axis=1)
        apart_m = np.abs(centres[:, None] - centres[None]).max(axis=2)
        neighbours = (apart_m < _CLOSE_UP_M).sum(axis=1)
        x, y = centres[neighbours.argmax()].tolist()
        detail.set(xlim=(x - _CLOSE_UP_M, x + _CLOSE_UP_M), ylim=(y - _CLOSE_UP_M, y + _CLOSE_UP_M))
        detail.set_title("Where markings are densest")
    caption: dict[str, Any] = {"drive": measured.title, "cameras": cameras, "markings": len(common)}
    for method, corners in moved.items():
        rmse_cm = 100 * np.sqrt(((corners - true) ** 2).sum(axis=2).mean())
        caption |= {method: f"{rmse_cm:.1f}", f"{method}_colour": style.WORDS[method]}
    return caption


@contextmanager
def _site_and_detail(path: Path, route_map: FloatArray) -> Iterator[tuple[Axes, Axes]]:
    """A figure of two panels, the site with the route (N, 2) in it and a close-up; legends below them."""
    low = route_map.min(axis=0) - _BESIDE_ROUTE_M
    high = route_map.max(axis=0) + _BESIDE_ROUTE_M
    extent_m = high - low
    site_width_in = _HEIGHT_IN * float(np.clip(extent_m[0] / extent_m[1], 0.5, 2.0)) + 1.6
    with style.figure(path, site_width_in + _HEIGHT_IN, _HEIGHT_IN) as fig:
        site, detail = fig.subplots(1, 2, width_ratios=[site_width_in, _HEIGHT_IN])
        site.plot(*route_map.T, color=style.ROUTE, lw=6, zorder=0, solid_capstyle="round", label="route")
        site.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        yield site, detail
        for axes in (site, detail):
            if axes.axison:
                axes.set(aspect="equal", xlabel="east (m)", ylabel="north (m)")
                axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.0), ncols=5, borderaxespad=3.5)


_BOX = "#7fb8b4"
_TOP_PERCENTILE = 99.5  # of the corner errors, where a panel ends: one bad corner would flatten the rest


def _save_boxes(path: Path, firsts: Sequence[Measured]) -> Caption | None:
    """Draw the four corner errors of each marking and their running mean."""
    sets = list(dict.fromkeys(cameras for drive in firsts for cameras in drive.matched))
    beyond = 0
    with style.figure(path, 8.0 * len(firsts), 3.1 * len(sets)) as fig:
        panels = fig.subplots(len(sets), len(firsts), squeeze=False)
        for column, drive in enumerate(firsts):
            for row, cameras in enumerate(sets):
                matched = drive.matched.get(cameras, {}).get("Opt")
                if matched is None or not len(matched.true):
                    panels[row, column].set_axis_off()
                    continue
                beyond += _draw_boxes(panels[row, column], matched)
                title = f"{drive.title}: Opt, {cameras}, {len(matched.true)} markings"
                panels[row, column].set_title(title)
        drawn = next((axes for axes in panels.flat if axes.axison), None)
        if drawn is not None:
            fig.legend(handles=drawn.get_legend_handles_labels()[0], loc="outside lower center", ncols=3)
    return {"beyond": beyond}


def _draw_boxes(axes: Axes, matched: Matched) -> int:
    """One panel; returns how many corners lie above it."""
    error_cm = 100 * np.linalg.norm(matched.errors_m, axis=2)
    low, lower, upper, high = np.percentile(error_cm, [0, 25, 75, 100], axis=1)
    number = np.arange(1, len(error_cm) + 1)
    for bottom, top, width, tint, name in (
        (low, high, 0.7, _BOX, "least to largest"),
        (lower, upper, 2.6, _BOX, "quartiles"),
    ):
        lines = np.stack([np.column_stack([number, bottom]), np.column_stack([number, top])], axis=1)
        axes.add_collection(LineCollection(list(lines), colors=tint, lw=width))
        axes.plot([], [], color=tint, lw=width, label=name)
    mean = error_cm.mean(axis=1).cumsum() / number
    axes.plot(number, mean, color="#14302e", lw=1.8, label="running mean")
    axes.annotate(
        f"{mean[-1]:.1f} cm", (number[-1], mean[-1]), xytext=(4, 0), textcoords="offset points", va="center"
    )
    top = float(np.percentile(error_cm, _TOP_PERCENTILE))
    axes.set(xlim=(0, len(number) + 1), ylim=(0, 1.05 * top), axisbelow=True)
    axes.grid(axis="y", color=style.GRID)
    axes.set(xlabel="marking, in route order", ylabel="corner error (cm)")
    return int((error_cm > 1.05 * top).sum())
