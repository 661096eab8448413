"""A style for a map's layer as QGIS stores it (QML): a colour a class."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

from v2hdm.records import CROSSWALK_BAR, DIAMOND, LANE_DASH, LANE_LINE, STOP_LINE

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
