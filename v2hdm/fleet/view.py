"""A fleet on the terminal, or in a log: how far it is, and in the end the table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from v2hdm.fleet.rows import ERROR, Row
from v2hdm.fleet.run import ALL, FleetOptions, Tell, run_fleet
from v2hdm.progress import progress_lines

_STYLES = {"PASS": "bold green", "WARN": "bold yellow", "FAIL": "bold red", ERROR: "bold red"}


def fleet_on_terminal(files: Sequence[Path], overrides: Sequence[str], options: FleetOptions) -> list[Row]:
    """Map a fleet, show how far it is, and its table."""
    console = Console()
    with _view(console) as tell:
        rows = run_fleet(files, overrides, options, tell)
    console.print(_table(rows))
    for row in rows:
        if row.says:
            console.print(f"{row.drive}: {row.says}", highlight=False, markup=False, soft_wrap=True)
    console.print(f"table in {options.folder}: fleet.csv, fleet.json", highlight=False, soft_wrap=True)
    return rows


def _table(rows: Sequence[Row]) -> Table:
    table = Table(header_style="bold")
    for name in ("drive", "verdict", "images", "markings", "minutes"):
        table.add_column(name, justify="left" if name in ("drive", "verdict") else "right")
    for row in rows:
        numbers = ["" if one is None else str(one) for one in (row.images, row.markings)]
        minutes = "kept" if row.kept else "" if row.minutes is None else f"{row.minutes:.1f}"
        table.add_row(Text(row.drive), Text(row.status, _STYLES.get(row.status, "")), *numbers, minutes)
    return table


@contextmanager
def _view(console: Console) -> Iterator[Tell]:
    """A bar for the fleet and one for each drive in work; without a terminal lines, now and then."""
    if not console.is_terminal:
        lines = progress_lines(lambda text: console.print(text, highlight=False, markup=False))
        yield lambda drive, stage, done, total: lines(f"{drive}: {stage}", done, total)
        return
    columns = (
        TextColumn("{task.description:<20}", markup=False),
        TextColumn("{task.fields[stage]:<12}", markup=False),
        BarColumn(30),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def advance(drive: str, stage: str, done: int, total: int) -> None:
            if stage in _STYLES:  # its verdict: it is done
                if drive in tasks:
                    bars.remove_task(tasks.pop(drive))
                return
            if drive not in tasks:
                tasks[drive] = bars.add_task(drive, total=total, stage=stage)
            bars.update(tasks[drive], completed=done, total=total, stage="" if drive == ALL else stage)

        yield advance
