"""A fleet from its run files to its table: drives side by side, each retried when its worker dies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2hdm.fleet.cluster import LOCAL, RETRIES, cluster
from v2hdm.fleet.gpus import NO_GPU, Shares, wants_gpu
from v2hdm.fleet.plan import Job, plan, plan_site
from v2hdm.fleet.rows import Row, as_csv, as_json
from v2hdm.store.remote import place_of
from v2hdm.store.results import GrowingFolder, growing_folder
from v2hdm.store.upload import RemoteTable

Tell = Callable[[str, str, int, int], None]
"""Told a drive, its stage, and how many of the stage's steps are done, of how many."""

ALL = "fleet"
"""In place of a drive's name, for what is told of the fleet."""

_LOOK_EVERY_S = 0.3


@dataclass(frozen=True)
class FleetOptions:
    """What a user chooses beside the drives.

    ``workers`` are the cores that are used on this machine, 0 for all; ``address`` is that of a cluster.
    ``folder``, or the URL of one, takes the table; ``again`` does what is finished again. ``site`` names the
    one that all drives are of; without a name each is mapped by itself.
    """

    folder: Path | str
    workers: int = 0
    address: str = LOCAL
    again: bool = False
    site: str | None = None


def run_fleet(
    files: Sequence[Path], overrides: Sequence[str], options: FleetOptions, tell: Tell
) -> list[Row]:
    """Map the drives of run files; the table is written anew whenever one is done.

    Args:
        files: run files.
        overrides: ``key=value`` for all of them.
        options: how.
        tell: told how far it is.

    Returns:
        A row for each file, in their order; one for a site.

    Raises:
        V2hdmError: the table cannot be written, or there is no Ray.
    """
    told = [*overrides, "resume=false"] if options.again else overrides
    todo = plan(files, told) if options.site is None else plan_site(files, told, options.site)
    with _growing(options.folder) as folder:
        table = _Table(folder, todo.sources, tell)
        for row in todo.refused:
            table.add(row)
        if todo.jobs:
            with cluster(options.address, options.workers) as ray:
                _map_all(ray, todo.jobs, table, tell)
        return table.rows


def _growing(place: Path | str) -> AbstractContextManager[GrowingFolder | RemoteTable]:
    """Where the table goes: a folder, or a place at an object store."""
    there = place_of(str(place), "--table")
    if isinstance(there, Path):
        return growing_folder(there, "--table")
    there.check()
    return nullcontext(RemoteTable(there))


class _Table:
    """The rows so far, on disk as well."""

    def __init__(self, folder: GrowingFolder | RemoteTable, sources: Sequence[str], tell: Tell) -> None:
        self._folder, self._sources, self._tell = folder, sources, tell
        self._rows: dict[str, Row] = {}

    @property
    def rows(self) -> list[Row]:
        """In the order of the sources."""
        return [self._rows[one] for one in self._sources if one in self._rows]

    def add(self, row: Row, trace: str = "") -> None:
        """Take the row of a drive, and the traceback of a bug where there is one."""
        self._rows[row.source] = row
        if trace:
            self._folder.write(f"{row.drive}.traceback.txt", trace.encode())
        self._folder.write("fleet.csv", as_csv(self.rows))
        self._folder.write("fleet.json", as_json(self.rows))
        self._tell(row.drive, row.status, 1, 1)
        self._tell(ALL, "drives", len(self._rows), len(self._sources))


def _map_all(ray: Any, todo: Sequence[Job], table: _Table, tell: Tell) -> None:
    """Map the drives, as many at a time as there are cores."""
    from v2hdm.fleet.board import Board
    from v2hdm.fleet.eyes import open_eyes
    from v2hdm.fleet.work import map_drive

    cores, gpus = (int(ray.cluster_resources().get(kind, 0)) for kind in ("CPU", "GPU"))
    cores, here = max(cores, 1), str(Path.cwd())
    for job in [one for one in todo if gpus == 0 and wants_gpu(one.config)]:
        table.add(Row.of_error(job.name, job.source, NO_GPU))
    todo = [job for job in todo if gpus or not wants_gpu(job.config)]
    shares = Shares.of([job.config for job in todo])
    eyes = open_eyes({job.config.detector.device for job in todo}, cores, gpus, shares.eyes, here, RETRIES)
    board = ray.remote(Board).options(num_cpus=0, max_restarts=-1).remote()
    left = list(todo)[::-1]
    doing: dict[Any, Job] = {}
    while left or doing:
        while left and len(doing) < cores:
            job = left.pop()
            share = shares.mapping if job.config.device == "cuda" else 0
            mapping = ray.remote(map_drive).options(num_cpus=0.5, num_gpus=share, max_retries=RETRIES)
            doing[mapping.remote(job, eyes[job.config.detector.device], board, here)] = job
        done, _ = ray.wait(list(doing), num_returns=1, timeout=_LOOK_EVERY_S)
        for message in _told(ray, board):
            tell(*message)
        for reference in done:
            table.add(*_outcome(ray, reference, doing.pop(reference)))


def _told(ray: Any, board: Any) -> list[tuple[str, str, int, int]]:
    try:
        messages: list[tuple[str, str, int, int]] = ray.get(board.take.remote())
    except ray.exceptions.RayError:  # it died, and is being restarted
        return []
    return messages


def _outcome(ray: Any, reference: Any, job: Job) -> tuple[Row, str]:
    try:
        outcome: tuple[Row, str] = ray.get(reference)
    except ray.exceptions.RayError as error:
        # What map_drive raises is a row already: this is its process, again and again.
        line = (
            f"its worker process died {RETRIES + 1} times ({type(error).__name__}), perhaps for want of "
            "memory; set fewer --workers"
        )
        return Row.of_error(job.name, job.source, line), str(error)
    return outcome
