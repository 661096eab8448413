"""An experiment on the terminal, or in a log: how far each drive is, and in the end the table."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from v2hdm.experiment.measures import Measured
from v2hdm.experiment.plan import ExperimentConfig
from v2hdm.experiment.run import Tell, run_experiment
from v2hdm.experiment.tables import by_port, results_table
from v2hdm.experiment.words import claims

_SHOWN = ("method", "cameras", "markings", "RMSE (cm)", "RMSE of shared (cm)")
"""Columns of the main table that the terminal shows."""

_EVERY_S = 30.0
"""How often a stage that goes on has a line where there is no terminal."""


def experiment_on_terminal(config: ExperimentConfig, config_yaml: str) -> None:
    """Run an experiment and show how far it is and what came of it."""
    console = Console()
    with _view(console) as tell:
        folder, measured = run_experiment(config, config_yaml, tell)
    for port, drives in by_port(measured).items():
        console.print(_table(port, drives))
    tested = claims(measured)
    for claim in tested:
        if not claim.holds:
            line = f"{claim.where}: {claim.text} is {claim.figure}, asked {claim.limit}"
            console.print(f"disagrees with the paper: {line}", highlight=False, soft_wrap=True)
    agree = sum(claim.holds for claim in tested)
    console.print(f"{agree} of {len(tested)} figures agree with the paper's claims", highlight=False)
    console.print(
        f"results in {folder}: begin with experiment.md and figures.md", highlight=False, soft_wrap=True
    )


def _table(port: str, drives: Sequence[Measured]) -> Table:
    """What fits a terminal of the main table: method by camera set."""
    seeds = f", {len(drives)} seeds" if len(drives) > 1 else ""
    table = Table(title=f"{port}{seeds}", title_justify="left", header_style="bold")
    heads, lines = results_table(drives)
    shown = [heads.index(name) for name in _SHOWN]
    for name in _SHOWN:
        table.add_column(name, justify="left" if name in ("method", "cameras") else "right")
    for number, line in enumerate(lines):
        if number and line[1] != lines[number - 1][1]:
            table.add_section()
        table.add_row(*(line[column] for column in shown))
    return table


@contextmanager
def _view(console: Console) -> Iterator[Tell]:
    """A bar for every drive on a terminal; elsewhere lines when a stage begins, ends and goes on."""
    if not console.is_terminal:
        yield _Lines(console)
        return
    columns = (
        TextColumn("{task.description:<18}"),
        TextColumn("{task.fields[stage]:<16}"),
        BarColumn(30),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def advance(drive: str, stage: str, done: int, total: int) -> None:
            if drive not in tasks:
                tasks[drive] = bars.add_task(drive, total=total, stage=stage)
            bars.update(tasks[drive], completed=done, total=total, stage=stage)

        yield advance


class _Lines:
    """Progress in plain lines."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._told: dict[str, tuple[str, float]] = {}
        self._begin_s = time.monotonic()

    def __call__(self, drive: str, stage: str, done: int, total: int) -> None:
        now_s = time.monotonic()
        before, told_s = self._told.get(drive, ("", -_EVERY_S))
        if stage == before and done < total and now_s - told_s < _EVERY_S:
            return
        self._told[drive] = stage, now_s
        line = f"{now_s - self._begin_s:6.0f} s  {drive}: {stage} {done}/{total}"
        self._console.print(line, highlight=False, soft_wrap=True)
