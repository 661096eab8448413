"""An experiment on the terminal, or in a log: how far each drive is, and in the end the table."""

from __future__ import annotations

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
from v2hdm.progress import progress_lines

_SHOWN = ("method", "cameras", "markings", "RMSE (cm)", "RMSE of shared (cm)")
"""Columns of the main table that the terminal shows."""


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
        lines = progress_lines(lambda line: console.print(line, highlight=False, soft_wrap=True))
        yield lambda drive, stage, done, total: lines(f"{drive}: {stage}", done, total)
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
