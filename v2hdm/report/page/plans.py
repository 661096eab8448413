"""The site from above as SVG: what was mapped, and how often each piece of ground was seen."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from v2hdm.records import FloatArray
from v2hdm.report.coverage import ENOUGH_VIEWS, Coverage
from v2hdm.report.page.charts import INK, MUTED, drawn_chart
from v2hdm.report.page.facts import Facts
from v2hdm.report.page.listing import route_map_of
from v2hdm.report.style import OKABE_ITO
from v2hdm.report.weak import Place

_WIDTH_IN = 7.2  # width of a plan: that of an A4 page between its margins
_TALLEST_IN = 7.6  # tallest plan that leaves room for its caption on a page
_MARGIN_M = 4.0  # of ground around the map
_STEPS = (1, ENOUGH_VIEWS, 6, 12, 24)
"""First numbers of images of the classes of coverage: too few, enough, and twice as many each."""
# Blues from light to dark, the first one a warning: what is there was seen too seldom to be mapped.
_COLOURS = ("#f2c9a8", "#cfe3f1", "#94c1e0", "#4f97c8", "#1f6aa5")
_GROUND = "#e4e8eb"  # covered ground under the plan of the markings
_MOST_PIXELS = 1400  # longer side of the ground's picture within a plan
_MOST_DRAWN = 3000  # markings above which a plan holds a picture of them: 20,000 outlines take 4 MB; chosen
_PICTURE_DPI = 220  # resolution of that picture; chosen


def site_plan(facts: Facts, places: Sequence[Place] = ()) -> str:
    """Plan of the map: covered ground, markings, lane lines, route, and the numbered weak places."""
    if facts.hd_map is None or not (facts.hd_map.markings or facts.hd_map.lanes):
        return ""
    box = _box(facts)
    with drawn_chart("plan", *_size_in(box)) as (figure, out):
        axes = figure.subplots()
        if facts.coverage is not None and facts.coverage.views.size:
            _show(axes, facts.coverage, ListedColormap([_GROUND]), None, facts.coverage.views >= ENOUGH_VIEWS)
        _draw_route(axes, route_map_of(facts))
        lanes = LineCollection([lane.points_map for lane in facts.hd_map.lanes], colors=OKABE_ITO["sky"])
        lanes.set(linewidths=0.8, label="lane lines")
        axes.add_collection(lanes)
        # An array is drawn faster than a list, though matplotlib's types know the list alone.
        quads: Any = np.array([marking.corners_map for marking in facts.hd_map.markings]).reshape(-1, 4, 2)
        outlines = [symbol.outline_map for symbol in facts.hd_map.symbols]
        paint: dict[str, Any] = {"facecolors": OKABE_ITO["blue"], "edgecolors": OKABE_ITO["blue"]}
        is_picture = len(quads) + len(outlines) > _MOST_DRAWN
        figure.set_dpi(_PICTURE_DPI if is_picture else figure.dpi)
        paint |= {"linewidths": 0.6, "rasterized": is_picture}
        axes.add_collection(PolyCollection(quads, label="markings", **paint))
        axes.add_collection(PolyCollection(outlines, **paint))
        _draw_places(axes, places)
        _finish(figure, axes, box)
    return out[0]


def coverage_plan(facts: Facts, places: Sequence[Place] = ()) -> str:
    """How many images show each piece of ground, the route, and the numbered weak places."""
    coverage = facts.coverage
    if coverage is None or not (coverage.views > 0).any():
        return ""
    box = _box(facts)
    with drawn_chart("coverage", *_size_in(box)) as (figure, out):
        axes = figure.subplots()
        draw_views(axes, coverage)
        _draw_route(axes, route_map_of(facts))
        _draw_places(axes, places)
        _finish(figure, axes, box, view_patches())
    return out[0]


def draw_views(axes: Axes, coverage: Coverage) -> None:
    """Shade the ground by the number of images that show it."""
    steps = BoundaryNorm([*_STEPS, _STEPS[-1] * 1000], len(_COLOURS))
    _show(axes, coverage, ListedColormap(_COLOURS), steps, coverage.views > 0)


def view_patches() -> list[Patch]:
    """The legend of :func:`draw_views`."""
    ends = [f"{first} to {last - 1}" for first, last in pairwise(_STEPS)]
    names = [*ends, f"{_STEPS[-1]} or more"]
    patches = [Patch(facecolor=colour, label=name) for colour, name in zip(_COLOURS, names, strict=True)]
    patches[0].set_label(f"{names[0]} images: too few")
    return patches


def _show(axes: Axes, coverage: Coverage, colours: ListedColormap, norm: Any, shown: np.ndarray) -> None:
    """Draw cells of ground as a picture."""
    stride = max(1, -(-max(coverage.views.shape) // _MOST_PIXELS))
    views = np.ma.masked_where(~shown, coverage.views)[::stride, ::stride]
    rows, columns = coverage.views.shape
    east_m = coverage.west_m + columns * coverage.cell_m
    south_m = coverage.north_m - rows * coverage.cell_m
    extent = (coverage.west_m, east_m, south_m, coverage.north_m)
    axes.imshow(views, cmap=colours, norm=norm, extent=extent, interpolation="nearest", zorder=0)


def _draw_route(axes: Axes, route_map: FloatArray) -> None:
    if len(route_map) < 2:
        return
    axes.plot(route_map[:, 0], route_map[:, 1], color=INK, lw=0.9, ls=(0, (5, 2)), label="route")
    axes.plot(*route_map[0], "o", color=INK, ms=4)


def _draw_places(axes: Axes, places: Sequence[Place]) -> None:
    """Ring the weak places with their numbers in the table beside."""
    look: dict[str, Any] = {"mfc": "none", "mec": OKABE_ITO["vermillion"], "mew": 1.4, "ls": "none"}
    for number, place in enumerate(places, 1):
        label = "drive again" if number == 1 else None
        at = place.centre_map.tolist()
        axes.plot(*place.centre_map, "o", ms=11, label=label, **look)
        box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
        axes.annotate(
            str(number), (at[0], at[1]), xytext=(9, 7), textcoords="offset points", fontsize=8.5,
            fontweight="bold", color=OKABE_ITO["vermillion"], bbox=box, zorder=5,
        )  # fmt: skip


def _box(facts: Facts) -> FloatArray:
    """South-west and north-east corner (2, 2), m, of what a plan shows."""
    hd_map = facts.hd_map
    points = [route_map_of(facts)]
    if hd_map is not None:
        points += [marking.corners_map for marking in hd_map.markings]
        points += [lane.points_map for lane in hd_map.lanes]
        points += [symbol.outline_map for symbol in hd_map.symbols]
    coverage = facts.coverage
    if coverage is not None and (coverage.views > 0).any():
        row, column = np.nonzero(coverage.views)
        east_m = coverage.west_m + coverage.cell_m * np.array([column.min(), column.max() + 1])
        north_m = coverage.north_m - coverage.cell_m * np.array([row.max() + 1, row.min()])
        points.append(np.column_stack([east_m, north_m]))
    every_point = np.concatenate(points)
    return np.array([every_point.min(axis=0) - _MARGIN_M, every_point.max(axis=0) + _MARGIN_M])


def _size_in(box: FloatArray) -> tuple[float, float]:
    """Width and height of a plan of that ground, in, with room for its axes and legend."""
    width_m, height_m = (box[1] - box[0]).tolist()
    inner_in = _WIDTH_IN - 0.8
    height_in = min(inner_in * height_m / width_m, _TALLEST_IN - 0.9)
    return max(min(_WIDTH_IN, height_in * width_m / height_m + 0.9), 4.2), max(height_in, 1.6) + 0.9


def _finish(figure: Figure, axes: Axes, box: FloatArray, more: Sequence[Patch] = ()) -> None:
    """Axes in metres, true to scale, with the legend above."""
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlim=box[:, 0], ylim=box[:, 1], xlabel="east (m)", ylabel="north (m)")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(color=MUTED)
    handles, labels = axes.get_legend_handles_labels()
    handles = [*more, *handles]
    names = [*(str(patch.get_label()) for patch in more), *labels]
    figure.legend(
        handles, names, loc="outside upper left", ncols=3, fontsize=8.5, handlelength=1.6, columnspacing=1.2
    )
