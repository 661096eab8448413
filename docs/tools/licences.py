"""Write the table of installed parts, ``docs/installed_parts.csv``: ``python docs/tools/licences.py``.

Parts are what the wheel's base install and its extras require, directly or through others, as installed here.
Licences are those that each states of itself: an SPDX expression, else its classifiers, else its own words.
"""

from __future__ import annotations

import csv
import re
import tomllib
from collections.abc import Iterator, Sequence
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
TABLE = ROOT / "docs" / "installed_parts.csv"
EXTRAS = ("", "map", "ros", "ubx", "video", "gis", "parquet", "text", "pdf")
"""Extras that users install; the first is the base install."""

_HEADS = ("package", "version", "licence", "installed by")
_LONGEST = 160  # letters of a licence; some packages state its whole text


class Part(NamedTuple):
    """An installed package, and the first of :data:`EXTRAS` that brings it."""

    name: str
    version: str
    licence: str
    extra: str


def parts() -> list[Part]:
    """The installed packages of all extras, by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    part_of_name: dict[str, Part] = {}
    for extra in EXTRAS:
        stated = project["optional-dependencies"][extra] if extra else project["dependencies"]
        for installed in _required(stated, set(part_of_name)):
            name = canonicalize_name(installed.metadata["Name"])
            part_of_name[name] = Part(name, installed.version, licence_of(installed), extra)
    return sorted(part_of_name.values())


def _required(stated: Sequence[str], listed: set[str]) -> Iterator[Distribution]:
    """The packages that requirements bring, but those whose names are ``known``, which grows."""
    pending = [Requirement(line) for line in stated]
    while pending:
        requirement = pending.pop()
        name = canonicalize_name(requirement.name)
        chosen = [{"extra": extra} for extra in requirement.extras] or [{"extra": ""}]
        if name in listed or (requirement.marker and not any(map(requirement.marker.evaluate, chosen))):
            continue
        listed.add(name)
        try:
            installed = distribution(name)
        except PackageNotFoundError:  # of another platform, or of no extra that is installed
            continue
        yield installed
        pending += [
            line
            for line in map(Requirement, installed.requires or ())
            if line.marker is None or any(map(line.marker.evaluate, chosen))
        ]


def licence_of(installed: Distribution) -> str:
    """The licence that a package states of itself."""
    metadata = installed.metadata
    classifiers = [
        line.rsplit(" :: ", 1)[-1]
        for line in metadata.get_all("Classifier") or ()
        if line.startswith("License ::") and not line.endswith("OSI Approved")
    ]
    stated = metadata.get("License-Expression") or "; ".join(classifiers) or metadata.get("License") or ""
    first = re.split(r"\n|\. ", stated.strip(), maxsplit=1)[0]
    return first[:_LONGEST] or "not stated in its metadata"


def main() -> None:
    """Write the table."""
    rows = [(part.name, part.version, part.licence, part.extra or "base") for part in parts()]
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([_HEADS, *rows])


if __name__ == "__main__":
    main()
