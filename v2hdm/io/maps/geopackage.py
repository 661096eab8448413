"""A style for a map's layer as QGIS stores it (QML): a colour a class.

An HD map as GeoPackage (OGC 12-128) through ``pyogrio``, and back; it opens styled in QGIS.

Layers ``markings`` and ``symbols`` hold polygons, ``lanes`` lines, all with heights; the table ``v2hdm`` what
is to be known of the map. With a geodetic origin coordinates are longitude, latitude and ellipsoidal height
(EPSG:4326). Without one they are local metres in an engineering CRS, which no GIS takes for degrees.
"""

from __future__ import annotations

import json
import re
import struct
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v2hdm.errors import MapFileError
from v2hdm.io.maps.features import (
    CORNERS,
    OUTLINE,
    POINTS,
    Feature,
    FeatureReader,
    Geometry,
    features_of,
    properties_of,
)
from v2hdm.io.maps.needs import need
from v2hdm.io.safe.fields import take_origin
from v2hdm.io.safe.texts import parse_json
from v2hdm.records import CROSSWALK_BAR, DIAMOND, LANE_DASH, LANE_LINE, STOP_LINE, GeodeticOrigin, HdMap
from v2hdm.store.files import take_array, whole_file

_COLOURS: Mapping[str, str] = {
    DIAMOND: "31,119,180,255",
    LANE_DASH: "255,127,14,255",
    LANE_LINE: "44,160,44,255",
    STOP_LINE: "214,39,40,255",
    CROSSWALK_BAR: "148,103,189,255",
}
"""Red, green, blue and opacity of the classes that everyone has."""

_OTHER_COLOUR = "127,127,127,255"
_LINE_WIDTH_MM = "0.4"


def qgis_style(kinds: Sequence[str], closed: bool) -> str:
    """The QML text of a layer with features of ``kinds``: filled where ``closed``, else lines.

    Classes that a later edit adds fall into the last category, whose value is empty.
    """
    root = ET.Element("qgis", version="3.28.0", styleCategories="Symbology")
    renderer = ET.SubElement(
        root, "renderer-v2", type="categorizedSymbol", attr="class", symbollevels="0", enableorderby="0"
    )
    categories = ET.SubElement(renderer, "categories")
    symbols = ET.SubElement(renderer, "symbols")
    for number, kind in enumerate([*kinds, ""]):
        ET.SubElement(
            categories,
            "category",
            symbol=str(number),
            value=kind,
            label=kind or "other",
            render="true",
            type="string",
        )
        colour = _COLOURS.get(kind, _OTHER_COLOUR)
        symbol = ET.SubElement(
            symbols, "symbol", name=str(number), type="fill" if closed else "line", alpha="1"
        )
        layer = ET.SubElement(
            symbol, "layer", {"class": "SimpleFill" if closed else "SimpleLine", "enabled": "1"}
        )
        options = ET.SubElement(layer, "Option", type="Map")
        for name, value in _fill(colour) if closed else _line(colour):
            ET.SubElement(options, "Option", type="QString", name=name, value=value)
    return "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + ET.tostring(
        root, encoding="unicode"
    )


def _fill(colour: str) -> list[tuple[str, str]]:
    return [
        ("color", colour),
        ("outline_color", "35,35,35,255"),
        ("outline_width", "0.1"),
        ("style", "solid"),
    ]


def _line(colour: str) -> list[tuple[str, str]]:
    return [("line_color", colour), ("line_width", _LINE_WIDTH_MM), ("line_width_unit", "MM")]


_WGS84 = "EPSG:4326"
_LOCAL = (
    'ENGCRS["v2hdm map frame: metres east and north of the drive\'s own origin",'
    'EDATUM["origin of the drive"],CS[Cartesian,2],AXIS["easting (E)",east,ORDER[1]],'
    'AXIS["northing (N)",north,ORDER[2]],LENGTHUNIT["metre",1]]'
)
_LAYERS = {
    CORNERS: ("markings", "Polygon Z"),
    POINTS: ("lanes", "LineString Z"),
    OUTLINE: ("symbols", "Polygon Z"),
}
"""Name and type of the layer of the features whose coordinates a property holds."""

AnyArray = NDArray[Any]

_ABOUT = "v2hdm"
_SQL = re.compile(r"sqlite3_\w+\(.*\) failed: |Failed to prepare SQL .*: ")
"""What a user need not know of an error."""

_EXACT = ("heights_m", "covariance_m2")
"""Columns that hold JSON, as does the one of the exact coordinates."""

_ROUNDING = np.array([1e-11, 1e-11, 1e-6])
"""Degrees and m that a float64 position may lose on its way through other tools."""

