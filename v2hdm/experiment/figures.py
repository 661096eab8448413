"""The figures of an experiment, as PNG, and the values that their captions state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from v2hdm.experiment.measures import Matched, Measured
from v2hdm.records import FloatArray
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
    for number, one in enumerate(measured):
        firsts.setdefault(one.port, number)
    work: dict[str, tuple[str, Callable[[Path], Caption | None]]] = {}
    for port, n in firsts.items():
        record, one = records[n], measured[n]
        of_port = {
            "map": partial(_save_map, record=record, measured=one),
            "eni_oni": partial(_save_shift, record=record, measured=one),
        }
        work |= {f"{kind}_{port}.png": (kind, draw) for kind, draw in of_port.items()}
    work["corners.png"] = "corners", partial(_save_boxes, firsts=[measured[n] for n in firsts.values()])
    captions = {}
    for done, (name, (kind, save)) in enumerate(work.items()):
        progress(done, len(work))
        caption = save(folder / name)
        if caption is None:
            (folder / name).unlink(missing_ok=True)
        else:
            captions[name] = kind, caption
    progress(len(work), len(work))
    return captions


LINK = "#e3001b"  # colour of lines between corners that belong together


def _drive_of(record: Mapping[str, Any]) -> str:
    return str(record["port"]) if record["seed"] is None else f"{record['port']}, seed {record['seed']}"


_SITE_IN = 9.0  # longer side of the site
_INSET_IN = 3.4
_BESIDE_M = 12.0
_WIDE = 1.6  # width of a site over its height above which the insets stand below it

_OPT, _LANE = style.METHOD["Opt"], style.METHOD["ONI"]

_NEAR_M, _FAR_M = 1.0, 6.0  # half the width, m, of an inset on a corner's error, and on a neighbourhood
_LETTERS = {"a": (2, (3, 1)), "b": (0, (-9, -9)), "c": (3, (-9, 1))}
"""Corner of each inset's square that its letter stands at, and how far from it (pt)."""

_ENI = "#3a3f44"  # ENI's outlines, where its own red is that of the correspondences


