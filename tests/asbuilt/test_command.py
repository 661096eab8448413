"""``v2hdm compare``: files that can be opened, an exit code that a script can use, bad input in one line."""

import csv
import json

import cv2
import pytest

from tests.asbuilt.site import layout, mapped, moved
from v2hdm.cli.main import main
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.store import names


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A map, its design, and one whose row 2 is painted 9 cm aside."""
    design = layout()
    aside = [
        moved(shape, 0, 0.09) if shape.name.startswith("lane_dash 2/") else shape for shape in design.shapes
    ]
    write_geojson(mapped(design.shapes, 1), tmp_path / "map.geojson")
    write_geojson(mapped(aside, 2), tmp_path / "aside.geojson")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_paint_that_conforms_ends_in_0_and_files_that_can_be_opened(site, capsys):
    assert main(["compare", "map.geojson", "map.geojson"]) == 0
    said = capsys.readouterr().out
    assert "the design as a whole lies in place" in said
    assert "results in outputs/map-compared" in said
    folder = site / "outputs/map-compared"
    assert json.loads((folder / names.AS_BUILT).read_text())["counts"]["right"] > 100
    rows = list(csv.DictReader((folder / names.AS_BUILT_TABLE).read_text().splitlines()))
    assert {row["quantity"] for row in rows} == {"along", "across", "turn", "length", "width"}
    layer = json.loads((folder / names.AS_BUILT_LAYER).read_text())
    assert len(layer["features"]) == 120
    assert cv2.imread(str(folder / names.AS_BUILT_PICTURE)) is not None


def test_paint_that_is_off_ends_in_3_and_is_listed(site, capsys):
    assert main(["compare", "aside.geojson", "map.geojson", "--output", "out"]) == 3
    said = capsys.readouterr().out
    assert "20 off" in said
    assert "  off: lane_dash" in said
    assert "and 8 more in comparison.csv" in said


def test_a_wider_tolerance_lets_it_pass(site):
    assert main(["compare", "aside.geojson", "map.geojson", "--tolerance", "0.3"]) == 0


def test_rules_take_the_place_of_a_design(site, capsys):
    (site / "rules.csv").write_text("class,quantity,low,high,unit\nlane_dash,length,3.5,,m\n")
    assert main(["compare", "map.geojson", "rules.csv"]) == 3
    assert "rules.csv: 60 off" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["map.geojson", "nothing.geojson"], "nothing.geojson"),
        (["map.geojson", "map.txt"], "is not a readable design"),
        (["map.geojson", "map.geojson", "--tolerance", "0"], "--tolerance 0: is not a tolerance in m"),
        (["map.geojson", "map.geojson", "--class", "a"], "--class a: give it as NAME=CLASS"),
        (["nothing", "map.geojson"], "nothing"),
    ],
)
def test_bad_input_is_one_line(words, says, site, capsys):
    before = sorted(site.iterdir())
    assert main(["compare", *words]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1
    assert sorted(site.iterdir()) == before
