"""Statements of people on a survey, for its document: ``job.json`` of a result."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

from v2hdm.errors import ConfigError, MapFileError
from v2hdm.settings import POSITIVE
from v2hdm.store import names
from v2hdm.store.files import check_keys, load_json, take_number, take_text, write_json

_MOST_LETTERS = 200  # of a field: two lines on paper


@dataclass(kw_only=True)
class Job:
    """The fields of a survey's document; what is None reads "not stated" there."""

    site: Annotated[str | None, "name of the site, for the report."] = None
    client: Annotated[str | None, "who ordered the survey."] = None
    operator: Annotated[str | None, "who drove and mapped."] = None
    receiver: Annotated[str | None, "receiver, antenna and correction service."] = None
    geoid: Annotated[str | None, "geoid model of heights above sea level, such as GCG2016."] = None
    epoch: Annotated[float | None, POSITIVE, "of the coordinates, years, if drive.yaml states none."] = None


JOB_KEYS = tuple(field.name for field in fields(Job))
"""The fields of a job, as settings, options and ``job.json`` name them."""

_GRID = "crs"  # in job.json: the system of the document's coordinates


def check_job(job: Job, where: str = "report.") -> None:
    """Raise ConfigError, which names the key, for a field that does not fit on the document."""
    for key, value in asdict(job).items():
        if isinstance(value, str) and (
            not value.strip() or len(value) > _MOST_LETTERS or not _is_line(value)
        ):
            raise ConfigError(f"{where}{key}: give one line of 1 to {_MOST_LETTERS} letters")
    if job.epoch is not None and not (math.isfinite(job.epoch) and job.epoch > 0):
        raise ConfigError(f"{where}epoch is {job.epoch}: give years, such as 2024.4")


def _is_line(text: str) -> bool:
    return all(letter.isprintable() for letter in text)


@dataclass(frozen=True)
class StatedJob:
    """A job and the coordinate system of its document, None for the UTM zone of the site."""

    job: Job
    crs: str | None = None

    def with_more(self, job: Job, crs: str | None) -> StatedJob:
        """The same with all that is stated now, in place of what was stated before."""
        stated = {key: value for key, value in asdict(job).items() if value is not None}
        return StatedJob(replace(self.job, **stated), crs or self.crs)


NO_JOB = StatedJob(Job())
"""Nothing is stated."""


def job_of(settings: Any) -> Job:
    """The fields of a job among other ``settings``."""
    return Job(**{key: getattr(settings, key) for key in JOB_KEYS})


def write_job(folder: Path, stated: StatedJob) -> None:
    """Write ``job.json`` into a folder; what is not stated has no entry."""
    content = {key: value for key, value in asdict(stated.job).items() if value is not None}
    if stated.crs is not None:
        content[_GRID] = stated.crs
    write_json(folder / names.JOB, content)


def read_job(folder: Path) -> StatedJob:
    """The job of a result; nothing is stated where the folder has none. MapFileError if damaged."""
    path = folder / names.JOB
    if not path.is_file():
        return NO_JOB
    content = load_json(path, MapFileError)
    check_keys(content, (), (*JOB_KEYS, _GRID), str(path), MapFileError)
    crs = take_text(content.pop(_GRID), f"{path}: {_GRID}", MapFileError) if _GRID in content else None
    values: dict[str, Any] = {}
    for key, value in content.items():
        take = take_number if key == "epoch" else take_text
        values[key] = take(value, f"{path}: {key}", MapFileError)
    return StatedJob(Job(**values), crs)
