"""A fleet from its run files to its table: drives side by side, by workers of this machine or others."""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table
from rich.text import Text

from v2hdm.cli.compose import compose_run_file, to_dataclass, to_yaml
from v2hdm.errors import (
    EXIT_FAILED_VERDICT,
    EXIT_USER_ERROR,
    ConfigError,
    V2hdmError,
    WorkerError,
    describe,
    masked,
    one_line,
)  # fmt: skip
from v2hdm.executor import Executor, open_executor
from v2hdm.pipeline.config import RunConfig, run_name
from v2hdm.pipeline.run import take_or_run
from v2hdm.progress import Progress, patient
from v2hdm.records import BEST
from v2hdm.report.terminal import DriveProgress, drive_bars, new_table, plain
from v2hdm.safe.texts import take_name
from v2hdm.store.files import csv_text
from v2hdm.store.remote import is_url, place_of
from v2hdm.store.results import WriteFile, growing_folder

ERROR = "ERROR"  # status of a drive without a result
STYLES = {"PASS": "bold green", "WARN": "bold yellow", "FAIL": "bold red", ERROR: "bold red"}


@dataclass(frozen=True)
class Row:
    """The outcome of one drive."""

    drive: str
    status: str
    says: str  # the worst finding, or the error, in one line
    images: int | None
    markings: int | None
    minutes: float | None
    kept: bool  # an earlier result of the same content was found
    folder: str  # of the result, or its URL, empty without one
    source: str  # the run file

    @classmethod
    def of_error(cls, drive: str, source: str, message: str) -> Row:
        """The row of a drive that gave no result."""
        return cls(drive, ERROR, one_line(message), None, None, None, False, "", source)

    @classmethod
    def of_result(
        cls, drive: str, source: str, place: str, metrics: Mapping[str, Any], is_reused: bool
    ) -> Row:
        """The row of a finished run, from its ``metrics.json``."""
        verdict = metrics["verdict"]
        sets = list(metrics["results"].values())
        worst = next(
            (
                f"{finding['check']} ({finding['about']}): {finding['says']}"
                for finding in verdict["findings"]
            ),
            "",
        )
        markings = int(sets[-1][BEST]["markings"]) if sets else None
        images = int(metrics["drive"]["images"])
        seconds = sum(metrics.get("seconds", {}).values())
        return cls(
            drive=drive,
            status=str(verdict["status"]),
            says=one_line(worst),
            images=images,
            markings=markings,
            minutes=round(seconds / 60, 3),
            kept=is_reused,
            folder=place,
            source=source,
        )


def _shown(row: Row) -> dict[str, Any]:
    """A row as others may see it."""
    return {name: masked(value) if isinstance(value, str) else value for name, value in asdict(row).items()}


def as_csv(rows: Sequence[Row]) -> bytes:
    """The rows as a spreadsheet."""
    heading = [field.name for field in fields(Row)]
    return csv_text([heading, *([*_shown(row).values()] for row in rows)]).encode()


def as_json(rows: Sequence[Row]) -> bytes:
    """The rows as JSON."""
    return (json.dumps({"drives": [_shown(row) for row in rows]}, indent=2) + "\n").encode()


def as_table(rows: Sequence[Row]) -> Table:
    """The rows for the terminal."""
    table = new_table(None, ("drive", "verdict"), ("images", "markings", "minutes"))
    for row in rows:
        images, markings = ("" if figure is None else str(figure) for figure in (row.images, row.markings))
        minutes = "" if row.minutes is None else f"{row.minutes:.1f}"
        if row.kept:
            minutes = "kept"
        status = Text(row.status, STYLES.get(row.status, ""))
        table.add_row(Text(row.drive), status, images, markings, minutes)
    return table


def exit_code(rows: Sequence[Row]) -> int:
    """2 where a drive gave no result, else 3 where a verdict is FAIL, else 0."""
    statuses = {row.status for row in rows}
    if ERROR in statuses:
        return EXIT_USER_ERROR
    return EXIT_FAILED_VERDICT if "FAIL" in statuses else 0


@dataclass(frozen=True)
class Job:
    """One drive to map; ``source`` is its run file, ``config_yaml`` its configuration, to be kept as text."""

    name: str
    source: str
    config: RunConfig
    config_yaml: str

    @property
    def place(self) -> str:
        """The folder of the results, or its URL."""
        output = place_of(self.config.output, "output=")
        return str((output / self.name).resolve() if isinstance(output, Path) else output.below(self.name))


@dataclass(frozen=True)
class Plan:
    """The jobs, a row for each file that names no drive, and the sources of both in the files' order."""

    jobs: list[Job]
    refused: list[Row]
    sources: list[str]


def plan(files: Sequence[Path], overrides: Sequence[str]) -> Plan:
    """The drives of run files, each by itself; ``overrides`` are ``key=value`` for all of them.

    Results of all must go to different places.
    """
    jobs: list[Job] = []
    refused: list[Row] = []
    file_of_place: dict[str, Path] = {}
    for file in files:
        try:
            composed, config = _composed(file, overrides)
            take_name(run_name(config), "name", ConfigError)
            job = Job(run_name(config), str(file), config, to_yaml(composed))
            place = job.place
            if place in file_of_place:
                raise ConfigError(
                    f"{file}: its results go to {place}, as those of {file_of_place[place]}; "
                    "name one otherwise"
                )
            file_of_place[place] = file
            jobs.append(job)
        except V2hdmError as error:
            refused.append(Row.of_error(file.stem, str(file), str(error)))
    return Plan(jobs, refused, [str(file) for file in files])


