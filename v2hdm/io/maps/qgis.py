"""Writing a QGIS project that opens a map's GeoPackage, coloured by class, over the mosaic of its ground."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import ConfigError, need
from v2hdm.geometry.geodetic import Grid, crs_of
from v2hdm.io.maps.features import POINTS, features_of
from v2hdm.io.maps.geopackage import LOCAL_CRS, layer_style
from v2hdm.io.maps.reading import LAYERS
from v2hdm.records import HdMap
from v2hdm.store.files import replace_text

MOSAIC = "mosaic.tif"  # beside the project, where the run has made one
_AROUND_M = 5.0


def write_qgis(hd_map: HdMap, path: Path, grid: Grid | None = None) -> None:
    """Write the project ``path`` of the GeoPackage beside it that has its name, atomically.

    The canvas is in metres: of the ``grid``, else of the map frame, about whose origin it is projected. All
    files are named relative to the project, so that the folder may be moved.
    """
    pyproj = need("pyproj", "map", "the format qgis", ConfigError)
    features, where = features_of(hd_map), grid or Grid("local", hd_map.origin)
    placed = hd_map.origin is not None and (grid is None or not grid.is_local)
    ground = crs_of(hd_map.origin) if placed and hd_map.origin is not None else LOCAL_CRS
    layers_crs = LOCAL_CRS if not placed else "EPSG:4326" if grid is None else grid.crs
    canvas_crs = ground if grid is None else layers_crs
    system = pyproj.CRS.from_user_input(canvas_crs)
    root = ET.Element("qgis", {"version": "3.22.0", "projectname": path.stem})
    ET.SubElement(root, "title").text = path.stem
    _refer(ET.SubElement(root, "projectCrs"), system)
    enabled = ET.SubElement(ET.SubElement(root, "properties"), "SpatialRefSys")
    ET.SubElement(enabled, "ProjectionsEnabled", {"type": "int"}).text = "1"
    tree = ET.SubElement(root, "layer-tree-group")
    canvas = ET.SubElement(root, "mapcanvas", {"name": "theMapCanvas"})
    ET.SubElement(canvas, "units").text = "degrees" if system.is_geographic else "meters"
    places = np.concatenate([one.positions(where)[:, :2] for one in features] or [np.zeros((1, 2))])
    around = _AROUND_M * (1e-5 if system.is_geographic else 1.0)
    extent = ET.SubElement(canvas, "extent")
    corners = (*(places.min(axis=0) - around), *(places.max(axis=0) + around))
    for name, value in zip(("xmin", "ymin", "xmax", "ymax"), corners, strict=True):
        ET.SubElement(extent, name).text = repr(float(value))
    layers = ET.SubElement(root, "projectlayers")
    for key, layer in reversed(LAYERS.items()):
        shape = "Line" if key == POINTS else "Polygon"
        source = f"./{path.stem}.gpkg|layername={layer}"
        element = _layer(tree, layers, layer, source, "ogr", {"type": "vector", "geometry": shape})
        _refer(ET.SubElement(element, "srs"), pyproj.CRS.from_user_input(layers_crs))
        kinds = sorted({one.kind for one in features if one.key == key})
        element.extend(ET.fromstring(layer_style(kinds, key != POINTS).split("\n", 1)[1]))
    if (path.parent / MOSAIC).is_file():
        element = _layer(tree, layers, "mosaic", f"./{MOSAIC}", "gdal", {"type": "raster"})
        _refer(ET.SubElement(element, "srs"), pyproj.CRS.from_user_input(ground))
    ET.indent(root, " ")
    doctype = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
    replace_text(path, f"{doctype}\n{ET.tostring(root, encoding='unicode')}\n")


def _refer(parent: ET.Element, system: Any) -> None:
    """State a coordinate system, without which QGIS takes a layer as it lies."""
    reference = ET.SubElement(parent, "spatialrefsys", {"nativeFormat": "Wkt"})
    ET.SubElement(reference, "wkt").text = system.to_wkt()
    if (code := system.to_authority()) is not None:
        ET.SubElement(reference, "authid").text = ":".join(code)


def _layer(
    tree: ET.Element, layers: ET.Element, name: str, source: str, provider: str, kind: Mapping[str, str]
) -> ET.Element:
    """Add a layer below those that are there."""
    identity = f"v2hdm_layer_{name}"  # QGIS gives those of ten letters and fewer another
    entry = {
        "id": identity,
        "name": name,
        "source": source,
        "providerKey": provider,
        "checked": "Qt::Checked",
    }
    ET.SubElement(tree, "layer-tree-layer", entry | {"expanded": "1"})
    element = ET.SubElement(layers, "maplayer", dict(kind))
    for tag, text in (("id", identity), ("datasource", source), ("layername", name), ("provider", provider)):
        ET.SubElement(element, tag).text = text
    return element
