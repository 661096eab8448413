"""The formats of a map: one registry of what is written, and of what is read.

An HD map as DXF for CAD: local metres, a layer a class, through ``ezdxf``.

Extended data (XDATA) of the application ``V2HDM`` at each polyline hold what CAD has no word for: strings
name the values after them, ``id``, ``sightings``, ``relative_sigma_m`` and the rows of ``covariance_m2``.

An HD map as CSV for surveyors: a row a corner or vertex, with its covariance.
"""

from __future__ import annotations

import csv
import io
import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import ConfigError, MapFileError
from v2hdm.io.maps.features import Feature, features_of
from v2hdm.io.maps.geojson import read_geojson, read_verdict, write_geojson
from v2hdm.io.maps.geopackage import read_geopackage, read_geopackage_verdict, write_geopackage
from v2hdm.io.maps.lanelet2 import write_lanelet2
from v2hdm.io.maps.needs import need
from v2hdm.records import GeodeticOrigin, HdMap
from v2hdm.store.files import replace_text, whole_file

_log = logging.getLogger(__name__)

Verdict = Mapping[str, Any] | None


APPLICATION = "V2HDM"
_TEXT, _REAL, _WHOLE = 1000, 1040, 1071
"""Group codes of extended data (DXF reference, "Extended data"): string, real, whole number of 32 bits."""

_COLOURS = 6
"""AutoCAD's first colours, red to magenta, take turns."""


def write_dxf(hd_map: HdMap, path: Path, verdict: Mapping[str, Any] | None = None) -> None:
    """Write ``hd_map`` to ``path``, atomically: closed 3D polylines for markings, open ones for lanes.

    A DXF has no place for the ``verdict``.

    Raises:
        ConfigError: ``ezdxf`` is not installed.
    """
    ezdxf = need("ezdxf", "dxf")
    document = ezdxf.new("R2010", units=ezdxf.units.M)
    document.appids.add(APPLICATION)
    space = document.modelspace()
    for feature in features_of(hd_map):
        layer = re.sub(r'[<>/\\":;?*|=`]', "_", feature.kind)
        if layer not in document.layers:
            document.layers.add(layer, color=1 + len(document.layers) % _COLOURS)
        points = feature.xyz_map[feature.ring].tolist()
        line = space.add_polyline3d(points, close=feature.closed, dxfattribs={"layer": layer})
        line.set_xdata(APPLICATION, _told(feature))
    with whole_file(path) as partial:
        document.saveas(partial)


def _told(feature: Feature) -> list[tuple[int, Any]]:
    told: list[tuple[int, Any]] = [(_TEXT, "id"), (_WHOLE, feature.id)]
    told += [(_TEXT, "sightings"), (_WHOLE, feature.sightings)]
    if feature.relative_sigma_m is not None:
        told += [(_TEXT, "relative_sigma_m"), (_REAL, feature.relative_sigma_m)]
    if feature.covariance_m2 is not None:
        order = [2 * k + axis for k in feature.ring for axis in (0, 1)]
        rows = feature.covariance_m2[order][:, order]
        told += [(_TEXT, "covariance_m2"), *((_REAL, value) for value in rows.ravel().tolist())]
    return told


_CORNERS = 4

COLUMNS: tuple[str, ...] = (
    *("id", "class", "point", "x_map_m", "y_map_m", "height_m"),
    *("longitude_deg", "latitude_deg", "ellipsoidal_height_m"),
    *("sigma_x_m", "sigma_y_m", "sightings", "relative_sigma_m"),
    *(f"cov_{own}_{other}{k}_m2" for own in "xy" for k in range(1, _CORNERS + 1) for other in "xy"),
)
"""``point`` counts from 1 along the feature. ``cov_x_y3_m2`` is the covariance of this point's x with the y
of point 3 of the same feature. Empty where it is not known."""


def write_csv(hd_map: HdMap, path: Path, verdict: Mapping[str, Any] | None = None) -> None:
    """Write ``hd_map`` to ``path``, atomically, every number at full precision.

    A CSV has no place for the ``verdict``.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for feature in features_of(hd_map):
        table.writerows(_rows(feature, hd_map.origin))
    replace_text(path, text.getvalue())


def _rows(feature: Feature, origin: GeodeticOrigin | None) -> list[list[Any]]:
    count = len(feature.points_map)
    geodetic: list[list[Any]] = [["", "", ""]] * count
    if origin is not None:
        positions = np.empty((count, 3))
        positions[feature.ring] = feature.positions(origin)
        geodetic = positions.tolist()
    rows = []
    for k, (x, y) in enumerate(feature.points_map.tolist()):
        height = "" if feature.heights_m is None else float(feature.heights_m[k])
        sigmas: list[Any] = ["", ""]
        covariances: list[Any] = [""] * (4 * _CORNERS)
        if feature.covariance_m2 is not None:
            own = feature.covariance_m2[2 * k : 2 * k + 2]
            sigmas = np.sqrt(np.diag(own[:, 2 * k : 2 * k + 2])).tolist()
            covariances = own.ravel().tolist()
        relative = "" if feature.relative_sigma_m is None else feature.relative_sigma_m
        row = [feature.id, feature.kind, k + 1, x, y, height, *geodetic[k], *sigmas]
        rows.append([*row, feature.sightings, relative, *covariances])
    return rows


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