def _composed(file: Path, overrides: Sequence[str]) -> tuple[DictConfig, RunConfig]:
    composed = compose_run_file(file, "map", RunConfig, overrides)
    config = to_dataclass(composed, RunConfig, f"set it in {file}")
    for place in (config.output, config.cache):
        if place.startswith("memory:"):
            raise ConfigError(f"{place}: is temporary, for one process, and a fleet has many")
    return composed, config


ALL = "fleet"  # in place of a drive's name, for the progress of the fleet


@dataclass(frozen=True)
class FleetOptions:
    """The choices of a user beside the drives."""

    folder: Path  # takes the table
    workers: int = 0  # processes of this machine, or jobs of a batch system; 0 for one per core
    again: bool = False  # does what is finished again


def fleet_on_terminal(files: Sequence[Path], overrides: Sequence[str], options: FleetOptions) -> list[Row]:
    """Map a fleet, show how far it is, and its table."""
    console = Console(file=patient(sys.stdout))
    with drive_bars(console, endings=STYLES) as progress:
        rows = run_fleet(files, overrides, options, progress)
    console.print(as_table(rows))
    for row in rows:
        if row.says:
            plain(console, f"{row.drive}: {row.says}")
    plain(console, f"table in {options.folder}: fleet.csv, fleet.json")
    return rows


def run_fleet(
    files: Sequence[Path], overrides: Sequence[str], options: FleetOptions, progress: DriveProgress
) -> list[Row]:
    """Map the drives of run files: a row for each, in order; the table is written after each drive."""
    settings = [*overrides, "resume=false"] if options.again else overrides
    todo = plan(files, settings)
    with growing_folder(options.folder, "--table", "v2hdm fleet") as write:
        table = _Table(write, todo.sources, progress)
        for row in todo.refused:
            table.add(row)
        _map_all(todo.jobs, options.workers, table, progress)
        return table.rows


class _Table:
    """The rows so far, on disk as well."""

    def __init__(self, write: WriteFile, sources: Sequence[str], progress: DriveProgress) -> None:
        self._write = write
        self._sources = sources
        self._progress = progress
        self._rows: dict[str, Row] = {}

    @property
    def rows(self) -> list[Row]:
        """In the order of the sources."""
        return [self._rows[source] for source in self._sources if source in self._rows]

    def add(self, row: Row, trace: str = "") -> None:
        """Add the row of a drive, and the traceback of a bug where there is one."""
        self._rows[row.source] = row
        if trace:
            self._write(f"{row.drive}.traceback.txt", trace.encode())
        self._write("fleet.csv", as_csv(self.rows))
        self._write("fleet.json", as_json(self.rows))
        self._progress(row.drive, row.status, 1, 1)
        self._progress(ALL, "drives", len(self._rows), len(self._sources))


def _map_all(jobs: Sequence[Job], workers: int, table: _Table, progress: DriveProgress) -> None:
    """Map drives side by side; where they are fewer than workers, each takes several."""
    if not jobs:
        return

    def advance(job: Job, task: str, done: int, total: int) -> None:
        progress(job.name, task, done, total)

    with _opened(jobs, workers) as executor:
        several = max(1, executor.workers // len(jobs))
        todo = [
            replace(job, config=replace(job.config, workers=several, cluster="", worker_gb=0.0))
            for job in jobs
        ]
        for number, outcome in executor.side_by_side(_mapped, todo, advance):
            if isinstance(outcome, WorkerError):
                table.add(Row.of_error(jobs[number].name, jobs[number].source, str(outcome)))
            else:
                row, trace = outcome
                table.add(row, trace)


def _opened(jobs: Sequence[Job], workers: int) -> AbstractContextManager[Executor]:
    """The executor that the settings of all drives name."""
    for setting in ("cluster", "worker_gb"):
        values = {getattr(job.config, setting) for job in jobs}
        if len(values) > 1:
            raise ConfigError(
                f"{setting} differs between the run files ({', '.join(sorted(map(str, values)))}); give one "
                f"for all, {setting}=..."
            )
    first = jobs[0].config
    places = {place for job in jobs for place in (job.config.cache, job.config.output) if not is_url(place)}
    return open_executor(
        workers,
        first.cluster,
        memory_gb=first.worker_gb,
        readable=[str(path) for job in jobs for path in job.config.drive.paths],
        writable=sorted(places),
        isolated=True,
    )


def _mapped(job: Job, progress: Progress) -> tuple[Row, str]:
    """Map one drive and write its results; its row, and the traceback where it met a bug of ours."""
    try:
        result, is_reused = take_or_run(job.config, job.config_yaml, progress)
    except Exception as error:  # a drive that fails is a row, and the others go on
        line = describe(error)
        if line is not None:
            return Row.of_error(job.name, job.source, line), ""
        line = f"a bug in V2HDM, {type(error).__name__}: {error}; its traceback is in the fleet's folder"
        return Row.of_error(job.name, job.source, line), traceback.format_exc()
    return Row.of_result(job.name, job.source, result.place, result.metrics, is_reused), ""
