"""A fleet from its run files to its table: drives side by side, each in a process of this machine."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from v2hdm.errors import WorkerError, describe
from v2hdm.fleet.plan import STYLES, Job, Row, as_csv, as_json, as_table, plan
from v2hdm.pipeline.run import take_or_run
from v2hdm.progress import Progress, patient
from v2hdm.report.terminal import DriveProgress, drive_bars, plain
from v2hdm.store.results import WriteFile, growing_folder
from v2hdm.workers import side_by_side

ALL = "fleet"  # in place of a drive's name, for the progress of the fleet


@dataclass(frozen=True)
class FleetOptions:
    """The choices of a user beside the drives.

    ``workers`` are the cores that are used, 0 for all. ``folder`` takes the table; ``again`` does what is
    finished again. ``share`` = (k, n) maps every n-th drive, beginning with the k-th; other machines map the
    others.
    """

    folder: Path
    workers: int = 0
    again: bool = False
    share: tuple[int, int] = (1, 1)


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
    """Map the drives of run files: a row for each file, in their order.

    The table is written anew whenever a drive is done. Raises V2hdmError where it cannot.
    """
    settings = [*overrides, "resume=false"] if options.again else overrides
    todo = plan(files, settings, options.share)
    with growing_folder(options.folder, "--table", "v2hdm fleet") as write:
        table = _Table(write, todo.sources, progress)
        for row in todo.refused:
            table.add(row)
        _map_all(todo.jobs, options.workers or os.cpu_count() or 1, table, progress)
        return table.rows


class _Table:
    """The rows so far, on disk as well."""

    def __init__(self, write: WriteFile, sources: Sequence[str], progress: DriveProgress) -> None:
        self._write, self._sources, self._progress = write, sources, progress
        self._rows: dict[str, Row] = {}

    @property
    def rows(self) -> list[Row]:
        """In the order of the sources."""
        return [self._rows[one] for one in self._sources if one in self._rows]

    def add(self, row: Row, trace: str = "") -> None:
        """Add the row of a drive, and the traceback of a bug where there is one."""
        self._rows[row.source] = row
        if trace:
            self._write(f"{row.drive}.traceback.txt", trace.encode())
        self._write("fleet.csv", as_csv(self.rows))
        self._write("fleet.json", as_json(self.rows))
        self._progress(row.drive, row.status, 1, 1)
        self._progress(ALL, "drives", len(self._rows), len(self._sources))


def _map_all(jobs: Sequence[Job], cores: int, table: _Table, progress: DriveProgress) -> None:
    """Map drives side by side; where they are fewer than cores, each takes several."""
    count = max(1, min(cores, len(jobs)))
    todo = [replace(one, config=replace(one.config, workers=cores // count)) for one in jobs]
    for number, found in side_by_side(_mapped, todo, count, lambda job, *step: progress(job.name, *step)):
        if isinstance(found, WorkerError):
            found = Row.of_error(jobs[number].name, jobs[number].source, str(found)), ""
        table.add(*found)


def _mapped(job: Job, progress: Progress) -> tuple[Row, str]:
    """Map one drive and write its results; its row, and the traceback where it met a bug of ours."""
    try:
        result, kept = take_or_run(job.config, job.config_yaml, progress)
    except Exception as error:  # a drive that fails is a row, and the others go on
        line = describe(error)
        if line is not None:
            return Row.of_error(job.name, job.source, line), ""
        line = f"a bug of ours, {type(error).__name__}: {error}; its traceback is in the fleet's folder"
        return Row.of_error(job.name, job.source, line), traceback.format_exc()
    return Row.of_result(job.name, job.source, result.place, result.metrics, kept), ""