_LOCAL_ROUNDING_M = 1e-6
_LITTLE_ENDIAN, _WKB_LINE_Z, _WKB_POLYGON_Z = 1, 1002, 1003
_WKB_KINDS = {2: False, 3: True, 5: False, 6: True}
"""Whether WKB types (line, polygon, and the Multi... of one of them) are closed (OGC 06-103r4, table 7)."""


def write_geopackage(hd_map: HdMap, path: Path, verdict: Mapping[str, Any] | None = None) -> None:
    """Write ``hd_map`` to ``path``, atomically, with the ``verdict`` on the run that made it.

    Raises:
        ConfigError: ``pyogrio`` is not installed.
        MapFileError: GDAL cannot write there.
    """
    raw, errors = need("pyogrio.raw", "gpkg"), need("pyogrio.errors", "gpkg")
    features = features_of(hd_map)
    told: dict[str, Any] = {"frame": "map"}
    if hd_map.origin is not None:
        told["origin"] = asdict(hd_map.origin)
    if verdict is not None:
        told["verdict"] = dict(verdict)
    with whole_file(path) as partial:
        # GDAL tells the format of a file by its ending.
        unfinished = partial.with_name(f"{partial.name}.gpkg")
        try:
            for key in _LAYERS:
                mine = [feature for feature in features if feature.key == key]
                _write_layer(raw, unfinished, key, mine, hd_map.origin)
            about = {key: _texts([json.dumps(value)]) for key, value in told.items()}
            _write_table(raw, unfinished, _ABOUT, about)
            _write_table(raw, unfinished, "layer_styles", _styles(features), FID="id")
            unfinished.replace(partial)
        except (errors.DataSourceError, errors.DataLayerError, errors.FeatureError) as failure:
            problem = _SQL.sub("", str(failure).splitlines()[0])
            raise MapFileError(f"{path}: cannot be written ({problem}); set another folder") from None
        finally:
            unfinished.unlink(missing_ok=True)


def read_geopackage(path: Path) -> HdMap:
    """Read what :func:`write_geopackage` wrote and others may have edited; as ``read_geojson`` does.

    Raises:
        MapFileError: when the file is missing, damaged or no map of this format.
        ConfigError: ``pyogrio`` is not installed.
    """
    content = _Content(path)
    origin = take_origin(content.about("origin"), f"{path}: origin", MapFileError)
    reader = FeatureReader(path, origin, np.full(3, _LOCAL_ROUNDING_M) if origin is None else _ROUNDING)
    for key, (layer, _) in _LAYERS.items():
        for number, (wkb, properties) in enumerate(content.layer(layer)):
            where = f"{path}: {layer}, row {number + 1}"
            exact = {name: _json(properties.get(name), f"{where}, {name}") for name in (key, *_EXACT)}
            reader.add(properties | exact, _geometry(wkb, where), where)
    return reader.map()


def read_geopackage_verdict(path: Path) -> Mapping[str, Any] | None:
    """The verdict that :func:`write_geopackage` wrote beside a map, None where there is none."""
    verdict = _Content(path).about("verdict")
    return verdict if isinstance(verdict, dict) else None


