"""Crosswalks, double lines, words and boxes in every format, by the types that each format has for them."""

import csv
import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import ezdxf
import lanelet2
import numpy as np
import pytest

from tests.maps.gis import ORIGIN, assert_same_map, street
from v2hdm.errors import MapFileError
from v2hdm.io.maps.features import features_of
from v2hdm.io.maps.formats import FORMATS, write_map
from v2hdm.io.maps.reading import read_map
from v2hdm.records import Lane, Marking, Symbol
from v2hdm.site.composed import composed

BAR = np.array([[-1.5, -0.25], [1.5, -0.25], [1.5, 0.25], [-1.5, 0.25]])
SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])


@pytest.fixture(scope="module")
def hd_map():
    """A street with a crosswalk, a double line, a word, a box, a bicycle and a give-way line."""
    plain = street()
    bars = [
        Marking("crosswalk_bar", BAR + np.array([20.0, k - 6.0]), 5, 1e-4 * np.eye(8), 0.008)
        for k in range(8)
    ]
    areas = [
        Symbol(
            kind,
            SQUARE + np.array([5.0 * k, -15.0]),
            4,
            covariance_m2=1e-3 * np.eye(8),
            sigma_m=float(np.sqrt(1e-3)),
        )
        for k, kind in enumerate(("text", "box", "bicycle", "taxi_rank"))
    ]
    x = np.arange(0.0, 30.0, 0.5)
    lines = [Lane("lane_line", np.column_stack([x, 40 + 0 * x]), 5)]
    lines += [Lane("lane_dash", np.column_stack([x, 40.24 + 0 * x])[::-1], 5)]
    give_way = replace(plain.markings[2], variety="give_way")
    markings = (*plain.markings[:2], give_way, *plain.markings[3:4], *bars)
    return composed(replace(plain, markings=markings, lanes=(*plain.lanes, *lines), symbols=tuple(areas)))


@pytest.fixture(scope="module")
def folder(hd_map, tmp_path_factory):
    path = tmp_path_factory.mktemp("maps")
    write_map(hd_map, path, "map", list(FORMATS))
    return path


@pytest.mark.parametrize("ending", ["geojson", "gpkg"])
def test_a_map_with_composed_markings_comes_back_as_it_was(hd_map, folder, ending):
    got, _ = read_map(folder / f"map.{ending}")
    assert_same_map(got, hd_map)
    (crosswalk,) = [symbol for symbol in got.symbols if symbol.kind == "crosswalk"]
    of_parts = [marking.kind for marking in got.markings if marking.id in crosswalk.parts]
    assert of_parts == ["crosswalk_bar"] * 8


def test_lanelet2_has_a_crosswalk_between_zebra_markings_and_reads_it(folder):
    projector = lanelet2.projection.LocalCartesianProjector(
        lanelet2.io.Origin(ORIGIN.latitude_deg, ORIGIN.longitude_deg, ORIGIN.altitude_m)
    )
    loaded = lanelet2.io.load(str(folder / "map_lanelet2" / "lanelet2_map.osm"), projector)
    (crosswalk,) = [
        lanelet for lanelet in loaded.laneletLayer if lanelet.attributes["subtype"] == "crosswalk"
    ]
    for bound in (crosswalk.leftBound, crosswalk.rightBound):
        assert bound.attributes["type"] == "zebra_marking"
        assert len(bound) == 2
    assert lanelet2.geometry.length2d(crosswalk) == pytest.approx(7.5, abs=0.01)
    left, right = (
        np.array([[p.x, p.y] for p in bound]) for bound in (crosswalk.leftBound, crosswalk.rightBound)
    )
    along, across = left[1] - left[0], left[0] - right[0]
    assert along[0] * across[1] - along[1] * across[0] > 0
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Pedestrian
    )
    assert rules.canPass(crosswalk)
    types = {polygon.attributes["type"] for polygon in loaded.polygonLayer}
    assert types == {"pose_marker", "crosswalk_polygon", "road_symbol"}
    subtypes = {p.attributes["subtype"] for p in loaded.polygonLayer if p.attributes["type"] == "road_symbol"}
    assert subtypes == {"text", "box", "bicycle", "taxi_rank"}
    (double,) = [
        line
        for line in loaded.lineStringLayer
        if "class" in line.attributes and line.attributes["class"] == "double_line"
    ]
    # The line runs east, the dashed one of the two on its left.
    assert double.attributes["subtype"] == "dashed_solid"
    assert double.attributes["lane_change:right"] == "yes"
    assert double.attributes["lane_change:left"] == "no"


