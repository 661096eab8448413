"""Writing an HD map as GeoPackage (OGC 12-128) through ``pyogrio``, and the QGIS project that opens it.

Layers ``markings`` and ``symbols`` hold polygons, ``lanes`` lines, all with heights; the table ``v2hdm``
describes the map. With a geodetic origin coordinates are longitude, latitude and ellipsoidal height
(EPSG:4326), or those of the grid that was asked for. Without one, or where the local frame was asked for,
they are local metres in an engineering CRS, which no GIS takes for degrees. The project has the colours
of the report's map, and dashed lines dashed, over the mosaic of the ground.
"""

from __future__ import annotations

import filecmp
import json
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import shorten
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from v2hdm.errors import ConfigError, MapFileError, need
from v2hdm.geometry.geodetic import Grid, crs_of
from v2hdm.io.maps.colours import LINE, OTHER, channels, colours_of
from v2hdm.io.maps.features import (
    CORNERS,
    OUTLINE,
    PAINT,
    POINTS,
    TEXT_READ,
    Feature,
    features_of,
    properties_of,
)
from v2hdm.io.maps.reading import EXACT, GEOMETRY, LAYERS
from v2hdm.records import LANE_DASH, GeodeticOrigin, HDMap
from v2hdm.store.files import replace_text, whole_file, xml_text
from v2hdm.store.names import MOSAIC

LOCAL_CRS = (
    'ENGCRS["v2hdm map frame: metres east and north of the drive\'s own origin",'
    'EDATUM["origin of the drive"],CS[Cartesian,2],AXIS["easting (E)",east,ORDER[1]],'
    'AXIS["northing (N)",north,ORDER[2]],LENGTHUNIT["metre",1]]'
)

_FILL = {"color": "{},140", "outline_color": "{},255", "outline_width": "0.3", "style": "solid"}
_LINE = {"line_color": "{},255", "line_width": "0.5", "line_width_unit": "MM", "line_style": "solid"}
_STYLE = """<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.28.0" styleCategories="Symbology"><renderer-v2 type="categorizedSymbol" attr="class"
symbollevels="0" enableorderby="0"><categories>{}</categories><symbols>{}</symbols></renderer-v2></qgis>"""
_CATEGORY = '<category symbol="{}" value={} label={} render="true" type="string"/>'
_SYMBOL = """<symbol name="{}" type="{}" alpha="1"><layer class="{}" enabled="1"><Option
type="Map">{}</Option>
</layer></symbol>"""
_OPTION = '<Option type="QString" name="{}" value="{}"/>'

_MESSAGE_LETTERS = 200  # longest text of a GDAL error in ours, letters: it may hold whole statements; chosen

AnyArray = NDArray[Any]


def write_geopackage(
    hd_map: HDMap, path: Path, verdict: Mapping[str, Any] | None = None, grid: Grid | None = None
) -> None:
    """Write ``hd_map`` and the ``verdict``, atomically; MapFileError when GDAL cannot write there."""
    raw = need("pyogrio.raw", "gis", "the format gpkg", ConfigError)
    features = features_of(hd_map)
    about: dict[str, Any] = {"frame": "map"}
    if hd_map.origin is not None:
        about["origin"] = asdict(hd_map.origin)
    if verdict is not None:
        about["verdict"] = dict(verdict)
    crs = LOCAL_CRS if hd_map.origin is None else "EPSG:4326"
    if grid is not None:
        about["crs"] = grid.crs
        crs = LOCAL_CRS if grid.is_local else grid.crs
    now = np.datetime64("now", "ms")

    def write(
        place: Path, layer: str, columns: Mapping[str, Any], shapes: AnyArray | None = None, **options: Any
    ) -> None:
        values = [
            np.array(column, dtype=object) if isinstance(column, list) else column
            for column in columns.values()
        ]
        raw.write(str(place), shapes, values, list(columns), layer=layer, driver="GPKG", **options)

    def write_all(place: Path) -> None:
        styles = []
        for key, layer in LAYERS.items():
            features_of_layer = [feature for feature in features if feature.key == key]
            kind = "LineString Z" if key == POINTS else "Polygon Z"
            shapes = shapes_of(features_of_layer, grid or hd_map.origin)
            write(place, layer, _columns(key, features_of_layer), shapes, geometry_type=kind, crs=crs)
            kinds = sorted({feature.kind for feature in features_of_layer})
            style = layer_style(kinds, key != POINTS, colours_of(features))
            styles.append(_style_row(layer, style))
        write(place, "v2hdm", {key: [json.dumps(value)] for key, value in about.items()})
        # The table in which QGIS looks for the style of a GeoPackage's layers.
        texts = {name: [row[name] for row in styles] for name in styles[0]}
        defaults = {"useAsDefault": np.ones(len(styles), bool), "update_time": np.full(len(styles), now)}
        write(place, "layer_styles", texts | defaults, FID="id")

    with whole_file(path) as partial, TemporaryDirectory(".part", f".{path.name}.", path.parent) as folder:
        # GDAL goes on after some calls that fail: only two files that are alike are whole.
        first, second = (Path(folder, name) for name in ("first.gpkg", "second.gpkg"))
        with gdal_errors(path), _gdal_options(now):
            for place in (first, second):
                write_all(place)
        if not filecmp.cmp(first, second, shallow=False):
            raise MapFileError(f"{path}: cannot be written (the disk failed meanwhile); set another folder")
        first.replace(partial)


