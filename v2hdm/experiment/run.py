"""An experiment from its settings to its folder: the drives side by side, then tables, figures and text."""

from __future__ import annotations

import logging
import multiprocessing
import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from v2hdm.errors import ConfigError
from v2hdm.experiment.drive import drive_record
from v2hdm.experiment.figures import save_figures
from v2hdm.experiment.measures import Measured, measure
from v2hdm.experiment.plan import ExperimentConfig, Job, jobs
from v2hdm.experiment.summary import by_port, claims, results_table, write_tables, write_words
from v2hdm.progress import patient
from v2hdm.report.terminal import DriveProgress, drive_bars, new_table, plain
from v2hdm.store.files import replace_text
from v2hdm.store.results import growing_folder, listed_files
from v2hdm.workers import share_out

_OPTION, _MADE = "output=", "v2hdm experiment"
_PATIENCE_S = 2.0
_queue: SimpleQueue[Any] | None = None


def run_experiment(
    config: ExperimentConfig, config_yaml: str, progress: DriveProgress
) -> tuple[Path, list[Measured]]:
    """Map every drive by every recipe and write what comes of it into ``<output>/<name>/``.

    Drives that an earlier run has finished under the same settings are taken from there. ``config_yaml`` is
    the configuration as text, kept beside the results. Returns the folder, and the figures of every drive.
    Raises V2hdmError where a setting or a drive is at fault, or the folder holds something that is not ours.
    """
    todo = jobs(config)
    folder = Path(config.output) / config.name
    try:
        with growing_folder(folder, _OPTION, _MADE):
            replace_text(folder / "config.yaml", config_yaml or f"{config!r}\n")
            records = _records(todo, config.workers or os.cpu_count() or 1, progress)
            measured = [measure(record) for record in records]
            drawing = partial(progress, "figures", "draw")
            captions = save_figures(folder, todo, records, measured, drawing)
            write_tables(folder, measured)
            write_words(folder, measured, captions, config)
    except OSError as failure:
        raise ConfigError(f"{folder}: cannot be written ({failure.strerror}); set output=") from failure
    return folder, measured


def _records(todo: Sequence[Job], workers: int, progress: DriveProgress) -> list[dict[str, Any]]:
    if workers <= 1 or len(todo) == 1:
        return [drive_record(job, workers, partial(progress, job.title)) for job in todo]
    records: list[dict[str, Any]] = []
    with _listening(progress) as queue:
        share_out(_work, todo, workers, _start_worker, (queue,), records.append)
    return records


@contextmanager
def _listening(progress: DriveProgress) -> Iterator[SimpleQueue[Any]]:
    """A queue whose messages become progress here while other processes work."""
    queue: SimpleQueue[Any] = multiprocessing.get_context("spawn").SimpleQueue()

    def listen() -> None:
        while (message := queue.get()) is not None:
            progress(*message)

    # A process that was ended in the middle of a message leaves a queue that is never heard to its end.
    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    try:
        yield queue
    finally:
        queue.put(None)
        listener.join(_PATIENCE_S)


def _start_worker(queue: SimpleQueue[Any]) -> None:
    global _queue
    _queue = queue
    logging.getLogger("v2hdm").setLevel(logging.ERROR)


def _work(job: Job) -> dict[str, Any]:
    def report(task: str, done: int, total: int) -> None:
        if _queue is not None:
            _queue.put((job.title, task, done, total))

    with listed_files(job.root, _OPTION, _MADE):
        return drive_record(job, 1, report)


_SHOWN = ("method", "cameras", "markings", "RMSE (cm)", "RMSE of shared (cm)")  # columns on the terminal


def experiment_on_terminal(config: ExperimentConfig, config_yaml: str) -> None:
    """Run an experiment and show how far it is and what came of it."""
    console = Console(file=patient(sys.stdout))
    with drive_bars(console) as progress:
        folder, measured = run_experiment(config, config_yaml, progress)
    for port, drives in by_port(measured).items():
        console.print(_table(port, drives))
    tested = claims(measured)
    for claim in tested:
        if not claim.holds:
            difference = f"{claim.where}: {claim.text} is {claim.figure}, asked {claim.limit}"
            plain(console, f"disagrees with the paper: {difference}")
    agree = sum(claim.holds for claim in tested)
    plain(console, f"{agree} of {len(tested)} figures agree with the paper's claims")
    plain(console, f"results in {folder}: begin with experiment.md and figures.md")


def _table(port: str, drives: Sequence[Measured]) -> Table:
    """The columns of the main table that fit a terminal: method by camera set."""
    seeds = f", {len(drives)} seeds" if len(drives) > 1 else ""
    table = new_table(f"{port}{seeds}", _SHOWN[:2], _SHOWN[2:])
    heads, lines = results_table(drives)
    shown = [heads.index(name) for name in _SHOWN]
    for number, line in enumerate(lines):
        if number and line[1] != lines[number - 1][1]:
            table.add_section()
        table.add_row(*(line[column] for column in shown))
    return table
