"""The experiment's main table, as CSV, Markdown and LaTeX."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from v2hdm.experiment.drive import ROWS, Measured, Row
from v2hdm.store.files import replace_csv, replace_text

_CM = 100.0  # in a metre

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
_ESCAPED = str.maketrans({sign: f"\\{sign}" for sign in "&%$#_{}"} | {"\\": r"\textbackslash{}"})


def write_tables(folder: Path, measured: Sequence[Measured]) -> None:
    """Write ``results`` as .csv (a line per seed) and .tex into a folder."""
    results = [
        [drive.port, drive.seed, cameras, method, *(f"{take(row):.6g}" for take, _ in COLUMNS.values())]
        for drive in measured
        for cameras, rows in drive.rows.items()
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
                rows = [by_method[method] for by_method in common_rows(drives, cameras, [method])]
                if rows:
                    cells = [_mean([take(row) for row in rows], digits) for take, digits in COLUMNS.values()]
                    lines.append([port, method, cameras, *cells])
    return ["port", "method", "cameras", *COLUMNS], lines


def by_port(measured: Sequence[Measured]) -> dict[str, list[Measured]]:
    """The drives of each port, in the order of the experiment."""
    drives: dict[str, list[Measured]] = {}
    for drive in measured:
        drives.setdefault(drive.port, []).append(drive)
    return drives


def markdown(heads: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table in Markdown; columns of figures are aligned to the right."""
    rule = [":--" if head in _WORDS else "--:" for head in heads]
    return "".join(f"| {' | '.join(line)} |\n" for line in [heads, rule, *lines])


def latex(heads: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table as a ``tabular`` of the package booktabs, a rule between ports."""
    rows = [" & ".join(cell.translate(_ESCAPED).replace("+-", "$\\pm$") for cell in line) for line in lines]
    firsts = [row.partition(" & ")[0] for row in rows]
    body = []
    for number, row in enumerate(rows):
        is_first_of_port = not number or firsts[number] != firsts[number - 1]
        body.append(("\\midrule\n" if is_first_of_port else "") + f"{row} \\\\\n")
    columns = "".join("l" if head in _WORDS else "r" for head in heads)
    head = f"\\begin{{tabular}}{{{columns}}}\n\\toprule\n{' & '.join(heads)} \\\\\n"
    return f"{head}{''.join(body)}\\bottomrule\n\\end{{tabular}}\n"


def _mean(values: Sequence[float], digits: int) -> str:
    known = finite(values)
    if not known:
        return "-"
    mean = f"{np.mean(known):.{digits}f}"
    return f"{mean} +- {np.std(known, ddof=1):.{max(digits, 1)}f}" if len(known) > 1 else mean


def finite(values: Iterable[float]) -> tuple[float, ...]:
    """The known values."""
    return tuple(value for value in values if not math.isnan(value))


def common_rows(drives: Sequence[Measured], cameras: str, methods: Sequence[str]) -> list[Mapping[str, Row]]:
    """The rows of those drives in which all of some methods gave a map."""
    by_method = (drive.rows.get(cameras, {}) for drive in drives)
    return [rows for rows in by_method if all(method in rows for method in methods)]
