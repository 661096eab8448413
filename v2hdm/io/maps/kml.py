"""Writing an HD map as KML 2.2 (OGC 12-007r2), for Google Earth and phones: a folder per layer, styled."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

from v2hdm.errors import ConfigError
from v2hdm.io.maps.colours import LINE, OTHER, channels, colours_of
from v2hdm.io.maps.features import POINTS, Feature, features_of, in_words, properties_of
from v2hdm.io.maps.reading import EXACT, LAYERS
from v2hdm.records import HDMap
from v2hdm.store.files import replace_text, xml_text

_WIDTH_PX = "3"  # width of strokes, px; chosen
_FILL_ALPHA = "8c"  # opacity of fills, of ff: as the report's; chosen


def write_kml(hd_map: HDMap, path: Path) -> None:
    """Write ``hd_map`` as KML, atomically, on the ground; ConfigError where it has no origin on the earth."""
    if hd_map.origin is None:
        raise ConfigError(
            f"{path.name}: KML needs a place on the earth, and the map has no origin; leave it out"
        )
    features = features_of(hd_map)
    root = ET.Element("kml", {"xmlns": "http://www.opengis.net/kml/2.2"})
    document = ET.SubElement(root, "Document")
    ET.SubElement(document, "name").text = path.stem
    colours = colours_of(features)
    looks = sorted({(feature.closed, feature.kind) for feature in features})
    for closed, kind in looks:
        _write_style(document, _style(closed, kind), colours.get(kind, OTHER) if closed else LINE)
    for key, layer in LAYERS.items():
        folder = ET.SubElement(document, "Folder")
        ET.SubElement(folder, "name").text = layer
        for feature in features:
            if feature.key == key:
                _write_placemark(folder, feature, hd_map)
    replace_text(path, xml_text(root))


def _style(closed: bool, kind: str) -> str:
    return f"{'area' if closed else 'line'}-{kind}".replace(" ", "_")


def _write_style(document: ET.Element, name: str, colour: str) -> None:
    red, green, blue = (f"{part:02x}" for part in channels(colour))
    style = ET.SubElement(document, "Style", {"id": name})
    line = ET.SubElement(style, "LineStyle")
    ET.SubElement(line, "color").text = f"ff{blue}{green}{red}"
    ET.SubElement(line, "width").text = _WIDTH_PX
    ET.SubElement(ET.SubElement(style, "PolyStyle"), "color").text = f"{_FILL_ALPHA}{blue}{green}{red}"


def _write_placemark(folder: ET.Element, feature: Feature, hd_map: HDMap) -> None:
    placemark = ET.SubElement(folder, "Placemark", {"id": f"feature-{feature.id}"})
    name = feature.kind.replace("_", " ") if feature.reading is None else feature.reading.text
    ET.SubElement(placemark, "name").text = f"{name} {feature.id}"
    ET.SubElement(placemark, "styleUrl").text = f"#{_style(feature.closed, feature.kind)}"
    _write_data(
        placemark, {k: v for k, v in properties_of(feature).items() if k not in (feature.key, *EXACT)}
    )
    positions = feature.positions(hd_map.origin)
    rows = [
        f"{longitude:.9f},{latitude:.9f},{height:.3f}" for longitude, latitude, height in positions.tolist()
    ]
    if feature.key == POINTS:
        line = ET.SubElement(placemark, "LineString")
        ET.SubElement(line, "coordinates").text = " ".join(rows)
        return
    polygon = ET.SubElement(placemark, "Polygon")
    ring = ET.SubElement(ET.SubElement(polygon, "outerBoundaryIs"), "LinearRing")
    ET.SubElement(ring, "coordinates").text = " ".join([*rows, rows[0]])


def _write_data(placemark: ET.Element, properties: Mapping[str, object]) -> None:
    data = ET.SubElement(placemark, "ExtendedData")
    for key, value in properties.items():
        ET.SubElement(ET.SubElement(data, "Data", {"name": key}), "value").text = in_words(value)
