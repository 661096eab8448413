"""The formats that a map is written in: their registry, and CSV for surveyors."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import ConfigError, V2hdmError, need, shown
from v2hdm.geometry.geodetic import Grid
from v2hdm.io.maps.dxf import write_dxf
from v2hdm.io.maps.features import (
    COMPOSITION,
    PAINT,
    TEXT_READ,
    Feature,
    features_of,
    in_words,
    properties_of,
)
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.geopackage import write_geopackage, write_qgis
from v2hdm.io.maps.kml import write_kml
from v2hdm.io.maps.landxml import write_landxml
from v2hdm.io.maps.lanelet2 import write_lanelet2
from v2hdm.io.maps.ogr import write_flatgeobuf, write_json_fg, write_pmtiles, write_shapefiles
from v2hdm.io.maps.opendrive import write_opendrive
from v2hdm.io.maps.parquet import write_geoparquet
from v2hdm.io.maps.questions import questions_file, write_questions
from v2hdm.io.maps.reading import Verdict, read_geopackage, stated_in
from v2hdm.io.maps.recording import write_mcap
from v2hdm.records import GeodeticOrigin, HDMap, Trajectory
from v2hdm.store.files import replace_csv
from v2hdm.store.inputs import protected_inputs
from v2hdm.surface.strips import write_ground_geotiff, write_opencrg
from v2hdm.topology.answers import Answer
from v2hdm.topology.build import lane_graph
from v2hdm.topology.graph import LaneGraph

_log = logging.getLogger(__name__)

COLUMNS: tuple[str, ...] = (
    *("id", "class", "point", "x_map_m", "y_map_m", "height_m"),
    *("longitude_deg", "latitude_deg", "ellipsoidal_height_m"),
    *("sigma_x_m", "sigma_y_m", "sigma_z_m", "sightings", "relative_sigma_m", "accuracy"),
    *(f"cov_{axis}_{other}{k}_m2" for axis in "xy" for k in range(1, 5) for other in "xy"),
    *PAINT,
    *COMPOSITION,
    *TEXT_READ,
)
"""``point`` counts from 1 along the feature. ``cov_x_y3_m2`` is the covariance of this point's x with the y
of point 3 of the same feature, of four points. Empty where it is not known."""


def write_csv(hd_map: HDMap, path: Path, grid: Grid | None = None) -> None:
    """Write ``hd_map`` as CSV, atomically: a row per corner or vertex, every number at full precision.

    Coordinates in a ``grid``, rounded to 0.1 mm, take the place of longitude and latitude, which its last
    columns name.
    """
    columns = [*COLUMNS]
    about = {} if grid is None else grid.stated
    if grid is not None:
        columns[6:9] = ["easting", "northing", "up_m" if grid.is_local else COLUMNS[8]]
    place = grid or hd_map.origin
    rows = ([*row, *about.values()] for feature in features_of(hd_map) for row in _rows(feature, place))
    replace_csv(path, [[*columns, *about], *rows])


def _rows(feature: Feature, origin: GeodeticOrigin | Grid | None) -> list[list[Any]]:
    count = len(feature.points_map)
    geodetic: list[list[Any]] = [["", "", ""]] * count
    if origin is not None:
        positions = np.empty((count, 3))
        positions[feature.ring] = feature.positions(origin)
        geodetic = positions.tolist()
    relative = "" if feature.relative_sigma_m is None else feature.relative_sigma_m
    properties = properties_of(feature)
    more = [properties.get(name, "") for name in PAINT]
    more += [in_words(properties.get(name, "")) for name in COMPOSITION]
    more += [properties.get(name, "") for name in TEXT_READ]
    rows = []
    for k, (x, y) in enumerate(feature.points_map.tolist()):
        z = "" if feature.heights_m is None else float(feature.heights_m[k])
        sigma_z = "" if feature.heights_sigma_m is None else float(feature.heights_sigma_m[k])
        sigmas: list[Any] = ["", ""]
        covariances: list[Any] = [""] * 16
        if feature.covariance_m2 is not None:
            rows_m2 = feature.covariance_m2[2 * k : 2 * k + 2]
            sigmas = np.sqrt(np.diag(rows_m2[:, 2 * k : 2 * k + 2])).tolist()
            covariances = rows_m2.ravel().tolist() if count == 4 else covariances
        row = [feature.id, feature.kind, k + 1, x, y, z, *geodetic[k], *sigmas, sigma_z]
        rows.append([*row, feature.sightings, relative, feature.accuracy or "", *covariances, *more])
    return rows


@dataclass(frozen=True)
class Format:
    """One format: its file by the map's name, the function that writes it, the package that it needs."""

    file: str
    write: Callable[..., None]
    needs: str | None = None
    takes_crs: bool = True
    states_verdict: bool = False
    metres: str = ""  # the format's name where it holds nothing but metres
    extra: str = "gis"  # brings the package that it needs


