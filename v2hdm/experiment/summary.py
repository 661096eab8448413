"""An experiment's tables and figures, and its text: the paper's claims against what was measured."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from v2hdm import __version__
from v2hdm.experiment.drive import ROWS, Matched, Measured, Row
from v2hdm.experiment.plan import RECIPES, ExperimentConfig
from v2hdm.records import FloatArray, Truth
from v2hdm.report import style
from v2hdm.store.files import replace_csv, replace_text

_CM = 100.0

COLUMNS: Mapping[str, tuple[Callable[[Row], float], int]] = {
    "markings": (lambda row: row.markings, 0),
    "recall": (lambda row: row.recall, 3),
    "false": (lambda row: row.false_markings, 1),
    "RMSE (cm)": (lambda row: _CM * row.rmse_m, 1),
    "bias (cm)": (lambda row: _CM * row.bias_m, 1),
    "spread (cm)": (lambda row: _CM * row.spread_m, 1),
    "shared": (lambda row: row.shared, 0),
    "RMSE of shared (cm)": (lambda row: _CM * row.shared_rmse_m, 1),
}
"""The figure of each column, and the digits behind the point."""

_WORDS = ("port", "method", "cameras", "claim", "where")  # columns of words
_ESCAPED = str.maketrans({one: f"\\{one}" for one in "&%$#_{}"} | {"\\": r"\textbackslash{}"})


def write_tables(folder: Path, measured: Sequence[Measured]) -> None:
    """Write ``results`` as .csv (a line per seed) and .tex into a folder."""
    results = [
        [one.port, one.seed, cameras, method, *(f"{take(row):.6g}" for take, _ in COLUMNS.values())]
        for one in measured
        for cameras, rows in one.rows.items()
        for method, row in rows.items()
    ]
    replace_csv(folder / "results.csv", [["port", "seed", "cameras", "method", *COLUMNS], *results])
    replace_text(folder / "results.tex", latex(*results_table(measured)))


def results_table(measured: Sequence[Measured]) -> tuple[list[str], list[list[str]]]:
    """Heads and lines of the main table: a line per port, method and cameras."""
    lines = []
    for port, drives in by_port(measured).items():
        for method in ROWS:
            for cameras in drives[0].rows:
                rows = [one[method] for one in _common(drives, cameras, [method])]
                if rows:
                    cells = [_mean([take(row) for row in rows], digits) for take, digits in COLUMNS.values()]
                    lines.append([port, method, cameras, *cells])
    return ["port", "method", "cameras", *COLUMNS], lines


def by_port(measured: Sequence[Measured]) -> dict[str, list[Measured]]:
    """The drives of each port, in the order of the experiment."""
    found: dict[str, list[Measured]] = {}
    for one in measured:
        found.setdefault(one.port, []).append(one)
    return found


def markdown(heads: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table in Markdown; columns of figures are aligned to the right."""
    rule = [":--" if head in _WORDS else "--:" for head in heads]
    return "".join(f"| {' | '.join(line)} |\n" for line in [heads, rule, *lines])


