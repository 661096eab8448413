"""An experiment from its settings to its folder: the drives side by side, then tables, figures and words."""

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

from v2hdm.errors import ConfigError
from v2hdm.experiment.drive import drive_record
from v2hdm.experiment.figures import save_figures
from v2hdm.experiment.measures import Measured, measure
from v2hdm.experiment.plan import ExperimentConfig, Job, jobs
from v2hdm.experiment.tables import write_tables
from v2hdm.experiment.words import write_words
from v2hdm.store.files import replace_text
from v2hdm.store.results import growing_folder, listed_files
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
