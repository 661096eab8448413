"""Texts in a map that a program which opens its exports must not act on, and how large exports grow."""

import csv
import io
import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from tests.drive.example import make_map
from v2hdm.errors import MapFileError, V2hdmError
from v2hdm.io.maps.formats import write_csv
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.landxml import write_landxml
from v2hdm.io.maps.opendrive import write_opendrive
from v2hdm.io.maps.reading import read_geojson
from v2hdm.records import GeodeticOrigin, HDMap, Lane
from v2hdm.store.files import csv_text, read_csv, xml_text
from v2hdm.surface import strips

FORMULAS = ["=1+1", "@SUM(A1)", "-2+3", "+1+1", "\t=1", "'=1+1"]


@pytest.mark.parametrize("kind", FORMULAS)
def test_a_cell_that_a_spreadsheet_would_compute_is_a_text_and_is_read_back(kind, tmp_path):
    text = csv_text([["class", "m"], [kind, "-2.5"]])
    _, (cell, number) = csv.reader(io.StringIO(text))
    assert cell == f"'{kind}"
    assert number == "-2.5"
    (tmp_path / "a.csv").write_text(text, newline="")
    assert read_csv(tmp_path / "a.csv", MapFileError)[1][0] == kind


def test_classes_of_a_map_are_no_formulas_in_its_csv(tmp_path):
    hd_map = make_map()
    marking = replace(hd_map.markings[0], kind="=1+1")
    write_csv(replace(hd_map, markings=(marking,)), tmp_path / "map.csv")
    kinds = {row["class"] for row in csv.DictReader(io.StringIO((tmp_path / "map.csv").read_text()))}
    assert "'=1+1" in kinds
    assert "=1+1" not in kinds


def test_xml_holds_no_letter_that_xml_cannot(tmp_path):
    origin = GeodeticOrigin(48.1, 11.6, 500.0, "ET\x1bRS\x00\ufffe89")
    write_landxml(replace(make_map(), origin=origin), tmp_path / "map.xml")
    system = next(
        ET.parse(tmp_path / "map.xml").iter("{http://www.landxml.org/schema/LandXML-1.2}CoordinateSystem")
    )
    assert "ET\ufffdRS\ufffd\ufffd89" in system.get("desc")
    assert "\x1b" not in xml_text(ET.Element("a", {"b": "\x1b[2J"}))


def test_a_datum_that_moves_the_cursor_is_refused_by_its_place(tmp_path):
    write_geojson(replace(make_map(), origin=GeodeticOrigin(48.1, 11.6, 500.0)), tmp_path / "map.geojson")
    text = (tmp_path / "map.geojson").read_text().replace('"WGS84"', '"\\u001b[2J"', 1)
    (tmp_path / "map.geojson").write_text(text)
    with pytest.raises(MapFileError, match=r"origin, datum: '.\[2J' is not the name of a datum"):
        read_geojson(tmp_path / "map.geojson")


@pytest.mark.parametrize("crs", ["x" * 1_000_000, '{"a":' * 3000 + "1" + "}" * 3000], ids=["long", "deep"])
def test_a_system_of_a_megabyte_or_3000_levels_is_a_short_line(crs, tmp_path):
    write_geojson(replace(make_map(), origin=GeodeticOrigin(48.1, 11.6, 500.0)), tmp_path / "map.geojson")
    content = json.loads((tmp_path / "map.geojson").read_text())
    content["v2hdm"]["crs"] = crs
    (tmp_path / "map.geojson").write_text(json.dumps(content))
    with pytest.raises(MapFileError, match="unknown crs '") as refused:
        read_geojson(tmp_path / "map.geojson")
    assert len(str(refused.value)) < 500


def test_an_error_keeps_its_beginning_and_its_remedy_whatever_is_quoted():
    error = str(V2hdmError(f"a.yaml: crs is {'x' * 1_000_000}; give an EPSG code"))
    assert len(error) < 1300
    assert error.startswith("a.yaml: crs is xxx")
    assert error.endswith("; give an EPSG code")


def test_a_line_shorter_than_a_millimetre_carries_no_road(tmp_path):
    short = Lane("lane_line", np.array([[0.0, 0.0], [0.0004, 0.0]]), 3)
    hd_map = make_map()
    write_opendrive(replace(hd_map, lanes=(short,)), tmp_path / "map.xodr")
    root = ET.parse(tmp_path / "map.xodr").getroot()
    assert len(root.findall("road")) == 1
    assert len(list(root.iter("object"))) == len(hd_map.markings) + len(hd_map.symbols)
    write_opendrive(HDMap((), (short,)), tmp_path / "only.xodr")
    assert len(ET.parse(tmp_path / "only.xodr").getroot().findall("road")) == 1


def test_a_cloud_of_a_large_mosaic_has_fewer_points_farther_apart(tmp_path, monkeypatch, caplog):
    rasterio = pytest.importorskip("rasterio")
    place = rasterio.Affine(0.05, 0, 10.0, 0, -0.05, 20.0)
    shape = {"width": 200, "height": 100, "count": 3, "dtype": "uint8", "driver": "GTiff"}
    with rasterio.open(tmp_path / "mosaic.tif", "w", transform=place, crs="EPSG:32632", **shape) as data:
        data.write(np.full((3, 100, 200), 90, np.uint8))

    def cloud():
        strips.write_cloud(tmp_path / "mosaic.tif", tmp_path / "a.pcd", lambda places: np.zeros(len(places)))
        head, body = (tmp_path / "a.pcd").read_bytes().split(b"DATA binary\n")
        points = np.frombuffer(body, "<f4").reshape(-1, 4)
        assert f"POINTS {len(points)} " in head.decode()
        return points

    assert len(cloud()) == 20_000
    monkeypatch.setattr(strips, "_MOST_POINTS", 4_000)
    points = cloud()
    assert 1_000 < len(points) <= 4_000
    np.testing.assert_allclose(points[:, :2].mean(axis=0), [15.0, 17.5], atol=0.05)
    assert points[:, 3].tolist() == [90.0] * len(points)
    assert "so large that the points are 0.15 m apart" in caplog.text


def test_a_point_beyond_the_earth_is_refused_by_its_feature(tmp_path):
    write_geojson(make_map(), tmp_path / "map.geojson")
    content = json.loads((tmp_path / "map.geojson").read_text())
    corners = np.array(content["features"][0]["properties"]["corners_map"]) + 1e308
    content["features"][0]["properties"]["corners_map"] = corners.tolist()
    content["features"][0]["geometry"] = None
    (tmp_path / "map.geojson").write_text(json.dumps(content))
    with pytest.raises(MapFileError, match=r"feature 0: a point lies beyond the earth"):
        read_geojson(tmp_path / "map.geojson")