@pytest.mark.parametrize(
    ("lines", "subtype"),
    [
        (("lane_line", "lane_line"), "solid_solid"),
        (("lane_line", "lane_dash"), "solid_dashed"),
        (("lane_dash", "lane_line"), "dashed_solid"),
        (("lane_dash", "lane_dash"), "dashed"),
    ],
)
def test_a_double_line_has_lanelet2_s_subtype_and_opendrive_s_mark(lines, subtype, tmp_path):
    plain = street()
    double = replace(plain.lanes[1], kind="double_line", lines=lines, apart_m=0.24)
    hd_map = replace(plain, lanes=(plain.lanes[0], double, plain.lanes[2]))
    write_map(hd_map, tmp_path, "map", ["lanelet2", "opendrive"])
    ways = ET.parse(tmp_path / "map_lanelet2" / "lanelet2_map.osm").getroot().findall("way")
    tags = [{tag.get("k"): tag.get("v") for tag in way.findall("tag")} for way in ways]
    assert [of.get("subtype") for of in tags if of.get("class") == "double_line"] == [subtype]
    words = " ".join("broken" if kind == "lane_dash" else "solid" for kind in lines)
    marks = [mark.get("type") for mark in ET.parse(tmp_path / "map.xodr").getroot().iter("roadMark")]
    assert marks.count(words) == 2  # of the lanes on either side


def test_opendrive_has_a_crosswalk_and_all_else_as_road_marks_by_name(hd_map, folder):
    objects = {
        element.get("id"): element for element in ET.parse(folder / "map.xodr").getroot().iter("object")
    }
    for feature in features_of(hd_map):
        if feature.closed:
            element = objects[str(feature.id)]
            assert element.get("name") == feature.kind
            assert element.get("type") == ("crosswalk" if feature.kind == "crosswalk" else "roadMark")
            assert len(list(element.iter("cornerLocal"))) == len(feature.points_map)
    said = [(data.get("code"), data.get("value")) for data in objects["3"].iter("userData")]
    assert ("kind", "give_way") in said


def test_csv_and_dxf_tell_what_is_composed_of_what(hd_map, folder):
    with (folder / "map.csv").open(newline="", encoding="utf-8-sig") as text:
        rows = list(csv.DictReader(text))
    assert all(None not in row for row in rows)
    by_class = {row["class"]: row for row in rows}
    assert by_class["crosswalk"]["parts"].split() == [str(k) for k in range(5, 13)]
    assert by_class["double_line"]["lines"] == "lane_dash lane_line"
    assert float(by_class["double_line"]["apart_m"]) == pytest.approx(0.24)
    assert by_class["stop_line"]["kind"] == "give_way"
    drawing = ezdxf.readfile(folder / "map.dxf")
    kinds = {feature.kind for feature in features_of(hd_map)}
    assert kinds <= {layer.dxf.name for layer in drawing.layers}
    (double,) = drawing.modelspace().query('POLYLINE[layer=="double_line"]')
    values = [value for _, value in double.get_xdata("V2HDM")]
    assert values[values.index("lines") + 1] == "lane_dash lane_line"


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("lines", ["lane_line"], "not two classes"),
        ("apart_m", -0.2, "not positive"),
        ("parts", ["a"], "parts"),
    ],
)
def test_a_composition_that_makes_no_sense_is_refused_in_one_line(folder, tmp_path, key, value, says):
    content = json.loads((folder / "map.geojson").read_text())
    content["features"][-1]["properties"][key] = value
    path = tmp_path / "map.geojson"
    path.write_text(json.dumps(content))
    with pytest.raises(MapFileError, match=says):
        read_map(path)


def test_a_symbol_of_many_vertices_keeps_its_columns_in_csv(tmp_path):
    angle = np.arange(7) * 2 * np.pi / 7
    outline = np.column_stack([np.cos(angle), np.sin(angle)])
    arrow = Symbol("arrow", outline, 3, covariance_m2=1e-4 * np.eye(14))
    write_map(replace(street(), symbols=(arrow,)), tmp_path, "map", ["csv"])
    with (tmp_path / "map.csv").open(newline="", encoding="utf-8-sig") as text:
        rows = [row for row in csv.DictReader(text) if row["class"] == "arrow"]
    assert len(rows) == 7
    assert all(None not in row and row["paint_left"] == "" for row in rows)
    assert float(rows[6]["sigma_y_m"]) == pytest.approx(0.01)
