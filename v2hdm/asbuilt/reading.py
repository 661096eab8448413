"""Reading a design: a map of ours, GeoJSON, GeoPackage, DXF or OpenDRIVE of others (docs/as-built.md).

A file's shapes are the closed ones. Their class is a property ``class`` (or ``kind``, ``type``, ``layer``,
``name``), a layer of a drawing, or the name of an object; names that are no class of ours are left out unless
a user says what they are.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.asbuilt.design import Design, DesignShape, design_of_map
from v2hdm.asbuilt.drawing import UNITS_M, read_drawing, units_per_system
from v2hdm.asbuilt.opendrive import Pose, outlines_of
from v2hdm.catalogue import load_catalogue
from v2hdm.errors import ConfigError, MapFileError, shown
from v2hdm.geometry import geodetic
from v2hdm.geometry.datums import is_named, is_same_datum
from v2hdm.geometry.geodetic import LOCAL, enu_from_geodetic
from v2hdm.io.maps.reading import (
    GEOMETRY,
    Geometry,
    geometry_of_geojson,
    geometry_of_wkb,
    geopackage_rows,
    read_map,
)
from v2hdm.records import CROSSWALK, FloatArray, GeodeticOrigin, HDMap
from v2hdm.store.files import load_json, take_mapping
from v2hdm.store.names import map_file

_log = logging.getLogger(__name__)

_NAMED_BY = ("class", "kind", "type", "layer", "name")  # properties that say what a feature is, in this order


@dataclass(frozen=True)
class Source:
    """The interpretation of a file where the file does not state it.

    Attributes:
        crs: the system of its coordinates, such as EPSG:25832, or local for the map's own frame.
        unit: the unit of a drawing, as m, cm, mm, ft, us-ft or in.
        kinds: our class by the file's name of it.
    """

    crs: str | None = None
    unit: str | None = None
    kinds: Mapping[str, str] | None = None


@dataclass(frozen=True)
class Drawn:
    """A shape as its file has it: x and y (N, 2), its name, what it is called, and its properties."""

    positions: FloatArray
    name: str
    called: str | None
    properties: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _File:
    """The shapes of a file, the system of their positions, and how many open lines it has besides."""

    shapes: list[Drawn]
    crs: str | None
    lines: int


def read_design(path: Path, hd_map: HDMap, source: Source | None = None) -> Design:
    """The design in a file, or in a folder of results, in the frame of a map, whose classes it may have.

    Raises:
        MapFileError: the file is damaged, of another format, or in another system or datum than it must be.
        ConfigError: the system, the unit or a class is unknown, or what reads the format is not installed.
    """
    source = source or Source()
    origin = hd_map.origin
    path = map_file(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        endings = ", ".join(_READERS)
        raise MapFileError(f"{path}: is not a readable design; give a file that ends in {endings}")
    if _is_ours(path):
        return design_of_map(read_map(path)[0], origin, str(path))
    content = reader(path, source)
    crs = source.crs or content.crs
    if crs is None:
        raise ConfigError(
            f"{path}: does not say what its coordinates count from; give --crs, or --crs {LOCAL}"
        )
    if crs != LOCAL and origin is not None and not is_named(geodetic.datum_of(crs, str(path), MapFileError)):
        _log.warning("%s: its system names no datum: taken to be on the map's, %s", path, origin.datum)
    shapes = []
    for drawn, kind in of_known_kinds(content.shapes, classes_of(hd_map), source, path):
        outline = in_map(drawn.positions, crs, origin, str(path))
        shapes.append(DesignShape(drawn.name, kind, outline))
    return Design(_without_copies(shapes), str(path), content.lines)


def _without_copies(shapes: Iterable[DesignShape]) -> tuple[DesignShape, ...]:
    """The shapes without those that are drawn twice, as a hatch and its border are."""
    first_of = dict[tuple[str | None, frozenset[tuple[float, ...]]], DesignShape]()
    for shape in shapes:
        corners = frozenset(map(tuple, (np.round(shape.outline_map, 3) + 0.0).tolist()))
        first_of.setdefault((shape.kind, corners), shape)
    return tuple(first_of.values())


def classes_of(hd_map: HDMap) -> tuple[str, ...]:
    """All classes that a design of a map's site may have: those of the catalogue, and the map's own."""
    of_map = sorted({paint.kind for paint in hd_map.markings} | {paint.kind for paint in hd_map.symbols})
    return tuple(dict.fromkeys([*load_catalogue().names, CROSSWALK, *of_map]))


def _is_ours(path: Path) -> bool:
    if path.suffix.lower() == ".geojson":
        return "v2hdm" in load_json(path, MapFileError)
    if path.suffix.lower() == ".gpkg":
        return any(row.get("table_name") == "v2hdm" for row in geopackage_rows(path, "gpkg_contents"))
    return False


def of_known_kinds(
    shapes: Iterable[Drawn], classes: Collection[str], source: Source, path: Path
) -> list[tuple[Drawn, str | None]]:
    """Shapes with their classes; shapes whose names match no class are left out, with one warning line."""
    stated_kinds = source.kinds or {}
    for name, stated in stated_kinds.items():
        if stated not in classes:
            choices = ", ".join(sorted(classes))
            raise ConfigError(f"--class {name}={shown(stated)}: is not a class; choose from: {choices}")
    meant = {_plain(name): stated for name, stated in stated_kinds.items()}
    out: list[tuple[Drawn, str | None]] = []
    unknown = dict[str, int]()
    for shape in shapes:
        called = None if shape.called is None else _plain(shape.called)
        kind = called if called in classes else meant.get(called or "")
        if called is not None and kind is None:
            unknown[shape.called or ""] = unknown.get(shape.called or "", 0) + 1
        else:
            out.append((shape, kind))
    if unknown:
        named = ", ".join(f"{shown(name)} ({count})" for name, count in list(unknown.items())[:_MOST_NAMED])
        line = f"{path}: left out shapes of unknown classes: {named}; --class NAME=CLASS names their class"
        if not out:
            raise MapFileError(line)
        _log.warning(line)
    return out


_MOST_NAMED = 8  # unknown classes that a line names


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def in_map(positions: FloatArray, crs: str, origin: GeodeticOrigin | None, where: str) -> FloatArray:
    """Positions (N, 2) of a system in the map, m."""
    if crs == LOCAL:
        return positions
    if origin is None:
        raise MapFileError(
            f"{where}: is in {crs}, but the map has no origin on the earth; give a design in the map's frame"
        )
    datum = geodetic.datum_of(crs, where, MapFileError)
    if is_named(datum) and not is_same_datum(datum, origin.datum):
        raise MapFileError(
            f"{where}: is on {datum} ({crs}), the map on {origin.datum}, which differ by decimetres; bring "
            "both to one datum"
        )
    height_m = np.full(len(positions), origin.altitude_m)
    if geodetic.is_geographic(crs, where, MapFileError):
        if np.abs(positions[:, 1]).max() > 90 or np.abs(positions[:, 0]).max() > 180:
            raise MapFileError(
                f"{where}: {positions[0, 0]:g}, {positions[0, 1]:g} is not a longitude and latitude; are its "
                "axes swapped, or is it in another system (--crs)?"
            )
        on_earth = np.column_stack([positions[:, ::-1], height_m])
    else:
        on_earth = geodetic.geodetic_from_grid(
            crs, np.column_stack([positions, height_m]), where, MapFileError
        )
    return enu_from_geodetic(origin, on_earth)[:, :2]


def called_by(properties: Mapping[str, Any]) -> str | None:
    """The name of a feature, from the first of its properties that has one, or None."""
    by_name = {str(key).lower(): value for key, value in properties.items()}
    return next((str(by_name[key]) for key in _NAMED_BY if by_name.get(key) not in (None, "")), None)


def _of_features(
    features: Iterable[tuple[Geometry | None, Mapping[str, Any], str]], crs: str | None
) -> _File:
    """A file of features: their geometry, properties and names."""
    shapes = []
    lines = 0
    for geometry, properties, name in features:
        if geometry is None:
            continue
        if geometry.closed:
            shapes.append(Drawn(geometry.positions[:, :2], name, called_by(properties)))
        else:
            lines = lines + 1
    return _File(shapes, crs, lines)


def _read_geojson(path: Path, source: Source) -> _File:
    content = load_json(path, MapFileError)
    if not isinstance(content.get("features"), list):
        raise MapFileError(f"{path}: is not a collection of features; give one")
    features = []
    for number, feature in enumerate(content["features"]):
        where = f"{path}: feature {number}"
        entry = take_mapping(feature, where, MapFileError)
        properties = take_mapping(entry.get("properties") or {}, where, MapFileError)
        geometry = entry.get("geometry")
        is_point = isinstance(geometry, dict) and geometry.get("type") in ("Point", "MultiPoint")
        name = str(properties.get("id", entry.get("id", number)))
        features.append(
            (None if is_point else geometry_of_geojson(geometry, where), properties, f"feature {shown(name)}")
        )
    return _of_features(features, crs_of_geojson(content))


def crs_of_geojson(content: Mapping[str, Any]) -> str:
    """The system of a GeoJSON file's positions: the one that older files state, else that of RFC 7946."""
    stated = content.get("crs")
    properties = stated.get("properties") if isinstance(stated, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    return str(name) if name else _RFC_7946


_RFC_7946 = "EPSG:4326"  # the only system of GeoJSON: longitude and latitude


def _read_geopackage(path: Path, source: Source) -> _File:
    contents = geopackage_rows(path, "gpkg_contents")
    columns = {row.get("table_name"): row for row in geopackage_rows(path, "gpkg_geometry_columns")}
    systems = {row.get("srs_id"): row for row in geopackage_rows(path, "gpkg_spatial_ref_sys")}
    files = []
    for entry in contents:
        table = entry.get("table_name")
        if entry.get("data_type") != "features" or table not in columns:
            continue
        column = str(columns[table].get("column_name") or GEOMETRY)
        system = systems.get(entry.get("srs_id"), {})
        authority = f"{system.get('organization')}:{system.get('organization_coordsys_id')}"
        features = []
        for number, row in enumerate(geopackage_rows(path, str(table)), 1):
            where = f"{path}: {table}, row {number}"
            geometry = geometry_of_wkb(row.get(column), where)
            features.append((geometry, {"layer": table, **row}, f"{table}, row {number}"))
        files.append(_of_features(features, authority if system.get("srs_id", 0) > 0 else None))
    systems_used = {file.crs for file in files if file.shapes}
    if len(systems_used) > 1 and source.crs is None:
        raise MapFileError(f"{path}: its layers use several coordinate systems; give a file that uses one")
    shapes = [shape for file in files for shape in file.shapes]
    return _File(shapes, next(iter(systems_used), None), sum(file.lines for file in files))


def _read_dxf(path: Path, source: Source) -> _File:
    drawing = read_drawing(path, source.unit)
    if drawing.unreadable:
        named = ", ".join(f"{count} {kind}" for kind, count in sorted(drawing.unreadable.items()))
        _log.warning(
            "%s: left out %s, whose outlines only CAD can read; explode those that are paint",
            path, named,
        )  # fmt: skip
    crs = source.crs or drawing.crs
    if crs is None or crs == LOCAL:
        scale = UNITS_M[drawing.unit]
    else:
        scale = units_per_system(drawing.unit, geodetic.units_of(crs, str(path), MapFileError).horizontal_m)
    shapes = [Drawn(scale * area.outline, area.name, area.layer) for area in drawing.areas]
    return _File(shapes, drawing.crs, drawing.lines)


def _read_opendrive(path: Path, source: Source) -> _File:
    drawing = outlines_of(path)
    # The header's offset leads to the system; the map's own frame is that of the file.
    frame = drawing.frame if source.crs != LOCAL else Pose(np.zeros(2), 0.0)
    shapes = [
        Drawn(frame.beside(outline.positions), outline.name, outline.called) for outline in drawing.outlines
    ]
    return _File(shapes, drawing.crs, 0)


_READERS: Mapping[str, Callable[[Path, Source], _File]] = {
    ".geojson": _read_geojson,
    ".json": _read_geojson,
    ".gpkg": _read_geopackage,
    ".dxf": _read_dxf,
    ".xodr": _read_opendrive,
}
