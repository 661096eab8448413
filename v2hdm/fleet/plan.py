"""What a fleet maps: run files composed, each drive with the folder of its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from v2hdm.config import compose_run_file, to_dataclass, to_yaml
from v2hdm.errors import ConfigError, V2hdmError
from v2hdm.fleet.rows import Row
from v2hdm.objects.bucket import place_of
from v2hdm.pipeline import RunConfig
from v2hdm.pipeline.config import run_name
from v2hdm.texts import take_name


@dataclass(frozen=True)
class Job:
    """One drive to map.

    Attributes:
        name: of the run.
        source: its run file.
        config, config_yaml: what to do, and as text to be kept beside the results.
    """

    name: str
    source: Path
    config: RunConfig
    config_yaml: str

    @property
    def place(self) -> str:
        """What takes the results: a folder, or the URL of one."""
        there = place_of(self.config.output, "output=")
        return str((there / self.name).resolve() if isinstance(there, Path) else there.below(self.name))


def plan(files: Sequence[Path], overrides: Sequence[str]) -> tuple[list[Job], list[Row]]:
    """The drives of run files, and a row for each file that says no drive.

    Args:
        files: as ``conf/run/*.yaml`` are written.
        overrides: ``key=value`` for all of them.
    """
    jobs: list[Job] = []
    refused: list[Row] = []
    taken: dict[str, Path] = {}
    for file in files:
        try:
            job = _job(file, overrides)
            place = job.place
            if place in taken:
                raise ConfigError(
                    f"{file}: its results go to {place}, as those of {taken[place]} do; give one of "
                    "them another name"
                )
            taken[place] = file
            jobs.append(job)
        except V2hdmError as error:
            refused.append(Row.of_error(file.stem, file, str(error)))
    return jobs, refused


def _job(file: Path, overrides: Sequence[str]) -> Job:
    composed = compose_run_file(file, "map", RunConfig, overrides)
    config = to_dataclass(composed, RunConfig, f"set it in {file}")
    name = run_name(config)
    take_name(name, "name", ConfigError)
    for place in (config.output, config.cache):
        if place.startswith("memory:"):
            raise ConfigError(f"{place}: is gone with the process that wrote it, and a fleet has many")
    return Job(name, file, config, to_yaml(composed))
