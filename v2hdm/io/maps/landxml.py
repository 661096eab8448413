"""Writing an HD map as LandXML 1.2, for surveyors and road designers.

Every feature is a ``PlanFeature`` named by its id, its class as ``desc``, made of straight lines between
points ``northing easting height``. Its ``Feature`` of properties holds sightings and sigma.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

from v2hdm import __version__
from v2hdm.geometry.geodetic import LOCAL, Grid
from v2hdm.io.maps.features import COMPOSITION, features_of, in_words, properties_of
from v2hdm.records import HDMap
from v2hdm.store.files import replace_text, xml_text

_NAMESPACE = "http://www.landxml.org/schema/LandXML-1.2"


def write_landxml(hd_map: HDMap, path: Path, grid: Grid | None = None) -> None:
    """Write ``hd_map`` as LandXML, atomically, in metres of the ``grid``, else of the map's own frame."""
    grid = grid or Grid(LOCAL, hd_map.origin)
    now = datetime.now(UTC)
    stamp = {"date": now.strftime("%Y-%m-%d"), "time": now.strftime("%H:%M:%S")}
    root = ET.Element("LandXML", {"xmlns": _NAMESPACE, "version": "1.2", **stamp})
    units = {"areaUnit": "squareMeter", "linearUnit": "meter", "volumeUnit": "cubicMeter"}
    more = {"temperatureUnit": "celsius", "pressureUnit": "milliBars", "angularUnit": "decimal degrees"}
    ET.SubElement(ET.SubElement(root, "Units"), "Metric", units | more)
    system = {"desc": ", ".join(f"{key} {value}" for key, value in grid.stated.items())}
    if grid.crs.upper().startswith("EPSG:"):
        system["epsgCode"] = grid.crs[5:]
    ET.SubElement(root, "CoordinateSystem", system)
    ET.SubElement(root, "Application", {"name": "v2hdm", "version": __version__})
    group = ET.SubElement(root, "PlanFeatures", {"name": "markings"})
    for feature in features_of(hd_map):
        element = ET.SubElement(group, "PlanFeature", {"name": str(feature.id), "desc": feature.kind})
        geometry = ET.SubElement(element, "CoordGeom")
        east_first = feature.positions(grid).tolist()
        points = [f"{north:.4f} {east:.4f} {up:.4f}" for east, north, up in east_first]
        for start, end in pairwise([*points, points[0]] if feature.closed else points):
            line = ET.SubElement(geometry, "Line")
            ET.SubElement(line, "Start").text = start
            ET.SubElement(line, "End").text = end
        about = ET.SubElement(element, "Feature", {"code": "v2hdm"})
        for key, value in properties_of(feature).items():
            if not isinstance(value, list) or key in COMPOSITION:
                text = f"{value:.5g}" if isinstance(value, float) else in_words(value)
                ET.SubElement(about, "Property", {"label": key, "value": text})
    replace_text(path, xml_text(root))
