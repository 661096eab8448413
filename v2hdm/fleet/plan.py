"""The plan of a fleet, from run files, and its table of verdicts: one row per drive."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.table import Table
from rich.text import Text

from v2hdm.cli.compose import compose_run_file, to_dataclass, to_yaml
from v2hdm.errors import EXIT_FAILED_VERDICT, EXIT_USER_ERROR, ConfigError, V2hdmError, one_line
from v2hdm.io.safe.texts import take_name
from v2hdm.pipeline.config import RunConfig, run_name
from v2hdm.report.terminal import new_table
from v2hdm.store.remote import place_of

ERROR = "ERROR"  # status of a drive of which there is no result
STYLES = {"PASS": "bold green", "WARN": "bold yellow", "FAIL": "bold red", ERROR: "bold red"}


@dataclass(frozen=True)
class Row:
    """The outcome of one drive: ``says`` is the worst finding, or the error, in one line.

    ``kept`` says that an earlier result of the same content was found. ``folder`` is that of the result,
    or its URL, empty without one; ``source`` is the run file.
    """

    drive: str
    status: str
    says: str
    images: int | None
    markings: int | None
    minutes: float | None
    kept: bool
    folder: str
    source: str

    @classmethod
    def of_error(cls, drive: str, source: str, message: str) -> Row:
        """The row of a drive that gave no result."""
        return cls(drive, ERROR, one_line(message), None, None, None, False, "", source)

    @classmethod
    def of_result(cls, drive: str, source: str, place: str, metrics: Mapping[str, Any], kept: bool) -> Row:
        """The row of a finished run, from its ``metrics.json``."""
        verdict, sets = metrics["verdict"], list(metrics["results"].values())
        worst = next((f"{one['check']} ({one['about']}): {one['says']}" for one in verdict["findings"]), "")
        markings = int(sets[-1]["Opt"]["markings"]) if sets else None
        images, seconds = int(metrics["drive"]["images"]), sum(metrics.get("seconds", {}).values())
        figures = (images, markings, round(seconds / 60, 3))
        return cls(drive, str(verdict["status"]), one_line(worst), *figures, kept, place, source)


def as_csv(rows: Sequence[Row]) -> bytes:
    """The rows as a spreadsheet."""
    out = io.StringIO()
    writer = csv.DictWriter(out, [one.name for one in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return out.getvalue().encode()


def as_json(rows: Sequence[Row]) -> bytes:
    """The rows as JSON."""
    return (json.dumps({"drives": [asdict(row) for row in rows]}, indent=2) + "\n").encode()


def as_table(rows: Sequence[Row]) -> Table:
    """The rows for the terminal."""
    table = new_table(None, ("drive", "verdict"), ("images", "markings", "minutes"))
    for row in rows:
        numbers = ["" if one is None else str(one) for one in (row.images, row.markings)]
        minutes = "kept" if row.kept else "" if row.minutes is None else f"{row.minutes:.1f}"
        table.add_row(Text(row.drive), Text(row.status, STYLES.get(row.status, "")), *numbers, minutes)
    return table


def exit_code(rows: Sequence[Row]) -> int:
    """2 where a drive gave no result, else 3 where a verdict is FAIL, else 0."""
    found = {row.status for row in rows}
    return EXIT_USER_ERROR if ERROR in found else EXIT_FAILED_VERDICT if "FAIL" in found else 0


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
        there = place_of(self.config.output, "output=")
        return str((there / self.name).resolve() if isinstance(there, Path) else there.below(self.name))


@dataclass(frozen=True)
class Plan:
    """The jobs, a row for each file that names no drive, and the sources of both in the files' order."""

    jobs: list[Job]
    refused: list[Row]
    sources: list[str]


def plan(files: Sequence[Path], overrides: Sequence[str], share: tuple[int, int] = (1, 1)) -> Plan:
    """The drives of run files, each by itself; ``overrides`` are ``key=value`` for all of them.

    Of ``share`` = (k, n) only every n-th file, beginning with the k-th, is planned; results of all must go to
    different places nevertheless.
    """
    jobs: list[Job] = []
    refused: list[Row] = []
    taken: dict[str, Path] = {}
    for file in files:
        try:
            composed, config = _composed(file, overrides)
            take_name(run_name(config), "name", ConfigError)
            job = Job(run_name(config), str(file), config, to_yaml(composed))
            place = job.place
            if place in taken:
                raise ConfigError(
                    f"{file}: its results go to {place}, as those of {taken[place]}; name one otherwise"
                )
            taken[place] = file
            jobs.append(job)
        except V2hdmError as error:
            refused.append(Row.of_error(file.stem, str(file), str(error)))
    sources = [str(file) for file in files][share[0] - 1 :: share[1]]
    mine = [one for one in jobs if one.source in sources]
    return Plan(mine, [one for one in refused if one.source in sources], sources)


def _composed(file: Path, overrides: Sequence[str]) -> tuple[DictConfig, RunConfig]:
    composed = compose_run_file(file, "map", RunConfig, overrides)
    config = to_dataclass(composed, RunConfig, f"set it in {file}")
    for place in (config.output, config.cache):
        if place.startswith("memory:"):
            raise ConfigError(f"{place}: is gone with the process that wrote it, and a fleet has many")
    return composed, config
