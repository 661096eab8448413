"""Readings of painted words are in every format."""

import csv
import json
import sqlite3
import xml.etree.ElementTree as ET

import ezdxf
import numpy as np
import pytest

from v2hdm.errors import MapFileError
from v2hdm.io.maps.formats import FORMATS
from v2hdm.io.maps.reading import read_map
from v2hdm.records import GeodeticOrigin, HDMap, Reading, Symbol

CORNERS = np.array([[2.0, 1.0], [2.0, 4.0], [1.0, 4.0], [1.0, 1.0]])  # read by who drives to the west
SAID = Reading("EBH", 0.9, "483", 0.07)


def words() -> HDMap:
    symbols = (
        Symbol("text", CORNERS, 5, 0.02, id=7, reading=SAID),
        Symbol("text", CORNERS + 9, 4, 0.02, id=8, reading=Reading("12", 0.8)),
        Symbol("text", CORNERS + 19, 4, 0.02, id=9),
    )
    return HDMap((), (), GeodeticOrigin(53.5, 9.9, 10.0), symbols)


@pytest.mark.parametrize("ending", ["geojson", "gpkg"])
def test_what_words_say_survives_the_files_that_are_read_again(tmp_path, ending):
    path = tmp_path / f"map.{ending}"
    FORMATS[ending].write(words(), path)
    read = read_map(path)[0]
    assert [symbol.reading for symbol in read.symbols] == [symbol.reading for symbol in words().symbols]
    np.testing.assert_array_equal(read.symbols[0].outline_map, CORNERS)


def test_a_gis_finds_a_word_by_its_column(tmp_path):
    FORMATS["gpkg"].write(words(), tmp_path / "map.gpkg")
    with sqlite3.connect(tmp_path / "map.gpkg") as data:
        rows = data.execute("SELECT id, text_alternative FROM symbols WHERE text = 'EBH'").fetchall()
    assert rows == [(7, "483")]


def test_csv_lanelet2_and_opendrive_name_what_words_say(tmp_path):
    for name in ("csv", "lanelet2", "opendrive"):
        FORMATS[name].write(words(), tmp_path / name)
    rows = list(csv.DictReader((tmp_path / "csv").read_text().splitlines()))
    assert {row["id"]: row["text"] for row in rows} == {"7": "EBH", "8": "12", "9": ""}
    assert rows[0]["text_alternative_confidence"] == "0.07"
    ways = {way.get("id"): way for way in ET.parse(tmp_path / "lanelet2").getroot().iter("way")}
    tags = {tag.get("k"): tag.get("v") for tag in ways["7"].iter("tag")}
    assert (tags["text"], tags["text_confidence"], tags["text_alternative"]) == ("EBH", "0.9", "483")
    objects = {
        element.get("id"): element for element in ET.parse(tmp_path / "opendrive").getroot().iter("object")
    }
    assert [objects[key].get("name") for key in "789"] == ["EBH", "12", "text"]
    data = {datum.get("code"): datum.get("value") for datum in objects["7"].iter("userData")}
    assert (data["class"], data["text_alternative"]) == ("text", "483")


def test_a_drawing_shows_a_word_as_a_text_in_the_direction_in_which_it_is_read(tmp_path):
    FORMATS["dxf"].write(words(), tmp_path / "map.dxf")
    texts = ezdxf.readfile(tmp_path / "map.dxf").modelspace().query("TEXT")
    assert [text.dxf.text for text in texts] == ["EBH", "12"]
    assert texts[0].dxf.rotation == pytest.approx(90.0)
    assert texts[0].dxf.height == pytest.approx(1.0)
    assert tuple(texts[0].dxf.insert)[:2] == pytest.approx((2.0, 1.0))


def test_a_probability_of_a_text_above_one_is_refused_in_one_line(tmp_path):
    path = tmp_path / "map.geojson"
    FORMATS["geojson"].write(words(), path)
    content = json.loads(path.read_text())
    content["features"][0]["properties"]["text_confidence"] = 1.5
    path.write_text(json.dumps(content))
    with pytest.raises(MapFileError, match=r"text_confidence is 1\.5; give a probability from 0 to 1"):
        read_map(path)
