"""The pictures of a run: bird's-eye map against truth, growth of the error, overlay on an image."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from v2hdm.geometry.ipm import apply_in_front
from v2hdm.geometry.lens import distort_points
from v2hdm.records import CameraInfo, FloatArray, HdMap, Truth
from v2hdm.report import metrics, style
from v2hdm.report.drawing import Pen, draw_lines, with_legend
from v2hdm.store.files import whole_file

_HEIGHT_IN = 7.6
_BESIDE_ROUTE_M = 12.0
_DETAIL_RADIUS_M = 5.5
_DETAIL_MARGIN_M = 0.15
_OVERLAY_RANGE_M = 30.0

_BEFORE = Pen(style.OKABE_ITO["orange"], dash_px=(9.0, 6.0))
"""How the map is drawn by what a run began with."""

OVERLAY = {"Opt": Pen(style.OKABE_ITO["sky"])}
"""How it is drawn by what the run found."""


def save_birdseye(
    path: Path,
    maps: Mapping[str, HdMap],
    best: str,
    route_map: FloatArray,
    truth: Truth | None = None,
) -> None:
    """Draw ``maps[best]`` over the truth from above, beside a close-up with all methods.

    Args:
        path: where the PNG goes.
        maps: the map of each method, by its name.
        best: the method shown on the whole site; its markings are coloured by their corner error.
        route_map: vehicle positions (N, 2), m, with nan between two drives.
        truth: ground truth, or None on a real drive.
    """
    span_m = np.nanmax(route_map, axis=0) - np.nanmin(route_map, axis=0)
    extent_m = np.maximum(span_m, 1.0) + 2 * _BESIDE_ROUTE_M
    site_width_in = _HEIGHT_IN * float(np.clip(extent_m[0] / extent_m[1], 0.5, 2.0)) + 1.6
    with style.figure(path, site_width_in + _HEIGHT_IN, _HEIGHT_IN) as fig:
        site, detail = fig.subplots(1, 2, width_ratios=[site_width_in, _HEIGHT_IN])
        site.plot(*route_map.T, color=style.ROUTE, lw=6, zorder=0, solid_capstyle="round", label="route")
        if truth is not None:
            _draw_truth(site, truth)
        _draw_best(site, maps[best], truth)
        site.set_title(f"{best}: {len(maps[best].markings)} markings, {len(maps[best].lanes)} lane lines")
        _close_up(detail, maps, best, truth)
        for axes in (site, detail):
            axes.set_aspect("equal")
            axes.set_xlabel("east (m)")
            axes.set_ylabel("north (m)")
        site.legend(loc="upper left", bbox_to_anchor=(0.0, -0.09), ncols=4, borderaxespad=0.0)


def save_growth(path: Path, growth: Mapping[str, Sequence[tuple[int, float]]]) -> None:
    """Draw corner RMSE (m) against the number of markings mapped so far, a line per method."""
    with style.figure(path, 7.5, 4.2) as fig:
        axes = fig.subplots()
        for method, points in growth.items():
            counts, errors = np.array(points, dtype=np.float64).reshape(-1, 2).T
            if not len(counts):
                continue
            axes.plot(
                counts, 100 * errors, ls=style.LINE.get(method, "-"), marker=style.MARKER.get(method, "."),
                ms=4.5, color=style.METHOD.get(method, "k"), label=method,
            )  # fmt: skip
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:g}"[0] in "25" else "")
        axes.grid(axis="y", which="both", color="#e6eaed")
        axes.set_xlabel("markings mapped so far")
        axes.set_ylabel("corner RMSE (cm)")
        axes.set_title("Growth of the error with the map")
        fig.legend(ncols=4, loc="outside lower center", handlelength=3.2)


def save_overlay(
    path: Path,
    image: np.ndarray,
    info: CameraInfo,
    hd_map: HdMap,
    position_map: FloatArray,
    views: Mapping[str, FloatArray],
) -> None:
    """Draw a map into an image as several calibrations and poses see it.

    Args:
        path: where the picture goes.
        image: as recorded.
        info: its camera.
        hd_map: what is drawn.
        position_map: (2,) the vehicle's; what lies far from it is not drawn.
        views: by name the homography ``pinhole_px_from_map`` (3 x 3) of the ground, whose third
            coordinate is positive in front of the camera.
    """
    canvas = image.copy()
    legend: list[tuple[Pen | None, str]] = []
    for name, pinhole_px_from_map in views.items():
        pen = OVERLAY.get(name, _BEFORE)
        for line, closed in _lines_of(hd_map):
            draw_lines(canvas, _project_line(line, closed, info, position_map, pinhole_px_from_map), pen)
        said = "found by the run" if name in OVERLAY else "that the run began with"
        legend.append((pen, f"{name}: the map by the calibration and pose {said}"))
    with whole_file(path) as partial:
        partial.write_bytes(cv2.imencode(path.suffix, with_legend(canvas, legend))[1].tobytes())


def _draw_truth(axes: Axes, truth: Truth) -> None:
    polygons = [m.corners_map for m in truth.map.markings]
    axes.add_collection(
        PolyCollection(polygons, facecolors="#dfe4e8", edgecolors=style.TRUTH, lw=0.4, label="truth")
    )
    axes.add_collection(
        LineCollection([lane.points_map for lane in truth.map.lanes], colors="#dfe4e8", lw=2.2)
    )
    axes.autoscale_view()


def _draw_best(axes: Axes, hd_map: HdMap, truth: Truth | None) -> None:
    solid = style.METHOD["Opt"]
    axes.add_collection(
        LineCollection(
            [lane.points_map for lane in hd_map.lanes],
            colors=style.OKABE_ITO["sky"],
            lw=1.1,
            label="lane lines",
        )
    )
    outlines = [symbol.outline_map for symbol in hd_map.symbols]
    symbols = PolyCollection(outlines, facecolors="none", edgecolors=solid, lw=0.9, label="symbols")
    axes.add_collection(symbols)
    polygons = [m.corners_map for m in hd_map.markings]
    if truth is None:
        axes.add_collection(PolyCollection(polygons, facecolors=solid, edgecolors=solid, label="markings"))
        axes.autoscale_view()
        return
    rows, columns = metrics.match_markings(hd_map.markings, truth.map.markings)
    error_cm = np.full(len(polygons), np.nan)
    for row, column in zip(rows, columns, strict=True):
        errors = metrics.corner_errors([hd_map.markings[row]], [truth.map.markings[column]])
        error_cm[row] = 100 * np.sqrt((errors**2).sum(axis=1).mean())
    shown = PolyCollection(polygons, array=error_cm, cmap="viridis_r", edgecolors="face", lw=1.2)
    top = np.nanpercentile(error_cm, 98) if np.isfinite(error_cm).any() else 1.0
    shown.set_clim(0.0, max(1.0, top))
    axes.add_collection(shown)
    axes.figure.colorbar(shown, ax=axes, shrink=0.6, label="corner error of the marking (cm)")
    axes.autoscale_view()


def _close_up(axes: Axes, maps: Mapping[str, HdMap], best: str, truth: Truth | None) -> None:
    """The neighbourhood of one marking, every method beside the truth; what would be cut off is left out."""
    if not maps[best].markings:
        axes.set_axis_off()
        return
    centre = _common_marking(maps, best)
    if truth is not None:
        polygons = _wholly_near(truth.map, centre)
        axes.add_collection(PolyCollection(polygons, facecolors="#dfe4e8", edgecolors=style.TRUTH, lw=0.6))
        axes.fill([], [], facecolor="#dfe4e8", edgecolor=style.TRUTH, label="truth")
    for method in sorted(maps, key=lambda name: name != best):
        look = {"color": style.METHOD.get(method, "k"), "ls": style.LINE.get(method, "-")}
        look |= {"lw": 2.2 if method == best else 1.5}
        for number, polygon in enumerate(_wholly_near(maps[method], centre)):
            closed = np.vstack([polygon, polygon[:1]])
            axes.plot(*closed.T, label=None if number else method, **look)
    axes.set_xlim(centre[0] - _DETAIL_RADIUS_M, centre[0] + _DETAIL_RADIUS_M)
    axes.set_ylim(centre[1] - _DETAIL_RADIUS_M, centre[1] + _DETAIL_RADIUS_M)
    axes.set_title("Close-up: the markings by every method")
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.09), ncols=5, borderaxespad=0.0, handlelength=3.0)


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


def _lines_of(hd_map: HdMap) -> list[tuple[FloatArray, bool]]:
    outlines = [(marking.corners_map, True) for marking in hd_map.markings]
    outlines += [(symbol.outline_map, True) for symbol in hd_map.symbols]
    return outlines + [(lane.points_map, False) for lane in hd_map.lanes]


def _project_line(
    line_map: FloatArray,
    closed: bool,
    info: CameraInfo,
    position_map: FloatArray,
    pinhole_px_from_map: FloatArray,
) -> list[FloatArray]:
    """The visible pieces (N, 2), recorded px, of a ground line; densified, so lenses bend it."""
    ends = np.vstack([line_map, line_map[:1]]) if closed else line_map
    dense = np.concatenate([np.linspace(a, b, 8) for a, b in itertools.pairwise(ends)])
    points_pinhole_px = apply_in_front(pinhole_px_from_map, dense)
    margin = np.array([info.width, info.height]) * 0.1
    size = np.array([info.width, info.height])
    near = np.linalg.norm(dense - position_map, axis=1) < _OVERLAY_RANGE_M
    visible = near & ((points_pinhole_px > -margin) & (points_pinhole_px < size + margin)).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], visible.astype(int), [0]])))
    pieces = [points_pinhole_px[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 2]
    return [distort_points(info, piece) for piece in pieces]
