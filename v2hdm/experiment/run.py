"""An experiment from its settings to its folder: the drives side by side, then tables, figures and text."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from v2hdm.errors import ConfigError, WorkerError
from v2hdm.executor import Executor, open_executor
from v2hdm.experiment.drive import Measured, drive_record, measure
from v2hdm.experiment.paper import load_paper
from v2hdm.experiment.plan import ExperimentConfig, Job, jobs
from v2hdm.progress import patient
from v2hdm.report.terminal import DriveProgress, drive_bars, plain
from v2hdm.store.files import replace_text
from v2hdm.store.names import CONFIG
from v2hdm.store.results import growing_folder

_paper = load_paper()
_OPTION = "output="
_MADE = "v2hdm experiment"


def run_experiment(
    config: ExperimentConfig, config_yaml: str, progress: DriveProgress
) -> tuple[Path, list[Measured]]:
    """Map every drive by every recipe and write what comes of it; returns the folder and all figures."""
    todo = jobs(config)
    folder = Path(config.output) / config.name
    try:
        with growing_folder(folder, _OPTION, _MADE):
            replace_text(folder / CONFIG, config_yaml or f"{config!r}\n")
            with open_executor(config.workers, config.cluster, writable=[config.cache]) as executor:
                records = _records(todo, executor, progress)
            measured = [measure(record) for record in records]
            captions = _paper.save_figures(folder, records, measured, partial(progress, "figures", "draw"))
            _paper.write_tables(folder, measured)
            replace_text(folder / "experiment.md", _paper.words(measured, config))
            replace_text(folder / "figures.md", _paper.filled("figures.md", captions=captions))
    except OSError as failure:
        raise ConfigError(f"{folder}: cannot be written ({failure.strerror}); set output=") from failure
    return folder, measured


def _records(todo: Sequence[Job], executor: Executor, progress: DriveProgress) -> list[dict[str, Any]]:
    if executor.workers <= 1 or len(todo) == 1:
        return [drive_record(job, partial(progress, job.title), executor) for job in todo]
    records: dict[int, dict[str, Any]] = {}

    def advance(job: Job, task: str, done: int, total: int) -> None:
        progress(job.title, task, done, total)

    for number, record in executor.side_by_side(drive_record, todo, advance):
        if isinstance(record, WorkerError):
            raise record
        records[number] = record
    return [records[number] for number in range(len(todo))]


def experiment_on_terminal(config: ExperimentConfig, config_yaml: str) -> None:
    """Run an experiment and show how far it is and what came of it."""
    console = Console(file=patient(sys.stdout))
    with drive_bars(console) as progress:
        folder, measured = run_experiment(config, config_yaml, progress)
    tested = _paper.claims(measured)
    for claim in tested:
        if not claim.holds:
            difference = f"{claim.where}: {claim.text} is {claim.figure}, expected {claim.limit}"
            plain(console, f"disagrees with the paper: {difference}")
    agree = sum(claim.holds for claim in tested)
    plain(console, f"{agree} of {len(tested)} figures agree with the paper's claims")
    plain(console, f"results in {folder}: start with experiment.md and figures.md")