@contextmanager
def _gdal_options(now: np.datetime64) -> Iterator[None]:
    """Within, GDAL's GeoPackages carry the date ``now`` and are written without a journal for failures."""
    gdal = need("pyogrio", "gis", "the format gpkg", ConfigError)
    options = {"OGR_CURRENT_DATE": f"{now}Z", "OGR_SQLITE_JOURNAL": "OFF", "OGR_SQLITE_SYNCHRONOUS": "OFF"}
    before = {name: gdal.get_gdal_config_option(name) for name in options}
    gdal.set_gdal_config_options(options)
    try:
        yield
    finally:
        gdal.set_gdal_config_options(before)


@contextmanager
def gdal_errors(path: Path) -> Iterator[None]:
    """Within, GDAL's failures to write are errors of one line that name the ``path``."""
    errors = need("pyogrio.errors", "gis", "the format gpkg", ConfigError)
    try:
        yield
    except (errors.DataSourceError, errors.DataLayerError, errors.FeatureError) as failure:
        first_line = shorten(str(failure).splitlines()[0], _MESSAGE_LETTERS)
        raise MapFileError(f"{path}: cannot be written ({first_line}); set another folder") from None


def _columns(key: str, features: Sequence[Feature]) -> dict[str, Any]:
    rows = [properties_of(feature) for feature in features]

    def numbers(name: str, kind: type = np.float64) -> AnyArray:
        return np.array([row.get(name, np.nan) for row in rows], dtype=kind)

    def texts(name: str) -> list[str | None]:
        return [json.dumps(row[name]) if name in row else None for row in rows]

    return {
        "id": numbers("id", np.int64),
        "class": [row["class"] for row in rows],
        "sightings": numbers("sightings", np.int64),
        "sigma_m": numbers("sigma_m"),
        "relative_sigma_m": numbers("relative_sigma_m"),
        **({} if key == POINTS else {"accuracy": [row.get("accuracy") for row in rows]}),
        **{name: numbers(name) for name in PAINT if key == CORNERS},
        **{name: [row.get(name) for row in rows] for name in TEXT_READ[::2] if key == OUTLINE},
        **{name: numbers(name) for name in TEXT_READ[1::2] if key == OUTLINE},
        **({"kind": [row.get("kind") for row in rows]} if key == CORNERS else {}),
        **({"lines": texts("lines"), "apart_m": numbers("apart_m")} if key == POINTS else {}),
        **({"parts": texts("parts")} if key == OUTLINE else {}),
        **{name: texts(name) for name in (key, *EXACT)},
    }


def shapes_of(features: Sequence[Feature], origin: GeodeticOrigin | Grid | None) -> AnyArray:
    """Well-known binary of features, with heights."""
    shapely = need("shapely", "gis", "the format gpkg", ConfigError)
    shapes = np.empty(len(features), dtype=object)
    for k, feature in enumerate(features):
        positions = feature.positions(origin)
        if positions.shape[1] == 2:
            positions = np.column_stack([positions, np.zeros(len(positions))])
        shapes[k] = (shapely.Polygon if feature.closed else shapely.LineString)(positions)
    return np.asarray(shapely.to_wkb(shapes, flavor="iso"))


def layer_style(kinds: Sequence[str], closed: bool, colours: Mapping[str, str]) -> str:
    """QGIS's style of a layer; classes of later edits fall into the last category, of an empty value."""
    categories = ""
    symbols = ""
    shape, drawing, options = ("fill", "SimpleFill", _FILL) if closed else ("line", "SimpleLine", _LINE)
    for number, kind in enumerate([*kinds, ""]):
        categories += _CATEGORY.format(number, quoteattr(kind), quoteattr(kind or "other"))
        hue = (colours.get(kind, OTHER) if closed else LINE) if kind else OTHER
        colour = ",".join(map(str, channels(hue)))
        looks = options | ({"line_style": "dash"} if kind == LANE_DASH and not closed else {})
        drawn = "".join(_OPTION.format(name, value.format(colour)) for name, value in looks.items())
        symbols += _SYMBOL.format(number, shape, drawing, drawn)
    return _STYLE.format(categories, symbols)


