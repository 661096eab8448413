"""Reading a map from the formats that people edit, GeoJSON and GeoPackage.

A file holds a feature's geometry and its exact local coordinates. The geometry is the truth, for people edit
it; the stored coordinates stand where they agree with it within the file's rounding.
"""

from __future__ import annotations

import logging
import sqlite3
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import MapFileError, V2hdmError
from v2hdm.geometry.geodetic import Grid, enu_from_geodetic
from v2hdm.geometry.planar import signed_area
from v2hdm.io.maps.corrections import SIGMA_M
from v2hdm.io.maps.features import (
    COMPOSITION,
    CORNERS,
    FARTHEST_M,
    OUTLINE,
    PAINT,
    POINTS,
    TEXT_READ,
    Feature,
    map_of,
    unique_ids,
)
from v2hdm.records import ACCURACIES, BoolArray, FloatArray, GeodeticOrigin, HDMap, PaintLeft, Reading
from v2hdm.safe.databases import opened, rows_of
from v2hdm.safe.fields import take_covariance, take_origin, take_whole
from v2hdm.safe.texts import parse_json, shown, take_name
from v2hdm.store.files import load_json, take_array, take_mapping, take_number, take_text
from v2hdm.store.inputs import note_input

_log = logging.getLogger(__name__)

Verdict = Mapping[str, Any] | None

_LARGEST_ID = 1_000_000_000  # largest id: every format and GIS holds it as a whole number of 32 bits
_MOST_SIGHTINGS = 1_000_000_000  # largest number of sightings, for the same reason as the largest id
_NAMED = 9  # edited features that the log names; chosen

# Longitude and latitude, degrees, and height, m, by which a file's positions may be off without an edit:
_TEXT_ROUNDING = (1e-9, 1e-9, 1e-4)
"""Rounding of GeoJSON in degrees: files of version 0.1 have nine and four decimals, 0.1 mm on the ground, and
GDAL takes a last digit after several zeros for noise and drops it."""
_BINARY_ROUNDING = (1e-11, 1e-11, 1e-6)  # rounding of a GeoPackage in degrees, which holds them in binary
_GRID_ROUNDING = (3e-9, 3e-9, 1.2e-4)  # rounding of a grid's 0.1 mm in degrees, as far as 70 degrees north

_GRID_ROUNDING_M = 1.2e-4  # rounding of a local grid's 0.1 mm, m
_LOCAL_ROUNDING_M = 1e-6  # rounding of local metres, which have full precision: a GIS keeps 15 digits

RESOLUTION = ("xy_coordinate_resolution", "z_coordinate_resolution")
"""Members of GeoJSON that state how coordinates are rounded, m or degrees, for GDAL since 3.9."""

EXACT = ("heights_m", "heights_sigma_m", "covariance_m2")
"""Columns of a GeoPackage with JSON, beside the coordinates."""

LAYERS = {CORNERS: "markings", POINTS: "lanes", OUTLINE: "symbols"}
"""Layers of a GeoPackage by the property that holds the coordinates of their features."""

GEOMETRY = "geom"  # the column of a GeoPackage's layer

# Types of geometries in well-known binary, to which thousands are added for heights and measures:
_LINE = 2  # type of a LineString
_POLYGON = 3  # type of a Polygon
_MULTIS = (5, 6)  # types of a MultiLineString and a MultiPolygon


