"""OpenDRIVE, opened by pyxodr, a reader that is not ours."""

import itertools
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from pyproj import Proj

from tests.maps.gis import ORIGIN, street
from v2hdm.io.maps.formats import write_map
from v2hdm.records import HDMap
from v2hdm.topology.closed_lanes import closed_lanes

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
    lanes = closed_lanes([lane.points_map for lane in hd_map.lanes])
    assert len(roads) == len(lanes) >= 2
    for road, lane in zip(roads, lanes, strict=True):
        (number, order), (across, _) = lane.left, lane.right
        assert away_m(hd_map.lanes[number].points_map[order], road.reference_line).max() < 0.06
        (section,) = road.lane_sections
        (driven,) = [lane for lane in section.lanes if lane.id == -1]
        assert driven.type == "driving"
        fine = np.concatenate(
            [np.linspace(a, b, 20) for a, b in itertools.pairwise(hd_map.lanes[across].points_map)]
        )
        assert away_m(driven.boundary_line, fine).max() < 0.06


def place_at(piece, way_m):
    """The place (2,) and the unit direction (2,) of a planView's geometry so far along it."""
    start = np.array([float(piece.get("x")), float(piece.get("y"))])
    cosine, sine = np.cos(float(piece.get("hdg"))), np.sin(float(piece.get("hdg")))
    axes = np.array([[cosine, sine], [-sine, cosine]])
    cubic = piece.find("paramPoly3")
    if cubic is None:
        return start + way_m * axes[0], axes[0]
    assert cubic.get("pRange") == "normalized"
    u, v = (np.polynomial.Polynomial([float(cubic.get(f"{c}{axis}")) for c in "abcd"]) for axis in "UV")
    fine = np.linspace(0.0, 1.0, 2001)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(u(fine)), np.diff(v(fine))))])
    p = np.interp(way_m, along, fine)
    ahead = np.array([u.deriv()(p), v.deriv()(p)]) @ axes
    return start + np.array([u(p), v(p)]) @ axes, ahead / np.linalg.norm(ahead)


def corners_of(root):
    """Corners (4, 3) of objects by their ids, from the standard's definitions alone."""
    corners_of_object = {}
    for road in root.findall("road"):
        pieces = road.findall("planView/geometry")
        for mark in road.findall("objects/object"):
            s, t = float(mark.get("s")), float(mark.get("t"))
            piece = max(
                (piece for piece in pieces if float(piece.get("s")) <= s + 1e-6),
                key=lambda p: float(p.get("s")),
            )
            place, ahead = place_at(piece, s - float(piece.get("s")))
            axes = np.array([ahead, [-ahead[1], ahead[0]]])
            corners = mark.findall("outlines/outline/cornerLocal")
            uv = np.array([[float(corner.get("u")), float(corner.get("v"))] for corner in corners])
            corners_of_object[int(mark.get("id"))] = place + t * axes[1] + uv @ axes
    return corners_of_object


@pytest.mark.parametrize("lanes", [3, 1, 0])
def test_every_marking_is_an_object_with_its_corners_also_without_lanes(tmp_path, lanes):
    hd_map = replace(street(), lanes=street().lanes[:lanes])
    path = written(tmp_path, hd_map)
    assert loaded(path)
    root = ET.parse(path).getroot()
    accuracies = {
        element.get("id"): element.find("userData[@code='accuracy']").get("value")
        for element in root.iter("object")
    }
    assert accuracies == {
        str(number): marking.accuracy for number, marking in enumerate(hd_map.markings, start=1)
    }
    corners_of_id = corners_of(root)
    assert len(corners_of_id) == len(hd_map.markings)
    for number, marking in enumerate(hd_map.markings, start=1):
        gaps = np.linalg.norm(corners_of_id[number][:, None] - marking.corners_map, axis=2)
        assert gaps.min(axis=0).max() < 1e-4


def test_the_projection_puts_the_origin_where_it_is(tmp_path):
    root = ET.parse(written(tmp_path, street())).getroot()
    at = Proj(root.findtext("header/geoReference"))(0.0, 0.0, inverse=True)
    np.testing.assert_allclose(at, (ORIGIN.longitude_deg, ORIGIN.latitude_deg), atol=1e-9)
    assert ET.parse(written(tmp_path, street(None))).find("header/geoReference") is None


def test_an_empty_map_is_a_file_that_opens(tmp_path):
    assert len(loaded(written(tmp_path, HDMap((), (), ORIGIN)))) == 1
