"""Writing an HD map as GeoPackage (OGC 12-128) through ``pyogrio``; it opens styled in QGIS.

Layers ``markings`` and ``symbols`` hold polygons, ``lanes`` lines, all with heights; the table ``v2hdm``
describes the map. With a geodetic origin coordinates are longitude, latitude and ellipsoidal height
(EPSG:4326). Without one they are local metres in an engineering CRS, which no GIS takes for degrees.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from v2hdm.errors import ConfigError, MapFileError
from v2hdm.extras import need
from v2hdm.io.maps.features import POINTS, Feature, features_of, properties_of
from v2hdm.io.maps.reading import EXACT, LAYERS, short_gdal_error
from v2hdm.records import CROSSWALK_BAR, DIAMOND, LANE_DASH, LANE_LINE, STOP_LINE, GeodeticOrigin, HdMap
from v2hdm.store.files import whole_file

_WGS84 = "EPSG:4326"
_LOCAL = (
    'ENGCRS["v2hdm map frame: metres east and north of the drive\'s own origin",'
    'EDATUM["origin of the drive"],CS[Cartesian,2],AXIS["easting (E)",east,ORDER[1]],'
    'AXIS["northing (N)",north,ORDER[2]],LENGTHUNIT["metre",1]]'
)
_LITTLE_ENDIAN, _WKB_LINE_Z, _WKB_POLYGON_Z = 1, 1002, 1003

_COLOURS: Mapping[str, str] = {
    DIAMOND: "31,119,180,255",
    LANE_DASH: "255,127,14,255",
    LANE_LINE: "44,160,44,255",
    STOP_LINE: "214,39,40,255",
    CROSSWALK_BAR: "148,103,189,255",
}
_OTHER_COLOUR = "127,127,127,255"
_FILL = {"color": "{}", "outline_color": "35,35,35,255", "outline_width": "0.1", "style": "solid"}
_LINE = {"line_color": "{}", "line_width": "0.4", "line_width_unit": "MM"}
_STYLE = """<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.28.0" styleCategories="Symbology"><renderer-v2 type="categorizedSymbol" attr="class"
symbollevels="0" enableorderby="0"><categories>{}</categories><symbols>{}</symbols></renderer-v2></qgis>"""
_CATEGORY = '<category symbol="{}" value={} label={} render="true" type="string"/>'
_SYMBOL = """<symbol name="{}" type="{}" alpha="1"><layer class="{}" enabled="1"><Option
type="Map">{}</Option>
</layer></symbol>"""
_OPTION = '<Option type="QString" name="{}" value="{}"/>'

AnyArray = NDArray[Any]


def write_geopackage(hd_map: HdMap, path: Path, verdict: Mapping[str, Any] | None = None) -> None:
    """Write ``hd_map`` to ``path``, atomically, with the ``verdict`` on the run that made it.

    Raises ConfigError when ``pyogrio`` is not installed, MapFileError when GDAL cannot write there.
    """
    raw, errors = (
        need(f"pyogrio.{part}", "gis", "the format gpkg", ConfigError) for part in ("raw", "errors")
    )
    features = features_of(hd_map)
    about: dict[str, Any] = {"frame": "map"}
    if hd_map.origin is not None:
        about["origin"] = asdict(hd_map.origin)
    if verdict is not None:
        about["verdict"] = dict(verdict)
    with whole_file(path) as partial:
        # GDAL recognises the format of a file by its ending.
        unfinished = partial.with_name(f"{partial.name}.gpkg")

        def write(
            layer: str, columns: Mapping[str, AnyArray], shapes: AnyArray | None, **options: Any
        ) -> None:
            values, names = list(columns.values()), list(columns)
            raw.write(str(unfinished), shapes, values, names, layer=layer, driver="GPKG", **options)

        try:
            for key, layer in LAYERS.items():
                mine = [feature for feature in features if feature.key == key]
                shapes = _texts([_wkb(feature, hd_map.origin) for feature in mine])
                kind = "LineString Z" if key == POINTS else "Polygon Z"
                crs = _LOCAL if hd_map.origin is None else _WGS84
                write(layer, _columns(key, mine), shapes, geometry_type=kind, crs=crs)
            write("v2hdm", {key: _texts([json.dumps(value)]) for key, value in about.items()}, None)
            write("layer_styles", _styles(features), None, FID="id")
            unfinished.replace(partial)
        except (errors.DataSourceError, errors.DataLayerError, errors.FeatureError) as failure:
            problem = short_gdal_error(failure)
            raise MapFileError(f"{path}: cannot be written ({problem}); set another folder") from None
        finally:
            unfinished.unlink(missing_ok=True)


def _columns(key: str, features: Sequence[Feature]) -> dict[str, AnyArray]:
    rows = [properties_of(feature) for feature in features]

    def numbers(name: str) -> AnyArray:
        return np.array([one.get(name, np.nan) for one in rows], dtype=np.float64)

    return {
        "id": np.array([one["id"] for one in rows], dtype=np.int64),
        "class": _texts([one["class"] for one in rows]),
        "sightings": np.array([one["sightings"] for one in rows], dtype=np.int64),
        "sigma_m": numbers("sigma_m"),
        "relative_sigma_m": numbers("relative_sigma_m"),
    } | {
        name: _texts([json.dumps(one[name]) if name in one else None for one in rows])
        for name in (key, *EXACT)
    }


def _wkb(feature: Feature, origin: GeodeticOrigin | None) -> bytes:
    """Well-known binary with heights (OGC 06-103r4, clause 8.2)."""
    positions = feature.positions(origin)
    if positions.shape[1] == 2:
        positions = np.column_stack([positions, np.zeros(len(positions))])
    head = struct.pack("<BI", _LITTLE_ENDIAN, _WKB_POLYGON_Z if feature.closed else _WKB_LINE_Z)
    if feature.closed:
        positions = np.concatenate([positions, positions[:1]])
        head += struct.pack("<I", 1)
    return head + struct.pack("<I", len(positions)) + positions.astype("<f8").tobytes()


def _texts(values: Sequence[str | bytes | None]) -> AnyArray:
    return np.array(values, dtype=object)


def _styles(features: Sequence[Feature]) -> dict[str, AnyArray]:
    """The table in which QGIS looks for the style of a GeoPackage's layers."""
    names = list(LAYERS.values())
    styles = [_style(sorted({f.kind for f in features if f.key == key}), key != POINTS) for key in LAYERS]
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


def _style(kinds: Sequence[str], closed: bool) -> str:
    """The QML text of a layer; classes of later edits fall into the last category, of an empty value."""
    categories, symbols = "", ""
    shape, layer, options = ("fill", "SimpleFill", _FILL) if closed else ("line", "SimpleLine", _LINE)
    for number, kind in enumerate([*kinds, ""]):
        categories += _CATEGORY.format(number, quoteattr(kind), quoteattr(kind or "other"))
        colour = _COLOURS.get(kind, _OTHER_COLOUR)
        drawn = "".join(_OPTION.format(name, value.format(colour)) for name, value in options.items())
        symbols += _SYMBOL.format(number, shape, layer, drawn)
    return _STYLE.format(categories, symbols)
