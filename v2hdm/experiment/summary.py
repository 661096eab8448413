"""An experiment's tables, and its text: the paper's claims, what was measured, where the two disagree."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from v2hdm import __version__
from v2hdm.experiment.measures import ROWS, Measured, Row
from v2hdm.experiment.plan import OURS, PAPER, RECIPES, ExperimentConfig
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
"""The figure of each column, and the digits behind the point."""

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
"""The columns and rows of the main table explained."""


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
                lines.append([one.port, one.seed, cameras, method, *cells])
    return _csv(lines)


def _calibrations_csv(measured: Sequence[Measured]) -> str:
    lines: list[list[object]] = [["port", "seed", "camera", "extrinsic of", *_EXTRINSICS]]
    for one in measured:
        for camera, origin, errors in _extrinsics(one):
            lines.append([one.port, one.seed, camera, origin, *(f"{error:.6g}" for error in errors)])
    return _csv(lines)


def _csv(lines: Iterable[Iterable[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


OPT_TO_CNI = 1.1
"""The optimised map is to be at most so many times as far off as one under a manual calibration (port1)."""

ENI_TO_OPT = 10.0
"""The map under a borrowed calibration is to be so many times as far off as the optimised one (port2)."""

ONI_TO_CNI = 1.2
"""The naive map under the optimised IPM is to be at most so many times as far off as under the manual one."""

_PAPER = (
    "The paper is *Monocular Camera Mapping with Pose-Guided Optimization* (IROS 2023). It drove through "
    "two real ports; these are two rendered ones, so ratios between methods are compared and no absolute "
    "figure. Its claims, as far as ratios can test them: the joint optimisation is as good as a manual "
    "calibration where there is one (port1), repairs a borrowed one (port2), finds an IPM that serves the "
    "naive method as well as a manual calibration does, and maps more with more cameras."
)


@dataclass(frozen=True)
class Claim:
    """One claim held against the figures of one port and set of cameras.

    The mean of ``values``, one per seed, is to keep ``limit``; ``shared`` are the same ratios over the
    markings that every method has mapped.
    """

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
            if started == "calibrated":
                text = "the optimisation is as good as a manual calibration: Opt / CNI"
                found.append(_claim(text, port, drives, cameras, ("Opt", "CNI"), most=OPT_TO_CNI))
            elif started == "estimated":
                text = "it repairs a borrowed calibration: ENI / Opt"
                found.append(_claim(text, port, drives, cameras, ("ENI", "Opt"), least=ENI_TO_OPT))
            text = "its IPM serves as well as the manual one: ONI / CNI"
            found.append(_claim(text, port, drives, cameras, ("ONI", "CNI"), most=ONI_TO_CNI))
        found += _more_with_more(port, drives)
    return [claim for claim in found if claim.values]


def write_words(
    folder: Path, measured: Sequence[Measured], captions: Mapping[str, str], config: ExperimentConfig
) -> None:
    """Write ``experiment.md``, the text, and ``figures.md``, the figures with their captions."""
    replace_text(folder / "experiment.md", words(measured, config))
    shown = "".join(f"![{name}]({name})\n\n{caption}\n\n" for name, caption in captions.items())
    replace_text(folder / "figures.md", f"# Figures\n\n{shown}")


def words(measured: Sequence[Measured], config: ExperimentConfig) -> str:
    """The text in Markdown."""
    tested = claims(measured)
    heads = ["claim", "where", "asked", "measured", "on shared markings", "holds"]
    lines = [
        [c.text, c.where, c.limit, c.figure, _with_range(c.shared), "yes" if c.holds else "**no**"]
        for c in tested
    ]
    drives = ", ".join(one.title for one in measured)
    recipes = "".join(f"- {name}: {what}\n" for name, what in RECIPES.items() if name in config.recipes)
    return (
        f"# Experiment {config.name}\n\nv2hdm {__version__}. Drives: {drives}. Recipes:\n\n{recipes}\n"
        f"## Beside the paper\n\n{_PAPER}\n\n"
        "Ratios are of corner RMSE; the mean over the seeds is asked, the range of the seeds stands behind "
        f"it.\n\n{markdown(heads, lines)}\n{_verdict(tested)}\n{_remarks(measured)}{_failures(measured)}"
        f"## Maps\n\n{markdown(*results_table(measured))}\n{NOTE}\n\n"
        f"## Calibrations\n\n{markdown(*calibrations_table(measured))}\n"
        "How far each camera's extrinsic is from the true one: angle, and distance of the centre. CNI and "
        "ENI are the rigid extrinsics nearest to the manual and the borrowed IPM; Opt is found with all "
        "cameras together.\n\nFigures and what they show: [figures.md](figures.md).\n"
    )


def _verdict(tested: Sequence[Claim]) -> str:
    broken = [claim for claim in tested if not claim.holds]
    if not broken:
        return f"All {len(tested)} figures agree with the paper's claims.\n"
    lines = "".join(f"- {c.where}: {c.text} is {c.figure}, asked was {c.limit}\n" for c in broken)
    return f"**{len(broken)} of {len(tested)} figures disagree with the paper's claims:**\n\n{lines}"


def _remarks(measured: Sequence[Measured]) -> str:
    """Errors on shared markings, those of the paper's recipe beside ours."""
    out = []
    for port, drives in by_port(measured).items():
        for cameras in drives[0].rows:
            rows = _common(drives, cameras, ("CNI", "Opt"))
            if rows:
                cni, opt = (_cm(row[name].shared_rmse_m for row in rows) for name in ("CNI", "Opt"))
                count = np.mean([row["Opt"].shared for row in rows])
                where = f"- {port}, {cameras}: on {count:.0f} shared markings"
                line = f"{where} CNI is {cni} cm off, Opt {opt} cm"
                recipe = _common(drives, cameras, ("Opt, paper",))
                if recipe:
                    line += f"; by the paper's recipe {_cm(r['Opt, paper'].shared_rmse_m for r in recipe)} cm"
                out.append(line + "\n")
    return f"Like with like, on markings that every method has mapped:\n\n{''.join(out)}\n" if out else ""


def _failures(measured: Sequence[Measured]) -> str:
    lines = [
        f"- {one.title}, {cameras}, recipe {recipe}: {text}\n"
        for one in measured
        for recipe, cameras, text in one.failures
    ]
    return f"No map came of these, and the tables are without them:\n\n{''.join(lines)}\n" if lines else ""


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
    least: float | None = None,
    most: float | None = None,
) -> Claim:
    """The ratio of two methods' corner RMSE, which is to be at least or at most some value."""
    rows = _common(drives, cameras, methods)
    pairs = [(row[methods[0]], row[methods[1]]) for row in rows]
    values = _known(above.rmse_m / below.rmse_m for above, below in pairs)
    shared = _known(above.shared_rmse_m / below.shared_rmse_m for above, below in pairs)
    mean = float(np.mean(values)) if values else float("nan")
    holds = mean <= most if most is not None else least is not None and mean >= least
    limit = f"<= {most:g}" if most is not None else f">= {least:g}"
    return Claim(text, f"{port}, {cameras}", limit, values, holds, shared)


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


def _cm(values_m: Iterable[float]) -> str:
    known = _known(values_m)
    return f"{100 * np.mean(known):.1f}" if known else "-"
