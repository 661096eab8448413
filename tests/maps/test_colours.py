"""The colours of a map's classes, which QGIS, CAD and KML have as the report's map has them."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import ezdxf
import numpy as np

from tests.maps.gis import ORIGIN, street
from v2hdm.io.maps.colours import LINE, SERIES, channels, colours_of
from v2hdm.io.maps.features import features_of
from v2hdm.io.maps.formats import write_map
from v2hdm.records import HDMap

PAGE = Path("v2hdm/report/page/templates")


def test_the_colours_are_those_of_the_report_s_light_theme():
    names = re.search(r"const SERIES = \[(.*?)\]", (PAGE / "map.js").read_text()).group(1)
    style = (PAGE / "page.css").read_text()
    colours = [
        re.search(rf"--{name}: (#[0-9a-f]{{6}})", style).group(1) for name in re.findall(r"\w+", names)
    ]
    assert tuple(colours) == SERIES
    assert re.search(r"--sky: (#[0-9a-f]{6})", style).group(1) == LINE


def test_qgis_has_the_classes_in_these_colours_and_dashed_lines_dashed(tmp_path):
    hd_map = street()
    write_map(hd_map, tmp_path, "map", ["qgis"])
    root = ET.parse(tmp_path / "map.qgs").getroot()
    expected = {kind: channels(colour) for kind, colour in colours_of(features_of(hd_map)).items()}
    styles = {}
    for layer in root.findall("projectlayers/maplayer"):
        renderer = layer.find("renderer-v2")
        for category in [] if renderer is None else renderer.findall("categories/category"):
            (symbol,) = [
                candidate
                for candidate in renderer.iter("symbol")
                if candidate.get("name") == category.get("symbol")
            ]
            options = {option.get("name"): option.get("value") for option in symbol.iter("Option")}
            styles[layer.findtext("layername"), category.get("value")] = options
    for kind, colour in expected.items():
        stated = styles["markings", kind]["color"].split(",")[:3]
        assert tuple(map(int, stated)) == colour
    assert styles["lanes", "lane_dash"]["line_style"] == "dash"
    assert styles["lanes", "lane_line"]["line_style"] == "solid"
    assert styles["lanes", "lane_line"]["line_color"].split(",")[:3] == [str(part) for part in channels(LINE)]


def test_a_drawing_opens_on_the_map_with_a_layer_per_class_and_dashes(tmp_path):
    hd_map = street()
    (path,) = write_map(hd_map, tmp_path, "map", ["dxf"])
    document = ezdxf.readfile(path)
    features = features_of(hd_map)
    points = np.concatenate([feature.xyz_map for feature in features])
    np.testing.assert_allclose(document.header["$EXTMIN"], points.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(document.header["$EXTMAX"], points.max(axis=0), atol=1e-6)
    (view,) = document.viewports.get("*Active")
    middle = (points.min(axis=0) + points.max(axis=0))[:2] / 2
    np.testing.assert_allclose(list(view.dxf.center)[:2], middle, atol=1e-6)
    assert view.dxf.height > np.ptp(points[:, 1])
    colours = colours_of(features)
    assert {kind: tuple(document.layers.get(kind).rgb) for kind in colours if kind != "lane_dash"} == {
        kind: channels(colour) for kind, colour in colours.items() if kind != "lane_dash"
    }
    dashed = [line for line in document.modelspace() if line.dxf.linetype == "DASHED"]
    assert len(dashed) == 1
    assert "DASHED" in document.linetypes


def test_an_empty_drawing_opens_as_well(tmp_path):
    (path,) = write_map(HDMap((), (), ORIGIN), tmp_path, "map", ["dxf"])
    assert not list(ezdxf.readfile(path).modelspace())
