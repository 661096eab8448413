"""An experiment from its settings to its folder: the drives side by side, then tables, figures and text."""

from __future__ import annotations

import logging
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from v2hdm.errors import ConfigError
from v2hdm.experiment.drive import drive_record
from v2hdm.experiment.figures import save_figures
from v2hdm.experiment.measures import Measured, measure
from v2hdm.experiment.plan import ExperimentConfig, Job, jobs
from v2hdm.experiment.summary import by_port, claims, results_table, write_tables, write_words
from v2hdm.progress import progress_lines
from v2hdm.store.files import replace_text
from v2hdm.store.outputs import growing_folder, listed_files
from v2hdm.workers import share_out

Tell = Callable[[str, str, int, int], None]
"""Told a drive, its stage, and how many of the stage's steps are done, of how many."""

_OPTION = "output="
_PATIENCE_S = 2.0
_queue: SimpleQueue[tuple[str, str, int, int] | None] | None = None


def run_experiment(config: ExperimentConfig, config_yaml: str, tell: Tell) -> tuple[Path, list[Measured]]:
    """Map every drive by every recipe and write what comes of it into ``<output>/<name>/``.

    Drives that an earlier run has finished under the same settings are taken from there.

    Args:
        config: what to do.
        config_yaml: the configuration as text, kept beside the results.
        tell: told how far each drive is.

    Returns:
        The folder, and the figures of every drive.

    Raises:
        V2hdmError: a setting or a drive is at fault, or the folder holds something that is not ours.
    """
    todo = jobs(config)
    folder = Path(config.output) / config.name
    try:
        with growing_folder(folder, _OPTION):
            replace_text(folder / "config.yaml", config_yaml or f"{config!r}\n")
            records = _records(todo, config.workers or os.cpu_count() or 1, tell)
            measured = [measure(record) for record in records]
            drawing = partial(tell, "figures", "draw")
            captions = save_figures(folder, todo, records, measured, drawing)
            write_tables(folder, measured)
            write_words(folder, measured, captions, config)
    except OSError as failure:
        raise ConfigError(
            f"output folder {folder} cannot be written: {failure.strerror}; set output="
        ) from failure
    return folder, measured


def _records(todo: Sequence[Job], workers: int, tell: Tell) -> list[dict[str, Any]]:
    if workers <= 1 or len(todo) == 1:
        return [drive_record(job, workers, partial(tell, job.title)) for job in todo]
    records: list[dict[str, Any]] = []
    with _listening(tell) as queue:
        share_out(_work, todo, workers, _start_worker, (queue,), records.append)
    return records


@contextmanager
def _listening(tell: Tell) -> Iterator[SimpleQueue[tuple[str, str, int, int] | None]]:
    """A queue whose messages are told here while other processes work."""
    queue: SimpleQueue[tuple[str, str, int, int] | None] = multiprocessing.get_context("spawn").SimpleQueue()

    def listen() -> None:
        while (message := queue.get()) is not None:
            tell(*message)

    # A process that was ended in the middle of a message leaves a queue that is never heard to its end.
    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    try:
        yield queue
    finally:
        queue.put(None)
        listener.join(_PATIENCE_S)


def _start_worker(queue: SimpleQueue[tuple[str, str, int, int] | None]) -> None:
    global _queue
    _queue = queue
    logging.getLogger("v2hdm").setLevel(logging.ERROR)


def _work(job: Job) -> dict[str, Any]:
    with listed_files(job.root, _OPTION):
        return drive_record(job, 1, partial(_tell, job.title))


def _tell(title: str, stage: str, done: int, total: int) -> None:
    if _queue is not None:
        _queue.put((title, stage, done, total))


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
