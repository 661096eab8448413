"""Tables and progress bars on the terminal."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from v2hdm.progress import progress_lines
from v2hdm.records import BEST

DriveProgress = Callable[[str, str, int, int], None]
"""Called with a drive, its stage, and the stage's completed and total steps."""

METHODS: Mapping[str, str] = {
    "CNI": "naive map, manually calibrated IPM",
    "ENI": "naive map, IPM estimated from another vehicle",
    BEST: "joint optimisation of extrinsics and corners",
    "ONI": "naive map, optimised IPM",
}
"""The methods of the paper (IROS 2023), in the order of its tables."""


class FigureColumn(NamedTuple):
    """How a column of a table shows a figure of ``metrics.json``."""

    key: str
    digits: int  # behind the point
    factor: float  # from the figure's unit to the column's


# Columns, by heading, of a table of maps that have ground truth.
_AGAINST_TRUTH: Mapping[str, FigureColumn] = {
    "recall": FigureColumn("recall", 3, 1.0),
    "false": FigureColumn("false_markings", 0, 1.0),
    "corner RMSE (cm)": FigureColumn("corner_rmse_m", 1, 100.0),
    "bias (cm)": FigureColumn("corner_bias_m", 1, 100.0),
}

# Columns, by heading, of a table of maps without ground truth.
_WITHOUT_TRUTH: Mapping[str, FigureColumn] = {
    "sigma (cm)": FigureColumn("median_sigma_m", 1, 100.0),
    "reprojection (px)": FigureColumn("reprojection_rmse_px", 2, 1.0),
}


def figure_columns(figures: Iterable[Mapping[str, Any]]) -> Mapping[str, FigureColumn]:
    """The columns of a table of methods: errors where any of their ``figures`` has ground truth."""
    return _AGAINST_TRUTH if any("recall" in row for row in figures) else _WITHOUT_TRUTH


def results_table(title: str, results: Mapping[str, Mapping[str, Mapping[str, float]]]) -> Table:
    """Markings, recall and corner errors by method and camera set, from ``results`` in ``metrics.json``."""
    columns = figure_columns(row for rows in results.values() for row in rows.values())
    table = new_table(title, ("method", "cameras"), ("markings", *columns))
    others = sorted({method for rows in results.values() for method in rows} - set(METHODS))
    for method in (*METHODS, *others):
        for cameras, rows in results.items():
            if method in rows:
                row = rows[method]
                cells = [_number(row.get(key), digits, factor) for key, digits, factor in columns.values()]
                table.add_row(method, cameras, str(row["markings"]), *cells)
        table.add_section()
    return table


def new_table(
    title: str | None, words: Sequence[str], numbers: Sequence[str], before: Sequence[str] = ()
) -> Table:
    """An empty table with right-aligned columns of numbers, ``before`` included."""
    table = Table(title=title, title_justify="left", header_style="bold")
    for heading in (*before, *words, *numbers):
        table.add_column(heading, justify="left" if heading in words else "right")
    return table


def _number(value: float | None, digits: int, factor: float) -> str:
    return "-" if value is None or math.isnan(value) else f"{factor * value:.{digits}f}"


def changes_table(changes: Mapping[str, Any]) -> Table | str:
    """Moved, vanished and new markings with respect to an earlier map, one per row; else one line."""
    counts = ", ".join(f"{number} {fate}" for fate, number in changes["counts"].items() if number)
    if not changes["listed"]:
        return f"changes: {counts}"
    numbers = ("by (cm)", "sigma (cm)", "odds", "seen / should be")
    table = new_table(f"changes: {counts}", ("class", "change"), numbers, before=("id",))
    table.add_column("at (m)")
    for change in changes["listed"]:
        shift = change["shift_m"]
        sigma = change["shift_sigma_m"]
        corners = change["after_map"] or change["before_map"]
        x, y = (sum(corner[k] for corner in corners) / len(corners) for k in (0, 1))
        table.add_row(
            str(change["id"]),
            change["class"],
            change["fate"],
            "" if shift is None else f"{100 * math.hypot(shift[0], shift[1]):.0f}",
            "" if sigma is None else f"{100 * math.hypot(sigma[0], sigma[1]) / math.sqrt(2):.1f}",
            f"{change['probability']:.3f}",
            f"{change['found']} / {change['views']}",
            f"({x:.1f}, {y:.1f})",
        )
    return table


@contextmanager
def drive_bars(console: Console, endings: Collection[str] = ()) -> Iterator[DriveProgress]:
    """A bar per running drive, until its stage is one of ``endings``; lines if there is no terminal."""
    if not console.is_terminal:
        lines = progress_lines(lambda line: plain(console, line))
        yield lambda drive, stage, finished, total: lines(f"{drive}: {stage}", finished, total)
        return
    name = TextColumn("{task.description:<20}", markup=False)
    stage_name = TextColumn("{task.fields[stage]:<16}", markup=False)
    columns = (name, stage_name, BarColumn(30), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def advance(drive: str, stage: str, finished: int, total: int) -> None:
            if stage in endings:
                if drive in tasks:
                    bars.remove_task(tasks.pop(drive))
                return
            if drive not in tasks:
                tasks[drive] = bars.add_task(drive, total=total, stage=stage)
            bars.update(
                tasks[drive], completed=finished, total=total, stage="" if stage == "drives" else stage
            )

        yield advance


def plain(console: Console, line: str) -> None:
    """Print a line without wrapping."""
    console.print(line, highlight=False, markup=False, soft_wrap=True)
