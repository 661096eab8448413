"""Every class, shipped, composed or one that nobody knows, in every format, read as others do."""

import csv
import xml.etree.ElementTree as ET
from collections import Counter

import ezdxf
import geopandas
import numpy as np
import pyogrio
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from tests.maps.gis import ORIGIN
from v2hdm.catalogue import SHIPPED
from v2hdm.io.maps.formats import FORMATS, write_map
from v2hdm.io.maps.reading import read_map
from v2hdm.records import CROSSWALK, DOUBLE_LINE, HDMap, Lane, Marking, Reading, Symbol

UNKNOWN = "helipad H"  # a class that no catalogue has
LINES = ("lane_line", "lane_dash", DOUBLE_LINE)
MARKINGS = [name for name in SHIPPED.cornered if name not in LINES]
SYMBOLS = [name for name in SHIPPED.names if name not in (*MARKINGS, *LINES)] + [CROSSWALK]
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def every_class() -> HDMap:
    """Each closed class twice, as a marking or as a symbol, and the lines between which they lie."""
    kinds = [*MARKINGS, UNKNOWN]
    markings = [
        Marking(kind, SQUARE + np.array([2.0 * k, side]), 5)
        for k, kind in enumerate(kinds)
        for side in (0, 5)
    ]
    symbols = [
        Symbol(
            kind,
            SQUARE + np.array([2.0 * k, side]),
            4,
            reading=Reading("A 7", 0.9) if kind == "text" else None,
        )
        for k, kind in enumerate([*SYMBOLS, f"{UNKNOWN} outline"])
        for side in (10, 15)
    ]
    along = np.arange(0.0, 40.0, 2.0)
    lanes = [
        Lane(kind, np.column_stack([along, np.full(len(along), 20.0 + 3.5 * k)]), 6, lines=lines, apart_m=gap)
        for k, (kind, lines, gap) in enumerate(
            [("lane_line", None, None), ("lane_dash", None, None), (DOUBLE_LINE, ("lane_line",) * 2, 0.2)]
        )
    ]
    return HDMap(tuple(markings), tuple(lanes), ORIGIN, tuple(symbols))


CLOSED = Counter([feature.kind for feature in (*every_class().markings, *every_class().symbols)])
ALL = CLOSED + Counter(LINES)


def of_map(path):
    hd_map, _ = read_map(path)
    return Counter(feature.kind for feature in (*hd_map.markings, *hd_map.lanes, *hd_map.symbols))


def of_csv(path):
    with path.open() as file:
        return Counter({row["id"]: row["class"] for row in csv.DictReader(file)}.values())


def of_lanelet2(path):
    tags = [
        {tag.get("k"): tag.get("v") for tag in way.iterfind("tag")} for way in ET.parse(path).iterfind("way")
    ]
    return Counter(tag["class"] for tag in tags if "class" in tag)


def of_dxf(path):
    return Counter(line.dxf.layer for line in ezdxf.readfile(path).modelspace().query("POLYLINE"))


def of_gdal(*paths):
    class_counts = Counter()
    for path in paths:
        for layer, _ in pyogrio.list_layers(path):
            meta, _, _, columns = pyogrio.raw.read(path, layer=layer)
            table = dict(zip(meta["fields"], columns, strict=True))
            class_counts += Counter(dict(zip(table["id"].tolist(), table["class"], strict=True)).values())
    return class_counts


def of_opendrive(path):
    objects = ET.parse(path).findall(".//objects/object")
    stated = [
        next((data.get("value") for data in element.iterfind("userData[@code='class']")), element.get("name"))
        for element in objects
    ]
    return Counter(stated)


def of_landxml(path):
    space = {"x": "http://www.landxml.org/schema/LandXML-1.2"}
    return Counter(feature.get("desc") for feature in ET.parse(path).iterfind(".//x:PlanFeature", space))


def of_kml(path):
    space = {"k": "http://www.opengis.net/kml/2.2"}
    named = ET.parse(path).iterfind(".//k:Placemark//k:Data[@name='class']/k:value", space)
    return Counter(value.text for value in named)


def of_qgis(path):
    named = {
        category.get("value")
        for category in ET.parse(path).iterfind(".//category")
        if category.get("symbol") is not None
    }
    return Counter(
        {kind: count for kind, count in of_map(path.with_suffix(".gpkg")).items() if kind in named}
    )


def of_mcap(path):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = reader.iter_decoded_messages(topics=["/map/features"])
        return Counter(feature.label for _, _, _, message in decoded for feature in message.features)


READERS = {
    "geojson": of_map,
    "csv": of_csv,
    "gpkg": of_map,
    "lanelet2": of_lanelet2,
    "dxf": of_dxf,
    "qgis": of_qgis,
    "opendrive": of_opendrive,
    "landxml": of_landxml,
    "flatgeobuf": lambda path: of_gdal(*path.parent.glob("*.fgb")),
    "shapefile": lambda path: of_gdal(f"/vsizip/{path}"),
    "kml": of_kml,
    "jsonfg": of_gdal,
    "pmtiles": of_gdal,
    "geoparquet": lambda path: Counter(geopandas.read_parquet(path)["class"]),
    "mcap": of_mcap,
}


def test_every_class_is_written_as_what_it_is_mapped_as():
    assert set(CLOSED) == {*SHIPPED.names, CROSSWALK, UNKNOWN, f"{UNKNOWN} outline"} - set(LINES)


@pytest.mark.parametrize("name", FORMATS)
def test_every_class_is_in_every_format(tmp_path, name):
    written = write_map(every_class(), tmp_path, "map", [name])
    expected = CLOSED if name == "opendrive" else ALL  # lines are the marks of its roads
    assert READERS[name](written[-1]) == expected


def test_lines_are_the_marks_of_opendrive_s_roads(tmp_path):
    (path,) = write_map(every_class(), tmp_path, "map", ["opendrive"])
    marks = {mark.get("type") for mark in ET.parse(path).iterfind(".//laneSection//roadMark")}
    assert {"solid", "broken", "solid solid"} <= marks
