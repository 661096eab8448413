"""An experiment on the terminal, or in a log: how far each drive is, and in the end the table."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from v2hdm.experiment.plan import ExperimentConfig
from v2hdm.experiment.run import Tell, run_experiment
from v2hdm.experiment.tables import results_table
from v2hdm.experiment.words import claims

_EVERY_S = 30.0
"""How often a stage that goes on has a line where there is no terminal."""


def experiment_on_terminal(config: ExperimentConfig, config_yaml: str) -> None:
    """Run an experiment and show how far it is and what came of it."""
    console = Console()
    with _view(console) as tell:
        folder, measured = run_experiment(config, config_yaml, tell)
    heads, lines = results_table(measured)
    table = Table(title=config.name, title_justify="left", header_style="bold")
    for number, head in enumerate(heads):
        table.add_column(head, justify="left" if number < 3 else "right")
    for number, line in enumerate(lines):
        if number and line[:2] != lines[number - 1][:2]:
            table.add_section()
        table.add_row(*line)
    console.print(table)
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


@contextmanager
def _view(console: Console) -> Iterator[Tell]:
    """A bar for every drive on a terminal; elsewhere lines when a stage begins, ends and goes on."""
    if not console.is_terminal:
        yield _Lines(console)
        return
    columns = (
        TextColumn("{task.description:<18}"),
        TextColumn("{task.fields[stage]:<9}"),
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