def latex(heads: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table as a ``tabular`` of the package booktabs, a rule between ports."""
    rows = [" & ".join(one.translate(_ESCAPED).replace("+-", "$\\pm$") for one in row) for row in lines]
    firsts = [row.partition(" & ")[0] for row in rows]
    body = [
        ("\\midrule\n" if not n or firsts[n] != firsts[n - 1] else "") + f"{row} \\\\\n"
        for n, row in enumerate(rows)
    ]
    columns = "".join("l" if head in _WORDS else "r" for head in heads)
    head = f"\\begin{{tabular}}{{{columns}}}\n\\toprule\n{' & '.join(heads)} \\\\\n"
    return f"{head}{''.join(body)}\\bottomrule\n\\end{{tabular}}\n"


def _mean(values: Sequence[float], digits: int) -> str:
    known = _known(values)
    if not known:
        return "-"
    mean = f"{np.mean(known):.{digits}f}"
    return f"{mean} +- {np.std(known, ddof=1):.{max(digits, 1)}f}" if len(known) > 1 else mean


_RATIOS: tuple[tuple[str, str, str, str, float, str | None], ...] = (
    ("the optimisation is as good as a manual calibration", "Opt", "CNI", "<=", 1.1, "calibrated"),
    ("it repairs a borrowed calibration", "ENI", "Opt", ">=", 10.0, "estimated"),
    ("its IPM serves as well as the manual one", "ONI", "CNI", "<=", 1.2, None),
)
"""Claims on how many times as far off the map of one method is as that of another, the limit of that, and the
IPM that a port must start from to test it; None for any."""


@dataclass(frozen=True)
class Claim:
    """One claim against the figures of a port and camera set: by seed, and over the shared markings."""

    text: str
    where: str
    limit: str
    values: tuple[float, ...]
    holds: bool
    shared: tuple[float, ...] = ()

    @property
    def figure(self) -> str:
        """The mean over the seeds and, where there are several, the range that they span."""
        return _with_range(self.values)


def claims(measured: Sequence[Measured]) -> list[Claim]:
    """The paper's claims held against every port and set of cameras that can test them."""
    found = []
    for port, drives in by_port(measured).items():
        started = drives[0].started_from
        tested = [ratio[:5] for ratio in _RATIOS if ratio[5] in (None, started)]
        for cameras, (text, above, below, sign, limit) in product(drives[0].rows, tested):
            pairs = [(row[above], row[below]) for row in _common(drives, cameras, (above, below))]
            values = _known(one.rmse_m / other.rmse_m for one, other in pairs)
            shared = _known(one.shared_rmse_m / other.shared_rmse_m for one, other in pairs)
            mean = float(np.mean(values)) if values else float("nan")
            holds = mean <= limit if sign == "<=" else mean >= limit
            where = f"{port}, {cameras}"
            found.append(
                Claim(f"{text}: {above} / {below}", where, f"{sign} {limit:g}", values, holds, shared)
            )
        found += _more_with_more(port, drives)
    return [claim for claim in found if claim.values]


def _more_with_more(port: str, drives: Sequence[Measured]) -> list[Claim]:
    """All cameras together map more markings than the best of them alone: the ratio is above one."""
    sets = list(drives[0].rows)
    if len(sets) < 2:
        return []
    values = []
    for one in drives:
        counts = [one.rows[cameras]["Opt"].markings for cameras in sets if "Opt" in one.rows[cameras]]
        if len(counts) == len(sets) and max(counts[:-1]):
            values.append(counts[-1] / max(counts[:-1]))
    text = f"{sets[-1]} cameras map more markings than one: Opt, {sets[-1]} / the best one alone"
    return [Claim(text, f"{port}, {sets[-1]}", "> 1", tuple(values), bool(values and np.mean(values) > 1))]


def words(measured: Sequence[Measured], config: ExperimentConfig) -> str:
    """The text in Markdown."""
    tested = claims(measured)
    holds = ("**no**", "yes")
    lines = [[c.text, c.where, c.limit, c.figure, _with_range(c.shared), holds[c.holds]] for c in tested]
    return filled(
        "experiment.md",
        config=config,
        version=__version__,
        drives=", ".join(one.title for one in measured),
        recipes=RECIPES,
        tested=tested,
        broken=[claim for claim in tested if not claim.holds],
        claims_table=markdown(["claim", "where", "asked", "measured", "on shared markings", "holds"], lines),
        failures=[(one.title, *failure) for one in measured for failure in one.failures],
        results_table=markdown(*results_table(measured)),
    )


def filled(template: str, **values: Any) -> str:
    """The text of a template of this package."""
    loader = jinja2.PackageLoader("v2hdm.experiment")
    found = jinja2.Environment(
        loader=loader, undefined=jinja2.StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
    return found.get_template(template).render(**values)


def _known(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(value for value in values if not math.isnan(value))


def _with_range(values: Sequence[float]) -> str:
    if not values:
        return "-"
    mean = f"{np.mean(values):.2f}"
    return f"{mean} ({min(values):.2f} to {max(values):.2f})" if len(values) > 1 else mean


def _common(drives: Sequence[Measured], cameras: str, methods: Sequence[str]) -> list[Mapping[str, Row]]:
    """The rows of those drives in which all of some methods gave a map."""
    found = (one.rows.get(cameras, {}) for one in drives)
    return [rows for rows in found if all(method in rows for method in methods)]


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
        draw = partial(_save_shift, record=records[n], measured=measured[n])
        work[f"eni_oni_{port}.png"] = "eni_oni", draw
    work["corners.png"] = "corners", partial(_save_boxes, firsts=[measured[n] for n in firsts.values()])
    captions = {}
    for done, (name, (kind, save)) in enumerate(work.items()):
        progress(done, len(work))
        caption = save(folder / name)
        if caption is not None:
            captions[name] = kind, caption
    progress(len(work), len(work))
    return captions


_HEIGHT_IN = 7.6
_BESIDE_ROUTE_M = 12.0
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
    links = np.stack([one.reshape(-1, 2) for one in moved.values()], axis=1)
    polygons = [m.corners_map for m in truth.map.markings]
    lanes = [one.points_map for one in truth.map.lanes]
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
        near = (np.abs(centres[:, None] - centres[None]).max(axis=2) < _CLOSE_UP_M).sum(axis=1)
        x, y = centres[near.argmax()].tolist()
        detail.set(xlim=(x - _CLOSE_UP_M, x + _CLOSE_UP_M), ylim=(y - _CLOSE_UP_M, y + _CLOSE_UP_M))
        detail.set_title("Where markings are densest")
    said: dict[str, Any] = {"drive": measured.title, "cameras": cameras, "markings": len(common)}
    for method, corners in moved.items():
        rmse_cm = 100 * np.sqrt(((corners - true) ** 2).sum(axis=2).mean())
        said |= {method: f"{rmse_cm:.1f}", f"{method}_colour": style.WORDS[method]}
    return said


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
    axes.set(xlabel="marking, in route order", ylabel="corner error (cm)")
    return int((error_cm > 1.05 * top).sum())