def _save_map(path: Path, record: Mapping[str, Any], measured: Measured) -> Caption | None:
    """Draw the optimised map over the truth, with three insets."""
    cameras = list(measured.matched)[-1]
    found = measured.matched[cameras].get("Opt")
    if found is None or not len(found.true):
        return None
    mapped = _mapped(record, found)
    error_cm = 100 * np.linalg.norm(found.errors_m, axis=2)
    mean_cm = error_cm.mean(axis=1)
    median, (worst, corner) = int(np.argsort(mean_cm)[len(mean_cm) // 2]), divmod(int(error_cm.argmax()), 4)
    insets = [
        (_crowd(mapped.mean(axis=1), _FAR_M), _FAR_M, "most markings together"),
        (mapped[median].mean(axis=0), _NEAR_M, f"a usual one, {mean_cm[median]:.1f} cm off"),
        (mapped[worst, corner], _NEAR_M, f"the worst corner, {error_cm.max():.1f} cm off"),
    ]
    lanes = [np.array(line) for line in record["lanes"].get("Opt", [])]
    with style.figure(path, *_size_in(record, len(insets))) as fig:
        site, others = _axes(fig, record, len(insets))
        for axes in (site, *others):
            _draw_truth(axes, record)
            axes.add_collection(LineCollection(lanes, colors=_LANE, lw=1.0, zorder=2))
            fill = _OPT if axes is site else "none"
            outlines = PolyCollection(list(mapped), facecolors=fill, edgecolors=_OPT, lw=1.4, zorder=3)
            axes.add_collection(outlines)
        for letter, axes, place in zip("abc", others, insets, strict=True):
            _frame(site, axes, place, letter)
        site.set_title(f"{_drive_of(record)}: Opt, {cameras}, {len(mapped)} markings over the truth")
        site.plot([], [], color=style.ROUTE, lw=5, label="route")
        site.fill([], [], facecolor=style.PAINT, edgecolor=style.TRUTH, label="truth")
        site.fill([], [], facecolor=_OPT, edgecolor=_OPT, label="mapped marking")
        site.plot([], [], color=_LANE, lw=1.0, label="mapped lane line")
        fig.legend(handles=site.get_legend_handles_labels()[0], loc="outside lower center", ncols=4)
    median_cm, worst_cm = f"{mean_cm[median]:.1f}", f"{error_cm.max():.1f}"
    return {"drive": _drive_of(record), "cameras": cameras, "median": median_cm, "worst": worst_cm}


def _save_shift(path: Path, record: Mapping[str, Any], measured: Measured) -> Caption | None:
    """Draw ENI against ONI with corner correspondences."""
    cameras = list(measured.matched)[-1]
    before, after = (measured.matched[cameras].get(name) for name in ("ENI", "ONI"))
    if before is None or after is None:
        return None
    common, rows, columns = np.intersect1d(before.true, after.true, return_indices=True)
    if not len(common):
        return None
    eni, oni = _mapped(record, before)[rows], _mapped(record, after)[columns]
    true = _true_corners(record)[common]
    error_cm = [100 * np.sqrt(((corners - true) ** 2).sum(axis=2).mean()) for corners in (eni, oni)]
    links = list(np.stack([eni.reshape(-1, 2), oni.reshape(-1, 2)], axis=1))
    moved = np.linalg.norm(eni - oni, axis=2).mean(axis=1)
    insets = [
        (_crowd(true.mean(axis=1), _FAR_M), _FAR_M, "most markings together"),
        (true[moved.argmax()].mean(axis=0), _FAR_M / 2, f"moved the most, by {100 * moved.max():.0f} cm"),
    ]
    with style.figure(path, *_size_in(record, len(insets))) as fig:
        site, others = _axes(fig, record, len(insets))
        for axes in (site, *others):
            _draw_truth(axes, record)
            width = 0.7 if axes is site else 1.5
            for corners, colour in ((eni, _ENI), (oni, style.METHOD["ONI"])):
                look: dict[str, Any] = {"edgecolors": colour, "lw": width, "zorder": 3}
                axes.add_collection(PolyCollection(list(corners), facecolors="none", **look))
            axes.add_collection(LineCollection(links, colors=LINK, lw=width, ls=(0, (3, 2)), zorder=4))
        for letter, axes, place in zip("ab", others, insets, strict=True):
            _frame(site, axes, place, letter)
        site.set_title(f"{_drive_of(record)}: ENI against ONI, {cameras}")
        site.plot([], [], color=_ENI, label="ENI")
        site.plot([], [], color=style.METHOD["ONI"], label="ONI")
        site.plot([], [], color=LINK, ls=(0, (3, 2)), label="the same corner")
        site.fill([], [], facecolor=style.PAINT, edgecolor=style.TRUTH, label="truth")
        fig.legend(handles=site.get_legend_handles_labels()[0], loc="outside lower center", ncols=4)
    errors = {name: f"{error:.1f}" for name, error in zip(("eni", "oni"), error_cm, strict=True)}
    return {"drive": _drive_of(record), "cameras": cameras, "markings": len(common), **errors}


_Place = tuple[FloatArray, float, str]  # an inset: its centre (2,) and half its width, m, and its title


def _true_corners(record: Mapping[str, Any]) -> FloatArray:
    return np.array(record["truth"]["corners"]).reshape(-1, 4, 2)


def _mapped(record: Mapping[str, Any], found: Matched) -> FloatArray:
    return np.asarray(_true_corners(record)[found.true] + found.errors_m)


def _crowd(centres: FloatArray, half_m: float) -> FloatArray:
    """The centre (2,) with the most others within a square about it."""
    near = (np.abs(centres[:, None] - centres[None]).max(axis=2) < half_m).sum(axis=1)
    return np.asarray(centres[int(near.argmax())])


def _layout(record: Mapping[str, Any]) -> tuple[bool, float, float]:
    """Whether the insets stand below the site, which is much wider than high; its width and height."""
    extent_m = np.ptp(np.array(record["route"]), axis=0) + 2 * _BESIDE_M
    width_in, height_in = (_SITE_IN * extent_m / extent_m.max()).tolist()
    return extent_m[0] > _WIDE * extent_m[1], width_in, height_in


def _size_in(record: Mapping[str, Any], insets: int) -> tuple[float, float]:
    below, width, height = _layout(record)
    if below:
        return max(width, insets * _INSET_IN) + 0.6, height + _INSET_IN + 1.4
    return width + _INSET_IN + 1.4, max(height, insets * (_INSET_IN + 0.5)) + 0.8


def _axes(fig: Figure, record: Mapping[str, Any], insets: int) -> tuple[Axes, list[Axes]]:
    """The site with its route, and the axes of the insets."""
    below, width, height = _layout(record)
    if below:
        grid = fig.add_gridspec(2, insets, height_ratios=[height, _INSET_IN])
        site, others = fig.add_subplot(grid[0, :]), [fig.add_subplot(grid[1, n]) for n in range(insets)]
    else:
        grid = fig.add_gridspec(insets, 2, width_ratios=[width, _INSET_IN])
        site, others = fig.add_subplot(grid[:, 0]), [fig.add_subplot(grid[n, 1]) for n in range(insets)]
    route = np.array(record["route"])
    site.plot(*route.T, color=style.ROUTE, lw=5, zorder=0, solid_capstyle="round")
    low, high = route.min(axis=0) - _BESIDE_M, route.max(axis=0) + _BESIDE_M
    site.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    for axes in (site, *others):
        style.set_map_axes(axes)
    return site, others


def _draw_truth(axes: Axes, record: Mapping[str, Any]) -> None:
    paint: dict[str, Any] = {"facecolors": style.PAINT, "edgecolors": style.TRUTH, "lw": 0.4}
    axes.add_collection(PolyCollection(list(_true_corners(record)), zorder=1, **paint))
    lanes = [np.array(line) for line in record["true_lanes"]]
    axes.add_collection(LineCollection(lanes, colors=style.PAINT, lw=2.2, zorder=0.5))


def _frame(site: Axes, inset: Axes, place: _Place, letter: str) -> None:
    """Cut an inset to a square, and mark that square on the site."""
    centre, half_m, text = place
    square = centre + half_m * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    site.plot(*square.T, color="k", lw=1.0, zorder=5)
    corner, offset = _LETTERS[letter]
    bold: dict[str, Any] = {"weight": "bold", "zorder": 6, "fontsize": 12}
    site.annotate(letter, square[corner], xytext=offset, textcoords="offset points", **bold)
    style.cut_to_square(inset, centre, half_m)
    inset.set_title(f"{letter}: {text}", fontsize=10)


_BOX = "#7fb8b4"
_TOP_PERCENTILE = 99.5  # of the corner errors, where a panel ends: one bad corner would flatten the rest


def _save_boxes(path: Path, firsts: Sequence[Measured]) -> Caption | None:
    """Draw the four corner errors of each marking and their running mean."""
    sets = list(dict.fromkeys(cameras for one in firsts for cameras in one.matched))
    beyond = 0
    with style.figure(path, 8.0 * len(firsts), 3.1 * len(sets)) as fig:
        panels = fig.subplots(len(sets), len(firsts), squeeze=False)
        for column, one in enumerate(firsts):
            for row, cameras in enumerate(sets):
                found = one.matched.get(cameras, {}).get("Opt")
                if found is None or not len(found.true):
                    panels[row, column].set_axis_off()
                    continue
                beyond += _draw_boxes(panels[row, column], found)
                panels[row, column].set_title(f"{one.title}: Opt, {cameras}, {len(found.true)} markings")
        drawn = next((axes for axes in panels.flat if axes.axison), None)
        if drawn is not None:
            fig.legend(handles=drawn.get_legend_handles_labels()[0], loc="outside lower center", ncols=3)
    return {"beyond": beyond}


def _draw_boxes(axes: Axes, found: Matched) -> int:
    """One panel; returns how many corners lie above it."""
    error_cm = 100 * np.linalg.norm(found.errors_m, axis=2)
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
    axes.set(xlabel="marking, in the order of the route", ylabel="corner error (cm)")
    return int((error_cm > 1.05 * top).sum())
