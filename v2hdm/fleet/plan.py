"""What a fleet maps: run files composed, each drive or a whole site with the folder of its result."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from v2hdm.cli.compose import compose_run_file, to_dataclass, to_yaml
from v2hdm.errors import ConfigError, V2hdmError
from v2hdm.fleet.rows import Row
from v2hdm.io.texts import shown, take_name
from v2hdm.pipeline.config import RunConfig, run_name
from v2hdm.store.objects.bucket import place_of


@dataclass(frozen=True)
class Job:
    """One drive to map, or several of one site together.

    Attributes:
        name: of the run.
        source: its run file, or those of its drives.
        config, config_yaml: what to do, and as text to be kept beside the results.
    """

    name: str
    source: str
    config: RunConfig
    config_yaml: str

    @property
    def place(self) -> str:
        """What takes the results: a folder, or the URL of one."""
        there = place_of(self.config.output, "output=")
        return str((there / self.name).resolve() if isinstance(there, Path) else there.below(self.name))


@dataclass(frozen=True)
class Plan:
    """What to map, a row for each file that says no drive, and the sources of both in the files' order."""

    jobs: list[Job]
    refused: list[Row]
    sources: list[str]


def plan(files: Sequence[Path], overrides: Sequence[str]) -> Plan:
    """The drives of run files, each by itself.

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
            refused.append(Row.of_error(file.stem, str(file), str(error)))
    return Plan(jobs, refused, [str(file) for file in files])


def plan_site(files: Sequence[Path], overrides: Sequence[str], site: str) -> Plan:
    """All drives of run files as the one site of that name.

    Args:
        files: as for :func:`plan`; what they say beside their drives and names is the same in all.
        overrides: ``key=value`` for all of them.
        site: names the result.

    Raises:
        ConfigError: the site's name cannot be that of a folder.
    """
    take_name(site, "--site", ConfigError)
    source = ", ".join(map(str, files))
    try:
        return Plan([_site_job(files, overrides, site, source)], [], [source])
    except V2hdmError as error:
        return Plan([], [Row.of_error(site, source, str(error))], [source])


def _job(file: Path, overrides: Sequence[str]) -> Job:
    composed, config = _composed(file, overrides)
    name = run_name(config)
    take_name(name, "name", ConfigError)
    return Job(name, str(file), config, to_yaml(composed))


def _site_job(files: Sequence[Path], overrides: Sequence[str], site: str, source: str) -> Job:
    first, settings = _composed(files[0], overrides)
    paths: list[str] = []
    for file in files:
        _, config = _composed(file, overrides)
        if not config.drive.paths:
            raise ConfigError(f"{file}: --site joins drives that lie in folders; set drive.path")
        _refuse_other_settings(files[0], settings, file, config)
        told = config.drive.path
        paths += map(str, told if isinstance(told, list) else [told])
    OmegaConf.update(first, "name", site)
    OmegaConf.update(first, "drive.path", paths)
    return Job(site, source, to_dataclass(first, RunConfig, f"set it in {files[0]}"), to_yaml(first))


def _composed(file: Path, overrides: Sequence[str]) -> tuple[DictConfig, RunConfig]:
    composed = compose_run_file(file, "map", RunConfig, overrides)
    config = to_dataclass(composed, RunConfig, f"set it in {file}")
    for place in (config.output, config.cache):
        if place.startswith("memory:"):
            raise ConfigError(f"{place}: is gone with the process that wrote it, and a fleet has many")
    return composed, config


def _refuse_other_settings(first: Path, settings: RunConfig, file: Path, config: RunConfig) -> None:
    told, other = (dict(_leaves(_without_drive(one))) for one in (settings, config))
    for key in [*told, *other]:
        values = [one.get(key) for one in (told, other)]
        if values[0] != values[1]:
            raise ConfigError(
                f"{file}: {key} is {shown(values[1])}, and {shown(values[0])} in {first}: a site has one "
                f"set of settings; say the same in both, or {key}=... for all"
            )


def _without_drive(config: RunConfig) -> dict[str, Any]:
    return asdict(replace(config, name=None, drive=replace(config.drive, path=None)))


def _leaves(settings: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """All that settings say, by its dotted key."""
    for key, value in settings.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value
