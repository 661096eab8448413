"""Errors as curves: marking by marking, while the map grows, over range, and bias against spread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from v2hdm.experiment.figures.site import colour, method_of
from v2hdm.experiment.measures import Matched, Measured
from v2hdm.experiment.plan import PAPER
from v2hdm.experiment.summary import by_port
from v2hdm.mapping.options import INCREMENTAL
from v2hdm.report import style

_BOX = "#7fb8b4"
_TOP_PERCENTILE = 99.5
"""Percentile of the corner errors at which a panel of boxes ends: one bad corner would flatten the rest."""

_EQUAL_CM = (0.5, 1, 2, 5, 10, 20, 50, 100)


def save_boxes(path: Path, firsts: Sequence[Measured]) -> str | None:
    """Draw the four corner errors of each marking and their running mean; returns the caption."""
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
    return (
        "Errors of the four corners of each marking (Opt; cm), in the order in which the vehicle passed "
        "them: box from the lower to the upper quartile, whiskers from the least to the largest of the "
        "four. The dark line is the running mean over all corners so far, its last value written beside "
        "it. See how soon it settles, and whether errors run together along the route: those drift with "
        f"the receiver. {beyond} of all corners lie above the top of their panel."
    )


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


def save_growth(path: Path, records: Sequence[Mapping[str, Any]]) -> str | None:
    """Draw the error against the size of the map that grows marking by marking; returns the caption."""
    ports = list(dict.fromkeys(record["port"] for record in records))
    if not any(record["growth"] for record in records):
        return None
    with style.figure(path, 6.4 * len(ports), 4.6) as fig:
        panels = fig.subplots(1, len(ports), squeeze=False, sharey=True)[0]
        for axes, port in zip(panels, ports, strict=True):
            for record in records:
                if record["port"] == port:
                    _draw_growth(axes, record["growth"])
            style.set_logarithmic(axes, "y")
            style.set_logarithmic(axes, "x")
            axes.set(xlabel="markings mapped so far", ylabel="corner RMSE (cm)", axisbelow=True)
            axes.set_title(f"{port}: the error while the map grows")
        fig.legend(handles=_growth_legend(records), loc="outside lower center", ncols=5)
    return (
        "Corner RMSE (cm) over the first markings of a drive, all cameras, a line per seed. Opt is "
        "the map that was grown marking by marking (mode=incremental); CNI and ENI keep a marking as it was "
        "when it was passed. See at which size Opt falls below CNI."
    )


def _draw_growth(axes: Axes, growth: Mapping[str, Any]) -> None:
    for method, points in growth.get(INCREMENTAL, {}).items():
        if points:
            counts, errors = np.array(points, dtype=np.float64).T
            axes.plot(
                counts, 100 * errors, marker=style.MARKER[method], ms=5, lw=1.3, color=colour(method),
                ls=style.LINE[method],
            )  # fmt: skip


def _growth_legend(records: Sequence[Mapping[str, Any]]) -> list[Line2D]:
    methods = dict.fromkeys(name for record in records for name in record["growth"].get(INCREMENTAL, {}))
    return [
        Line2D([], [], color=colour(name), marker=style.MARKER[name], ls=style.LINE[name], label=name)
        for name in methods
    ]


def save_ranges(path: Path, records: Sequence[Mapping[str, Any]]) -> str | None:
    """Draw the error of single sightings against their range; returns the caption."""
    known = [record for record in records if record.get("residuals")]
    if not known:
        return None
    ports = list(dict.fromkeys(record["port"] for record in known))
    cameras = list(dict.fromkeys(name for record in known for name in record["residuals"]))
    with style.figure(path, 5.6 * len(cameras), 4.0 * len(ports)) as fig:
        panels = fig.subplots(len(ports), len(cameras), squeeze=False, sharex=True, sharey=True)
        for row, port in enumerate(ports):
            for column, camera in enumerate(cameras):
                axes = panels[row, column]
                found = [
                    r["residuals"][camera]["range"]
                    for r in known
                    if r["port"] == port and camera in r["residuals"]
                ]
                _draw_ranges(axes, found)
                style.set_logarithmic(axes, "y")
                axes.set(xlabel="distance of the corner from the camera (m)", axisbelow=True)
                axes.set(ylabel="error on the ground (cm)", title=f"{port}, {camera}")
        handles = [Line2D([], [], label=name, **_line(name)) for name in style.MARKER]
        fig.legend(handles=handles, loc="outside lower center", ncols=4)
    return (
        "How far a corner of a single sighting, laid on the ground, is from the true one (cm), by its "
        "distance from the camera (m): median, with the quartiles as a band; each the mean of the seeds'. "
        "CNI, ENI and ONI lay it by their IPM and the recorded pose, Opt by its extrinsic and the "
        "adjusted pose. See that the naive methods grow with range even under a right calibration, since "
        "pitch and heading of the recorded poses err, and that the adjusted poses take most of that away."
    )


def _draw_ranges(axes: Axes, found: Sequence[Mapping[str, Any]]) -> None:
    for method in style.MARKER:
        bins: dict[float, list[list[float]]] = {}
        for one in found:
            for middle, *quartiles, _ in one.get(method, []):
                bins.setdefault(middle, []).append(quartiles)
        if not bins:
            continue
        middle = np.array(sorted(bins))
        lower, median, upper = 100 * np.array([np.mean(bins[m], axis=0) for m in middle]).T
        axes.plot(middle, median, ms=4, **_line(method))
        axes.fill_between(middle, lower, upper, color=colour(method), alpha=0.13, lw=0)


def save_balance(path: Path, measured: Sequence[Measured]) -> str | None:
    """Draw bias against spread of every map; returns the caption."""
    ports = by_port(measured)
    sets = list(dict.fromkeys(cameras for one in measured for cameras in one.rows))
    shown = ("CNI", "ENI", "Opt", "ONI", f"Opt, {PAPER}")
    with style.figure(path, 6.2 * len(ports), 0.8 + 3.6 * len(sets)) as fig:
        panels = fig.subplots(len(sets), len(ports), squeeze=False, sharex=True, sharey=True)
        for row, cameras in zip(panels, sets, strict=True):
            for axes, (port, drives) in zip(row, ports.items(), strict=True):
                for name in shown:
                    found = [one.rows[cameras][name] for one in drives if name in one.rows.get(cameras, {})]
                    pairs = [(one.spread_m, one.bias_m) for one in found if one.spread_m > 0]
                    axes.plot(*(100 * np.array(pairs).reshape(-1, 2).T), **_sign(name))
                style.set_logarithmic(axes, "x")
                style.set_logarithmic(axes, "y")
                axes.set(title=f"{port}, {cameras}", axisbelow=True)
        for axes in panels[:, 0]:
            axes.set_ylabel("bias (cm)")
        for axes in panels[-1]:
            axes.set_xlabel("spread of the corner errors (cm)")
        _equal_errors(list(panels.flat))
        handles = [
            Line2D([], [], label=name, **_sign(name))
            for name in shown if any(name in rows for one in measured for rows in one.rows.values())
        ]  # fmt: skip
        handles.append(Line2D([], [], color=style.TRUTH, ls=":", label="equal RMSE"))
        fig.legend(handles=handles, loc="outside lower center", ncols=6)
    return (
        "Bias, the length of the mean corner error, against the spread of the corner errors (cm), a sign per "
        "seed: a row of panels for each set of cameras, colour and shape are the method, hollow the paper's "
        "recipe; dotted lines join points of equal RMSE. Bias moves the whole map, as a wrong calibration or "
        "the receiver's drift do; spread is what is left. See how far the optimisation moves the points to "
        "the left and down, and which of the two is what remains."
    )


_INCREMENTAL = {"ls": (0, (2, 1)), "mfc": "white"}


def _line(method: str) -> dict[str, Any]:
    return {"color": colour(method), "marker": style.MARKER[method], "ls": style.LINE[method]}


def _sign(row: str) -> dict[str, Any]:
    """Keywords of a row of the tables drawn as single points."""
    face = "white" if PAPER in row else colour(row)
    return {"lw": 0, "marker": style.MARKER[method_of(row)], "color": colour(row), "mfc": face, "ms": 7}


def _equal_errors(panels: Sequence[Axes]) -> None:
    """Dotted lines of equal RMSE within the limits that the points have set."""
    for axes in panels:
        (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        for value in _EQUAL_CM:
            spread = np.geomspace(left, min(value * 0.99999, right), 200) if left < value else np.empty(0)
            bias = np.sqrt(value**2 - spread**2)
            inside = (bias >= bottom) & (bias <= top)
            if inside.sum() > 1:
                axes.plot(spread[inside], bias[inside], ":", color=style.TRUTH, lw=1, zorder=0)
                axes.annotate(
                    f"{value:g}", (spread[inside][0], bias[inside][0]), color=style.TRUTH, fontsize=8,
                    xytext=(2, -9), textcoords="offset points",
                )  # fmt: skip
        axes.set(xlim=(left, right), ylim=(bottom, top))