def _composition(properties: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The variety of a marking, the parts of a symbol, and the lines of a double line, as far as stated."""
    stated = {key: properties[key] for key in COMPOSITION if properties.get(key) is not None}
    stated |= {
        key: _json(stated[key], f"{where}, {key}")
        for key in stated
        if isinstance(stated[key], str) and key in ("parts", "lines")
    }
    out: dict[str, Any] = {}
    if "kind" in stated:
        out["variety"] = take_name(stated["kind"], f"{where}, kind", MapFileError)
    if "parts" in stated:
        parts = take_array(stated["parts"], (-1,), f"{where}, parts", MapFileError)
        out["parts"] = tuple(int(part) for part in parts)
    if "lines" in stated:
        lines = stated["lines"]
        if not isinstance(lines, list) or len(lines) != 2:
            raise MapFileError(f"{where}, lines: not two classes of lines, left and right; fix or drop them")
        out["lines"] = tuple(take_name(line, f"{where}, lines", MapFileError) for line in lines)
    if "apart_m" in stated:
        out["apart_m"] = take_number(stated["apart_m"], f"{where}, apart_m", MapFileError)
        if out["apart_m"] <= 0:
            raise MapFileError(f"{where}, apart_m: a distance is not positive; fix or drop it")
    return out


def read_map(path: Path) -> tuple[HDMap, Verdict]:
    """A map and its verdict, from GeoJSON or GeoPackage; MapFileError, or ConfigError without a package."""
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        endings = " or ".join(_READERS)
        raise MapFileError(f"{path}: not a readable map; give a file that ends in {endings}")
    return reader(path), read_verdict(path)


def read_geojson(path: Path) -> HDMap:
    """Read our own GeoJSON, perhaps edited, in its order; missing or repeated ids are given anew."""
    return read_geojson_of(load_json(path, MapFileError), path)


def read_geojson_of(content: Mapping[str, Any], path: Path) -> HDMap:
    """The map in the ``content`` of the GeoJSON at ``path``; see :func:`read_geojson`."""
    about = content.get("v2hdm")
    features = content.get("features")
    if not isinstance(about, dict) or not isinstance(features, list):
        raise MapFileError(
            f"{path}: not a map written by v2hdm (no 'v2hdm' member or no 'features'); give one that is. A "
            "GIS keeps that member when it saves edits in place, and drops it from a copy"
        )
    origin = take_origin(about.get("origin"), f"{path}: origin", MapFileError)
    rounding = np.full(3, _LOCAL_ROUNDING_M) if origin is None else np.array(_TEXT_ROUNDING)
    for axes, key in zip((slice(0, 2), slice(2, 3)), RESOLUTION, strict=True):
        if key in content:
            stated = take_number(content[key], f"{path}: {key}", MapFileError)
            rounding[axes] = np.maximum(rounding[axes], stated)
    reader = _Reader(path, origin, rounding, about.get("crs"))
    for number, feature in enumerate(features):
        where = f"{path}: feature {number}"
        entry = take_mapping(feature, where, MapFileError)
        properties = take_mapping(entry.get("properties"), where, MapFileError)
        reader.add(properties, geometry_of_geojson(entry.get("geometry"), where), where)
    hd_map = reader.map()
    over_m = about.get("drift_over_m")
    largest = take_whole(about.get("largest_id") or 0, 0, _LARGEST_ID, f"{path}: largest_id", MapFileError)
    if over_m is not None:
        over_m = take_number(over_m, f"{path}: drift_over_m", MapFileError)
    return replace(hd_map, largest_id=largest, drift_over_m=over_m)


def read_verdict(path: Path) -> Verdict:
    """The verdict beside a map, None where there is none; errors as :func:`read_map`."""
    if path.suffix.lower() == ".gpkg":
        verdict = stated_in(path, "verdict")
    else:
        about = load_json(path, MapFileError).get("v2hdm")
        verdict = about.get("verdict") if isinstance(about, dict) else None
    return verdict if isinstance(verdict, dict) else None


def read_geopackage(path: Path) -> HDMap:
    """Read our own GeoPackage, which others may have edited, as :func:`read_geojson` does."""
    origin = take_origin(stated_in(path, "origin"), f"{path}: origin", MapFileError)
    rounding = np.full(3, _LOCAL_ROUNDING_M) if origin is None else np.array(_BINARY_ROUNDING)
    reader = _Reader(path, origin, rounding, stated_in(path, "crs"))
    for key, layer in LAYERS.items():
        for number, properties in enumerate(_layer(path, layer)):
            where = f"{path}: {layer}, row {number + 1}"
            exact = {name: _json(properties.get(name), f"{where}, {name}") for name in (key, *EXACT)}
            reader.add(properties | exact, geometry_of_wkb(properties.get(GEOMETRY), where), where)
    return reader.map()


_READERS: Mapping[str, Callable[[Path], HDMap]] = {".geojson": read_geojson, ".gpkg": read_geopackage}

_RIGID_M = 1e-3  # largest difference, m, between the motions of a feature's points that moved as a whole


@dataclass(frozen=True)
class Geometry:
    """A feature's geometry as a file has it: ``positions`` (N, 2 or 3) without a closing one."""

    positions: FloatArray
    closed: bool


class _Reader:
    """Reads a file's features, whose positions are off by ``rounding`` (3,), reports edits and gives ids."""

    def __init__(
        self, path: Path, origin: GeodeticOrigin | None, rounding: FloatArray, crs: object = None
    ) -> None:
        self._path = path
        self._origin = origin
        self._rounding = rounding
        self._grid: Grid | None = None
        if crs is not None:
            text = take_text(crs, f"{path}: crs", MapFileError)
            self._grid = Grid.of(text, origin, str(path), MapFileError)
            self._rounding = np.array(_GRID_ROUNDING if origin else (_GRID_ROUNDING_M,) * 3)
        self._features: list[Feature] = []
        self._edited: list[int] = []

    def add(self, properties: Mapping[str, Any], geometry: Geometry | None, where: str) -> None:
        if geometry is None and not properties.keys() & set(LAYERS):
            raise MapFileError(f"{where}: has no geometry, '{CORNERS}', '{POINTS}' or '{OUTLINE}'; drop it")
        if geometry is not None and geometry.closed and len(geometry.positions) < 3:
            raise MapFileError(f"{where}: its ring has fewer than three corners; fix it, or drop it")
        geodetic = geometry is not None and self._origin is not None
        if geometry is not None and geodetic and self._grid is not None:
            if geometry.positions.shape[1] < 3:
                raise MapFileError(f"{where}: its geometry has lost its heights; keep them when you edit")
            positions = self._grid.geodetic(geometry.positions, where, MapFileError)
            geometry = replace(geometry, positions=positions)
        if geometry is not None and geodetic and (np.abs(geometry.positions[:, 1]) > 90).any():
            raise MapFileError(
                f"{where}: its geometry is not in degrees of longitude and latitude; save it in EPSG:4326"
            )
        closed = POINTS not in properties if geometry is None else geometry.closed
        stored = _stored(properties, closed, where)
        feature = stored if geometry is None else _believed(stored, geometry, self._origin, self._rounding)
        if closed and not feature.symbol and len(feature.points_map) != 4:
            raise MapFileError(f"{where}: a marking has four corners, not {len(feature.points_map)}; fix it")
        if feature is not stored and len(stored.points_map):
            self._edited.append(len(self._features))
        if np.abs(feature.points_map).max(initial=0.0) > FARTHEST_M:
            raise MapFileError(
                f"{where}: a point lies beyond the earth, in metres of the map; fix or drop it"
            )
        self._features.append(feature)

    def map(self) -> HDMap:
        """The map of the features that were added; logs edits and new ids."""
        before = [feature.id for feature in self._features]
        ids = unique_ids(before)
        if self._edited:
            numbers = ", ".join(str(ids[index]) for index in self._edited[:_NAMED])
            more = ", ..." if len(self._edited) > _NAMED else ""
            edited = f"{len(self._edited)} features were edited and are taken as drawn"
            _log.info("%s: %s: %s", self._path, edited, numbers + more)
        new_ids = sum(stored != number for stored, number in zip(before, ids, strict=True))
        if new_ids:
            _log.info("%s: %d features had no id of their own and were given one", self._path, new_ids)
        return map_of(self._features, ids, self._origin)


def _believed(
    stored: Feature, geometry: Geometry, origin: GeodeticOrigin | None, rounding: FloatArray
) -> Feature:
    """``stored`` itself where the geometry says the same, else what the geometry says, point by point.

    A ring may start at another corner and run the other way round. Where the number of points has not
    changed, they keep their order, and their heights unless these were edited, too.
    """
    positions = geometry.positions
    if len(positions) != len(stored.points_map):
        return _redrawn(stored, geometry, origin, rounding)
    size = positions.shape[1]
    drawn = stored.positions(origin)
    expected = np.zeros((len(positions), 3))
    expected[stored.ring, : drawn.shape[1]] = drawn
    agree = np.abs(positions - expected[:, :size]) <= rounding[:size]
    if geometry.closed and not agree.all():
        positions = _aligned(positions, expected)
        agree = np.abs(positions - expected[:, :size]) <= rounding[:size]
    if agree.all():
        return stored
    xyz = _in_map(positions, stored.heights_m, origin)
    is_moved = np.logical_not(agree[:, :2].all(axis=1))
    points_map = np.where(is_moved[:, None], xyz[:, :2], stored.points_map)
    heights_m = stored.heights_m
    if not agree[:, 2:].all():
        heights_m = np.where(agree[:, 2], stored.xyz_map[:, 2], xyz[:, 2])
    moved_m = points_map - stored.points_map
    return replace(_placed_by_hand(stored, is_moved, moved_m), points_map=points_map, heights_m=heights_m)


def _placed_by_hand(stored: Feature, is_moved: BoolArray, moved_m: FloatArray) -> Feature:
    """The feature with the sigmas of points (N,) that a person moved by ``moved_m`` (N, 2), and no accuracy.

    Beside the others they have these's common error and a hand's own, as corrections do (docs/report.md). A
    feature that was moved as a whole keeps its shape, and a hand placed it once.
    """
    if not is_moved.any():
        return stored
    count = len(is_moved)
    as_whole = is_moved.all() and np.ptp(moved_m, axis=0).max() < _RIGID_M
    mixing = np.eye(count)
    if not as_whole:
        beside = is_moved if is_moved.all() else np.logical_not(is_moved)
        mixing[is_moved] = beside / beside.sum()
    hand_m2 = SIGMA_M**2 * (np.ones((count, count)) if as_whole else np.diag(is_moved.astype(np.float64)))
    covariance_m2 = stored.covariance_m2
    if covariance_m2 is not None:
        by_axis = np.kron(mixing, np.eye(2))
        covariance_m2 = by_axis @ covariance_m2 @ by_axis.T + np.kron(hand_m2, np.eye(2))
    relative_m, place_m, vertex_m = stored.relative_sigma_m, stored.place_sigma_m, stored.vertex_sigma_m
    return replace(
        stored,
        covariance_m2=covariance_m2,
        relative_sigma_m=None if relative_m is None else float(np.hypot(relative_m, np.sqrt(hand_m2.mean()))),
        place_sigma_m=None if place_m is None else float(np.hypot(place_m, np.sqrt(np.diag(hand_m2).mean()))),
        vertex_sigma_m=None if vertex_m is None else np.sqrt(vertex_m**2 + np.diag(hand_m2)),
        accuracy=None,
    )


def _redrawn(
    stored: Feature, geometry: Geometry, origin: GeodeticOrigin | None, rounding: FloatArray
) -> Feature:
    """The feature with the points of a geometry that has more or fewer of them, and no covariance."""
    xyz = _in_map(geometry.positions, None, origin)
    if geometry.closed and signed_area(xyz[:, :2]) < 0:
        xyz = xyz[::-1]
    has_heights = np.abs(xyz[:, 2]).max(initial=0.0) > rounding[2]
    return replace(
        stored,
        points_map=xyz[:, :2],
        heights_m=xyz[:, 2] if has_heights else None,
        vertex_sigma_m=None,
        covariance_m2=None,
        relative_sigma_m=None,
        accuracy=None,
    )


def _aligned(positions: FloatArray, expected: FloatArray) -> FloatArray:
    """A ring's positions (N, 2 or 3) from the corner, and in the turn, that come nearest to the expected."""
    forward = np.arange(len(positions))
    orders = [np.roll(turn, -start) for turn in (forward, forward[::-1]) for start in range(len(forward))]
    misfits = [float(((positions[order, :2] - expected[:, :2]) ** 2).sum()) for order in orders]
    return positions[orders[int(np.argmin(misfits))]]


def _in_map(positions: FloatArray, heights_m: FloatArray | None, origin: GeodeticOrigin | None) -> FloatArray:
    """A file's positions (N, 2 or 3) in the map (N, 3), m; heights that they lack are ``heights_m`` or 0."""
    heights_or_zero_m = np.zeros(len(positions)) if heights_m is None else heights_m
    if origin is None:
        return np.column_stack([positions, heights_or_zero_m])[:, :3]
    above_m = np.column_stack([positions, origin.altitude_m + heights_or_zero_m])[:, 2]
    return enu_from_geodetic(origin, np.column_stack([positions[:, 1], positions[:, 0], above_m]))


def _stored(properties: Mapping[str, Any], closed: bool, where: str) -> Feature:
    """The feature by its properties alone; without points where they are not among them."""
    symbol = closed and properties.get(CORNERS) is None and properties.get(OUTLINE) is not None
    key = OUTLINE if symbol else CORNERS if closed else POINTS
    points = np.empty((0, 2))
    if properties.get(key) is not None:
        shape = (4, 2) if key == CORNERS else (-1, 2)
        points = take_array(properties[key], shape, f"{where}, {key}", MapFileError)

    def optional(key: str, take: Callable[..., Any], *how: Any) -> Any:
        # Properties of each point mean nothing without the points.
        stated = properties.get(key) if key not in EXACT or len(points) else None
        value = None if stated is None else take(stated, *how, f"{where}, {key}", MapFileError)
        if value is not None and "sigma" in key and np.min(value, initial=0.0) < 0:
            raise MapFileError(f"{where}, {key}: a standard deviation is negative; fix it or leave it out")
        return value

    share, sigma, change, change_sigma = (optional(name, take_number) for name in PAINT)
    read = [optional(name, take) for name, take in zip(TEXT_READ, 2 * (take_text, _take_share), strict=True)]
    return Feature(
        id=optional("id", take_whole, -_LARGEST_ID, _LARGEST_ID) or 0,
        kind=take_name(properties.get("class"), f"{where}, class", MapFileError),
        points_map=points,
        sightings=optional("sightings", take_whole, 0, _MOST_SIGHTINGS) or 0,
        closed=closed,
        heights_m=optional("heights_m", take_array, (len(points),)),
        heights_sigma_m=optional("heights_sigma_m", take_array, (len(points),)),
        covariance_m2=optional("covariance_m2", take_covariance, 2 * len(points)),
        relative_sigma_m=optional("relative_sigma_m", take_number),
        accuracy=optional("accuracy", _take_accuracy) if closed else None,
        symbol=symbol,
        place_sigma_m=optional("sigma_m", take_number) if symbol else None,
        vertex_sigma_m=None
        if closed or not len(points)
        else optional("vertex_sigma_m", take_array, (len(points),)),
        paint=None if share is None or sigma is None else PaintLeft(share, sigma, change, change_sigma),
        reading=None if not symbol or None in read[:2] else Reading(*read),
        **_composition(properties, where),
    )


def _take_share(value: object, where: str, error: type[V2hdmError]) -> float:
    share = take_number(value, where, error)
    if not 0.0 <= share <= 1.0:
        raise error(f"{where} is {shown(value)}; give a probability from 0 to 1, or leave it out")
    return share


def _take_accuracy(value: object, where: str, error: type[V2hdmError]) -> str:
    if value not in ACCURACIES:
        raise error(f"{where} is {shown(value)}; give one of {', '.join(ACCURACIES)}, or leave it out")
    return str(value)


def geometry_of_geojson(content: object, where: str) -> Geometry | None:
    """A Polygon of one ring, a LineString, or what a GIS may make of one: a Multi... with one of them."""
    if content is None:
        return None
    entry = take_mapping(content, f"{where}, geometry", MapFileError)
    kind = entry.get("type")
    parts = entry.get("coordinates")
    closed = kind in ("Polygon", "MultiPolygon")
    if not closed and kind not in ("LineString", "MultiLineString"):
        raise MapFileError(f"{where}: its geometry is a {kind}; draw Polygons (markings) or LineStrings")
    for _ in range({"Polygon": 1, "MultiPolygon": 2, "MultiLineString": 1}.get(str(kind), 0)):
        if not isinstance(parts, list) or len(parts) != 1:
            raise MapFileError(f"{where}: its {kind} has holes or several parts; split it")
        (parts,) = parts
    heights = isinstance(parts, list) and bool(parts) and isinstance(parts[0], list) and len(parts[0]) > 2
    positions = take_array(parts, (-1, 3 if heights else 2), f"{where}, coordinates", MapFileError)
    return Geometry(positions[:-1] if closed else positions, closed)


def geometry_of_wkb(blob: object, where: str) -> Geometry | None:
    """A polygon of one ring, a line, or a Multi... of one, from GeoPackage's binary (OGC 12-128r19, 2.1.3).

    By hand: GEOS dies of a geometry that holds another, which holds another, and so on.
    """
    if blob is None:
        return None
    try:
        data = bytes(memoryview(blob))  # type: ignore[arg-type]
        kind = _MULTIS[0]
        count = 1
        envelope_bytes = (0, 32, 48, 48, 64)[data[3] >> 1 & 7]
        at = 8 + envelope_bytes
        for _ in range(2):  # a Multi..., and what is in it
            if kind % 1000 in _MULTIS and count == 1:
                order = "<" if data[at] else ">"
                kind, count = struct.unpack_from(f"{order}II", data, at + 1)
                at = at + 9
        closed = kind % 1000 == _POLYGON
        dimensions = (2, 3, 3, 4)[kind // 1000]
        if kind % 1000 not in (_LINE, _POLYGON):
            several = kind % 1000 in _MULTIS
            problem = "has several parts; split it" if several else "is not one that maps have; draw another"
            raise MapFileError(f"{where}: its geometry {problem}")
        if closed and count != 1:
            raise MapFileError(f"{where}: its polygon has holes; fill them")
        if closed:
            (count,) = struct.unpack_from(f"{order}I", data, at)
            at = at + 4
        positions = np.frombuffer(data, f"{order}f8", count * dimensions, at).reshape(count, dimensions)
    except (TypeError, ValueError, LookupError, struct.error):
        raise MapFileError(f"{where}: its geometry is damaged; draw it again") from None
    has_z = kind // 1000 in (1, 3)
    read = take_array(positions[:, : 3 if has_z else 2], (-1, 2 + has_z), f"{where}, geometry", MapFileError)
    return Geometry(read[:-1] if closed else read, closed)


def stated_in(path: Path, key: str) -> object:
    """The entry ``key`` of a GeoPackage's table about the map."""
    rows = _layer(path, "v2hdm")
    return _json(rows[0].get(key), f"{path}: {key}") if rows else None


def _layer(path: Path, layer: str) -> list[dict[str, Any]]:
    """The rows of a layer of our own GeoPackage."""
    return geopackage_rows(path, layer, "not a map written by v2hdm")


def geopackage_rows(path: Path, table: str, otherwise: str = "not a GeoPackage") -> list[dict[str, Any]]:
    """The rows of a GeoPackage's table, by SQLite alone: GDAL would open whatever a file says that it is.

    Raises MapFileError, which says that the file is ``otherwise``, where it is damaged or lacks the table.
    """
    note_input(path)
    if not path.is_file():
        raise MapFileError(f"{path}: no such file; check the path or restore it")
    others = f"{path}: {otherwise}"
    try:
        with opened(path, "mode=ro") as data:
            # A view, a virtual table and a generated column would compute without end.
            about = data.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", [table]).fetchall()
            hidden = data.execute("SELECT 1 FROM pragma_table_xinfo(?) WHERE hidden", [table]).fetchall()
            plain = [kind == "table" and "VIRTUAL" not in sql.upper()[:20] for kind, sql in about]
            if plain != [True] or hidden:
                raise MapFileError(f"{others} (it has no plain table '{table}'); give one that is")
            return list(rows_of(data, path, table))
    except (sqlite3.Error, UnicodeError, AttributeError) as failure:
        raise MapFileError(f"{others} ({failure}); give one that is") from None


def _json(text: object, where: str) -> object:
    return None if text is None else parse_json(str(text), where, MapFileError)