LANE_FORMATS = ("lanelet2", "opendrive")
"""Formats of lanes that lead to lanes, for which the paths of drives are needed."""

DRIVEN_FORMATS = (*LANE_FORMATS, "mcap")
"""Formats that the paths of drives go into."""

FORMATS: Mapping[str, Format] = {
    "geojson": Format("{name}.geojson", write_geojson, states_verdict=True),
    "csv": Format("{name}.csv", write_csv),
    "gpkg": Format("{name}.gpkg", write_geopackage, "pyogrio", states_verdict=True),
    "lanelet2": Format("{name}_lanelet2/lanelet2_map.osm", write_lanelet2, takes_crs=False),
    "dxf": Format("{name}.dxf", write_dxf, "ezdxf", metres="DXF"),
    "qgis": Format("{name}.qgs", write_qgis, "pyogrio"),
    "opendrive": Format("{name}.xodr", write_opendrive, takes_crs=False),
    "landxml": Format("{name}.xml", write_landxml, metres="LandXML"),
    "flatgeobuf": Format("{name}_flatgeobuf/markings.fgb", write_flatgeobuf, "pyogrio"),
    "shapefile": Format("{name}_shapefile.zip", write_shapefiles, "pyogrio"),
    "kml": Format("{name}.kml", write_kml, takes_crs=False),
    "jsonfg": Format("{name}_fg.json", write_json_fg, "pyogrio"),
    "pmtiles": Format("{name}.pmtiles", write_pmtiles, "pyogrio", takes_crs=False),
    "geoparquet": Format("{name}.parquet", write_geoparquet, "pyarrow", extra="parquet"),
    "mcap": Format("{name}.mcap", write_mcap, "rosbags", takes_crs=False, extra="ros"),
}

GROUND_FORMATS: Mapping[str, Format] = {
    "geotiff": Format("{name}_ground.tif", write_ground_geotiff, "rasterio", takes_crs=False),
    "opencrg": Format("{name}_ground.crg", write_opencrg, "pyopencrg", takes_crs=False),
}
"""Formats of the ground's surface, which a map has as the result of a run, but not when read from a file."""

_ALL = {**FORMATS, **GROUND_FORMATS}


def check_formats(names: Sequence[str], key: str) -> None:
    """Refuse unknown formats, given by ``key``, and those whose packages are not installed."""
    for name in names:
        if name not in _ALL:
            raise ConfigError(f"{key}: unknown format {shown(name)}; choose from: {', '.join(_ALL)}")
        if (package := _ALL[name].needs) is not None:
            need(package, _ALL[name].extra, f"the format {name}", ConfigError)


def holds(path: Path, hd_map: HDMap, crs: str | None) -> bool:
    """Whether the GeoPackage at ``path`` holds just this map's features, in the system ``crs``."""
    try:
        with protected_inputs():  # where it holds others, it may be written anew
            stored = read_geopackage(path)
            stated = stated_in(path, "crs")
    except (V2hdmError, OSError):
        return False
    same = _properties_by_id(hd_map) == _properties_by_id(stored)
    return same and stored.origin == hd_map.origin and stated == crs


def _properties_by_id(hd_map: HDMap) -> list[dict[str, Any]]:
    """The properties of a map's features in order of their ids."""
    rows = [properties_of(feature) for feature in features_of(hd_map)]
    return sorted(rows, key=lambda row: int(row["id"]))


def with_data(formats: Sequence[str]) -> list[str]:
    """``formats``, each once, with the GeoPackage that a project of QGIS opens."""
    return list(dict.fromkeys(["gpkg", *formats] if "qgis" in formats else formats))


