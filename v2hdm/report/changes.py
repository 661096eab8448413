"""A picture of what became of an earlier map: where markings were, where they are, and how far they moved."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import Polygon

from v2hdm.records import Change, Changes, Fate, FloatArray, HdMap
from v2hdm.report import style

_HEIGHT_IN = 7.6
_BESIDE_ROUTE_M = 12.0
_AROUND_M = 2.0
"""Ground around a change in its close-up, m."""

_MOST_CLOSE_UPS = 12

_COLOURS = {Fate.MOVED: "#3b6fb6", Fate.VANISHED: "#d0432b", Fate.NEW: "#0b7a75"}


def save_changes(path: Path, changes: Changes, hd_map: HdMap, route_map: FloatArray) -> None:
    """Draw the changes over the map as it is now, beside close-ups of the largest moves.

    Args:
        path: where the PNG goes.
        changes: what became of the earlier map's markings.
        hd_map: the map as it is now.
        route_map: vehicle positions (N, 2), m, with nan between two drives.
    """
    moved = sorted(changes.of(Fate.MOVED), key=_distance_m, reverse=True)[:_MOST_CLOSE_UPS]
    columns = 3 if len(moved) > 4 else 2
    corners = np.concatenate([route_map, *(one.corners_map for one in hd_map.markings)])
    extent_m = np.nanmax(corners, axis=0) - np.nanmin(corners, axis=0) + _BESIDE_ROUTE_M
    site_in = _HEIGHT_IN * float(np.clip(extent_m[0] / extent_m[1], 0.6, 2.0)) + 1.0
    detail_in = _HEIGHT_IN * columns / 3 if moved else 0.01
    with style.figure(path, site_in + detail_in, _HEIGHT_IN) as fig:
        if moved:
            whole, close = np.asarray(fig.subfigures(1, 2, width_ratios=[site_in, detail_in])).tolist()
            rows = -(-len(moved) // columns)
            axes = close.subplots(rows, columns, squeeze=False).ravel()
            close.suptitle(
                "The largest moves by id: dashed before, solid now; east and north (m)", fontsize=9
            )
            for place, one in zip(axes, moved, strict=False):
                _close_up(place, one, changes, hd_map)
            for place in axes[len(moved) :]:
                place.set_axis_off()
        else:
            whole = fig
        _site(whole.subplots(), changes, hd_map, route_map)


def _site(axes: Axes, changes: Changes, hd_map: HdMap, route_map: FloatArray) -> None:
    axes.plot(*route_map.T, color=style.ROUTE, lw=5, zorder=0, solid_capstyle="round", label="route")
    _draw_map(axes, hd_map)
    for fate, colour in _COLOURS.items():
        own = changes.of(fate)
        places = np.array([_outline(one).mean(axis=0) for one in own]).reshape(-1, 2)
        marker = {Fate.MOVED: "o", Fate.VANISHED: "x", Fate.NEW: "+"}[fate]
        face = "none" if fate is Fate.MOVED else colour
        label = f"{len(own)} {fate.value}"
        axes.plot(*places.T, marker, ms=9, mew=1.6, mec=colour, mfc=face, zorder=3, label=label)
        for one, place in zip(own, places, strict=True):
            axes.annotate(
                str(one.id),
                (place[0], place[1]),
                (5, 5),
                textcoords="offset points",
                fontsize=7,
                color=colour,
            )
    axes.set_title(f"{changes.same} markings as they were, {len(changes.of(Fate.NOT_SEEN))} not seen")
    axes.set_aspect("equal")
    axes.set_xlabel("east (m)")
    axes.set_ylabel("north (m)")
    axes.legend(loc="best")


def _close_up(axes: Axes, one: Change, changes: Changes, hd_map: HdMap) -> None:
    """Old outline dashed, new one solid, an arrow from centre to centre with its length and sigma."""
    assert one.before is not None
    assert one.after is not None
    assert one.shift_sigma_m is not None
    _draw_map(axes, hd_map)
    for other in changes.changes:
        colour = _COLOURS.get(other.fate, "#7a8690")
        if other.before is not None and other.fate in _COLOURS:
            axes.add_patch(_ring(other.before, colour, "--"))
        if other.after is not None and other.fate in _COLOURS:
            axes.add_patch(_ring(other.after, colour, "-"))
    begin, end = one.before.mean(axis=0), one.after.mean(axis=0)
    axes.annotate("", xy=end, xytext=begin, arrowprops={"arrowstyle": "->", "color": "#2d3439", "lw": 1.4})
    sigma_cm = 100 * float(np.sqrt(np.mean(one.shift_sigma_m**2)))
    axes.set_title(f"id {one.id}: {100 * _distance_m(one):.0f} +- {sigma_cm:.1f} cm", fontsize=8)
    middle = np.concatenate([one.before, one.after]).mean(axis=0)
    axes.set_xlim(middle[0] - _AROUND_M, middle[0] + _AROUND_M)
    axes.set_ylim(middle[1] - _AROUND_M, middle[1] + _AROUND_M)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=6)


def _ring(corners: FloatArray, colour: str, line: str) -> Polygon:
    return Polygon(corners, closed=True, fill=False, edgecolor=colour, lw=1.4, ls=line, zorder=3)


def _draw_map(axes: Axes, hd_map: HdMap) -> None:
    lanes = [lane.points_map for lane in hd_map.lanes]
    axes.add_collection(LineCollection(lanes, colors="#dfe4e8", lw=1.6))
    polygons = [one.corners_map for one in hd_map.markings]
    axes.add_collection(PolyCollection(polygons, facecolors="#c9d3da", edgecolors="#9aa4ad", lw=0.4))
    axes.autoscale_view()


def _outline(one: Change) -> FloatArray:
    corners = one.before if one.after is None else one.after
    assert corners is not None
    return corners


def _distance_m(one: Change) -> float:
    return 0.0 if one.shift_m is None else float(np.linalg.norm(one.shift_m))
