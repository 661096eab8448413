"""What a fleet maps: run files composed, each drive with the folder and the key of its result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from v2hdm import __version__
from v2hdm.config import compose_run_file, to_dataclass, to_yaml
from v2hdm.detection.weights import NETWORK_FILE, digest
from v2hdm.errors import ConfigError, V2hdmError
from v2hdm.fleet.rows import Row
from v2hdm.pipeline import RunConfig
from v2hdm.pipeline.run import run_name
from v2hdm.texts import take_name

_OF_PLACE = ("output", "cache", "workers")
"""Settings that say where and how something is done, and change nothing of what comes out."""


@dataclass(frozen=True)
class Job:
    """One drive to map.

    Attributes:
        name: of the run.
        source: its run file.
        config, config_yaml: what to do, and as text to be kept beside the results.
        key: of all that the result is made of.
    """

    name: str
    source: Path
    config: RunConfig
    config_yaml: str
    key: str

    @property
    def folder(self) -> Path:
        """The folder that takes the results."""
        return Path(self.config.output) / self.name


def plan(files: Sequence[Path], overrides: Sequence[str]) -> tuple[list[Job], list[Row]]:
    """The drives of run files, and a row for each file that says no drive.

    Args:
        files: as ``conf/run/*.yaml`` are written.
        overrides: ``key=value`` for all of them.
    """
    jobs: list[Job] = []
    refused: list[Row] = []
    taken: dict[Path, Path] = {}
    for file in files:
        try:
            job = _job(file, overrides)
            place = job.folder.resolve()
            if place in taken:
                raise ConfigError(
                    f"{file}: its results go to {job.folder}, as those of {taken[place]} do; give one of "
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
    return Job(name, file, config, to_yaml(composed), _key(config))


def _key(config: RunConfig) -> str:
    settings: dict[str, Any] = asdict(config)
    for name in _OF_PLACE:
        del settings[name]
    del settings["drive"]["cache"]
    model = NETWORK_FILE if config.detector.model is None else Path(config.detector.model)
    made_of = {
        "version": __version__,
        "settings": settings,
        "network": digest(model) if model.is_file() else None,
        "inputs": list(_inputs(config)),
    }
    return hashlib.sha256(json.dumps(made_of, sort_keys=True, default=str).encode()).hexdigest()


def _inputs(config: RunConfig) -> Iterator[tuple[str, int, int]]:
    """The files that a run reads: name, size and time of the last change."""
    named = [*config.drive.paths, config.map.base, config.mapping.survey.file]
    for path in [Path(one) for one in named if one is not None]:
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in files:
            if file.is_file():
                state = file.stat()
                yield str(file), state.st_size, state.st_mtime_ns
