"""The site from above: the map over the truth with insets, and ENI against ONI corner by corner."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from v2hdm.experiment.figures.look import LINE, LINK, PAINT, drive_of
from v2hdm.experiment.measures import Matched, Measured
from v2hdm.records import FloatArray
from v2hdm.report import style

_HEIGHT_IN = 8.0
_BESIDE_M = 6.0
_INSET_M = 3.5
"""Half the width of an inset: a few diamonds."""

_SHIFT_M = 7.0
"""Half the width of the inset that shows how corners move."""


def save_map(path: Path, record: Mapping[str, Any], measured: Measured) -> str | None:
    """Draw the optimised map over the truth, with two insets; returns the caption."""
    cameras = list(measured.matched)[-1]
    found = measured.matched[cameras].get("Opt")
    if found is None or not len(found.true):
        return None
    error_cm = 100 * np.sqrt((found.errors_m**2).sum(axis=2).mean(axis=1))
    order = np.argsort(error_cm)
    shown = {"a": int(order[len(order) // 2]), "b": int(order[-1])}
    true, mapped = _corners(record, found)
    route = np.array(record["route"])
    with style.figure(path, _width_in(route), _HEIGHT_IN) as fig:
        grid = fig.add_gridspec(2, 2, width_ratios=[_site_in(route), _HEIGHT_IN / 2])
        site = fig.add_subplot(grid[:, 0])
        _draw_site(site, record, route)
        site.add_collection(PolyCollection(mapped, facecolors=_OPT, edgecolors=_OPT, lw=0.8, zorder=3))
        site.add_collection(LineCollection(_lines(record["lanes"].get("Opt", [])), colors=_LANE, lw=1.0))
        site.set_title(f"{drive_of(record)}: Opt, {cameras}, {len(found.mapped)} markings over the truth")
        _legend(site)
        for row, (letter, number) in enumerate(shown.items()):
            inset = fig.add_subplot(grid[row, 1])
            centre = true[number].mean(axis=0)
            _draw_truth(inset, record)
            inset.add_collection(LineCollection(_lines(record["lanes"].get("Opt", [])), colors=_LANE, lw=1.4))
            inset.add_collection(PolyCollection(mapped, facecolors="none", edgecolors=_OPT, lw=1.6))
            _frame(site, inset, centre, _INSET_M, letter)
            inset.set_title(f"{letter}: its middle marking is {error_cm[number]:.1f} cm off")
    return (
        f"The map of {drive_of(record)} (Opt, cameras: {cameras}) in teal over the true paint in grey; "
        "lanes in blue. East and north in m. The insets are the squares on the map: a about the marking "
        f"of median corner error ({error_cm[shown['a']]:.1f} cm), b about the worst one "
        f"({error_cm[shown['b']]:.1f} cm). See that the outlines run along the edges of the paint in a, "
        "and how far they leave it in b."
    )


def save_shift(path: Path, record: Mapping[str, Any], measured: Measured) -> str | None:
    """Draw ENI against ONI with corner correspondences; returns the caption."""
    cameras = list(measured.matched)[-1]
    before, after = (measured.matched[cameras].get(name) for name in ("ENI", "ONI"))
    if before is None or after is None:
        return None
    common, rows, columns = np.intersect1d(before.true, after.true, return_indices=True)
    if not len(common):
        return None
    eni, oni = _corners(record, before)[1][rows], _corners(record, after)[1][columns]
    true = np.array(record["truth"]["corners"]).reshape(-1, 4, 2)[common]
    moved_cm = 100 * np.linalg.norm(eni - oni, axis=2).mean(axis=1)
    centres = true.mean(axis=1)
    crowd = (np.linalg.norm(centres[:, None] - centres[None], axis=2) < _SHIFT_M).sum(axis=1)
    centre = centres[int(crowd.argmax())]
    route = np.array(record["route"])
    links = np.stack([eni.reshape(-1, 2), oni.reshape(-1, 2)], axis=1)
    with style.figure(path, _site_in(route) + _HEIGHT_IN, _HEIGHT_IN) as fig:
        site, inset = fig.subplots(1, 2, width_ratios=[_site_in(route), _HEIGHT_IN])
        _draw_site(site, record, route)
        _draw_truth(inset, record)
        for axes, width in ((site, 0.7), (inset, 1.6)):
            for name, corners in (("ENI", eni), ("ONI", oni)):
                axes.add_collection(
                    PolyCollection(
                        corners,
                        facecolors="none",
                        edgecolors=style.METHOD[name],
                        lw=width,
                        ls=LINE["ENI"] if name == "ENI" else "-",
                        zorder=3,
                    )
                )
            axes.add_collection(LineCollection(list(links), colors=LINK, lw=width, ls=(0, (3, 2)), zorder=4))
        for name in ("ENI", "ONI"):
            line = LINE["ENI"] if name == "ENI" else "-"
            inset.plot([], [], color=style.METHOD[name], lw=1.6, ls=line, label=name)
        inset.plot([], [], color=LINK, ls=(0, (3, 2)), label="the same corner")
        inset.fill([], [], facecolor=PAINT, edgecolor=style.TRUTH, label="truth")
        inset.legend(loc="upper right", frameon=True, edgecolor="none", framealpha=0.9)
        _frame(site, inset, centre, _SHIFT_M, "a")
        site.set_title(f"{drive_of(record)}: ENI against ONI, {cameras}")
        inset.set_title(f"a: corners moved by {moved_cm.mean():.0f} cm on average")
    return (
        f"The naive map of {drive_of(record)} (cameras: {cameras}) under the borrowed IPM (ENI, "
        "orange-red, dashed) and under the IPM that the optimisation found (ONI, blue, solid), for the "
        f"{len(common)} markings that both have; a red dashed line joins the two places of each corner. "
        "East and north in m; inset a is the square on the map. See that ONI lies on the grey paint, and "
        "that ENI is off in a pattern that turns with the vehicle: an error of the calibration, not of "
        "single sightings."
    )


_OPT, _LANE = style.METHOD["Opt"], style.METHOD["ONI"]


def _corners(record: Mapping[str, Any], found: Matched) -> tuple[FloatArray, FloatArray]:
    """True and mapped corners (M, 4, 2) of matched markings, in the same order."""
    true = np.array(record["truth"]["corners"]).reshape(-1, 4, 2)[found.true]
    return true, true + found.errors_m


def _site_in(route: FloatArray) -> float:
    extent = np.maximum(np.ptp(route, axis=0), 1.0) + 4 * _BESIDE_M
    return _HEIGHT_IN * float(np.clip(extent[0] / extent[1], 0.6, 1.8))


def _width_in(route: FloatArray) -> float:
    return _site_in(route) + _HEIGHT_IN / 2


def _lines(plain: Sequence[Any]) -> list[FloatArray]:
    return [np.array(line) for line in plain]


def _draw_truth(axes: Axes, record: Mapping[str, Any]) -> None:
    corners = np.array(record["truth"]["corners"]).reshape(-1, 4, 2)
    axes.add_collection(PolyCollection(corners, facecolors=PAINT, edgecolors=style.TRUTH, lw=0.4))
    axes.add_collection(LineCollection(_lines(record["true_lanes"]), colors=PAINT, lw=2.2, zorder=0))


def _draw_site(axes: Axes, record: Mapping[str, Any], route: FloatArray) -> None:
    axes.plot(*route.T, color=style.ROUTE, lw=5, zorder=0, solid_capstyle="round")
    _draw_truth(axes, record)
    low, high = route.min(axis=0) - 2 * _BESIDE_M, route.max(axis=0) + 2 * _BESIDE_M
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("east (m)")
    axes.set_ylabel("north (m)")


def _legend(axes: Axes) -> None:
    axes.plot([], [], color=style.ROUTE, lw=5, label="route")
    axes.fill([], [], facecolor=PAINT, edgecolor=style.TRUTH, label="truth")
    axes.fill([], [], facecolor=_OPT, edgecolor=_OPT, label="mapped marking")
    axes.plot([], [], color=_LANE, lw=1.0, label="mapped lane line")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=4)


def _frame(site: Axes, inset: Axes, centre: FloatArray, half_m: float, letter: str) -> None:
    """Cut an inset to a square, and mark that square on the site."""
    corners = centre + half_m * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    for start, end in itertools.pairwise(corners):
        site.plot(*zip(start, end, strict=True), color="k", lw=1.0, zorder=5)
    site.annotate(
        letter, corners[2], xytext=(3, 1), textcoords="offset points", weight="bold", zorder=6, fontsize=12
    )
    inset.set_xlim(centre[0] - half_m, centre[0] + half_m)
    inset.set_ylim(centre[1] - half_m, centre[1] + half_m)
    inset.set_aspect("equal")
    inset.set_xlabel("east (m)")
    inset.set_ylabel("north (m)")
