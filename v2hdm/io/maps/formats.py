"""The formats of a map: one registry of what is written, and of what is read."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from v2hdm.errors import ConfigError, MapFileError
from v2hdm.io.maps.dxf import write_dxf
from v2hdm.io.maps.geojson import read_geojson, read_verdict, write_geojson
from v2hdm.io.maps.geopackage import read_geopackage, read_geopackage_verdict, write_geopackage
from v2hdm.io.maps.lanelet2 import write_lanelet2
from v2hdm.io.maps.needs import need
from v2hdm.io.maps.spreadsheet import write_csv
from v2hdm.records import HdMap

_log = logging.getLogger(__name__)

Verdict = Mapping[str, Any] | None


@dataclass(frozen=True)
class Format:
    """One format: where its file lies, by the map's name, what writes it and the packages that it needs."""

    file: str
    write: Callable[[HdMap, Path, Verdict], None]
    needs: tuple[str, ...] = ()


FORMATS: Mapping[str, Format] = {
    "geojson": Format("{name}.geojson", write_geojson),
    "csv": Format("{name}.csv", write_csv),
    "gpkg": Format("{name}.gpkg", write_geopackage, ("pyogrio",)),
    "lanelet2": Format("{name}_lanelet2/lanelet2_map.osm", write_lanelet2),
    "dxf": Format("{name}.dxf", write_dxf, ("ezdxf",)),
}


@dataclass(frozen=True)
class Reader:
    """What reads a map from a file of one format, and the verdict that stands in it."""

    read: Callable[[Path], HdMap]
    verdict: Callable[[Path], Verdict]


READERS: Mapping[str, Reader] = {
    ".geojson": Reader(read_geojson, read_verdict),
    ".gpkg": Reader(read_geopackage, read_geopackage_verdict),
}
"""By the ending of the file's name: the formats that people edit."""


def check_formats(names: Sequence[str], key: str) -> None:
    """Refuse formats that are not known, or whose packages are not installed, before any long work.

    Raises:
        ConfigError: the message names the ``key`` that they were given by, or the package.
    """
    for name in names:
        if name not in FORMATS:
            raise ConfigError(f"{key}: unknown format '{name}'; choose from: {', '.join(FORMATS)}")
        for package in FORMATS[name].needs:
            need(package, name)


def write_map(
    hd_map: HdMap,
    folder: Path,
    name: str,
    formats: Sequence[str],
    verdict: Verdict = None,
    projector: str | None = None,
) -> list[Path]:
    """Write a map in several formats to ``folder``; returns the files, each written atomically.

    Args:
        hd_map: what is written.
        folder: where to.
        name: what the files are called.
        formats: of :data:`FORMATS`.
        verdict: that on the run which made the map, as JSON.
        projector: that of Lanelet2, see :func:`v2hdm.io.maps.lanelet2.write_lanelet2`.

    Raises:
        ConfigError: a format is not known, lacks its package, or the projector does not suit the map.
    """
    check_formats(formats, "formats")
    written = []
    for chosen in dict.fromkeys(formats):
        path = folder / FORMATS[chosen].file.format(name=name)
        write = (
            partial(write_lanelet2, projector=projector) if chosen == "lanelet2" else FORMATS[chosen].write
        )
        write(hd_map, path, verdict)
        written.append(path)
        if chosen == "geojson" and hd_map.origin is None:
            _log.warning(
                "%s: the drive has no origin on the earth, so its coordinates are metres, which a GIS opens "
                "as degrees; the format gpkg says what they are",
                path.name,
            )
    return written


def read_map(path: Path) -> tuple[HdMap, Verdict]:
    """A map and the verdict on it, from a file in one of the formats of :data:`READERS`.

    Raises:
        MapFileError: the file is missing, damaged or in another format.
        ConfigError: a package that reads it is not installed.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise MapFileError(
            f"{path}: no map that can be read; give a file that ends in {' or '.join(READERS)}"
        )
    return reader.read(path), reader.verdict(path)
