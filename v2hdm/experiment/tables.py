"""The tables of an experiment as CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from v2hdm.experiment.measures import ROWS, Measured, Row
from v2hdm.experiment.plan import OURS, PAPER
from v2hdm.store.files import replace_text

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
"""Of each column its figure, and the digits behind the point."""

_EXTRINSICS = ("rotation (deg)", "centre (cm)")

NOTE = (
    "Mean over the seeds, and after +- the standard deviation from seed to seed. CNI, ENI: naive map "
    "under the manually calibrated and the borrowed IPM. Opt: joint optimisation. ONI: naive map under "
    "the optimised IPM. 'paper': our code under the paper's recipe (pose_model=paper, loss=none); "
    "'incremental': marking by marking. Recall is that of the diamonds driven past. Bias is the length of "
    "the mean error vector of all corners, spread the root mean square distance from it. Shared are the "
    "markings that every row of the same cameras has mapped: only there do the methods' errors compare "
    "like with like."
)
"""What the columns and rows of the main table are."""


def write_tables(folder: Path, measured: Sequence[Measured]) -> None:
    """Write ``results`` and ``calibrations`` as .csv (a line per seed), .md and .tex into a folder."""
    replace_text(folder / "results.csv", _results_csv(measured))
    replace_text(folder / "calibrations.csv", _calibrations_csv(measured))
    for name, table in (("results", results_table), ("calibrations", calibrations_table)):
        heads, lines = table(measured)
        replace_text(folder / f"{name}.md", markdown(heads, lines))
        replace_text(folder / f"{name}.tex", _latex(heads, lines))


def results_table(measured: Sequence[Measured]) -> tuple[list[str], list[list[str]]]:
    """Heads and lines of the main table: a line per port, method and cameras."""
    lines = []
    for port, drives in by_port(measured).items():
        for method in ROWS:
            for cameras in drives[0].rows:
                rows = [one.rows[cameras][method] for one in drives if method in one.rows.get(cameras, {})]
                if rows:
                    cells = [_mean([take(row) for row in rows], digits) for take, digits in COLUMNS.values()]
                    lines.append([port, method, cameras, *cells])
    return ["port", "method", "cameras", *COLUMNS], lines


def calibrations_table(measured: Sequence[Measured]) -> tuple[list[str], list[list[str]]]:
    """Heads and lines: how far the extrinsics are from the true ones, by port, camera and origin."""
    lines = []
    for port, drives in by_port(measured).items():
        found: dict[tuple[str, str], list[tuple[float, float]]] = {}
        for one in drives:
            for camera, origin, errors in _extrinsics(one):
                found.setdefault((camera, origin), []).append(errors)
        for (camera, origin), pairs in found.items():
            degrees, centres = ([pair[n] for pair in pairs] for n in range(2))
            lines.append([port, camera, origin, _mean(degrees, 3), _mean(centres, 1)])
    return ["port", "camera", "extrinsic of", *_EXTRINSICS], lines


def by_port(measured: Sequence[Measured]) -> dict[str, list[Measured]]:
    """The drives of each port, in the order of the experiment."""
    found: dict[str, list[Measured]] = {}
    for one in measured:
        found.setdefault(one.port, []).append(one)
    return found


def markdown(heads: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table in Markdown; columns of figures are aligned to the right."""
    left = ("port", "method", "cameras", "camera", "extrinsic of", "claim", "where")
    rule = [":--" if head in left else "--:" for head in heads]
    return "".join(f"| {' | '.join(line)} |\n" for line in [heads, rule, *lines])


def _extrinsics(one: Measured) -> list[tuple[str, str, tuple[float, float]]]:
    """Camera, origin and errors (deg, cm) of a drive's extrinsics, those found with all cameras together."""
    out = []
    for recipe, origins in ((OURS, ("CNI", "ENI", "Opt")), (PAPER, ("Opt",))):
        sets = one.extrinsics.get(recipe, {})
        for camera, methods in (list(sets.values())[-1] if sets else {}).items():
            for origin in origins:
                if origin in methods:
                    errors = methods[origin]
                    title = origin if recipe == OURS else f"{origin}, {recipe}"
                    figures = errors["rotation_error_deg"], _CM * errors["translation_error_m"]
                    out.append((camera, title, figures))
    return sorted(out, key=lambda found: found[0])


def _mean(values: Sequence[float], digits: int) -> str:
    known = [value for value in values if not math.isnan(value)]
    if not known:
        return "-"
    mean = f"{np.mean(known):.{digits}f}"
    return f"{mean} +- {np.std(known, ddof=1):.{max(digits, 1)}f}" if len(known) > 1 else mean


def _latex(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table for the booktabs package, with a rule between ports."""
    kinds = "".join("l" if n < 3 else "r" for n in range(len(heads)))
    out = [rf"\begin{{tabular}}{{{kinds}}}", r"\toprule", " & ".join(map(_tex, heads)) + r" \\", r"\midrule"]
    for number, line in enumerate(lines):
        if number and line[0] != lines[number - 1][0]:
            out.append(r"\midrule")
        out.append(" & ".join(map(_tex, line)) + r" \\")
    return "\n".join([*out, r"\bottomrule", r"\end{tabular}", ""])


def _tex(text: str) -> str:
    for sign in "_%&#":
        text = text.replace(sign, rf"\{sign}")
    return text.replace("+-", r"$\pm$")


def _results_csv(measured: Sequence[Measured]) -> str:
    lines: list[list[object]] = [["port", "seed", "cameras", "method", *COLUMNS]]
    for one in measured:
        for cameras, rows in one.rows.items():
            for method, row in rows.items():
                cells = [f"{take(row):.6g}" for take, _ in COLUMNS.values()]
                lines.append([one.port, _seed(one), cameras, method, *cells])
    return _csv(lines)


def _calibrations_csv(measured: Sequence[Measured]) -> str:
    lines: list[list[object]] = [["port", "seed", "camera", "extrinsic of", *_EXTRINSICS]]
    for one in measured:
        for camera, origin, errors in _extrinsics(one):
            lines.append([one.port, _seed(one), camera, origin, *(f"{error:.6g}" for error in errors)])
    return _csv(lines)


def _seed(one: Measured) -> str:
    return "" if one.seed is None else str(one.seed)


def _csv(lines: Iterable[Iterable[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()
