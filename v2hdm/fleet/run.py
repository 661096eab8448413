"""A fleet from its run files to its table: drives side by side, each retried when its worker dies."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from v2hdm.fleet.cluster import LOCAL, NO_GPU, RETRIES, Shares, cluster, wants_gpu
from v2hdm.fleet.plan import STYLES, Job, Row, as_csv, as_json, as_table, plan, plan_site
from v2hdm.progress import patient
from v2hdm.report.terminal import DriveProgress, drive_bars, plain
from v2hdm.store.results import GrowingFolder, growing_folder

ALL = "fleet"  # in place of a drive's name, for the progress of the fleet
_LOOK_EVERY_S = 0.3


@dataclass(frozen=True)
class FleetOptions:
    """The choices of a user beside the drives.

    ``workers`` are the cores that are used on this machine, 0 for all; ``address`` is that of a cluster.
    ``folder`` takes the table; ``again`` does what is finished again. ``site`` names the
    one that all drives are of; without a name each is mapped by itself.
    """

    folder: Path
    workers: int = 0
    address: str = LOCAL
    again: bool = False
    site: str | None = None


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
    """Map the drives of run files: a row for each file, in their order, or one for a site.

    The table is written anew whenever a drive is done. Raises V2hdmError where it cannot, or without Ray.
    """
    settings = [*overrides, "resume=false"] if options.again else overrides
    todo = plan(files, settings) if options.site is None else plan_site(files, settings, options.site)
    with growing_folder(options.folder, "--table", "v2hdm fleet") as folder:
        table = _Table(folder, todo.sources, progress)
        for row in todo.refused:
            table.add(row)
        if todo.jobs:
            with cluster(options.address, options.workers) as ray:
                _map_all(ray, todo.jobs, table, progress)
        return table.rows


class _Table:
    """The rows so far, on disk as well."""

    def __init__(self, folder: GrowingFolder, sources: Sequence[str], progress: DriveProgress) -> None:
        self._folder, self._sources, self._progress = folder, sources, progress
        self._rows: dict[str, Row] = {}

    @property
    def rows(self) -> list[Row]:
        """In the order of the sources."""
        return [self._rows[one] for one in self._sources if one in self._rows]

    def add(self, row: Row, trace: str = "") -> None:
        """Add the row of a drive, and the traceback of a bug where there is one."""
        self._rows[row.source] = row
        if trace:
            self._folder.write(f"{row.drive}.traceback.txt", trace.encode())
        self._folder.write("fleet.csv", as_csv(self.rows))
        self._folder.write("fleet.json", as_json(self.rows))
        self._progress(row.drive, row.status, 1, 1)
        self._progress(ALL, "drives", len(self._rows), len(self._sources))


def _map_all(ray: Any, todo: Sequence[Job], table: _Table, progress: DriveProgress) -> None:
    from v2hdm.fleet.workers import ProgressActor, map_drive, open_detectors

    cores, gpus = (int(ray.cluster_resources().get(kind, 0)) for kind in ("CPU", "GPU"))
    cores, here = max(cores, 1), str(Path.cwd())
    for job in [one for one in todo if gpus == 0 and wants_gpu(one.config)]:
        table.add(Row.of_error(job.name, job.source, NO_GPU))
    todo = [job for job in todo if gpus or not wants_gpu(job.config)]
    shares = Shares.of([job.config for job in todo])
    devices = {job.config.detector.device for job in todo}
    detectors = open_detectors(devices, cores, gpus, shares.detector, here, RETRIES)
    reports = ray.remote(ProgressActor).options(num_cpus=0, max_restarts=-1).remote()
    left = list(todo)[::-1]
    doing: dict[Any, Job] = {}
    while left or doing:
        while left and len(doing) < cores:
            job = left.pop()
            share = shares.mapping if job.config.device == "cuda" else 0
            mapping = ray.remote(map_drive).options(num_cpus=0.5, num_gpus=share, max_retries=RETRIES)
            doing[mapping.remote(job, detectors[job.config.detector.device], reports, here)] = job
        done, _ = ray.wait(list(doing), num_returns=1, timeout=_LOOK_EVERY_S)
        with suppress(ray.exceptions.RayError):  # the actor died, and is being restarted
            for report in ray.get(reports.take.remote()):
                progress(*report)
        for reference in done:
            table.add(*_outcome(ray, reference, doing.pop(reference)))


def _outcome(ray: Any, reference: Any, job: Job) -> tuple[Row, str]:
    try:
        outcome: tuple[Row, str] = ray.get(reference)
    except ray.exceptions.RayError as error:
        # Whatever map_drive raises is a row already: this is its process, again and again.
        line = (
            f"its worker process died {RETRIES + 1} times ({type(error).__name__}), perhaps for want of "
            "memory; set fewer --workers"
        )
        return Row.of_error(job.name, job.source, line), str(error)
    return outcome
