"""Figures as PNG: a map against the truth, and the route of a drive."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from v2hdm.geometry.planar import length_along
from v2hdm.records import FloatArray, HdMap, Trajectory, Truth
from v2hdm.report import metrics, style

_HEIGHT_IN = 7.6
_BESIDE_ROUTE_M = 12.0
_DETAIL_RADIUS_M = 5.5
_DETAIL_MARGIN_M = 0.15


def save_birdseye(
    path: Path,
    maps: Mapping[str, HdMap],
    best: str,
    route_map: FloatArray,
    truth: Truth,
) -> None:
    """Draw ``maps[best]`` over the truth from above, beside a close-up with all methods.

    The best map's markings are coloured by their corner error. ``route_map`` (N, 2) is in m.
    """
    with site_and_detail(path, route_map) as (site, detail):
        draw_truth(site, truth)
        _draw_best(site, maps[best], truth)
        site.set_title(f"{best}: {len(maps[best].markings)} markings, {len(maps[best].lanes)} lane lines")
        _close_up(detail, maps, best, truth)


@contextmanager
def site_and_detail(path: Path, route_map: FloatArray) -> Iterator[tuple[Axes, Axes]]:
    """A figure of two panels, the site with the route (N, 2) in it and a close-up; legends below them."""
    low, high = route_map.min(axis=0) - _BESIDE_ROUTE_M, route_map.max(axis=0) + _BESIDE_ROUTE_M
    extent_m = high - low
    site_width_in = _HEIGHT_IN * float(np.clip(extent_m[0] / extent_m[1], 0.5, 2.0)) + 1.6
    with style.figure(path, site_width_in + _HEIGHT_IN, _HEIGHT_IN) as fig:
        site, detail = fig.subplots(1, 2, width_ratios=[site_width_in, _HEIGHT_IN])
        site.plot(*route_map.T, color=style.ROUTE, lw=6, zorder=0, solid_capstyle="round", label="route")
        site.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        yield site, detail
        for axes in (site, detail):
            if axes.axison:
                style.set_map_axes(axes)
                axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.0), ncols=5, borderaxespad=3.5)


def draw_truth(axes: Axes, truth: Truth) -> None:
    """Draw the true paint."""
    polygons, lanes = [m.corners_map for m in truth.map.markings], [one.points_map for one in truth.map.lanes]
    paint = PolyCollection(polygons, facecolors=style.PAINT, edgecolors=style.TRUTH, lw=0.4, label="truth")
    axes.add_collection(paint)
    axes.add_collection(LineCollection(lanes, colors=style.PAINT, lw=2.2))


def _draw_best(axes: Axes, hd_map: HdMap, truth: Truth) -> None:
    lanes = [lane.points_map for lane in hd_map.lanes]
    axes.add_collection(LineCollection(lanes, colors=style.OKABE_ITO["sky"], lw=1.1, label="lane lines"))
    polygons = [m.corners_map for m in hd_map.markings]
    rows, columns = metrics.match_markings(hd_map.markings, truth.map.markings)
    error_cm = np.full(len(polygons), np.nan)
    for row, column in zip(rows, columns, strict=True):
        errors = metrics.corner_errors([hd_map.markings[row]], [truth.map.markings[column]])
        error_cm[row] = 100 * metrics.rms(errors)
    shown = PolyCollection(polygons, array=error_cm, cmap="viridis_r", edgecolors="face", lw=1.2)
    top = np.nanpercentile(error_cm, 98) if np.isfinite(error_cm).any() else 1.0
    shown.set_clim(0.0, max(1.0, top))
    axes.add_collection(shown)
    axes.figure.colorbar(shown, ax=axes, shrink=0.6, label="corner error of the marking (cm)")


def _close_up(axes: Axes, maps: Mapping[str, HdMap], best: str, truth: Truth) -> None:
    """The neighbourhood of one marking, every method beside the truth; what would be cut off is left out."""
    if not maps[best].markings:
        axes.set_axis_off()
        return
    centre = _common_marking(maps, best)
    polygons = _wholly_near(truth.map, centre)
    axes.add_collection(PolyCollection(polygons, facecolors=style.PAINT, edgecolors=style.TRUTH, lw=0.6))
    axes.fill([], [], facecolor=style.PAINT, edgecolor=style.TRUTH, label="truth")
    for method in sorted(maps, key=lambda name: name != best):
        look = {"color": style.METHOD.get(method, "k"), "ls": style.LINE.get(method, "-")}
        look |= {"lw": 2.2 if method == best else 1.5}
        for number, polygon in enumerate(_wholly_near(maps[method], centre)):
            closed = np.vstack([polygon, polygon[:1]])
            axes.plot(*closed.T, label=None if number else method, **look)
    style.cut_to_square(axes, centre, _DETAIL_RADIUS_M)
    axes.set_title("Close-up: the markings by every method")


def _wholly_near(hd_map: HdMap, centre: FloatArray) -> list[FloatArray]:
    """Corners (4, 2) of the markings that the close-up shows without cutting anything off."""
    reach_m = _DETAIL_RADIUS_M - _DETAIL_MARGIN_M
    return [m.corners_map for m in hd_map.markings if (np.abs(m.corners_map - centre) < reach_m).all()]


def _common_marking(maps: Mapping[str, HdMap], best: str) -> FloatArray:
    """Centre (2,) of a marking of the best map, near the middle of the drive, that all methods mapped."""
    markings = maps[best].markings
    known = set(range(len(markings)))
    for hd_map in maps.values():
        rows, _ = metrics.match_markings(markings, hd_map.markings)
        known &= set(rows)
    middle = len(markings) // 2
    chosen = min(known or {middle}, key=lambda m: abs(m - middle))
    return np.asarray(markings[chosen].corners_map.mean(axis=0))


_ARROWS = 30  # arrows along the route: enough to see a heading go wrong, few enough to see each
_MOST_POINTS = 5000  # points of the line that is drawn


def save_route(path: Path, trajectory: Trajectory) -> None:
    """Draw where the vehicle was, how fast, and where its x axis pointed."""
    stride = -(-len(trajectory.stamp_s) // _MOST_POINTS)
    stamp_s, poses = trajectory.stamp_s[::stride], trajectory.map_from_vehicle[::stride]
    place = poses[:, :2, 3]
    with style.figure(path, 8.0, 6.0) as fig:
        axes = fig.subplots()
        if len(place) > 1:
            segments = np.stack([place[:-1], place[1:]], axis=1)
            speed = np.linalg.norm(np.diff(place, axis=0), axis=1) / np.diff(stamp_s)
            line = LineCollection(list(segments), array=speed, cmap="cividis", lw=8, capstyle="round")
            line.set_clim(0.0, max(float(np.percentile(speed, 99)), 1e-9))
            axes.add_collection(line)
            fig.colorbar(line, ax=axes, shrink=0.7, label="speed (m/s)")
        _draw_headings(axes, poses)
        axes.plot(*place[0], "o", color="white", mec="#1b1e21", ms=9, zorder=4, label="start")
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        axes.set(xlabel="x: east (m)", ylabel="y: north (m)")
        axes.set_title("Route as recorded; arrows: the vehicle's x axis")
        fig.legend(loc="outside lower left")


def _draw_headings(axes: Axes, poses: FloatArray) -> None:
    """Arrows at even distances along the path, each a twentieth of the route's extent long."""
    place = poses[:, :2, 3]
    way = length_along(place)
    chosen = np.unique(np.searchsorted(way, np.linspace(0, way[-1], _ARROWS)))
    length = 0.05 * max(float(np.ptp(place, axis=0).max()), 1e-9)
    look: dict[str, Any] = {
        "color": "white",
        "edgecolor": "#1b1e21",
        "linewidth": 0.7,
        "width": 0.0028,
        "zorder": 3,
    }
    arrows = (length * poses[chosen, :2, 0]).T
    axes.quiver(*place[chosen].T, *arrows, angles="xy", scale_units="xy", scale=1, **look)
