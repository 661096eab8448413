"""An experiment's tables, and its text: the paper's claims, what was measured, where the two disagree."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from v2hdm import __version__
from v2hdm.experiment.drive import ROWS, Measured, Row
from v2hdm.experiment.plan import RECIPES, ExperimentConfig
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


_RATIOS = (
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
        for cameras in drives[0].rows:
            for text, above, below, sign, limit, needed in _RATIOS:
                if needed in (None, started):
                    found.append(_claim(text, port, drives, cameras, (above, below), sign, limit))
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


def _claim(
    text: str,
    port: str,
    drives: Sequence[Measured],
    cameras: str,
    methods: tuple[str, str],
    sign: str,
    limit: float,
) -> Claim:
    """The ratio of two methods' corner RMSE, which is to be at least or at most some value."""
    pairs = [(row[methods[0]], row[methods[1]]) for row in _common(drives, cameras, methods)]
    values = _known(above.rmse_m / below.rmse_m for above, below in pairs)
    shared = _known(above.shared_rmse_m / below.shared_rmse_m for above, below in pairs)
    mean = float(np.mean(values)) if values else float("nan")
    holds = mean <= limit if sign == "<=" else mean >= limit
    title = f"{text}: {' / '.join(methods)}"
    return Claim(title, f"{port}, {cameras}", f"{sign} {limit:g}", values, holds, shared)


def write_words(
    folder: Path,
    measured: Sequence[Measured],
    captions: Mapping[str, tuple[str, Mapping[str, Any]]],
    config: ExperimentConfig,
) -> None:
    """Write ``experiment.md``, the text, and ``figures.md``, the figures with their captions."""
    replace_text(folder / "experiment.md", words(measured, config))
    replace_text(folder / "figures.md", _filled("figures.md", captions=captions))


def words(measured: Sequence[Measured], config: ExperimentConfig) -> str:
    """The text in Markdown."""
    tested = claims(measured)
    holds = ("**no**", "yes")
    lines = [[c.text, c.where, c.limit, c.figure, _with_range(c.shared), holds[c.holds]] for c in tested]
    return _filled(
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


def _filled(template: str, **values: Any) -> str:
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
