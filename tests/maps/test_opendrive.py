"""OpenDRIVE, opened by pyxodr, a reader that is not ours."""

import itertools
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from pyproj import Proj

from tests.maps.gis import ORIGIN, street
from v2hdm.io.maps.closed_lanes import closed_lanes
from v2hdm.io.maps.formats import write_map
from v2hdm.records import HDMap

pytestmark = pytest.mark.filterwarnings("ignore")  # of the reader's own libraries


def written(folder, hd_map):
    (path,) = write_map(hd_map, folder, "map", ["opendrive"])
    return path


def loaded(path):
    from pyxodr.road_objects.network import RoadNetwork

    return RoadNetwork(str(path), resolution=0.05).get_roads()


def away_m(points, line):
    return np.linalg.norm(points[:, None, :2] - line[None, :, :2], axis=2).min(axis=1)


def test_a_reader_finds_roads_between_the_lines_with_both_lines_where_they_are(tmp_path):
    hd_map = street()
    roads = loaded(written(tmp_path, hd_map))
    lanes = closed_lanes([one.points_map for one in hd_map.lanes])
    assert len(roads) == len(lanes) >= 2
    for road, lane in zip(roads, lanes, strict=True):
        (number, order), (across, _) = lane.left, lane.right
        assert away_m(hd_map.lanes[number].points_map[order], road.reference_line).max() < 0.06
        (section,) = road.lane_sections
        (driven,) = [one for one in section.lanes if one.id == -1]
        assert driven.type == "driving"
        fine = np.concatenate(
            [np.linspace(a, b, 20) for a, b in itertools.pairwise(hd_map.lanes[across].points_map)]
        )
        assert away_m(driven.boundary_line, fine).max() < 0.06


def corners_of(root):
    """Corners (4, 3) of objects by their ids, from the standard's definitions alone."""
    found = {}
    for road in root.findall("road"):
        pieces = [{k: float(v) for k, v in one.attrib.items()} for one in road.findall("planView/geometry")]
        for one in road.findall("objects/object"):
            s, t = float(one.attrib["s"]), float(one.attrib["t"])
            piece = max((p for p in pieces if p["s"] <= s + 1e-6), key=lambda p: p["s"])
            cos, sin = np.cos(piece["hdg"]), np.sin(piece["hdg"])
            at = np.array([piece["x"], piece["y"]]) + (s - piece["s"]) * np.array([cos, sin])
            at += t * np.array([-sin, cos])
            corners = one.findall("outlines/outline/cornerLocal")
            uv = np.array([[float(c.attrib["u"]), float(c.attrib["v"])] for c in corners])
            found[int(one.attrib["id"])] = at + uv @ np.array([[cos, sin], [-sin, cos]])
    return found


@pytest.mark.parametrize("lanes", [3, 1, 0])
def test_every_marking_is_an_object_with_its_corners_also_without_lanes(tmp_path, lanes):
    hd_map = replace(street(), lanes=street().lanes[:lanes])
    path = written(tmp_path, hd_map)
    assert loaded(path)
    root = ET.parse(path).getroot()
    told = {one.get("id"): one.find("userData[@code='accuracy']").get("value") for one in root.iter("object")}
    assert told == {str(number): one.accuracy for number, one in enumerate(hd_map.markings, start=1)}
    found = corners_of(root)
    assert len(found) == len(hd_map.markings)
    for number, one in enumerate(hd_map.markings, start=1):
        gaps = np.linalg.norm(found[number][:, None] - one.corners_map, axis=2)
        assert gaps.min(axis=0).max() < 1e-4


def test_the_projection_puts_the_origin_where_it_is(tmp_path):
    root = ET.parse(written(tmp_path, street())).getroot()
    at = Proj(root.findtext("header/geoReference"))(0.0, 0.0, inverse=True)
    np.testing.assert_allclose(at, (ORIGIN.longitude_deg, ORIGIN.latitude_deg), atol=1e-9)
    assert ET.parse(written(tmp_path, street(None))).find("header/geoReference") is None


def test_an_empty_map_is_a_file_that_opens(tmp_path):
    assert len(loaded(written(tmp_path, HDMap((), (), ORIGIN)))) == 1
