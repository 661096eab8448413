"""Tables and progress bars on the terminal."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from v2hdm.progress import progress_lines

DriveProgress = Callable[[str, str, int, int], None]
"""Called with a drive, its stage, and the stage's completed and total steps."""

METHODS: Mapping[str, str] = {
    "CNI": "naive map, manually calibrated IPM",
    "ENI": "naive map, IPM estimated from another vehicle",
    "Opt": "joint optimisation of extrinsics and corners",
    "ONI": "naive map, optimised IPM",
}
"""The methods of the paper (IROS 2023), in the order of its tables."""

_Column = tuple[str, int, float]  # key in metrics.json, digits behind the point, factor
_AGAINST_TRUTH: Mapping[str, _Column] = {
    "recall": ("recall", 3, 1.0),
    "false": ("false_markings", 0, 1.0),
    "corner RMSE (cm)": ("corner_rmse_m", 1, 100.0),
    "bias (cm)": ("corner_bias_m", 1, 100.0),
}
_WITHOUT_TRUTH: Mapping[str, _Column] = {
    "sigma (cm)": ("median_sigma_m", 1, 100.0),
    "reprojection (px)": ("reprojection_rmse_px", 2, 1.0),
}


def figure_columns(figures: Iterable[Mapping[str, Any]]) -> Mapping[str, _Column]:
    """The columns of a table of methods: errors where any of their ``figures`` has ground truth."""
    return _AGAINST_TRUTH if any("recall" in one for one in figures) else _WITHOUT_TRUTH


def results_table(title: str, results: Mapping[str, Mapping[str, Mapping[str, float]]]) -> Table:
    """Markings, recall and corner errors by method and camera set, from ``results`` in ``metrics.json``."""
    columns = figure_columns(row for rows in results.values() for row in rows.values())
    table = new_table(title, ("method", "cameras"), ("markings", *columns))
    others = sorted({method for rows in results.values() for method in rows} - set(METHODS))
    for method in (*METHODS, *others):
        for cameras, rows in results.items():
            if method in rows:
                found = rows[method]
                cells = [_number(found.get(key), digits, by) for key, digits, by in columns.values()]
                table.add_row(method, cameras, str(found["markings"]), *cells)
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
    table = new_table(f"changes: {counts}", ("class", "fate"), numbers, before=("id",))
    table.add_column("at (m)")
    for one in changes["listed"]:
        shift = one["shift_m"]
        sigma = one["shift_sigma_m"]
        corners = one["after_map"] or one["before_map"]
        x, y = (sum(corner[k] for corner in corners) / len(corners) for k in (0, 1))
        table.add_row(
            str(one["id"]),
            one["class"],
            one["fate"],
            "" if shift is None else f"{100 * math.hypot(*shift):.0f}",
            "" if sigma is None else f"{100 * math.hypot(*sigma) / math.sqrt(2):.1f}",
            f"{one['probability']:.3f}",
            f"{one['found']} / {one['views']}",
            f"({x:.1f}, {y:.1f})",
        )
    return table


@contextmanager
def drive_bars(console: Console, endings: Collection[str] = ()) -> Iterator[DriveProgress]:
    """A bar per running drive, until its stage is one of ``endings``; lines if there is no terminal."""
    if not console.is_terminal:
        lines = progress_lines(lambda line: plain(console, line))
        yield lambda drive, stage, done, total: lines(f"{drive}: {stage}", done, total)
        return
    texts = [TextColumn(one, markup=False) for one in ("{task.description:<20}", "{task.fields[stage]:<16}")]
    bar = (BarColumn(30), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*texts, *bar, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def advance(drive: str, stage: str, done: int, total: int) -> None:
            if stage in endings:
                if drive in tasks:
                    bars.remove_task(tasks.pop(drive))
                return
            if drive not in tasks:
                tasks[drive] = bars.add_task(drive, total=total, stage=stage)
            bars.update(tasks[drive], completed=done, total=total, stage="" if stage == "drives" else stage)

        yield advance


def plain(console: Console, line: str) -> None:
    """Print a line without wrapping."""
    console.print(line, highlight=False, markup=False, soft_wrap=True)