class _Content:
    """The tables of a GeoPackage."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._raw, self._errors = need("pyogrio.raw", "gpkg"), need("pyogrio.errors", "gpkg")
        if not path.is_file():
            raise MapFileError(f"{path}: no such file; check the path or restore it")

    def about(self, key: str) -> object:
        """What is to be known of the map by ``key``."""
        rows = self.layer(_ABOUT)
        return _json(rows[0][1].get(key), f"{self._path}: {key}") if rows else None

    def layer(self, layer: str) -> list[tuple[bytes | None, dict[str, Any]]]:
        """Geometry and properties of each row; numbers that are missing are None."""
        errors = self._errors
        try:
            meta, _, geometry, columns = self._raw.read(str(self._path), layer=layer)
        except (errors.DataSourceError, errors.DataLayerError, errors.FeatureError) as failure:
            problem = _SQL.sub("", str(failure).splitlines()[0])
            raise MapFileError(
                f"{self._path}: not a map written by v2hdm ({problem}); give one that is"
            ) from None
        rows = [
            {name: None if value != value else value for name, value in zip(meta["fields"], row, strict=True)}
            for row in zip(*(column.tolist() for column in columns), strict=True)
        ]
        return list(zip([None] * len(rows) if geometry is None else geometry, rows, strict=True))


def _write_layer(
    raw: Any, path: Path, shape: str, features: Sequence[Feature], origin: GeodeticOrigin | None
) -> None:
    told = [properties_of(feature) for feature in features]
    layer, geometry_type = _LAYERS[shape]
    columns: dict[str, AnyArray] = {
        "id": np.array([one["id"] for one in told], dtype=np.int64),
        "class": _texts([one["class"] for one in told]),
        "sightings": np.array([one["sightings"] for one in told], dtype=np.int64),
        "sigma_m": np.array([one.get("sigma_m", np.nan) for one in told], dtype=np.float64),
        "relative_sigma_m": np.array([one.get("relative_sigma_m", np.nan) for one in told], dtype=np.float64),
    }
    for key in (shape, *_EXACT):
        texts = [json.dumps(one[key]) if key in one else None for one in told]
        columns[key] = _texts(texts)
    raw.write(
        str(path),
        _texts([_wkb(feature, origin) for feature in features]),
        list(columns.values()),
        list(columns),
        layer=layer,
        driver="GPKG",
        geometry_type=geometry_type,
        crs=_LOCAL if origin is None else _WGS84,
    )


def _wkb(feature: Feature, origin: GeodeticOrigin | None) -> bytes:
    """Well-known binary with heights (OGC 06-103r4, clause 8.2)."""
    positions = feature.positions(origin)
    if positions.shape[1] == 2:
        positions = np.column_stack([positions, np.zeros(len(positions))])
    if not feature.closed:
        return (
            struct.pack("<BII", _LITTLE_ENDIAN, _WKB_LINE_Z, len(positions))
            + positions.astype("<f8").tobytes()
        )
    ring = np.concatenate([positions, positions[:1]])
    return struct.pack("<BIII", _LITTLE_ENDIAN, _WKB_POLYGON_Z, 1, len(ring)) + ring.astype("<f8").tobytes()


def _geometry(wkb: bytes | None, where: str) -> Geometry | None:
    """A polygon of one ring, a line, or a Multi... of one of them."""
    if wkb is None:
        return None
    at = 0
    for _ in range(2):
        order = "<" if wkb[at] == _LITTLE_ENDIAN else ">"
        code, parts = struct.unpack_from(f"{order}II", wkb, at + 1)
        # Heights are told by a thousand (ISO) or by the highest bit (as GDAL did before ISO).
        plain = code & 0xFFFF
        kind, dimensions = plain % 1000, 3 if code & 0x80000000 or plain // 1000 == 1 else 2
        at += 9
        if kind < 4:
            break
        if parts != 1:
            raise MapFileError(f"{where}: its geometry has several parts; split it")
    closed = _WKB_KINDS.get(kind)
    if closed is None:
        raise MapFileError(f"{where}: its geometry is none that a map has; draw a polygon or a line")
    count = parts
    if closed:
        if parts != 1:
            raise MapFileError(f"{where}: its polygon has holes; fill them")
        (count,) = struct.unpack_from(f"{order}I", wkb, at)
        at += 4
    positions = np.frombuffer(wkb, f"{order}f8", count * dimensions, at).reshape(count, dimensions)
    positions = take_array(positions.tolist(), (-1, dimensions), f"{where}, geometry", MapFileError)
    return Geometry(positions[:-1] if closed else positions, closed)


def _write_table(raw: Any, path: Path, layer: str, columns: Mapping[str, AnyArray], **options: Any) -> None:
    """A table without geometry."""
    raw.write(str(path), None, list(columns.values()), list(columns), layer=layer, driver="GPKG", **options)


def _texts(values: Sequence[str | bytes | None]) -> AnyArray:
    return np.array(values, dtype=object)


def _styles(features: Sequence[Feature]) -> dict[str, AnyArray]:
    """The table in which QGIS looks for the style of a GeoPackage's layers."""
    names = [layer for layer, _ in _LAYERS.values()]
    styles = [
        qgis_style(sorted({f.kind for f in features if f.key == key}), key != POINTS) for key in _LAYERS
    ]
    empty = _texts([""] * len(names))
    return {
        "f_table_catalog": empty,
        "f_table_schema": empty,
        "f_table_name": _texts(names),
        "f_geometry_column": _texts(["geom"] * len(names)),
        "styleName": _texts([f"v2hdm {name}" for name in names]),
        "styleQML": _texts(styles),
        "styleSLD": empty,
        "useAsDefault": np.ones(len(names), dtype=bool),
        "description": _texts(["colours by class"] * len(names)),
        "owner": empty,
        "ui": empty,
        "update_time": np.full(len(names), np.datetime64("now", "ms")),
    }


def _json(text: object, where: str) -> object:
    """A column that holds JSON; None where it is empty."""
    if text is None:
        return None
    return parse_json(str(text), where, MapFileError)