def check_crs(
    crs: str | None, formats: Sequence[str], origin: GeodeticOrigin | None, key: str
) -> Mapping[str, Grid]:
    """The grid of each format that supports ``crs``; raises ConfigError if it does not cover the site."""
    chosen = [name for name in formats if crs is not None and _ALL[name].takes_crs]
    if crs is not None and not chosen:
        others = ", ".join(
            name for name, format_ in FORMATS.items() if format_.takes_crs and name != "geojson"
        )
        raise ConfigError(f"{key}: no format to write uses it; add one of {others}, or leave it out")
    return {name: Grid.of(str(crs), origin, key, ConfigError, FORMATS[name].metres) for name in chosen}


def write_map(
    hd_map: HDMap,
    folder: Path,
    name: str,
    formats: Sequence[str],
    verdict: Verdict = None,
    projector: str | None = None,
    crs: str | None = None,
    present: Sequence[str] = (),
    trajectories: Sequence[Trajectory] = (),
    answers: Sequence[Answer] = (),
    pictures: Sequence[Path] = (),
) -> list[Path]:
    """Write a map in several of :data:`FORMATS` to ``folder``; returns the files, each written atomically.

    ``name`` is that of the files, ``verdict`` that on the run which made the map, as JSON, ``projector`` that
    of :func:`v2hdm.io.maps.lanelet2.write_lanelet2`, and ``crs`` the system of the other formats' coordinates
    in place of their own; files of the formats ``present`` are there already. ``trajectories`` are of the
    drives whose paths say where lanes lead, for :data:`DRIVEN_FORMATS`. What paint and paths leave open of
    lanes is written as ``{name}_questions.geojson``, but for what ``answers`` state. ``pictures`` are the
    overlays of a recording. Raises ConfigError when a format is not known or lacks its package, or when the
    projector or the system does not suit the map.
    """
    check_formats(formats, "formats")
    grids = check_crs(crs, with_data(formats), hd_map.origin, "crs")
    written = []
    graph = None
    if set(LANE_FORMATS) & set(formats) - set(present):
        graph = lane_graph(hd_map, trajectories, answers)
    for chosen in [chosen for chosen in with_data(formats) if chosen not in present]:
        path = folder / _ALL[chosen].file.format(name=name)
        if chosen in GROUND_FORMATS and not hd_map.ground:
            _log.warning(
                "%s is not written: the map holds no ground surface; map the drive with "
                "mapping.ground=surface, or auto if it is not a plane", path.name,
            )  # fmt: skip
            continue
        more: dict[str, Any] = {"projector": projector} if chosen == "lanelet2" else {}
        more |= {"verdict": verdict} if _ALL[chosen].states_verdict else {}
        more |= {"grid": grids[chosen]} if chosen in grids else {}
        more |= {"graph": graph} if chosen in LANE_FORMATS else {}
        more |= {"trajectories": trajectories, "pictures": pictures} if chosen == "mcap" else {}
        _ALL[chosen].write(hd_map, path, **more)
        written.append(path)
        if chosen == "geojson" and hd_map.origin is None and crs is None:
            _log.warning(
                "%s: the drive has no origin on the earth, so its coordinates are metres, which a GIS opens "
                "as degrees; the format gpkg marks them as metres", path.name,
            )  # fmt: skip
    if graph is not None:
        written += _tell_open(graph, hd_map.origin, folder, name, bool(trajectories))
    return written


def _tell_open(
    graph: LaneGraph, origin: GeodeticOrigin | None, folder: Path, name: str, has_drives: bool
) -> list[Path]:
    """Write the open questions on lanes if drives are known; log other notes on lanes."""
    for question in graph.questions:
        if question.subject == "line":
            _log.warning("%s: %s; it bounds no lane: redraw it", name, question.text)
    if graph.lanes and not has_drives:
        _log.warning(
            "%s: no path of a drive is known: lanes have the directions of their lines, and no way leads "
            "through crossings; export from the result folder, or give --path", name,
        )  # fmt: skip
    if not graph.questions or not has_drives:
        return []
    path = folder / questions_file(name)
    write_questions(graph.questions, origin, path)
    _log.info("%s: %d questions on lanes are open", path, len(graph.questions))
    return [path]