def _style_row(layer: str, style: str) -> dict[str, str]:
    """A layer's row in the table of styles."""
    empty = dict.fromkeys(("f_table_catalog", "f_table_schema", "styleSLD", "owner", "ui"), "")
    return empty | {
        "f_table_name": layer,
        "f_geometry_column": GEOMETRY,
        "styleName": f"v2hdm {layer}",
        "styleQML": style,
        "description": "colours by class",
    }


_AROUND_M = 5.0  # margin of a QGIS project's first view around the features, m; chosen


def write_qgis(hd_map: HDMap, path: Path, grid: Grid | None = None) -> None:
    """Write the project ``path`` of the GeoPackage beside it that has its name, atomically.

    The canvas is in metres: of the ``grid``, else of the map frame, about whose origin it is projected. All
    files are named relative to the project, so that the folder may be moved.
    """
    pyproj = need("pyproj", "map", "the format qgis", ConfigError)
    features = features_of(hd_map)
    where = grid or Grid("local", hd_map.origin)
    ground_crs = LOCAL_CRS
    layers_crs = LOCAL_CRS
    if hd_map.origin is not None and (grid is None or not grid.is_local):
        ground_crs = crs_of(hd_map.origin)
        layers_crs = "EPSG:4326" if grid is None else grid.crs
    canvas_crs = ground_crs if grid is None else layers_crs
    system = pyproj.CRS.from_user_input(canvas_crs)
    root = ET.Element("qgis", {"version": "3.22.0", "projectname": path.stem})
    ET.SubElement(root, "title").text = path.stem
    _refer(ET.SubElement(root, "projectCrs"), system)
    enabled = ET.SubElement(ET.SubElement(root, "properties"), "SpatialRefSys")
    ET.SubElement(enabled, "ProjectionsEnabled", {"type": "int"}).text = "1"
    tree = ET.SubElement(root, "layer-tree-group")
    canvas = ET.SubElement(root, "mapcanvas", {"name": "theMapCanvas"})
    ET.SubElement(canvas, "units").text = "degrees" if system.is_geographic else "meters"
    places = np.concatenate([feature.positions(where)[:, :2] for feature in features] or [np.zeros((1, 2))])
    margin = _AROUND_M * (1e-5 if system.is_geographic else 1.0)  # 1e-5 deg is about 1 m
    extent = ET.SubElement(canvas, "extent")
    low = places.min(axis=0) - margin
    high = places.max(axis=0) + margin
    sides = {"xmin": low[0], "ymin": low[1], "xmax": high[0], "ymax": high[1]}
    for name, value in sides.items():
        ET.SubElement(extent, name).text = repr(float(value))
    layers = ET.SubElement(root, "projectlayers")
    for key, layer in reversed(LAYERS.items()):
        shape = "Line" if key == POINTS else "Polygon"
        source = f"./{path.stem}.gpkg|layername={layer}"
        element = _layer(tree, layers, layer, source, "ogr", {"type": "vector", "geometry": shape})
        _refer(ET.SubElement(element, "srs"), pyproj.CRS.from_user_input(layers_crs))
        kinds = sorted({feature.kind for feature in features if feature.key == key})
        element.extend(
            ET.fromstring(layer_style(kinds, key != POINTS, colours_of(features)).split("\n", 1)[1])
        )
    if (path.parent / MOSAIC).is_file():
        element = _layer(tree, layers, "mosaic", f"./{MOSAIC}", "gdal", {"type": "raster"})
        _refer(ET.SubElement(element, "srs"), pyproj.CRS.from_user_input(ground_crs))
    doctype = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
    replace_text(path, xml_text(root, before=f"{doctype}\n"))


def _refer(parent: ET.Element, system: Any) -> None:
    """State a coordinate system, without which QGIS takes a layer as it lies."""
    reference = ET.SubElement(parent, "spatialrefsys", {"nativeFormat": "Wkt"})
    ET.SubElement(reference, "wkt").text = system.to_wkt()
    if (code := system.to_authority()) is not None:
        ET.SubElement(reference, "authid").text = ":".join(code)


def _layer(
    tree: ET.Element, layers: ET.Element, name: str, source: str, provider: str, kind: Mapping[str, str]
) -> ET.Element:
    """Add a layer below the layers so far; returns its element in ``layers``."""
    identity = f"v2hdm_layer_{name}"  # QGIS gives those of ten letters and fewer another
    entry = {"id": identity, "name": name, "source": source, "providerKey": provider}
    ET.SubElement(tree, "layer-tree-layer", entry | {"checked": "Qt::Checked", "expanded": "1"})
    element = ET.SubElement(layers, "maplayer", dict(kind))
    for tag, text in (("id", identity), ("datasource", source), ("layername", name), ("provider", provider)):
        ET.SubElement(element, tag).text = text
    return element
