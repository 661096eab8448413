"""Every export, read by a tool that is not ours, has the map's coordinates, heights, ids and covariances."""

import csv
import itertools
import sqlite3
import struct
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import ezdxf
import lanelet2
import numpy as np
import pyogrio.raw
import pytest
import yaml
from lanelet2.projection import LocalCartesianProjector, UtmProjector

from tests.maps.gis import ORIGIN, street
from v2hdm.errors import ConfigError
from v2hdm.io.maps.formats import FORMATS, check_formats, write_map
from v2hdm.io.maps.osm import grid_places
from v2hdm.io.maps.reading import read_map
from v2hdm.records import GeodeticOrigin, HDMap, Lane, Marking
from v2hdm.topology.closed_lanes import closed_lanes

TENTH_OF_A_MM = 1e-4
BOTH = pytest.mark.parametrize("origin", [ORIGIN, None])
VERDICT = {"status": "PASS", "findings": []}


def features(hd_map):
    """By the ids that a file gives them: counted from 1, markings first."""
    return dict(enumerate([*hd_map.markings, *hd_map.lanes], start=1))


def xyz(feature):
    points = feature.corners_map if isinstance(feature, Marking) else feature.points_map
    heights = np.zeros(len(points)) if feature.heights_m is None else feature.heights_m
    return np.column_stack([points, heights])


def ring(feature):
    """The points' order as written; of the map's markings the second one runs clockwise."""
    order = np.arange(len(xyz(feature)))
    if not isinstance(feature, Marking):
        return order
    x, y = feature.corners_map.T
    return order if x @ np.roll(y, -1) - y @ np.roll(x, -1) > 0 else order[::-1]


def in_ring_order(covariance, feature):
    order = np.stack([2 * ring(feature), 2 * ring(feature) + 1], axis=1).ravel()
    return covariance[np.ix_(order, order)]


def to_map(positions, origin):
    """Longitude, latitude and height in the map, by GeographicLib within lanelet2."""
    if origin is None:
        return positions
    projector = cartesian(origin)
    places = [projector.forward(lanelet2.core.GPSPoint(lat, lon, height)) for lon, lat, height in positions]
    return np.array([[place.x, place.y, place.z] for place in places])


def cartesian(origin):
    place = lanelet2.io.Origin(origin.latitude_deg, origin.longitude_deg, origin.altitude_m)
    return LocalCartesianProjector(place)


def exported(folder, file_format, hd_map, projector=None):
    *_, path = write_map(hd_map, folder, "map", [file_format], VERDICT, projector)
    return path


@BOTH
def test_geojson_is_read_by_gdal(tmp_path, origin):
    hd_map = street(origin)
    meta, fids, geometry, columns = pyogrio.raw.read(exported(tmp_path, "geojson", hd_map), return_fids=True)
    assert fids.tolist() == list(range(1, 9))
    table = dict(zip(meta["fields"], columns, strict=True))
    assert table["id"].tolist() == fids.tolist()
    for number, feature, kind, wkb in zip(
        fids, features(hd_map).values(), table["class"], geometry, strict=True
    ):
        assert kind == feature.kind
        np.testing.assert_allclose(
            to_map(from_wkb(wkb), origin),
            xyz(feature)[ring(feature)],
            atol=TENTH_OF_A_MM,
            err_msg=str(number),
        )


def from_wkb(wkb):
    """The points (N, 3) of a little-endian line or polygon of one ring with heights."""
    kind, count = struct.unpack_from("<II", wkb, 1)
    start = 9
    if kind in (1003, 0x80000003):
        assert count == 1
        (count,) = struct.unpack_from("<I", wkb, start)
        start += 4
    positions = np.frombuffer(wkb, "<f8", 3 * count, start).reshape(count, 3)
    return positions[:-1] if kind in (1003, 0x80000003) else positions


@BOTH
@pytest.mark.parametrize("with_heights", [True, False])
def test_csv_has_every_point_with_its_covariance(tmp_path, origin, with_heights):
    hd_map = street(origin, with_heights)
    with exported(tmp_path, "csv", hd_map).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    grouped = {int(k): list(group) for k, group in itertools.groupby(rows, key=lambda row: row["id"])}
    assert list(grouped) == list(range(1, 9))
    for number, feature in features(hd_map).items():
        mine = grouped[number]
        assert [row["point"] for row in mine] == [str(k + 1) for k in range(len(mine))]
        assert {row["class"] for row in mine} == {feature.kind}
        assert {row["sightings"] for row in mine} == {str(feature.sightings)}
        assert {row["accuracy"] for row in mine} == {getattr(feature, "accuracy", "")}
        got = np.array([[float(row["x_map_m"]), float(row["y_map_m"])] for row in mine])
        np.testing.assert_array_equal(got, xyz(feature)[:, :2])
        heights = [row["height_m"] for row in mine]
        assert heights == (
            [repr(h) for h in xyz(feature)[:, 2].tolist()] if with_heights else [""] * len(mine)
        )
        if origin is not None:
            keys = ("longitude_deg", "latitude_deg", "ellipsoidal_height_m")
            degrees = np.array([[float(row[key]) for key in keys] for row in mine])
            np.testing.assert_allclose(to_map(degrees, origin), xyz(feature), atol=TENTH_OF_A_MM)
        if isinstance(feature, Marking) and feature.covariance_m2 is not None:
            columns = [f"cov_{{}}_{other}{k}_m2" for k in range(1, 5) for other in "xy"]
            matrix = [
                [float(row[column.format(axis)]) for column in columns] for row in mine for axis in "xy"
            ]
            np.testing.assert_array_equal(matrix, feature.covariance_m2)
            sigmas = [[float(row["sigma_x_m"]), float(row["sigma_y_m"])] for row in mine]
            np.testing.assert_allclose(np.ravel(sigmas), np.sqrt(np.diag(feature.covariance_m2)))


@BOTH
def test_a_geopackage_is_read_by_sqlite_alone(tmp_path, origin):
    hd_map = street(origin)
    data = sqlite3.connect(exported(tmp_path, "gpkg", hd_map))
    rows = data.execute("SELECT id, class, geom, covariance_m2, accuracy FROM markings").fetchall()
    rows += data.execute("SELECT id, class, geom, NULL, NULL FROM lanes").fetchall()
    assert [row[0] for row in rows] == list(range(1, 9))
    envelope_bytes = {0: 0, 1: 32, 2: 48, 3: 48, 4: 64}
    for number, kind, blob, covariance, accuracy in rows:
        feature = features(hd_map)[number]
        assert (kind, accuracy) == (feature.kind, getattr(feature, "accuracy", None))
        header = 8 + envelope_bytes[blob[3] >> 1 & 7]
        got = to_map(from_wkb(blob[header:]), origin)
        np.testing.assert_allclose(got, xyz(feature)[ring(feature)], atol=TENTH_OF_A_MM)
        if isinstance(feature, Marking):
            np.testing.assert_array_equal(yaml.safe_load(covariance), feature.covariance_m2)
    definition, organisation = data.execute(
        "SELECT definition, organization FROM gpkg_spatial_ref_sys JOIN gpkg_contents USING (srs_id) "
        "WHERE table_name = 'markings'"
    ).fetchone()
    if origin is None:
        assert definition.startswith("LOCAL_CS[")
        assert 'UNIT["metre",1' in definition
    else:
        assert organisation == "EPSG"
        assert "WGS" in definition
    data.close()


def test_a_geopackage_brings_a_style_of_every_class_as_qgis_looks_for_it(tmp_path):
    data = sqlite3.connect(exported(tmp_path, "gpkg", street()))
    rows = data.execute(
        "SELECT f_table_name, f_geometry_column, styleQML, useAsDefault FROM layer_styles"
    ).fetchall()
    classes = {
        layer: {row[0] for row in data.execute(f"SELECT DISTINCT class FROM {layer}")}
        for layer in ("markings", "lanes", "symbols")
    }
    data.close()
    assert [row[0] for row in rows] == ["markings", "lanes", "symbols"]
    for layer, column, style, default in rows:
        assert (column, default) == ("geom", 1)
        root = ET.fromstring(style)
        categories = root.findall("renderer-v2/categories/category")
        assert {category.get("value") for category in categories} == classes[layer] | {""}
        symbols = {symbol.get("name") for symbol in root.findall("renderer-v2/symbols/symbol")}
        assert {category.get("symbol") for category in categories} == symbols


def test_a_dxf_is_read_by_gdal_and_holds_what_cad_does_not_know(tmp_path):
    hd_map = street()
    path = exported(tmp_path, "dxf", hd_map)
    meta, _, geometry, columns = pyogrio.raw.read(path)
    layers = dict(zip(meta["fields"], columns, strict=True))["Layer"]
    lines = list(ezdxf.readfile(path).modelspace())
    assert len(lines) == len(geometry) == 8
    for feature, layer, wkb, line in zip(features(hd_map).values(), layers, geometry, lines, strict=True):
        assert layer == feature.kind
        closed = isinstance(feature, Marking)
        assert line.is_closed is closed
        got = from_wkb(wkb)
        count = len(xyz(feature))
        np.testing.assert_allclose(got[:count], xyz(feature)[ring(feature)], atol=TENTH_OF_A_MM)
        values = [value for _, value in line.get_xdata("V2HDM")]
        assert features(hd_map)[values[values.index("id") + 1]] is feature
        assert values[values.index("sightings") + 1] == feature.sightings
        if isinstance(feature, Marking) and feature.covariance_m2 is not None:
            assert values[values.index("accuracy") + 1] == feature.accuracy
            matrix = np.reshape(values[values.index("covariance_m2") + 1 :], (8, 8))
            np.testing.assert_array_equal(matrix, in_ring_order(feature.covariance_m2, feature))


def load(path, origin):
    return lanelet2.io.load(str(path), cartesian(origin or GeodeticOrigin(0.0, 0.0, 0.0)))


def points_of(line):
    return np.array([[point.x, point.y, point.z] for point in line])  # type: ignore[attr-defined]


def routing(loaded):
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    return rules, lanelet2.routing.RoutingGraph(loaded, rules)


@BOTH
def test_every_marking_and_line_is_found_through_lanelet2(tmp_path, origin):
    hd_map = street(origin)
    loaded = load(exported(tmp_path, "lanelet2", hd_map), origin)
    for number, feature in features(hd_map).items():
        if not isinstance(feature, Marking):
            line = loaded.lineStringLayer[number]
            np.testing.assert_allclose(points_of(line)[:, :2], xyz(feature)[:, :2], atol=TENTH_OF_A_MM)
            assert line.attributes["type"] == "line_thin"
            assert line.attributes["subtype"] == ("dashed" if feature.kind == "lane_dash" else "solid")
            assert line.attributes["lane_change"] == ("yes" if feature.kind == "lane_dash" else "no")
            continue
        polygon = loaded.polygonLayer[number]
        corners = points_of(polygon)
        assert corners.shape == (4, 3)
        np.testing.assert_allclose(corners[:, :2], xyz(feature)[ring(feature), :2], atol=TENTH_OF_A_MM)
        (x, y), (ahead_x, ahead_y) = corners[:, :2].T, np.roll(corners[:, :2], -1, axis=0).T
        assert x @ ahead_y - y @ ahead_x > 0
        assert polygon.attributes["type"] == "pose_marker"
        assert polygon.attributes["subtype"] == feature.kind
        assert polygon.attributes["marker_id"] == str(number)
        assert feature.covariance_m2 is not None
        covariance = yaml.safe_load(polygon.attributes["covariance_m2"])
        np.testing.assert_array_equal(covariance, in_ring_order(feature.covariance_m2, feature))
        assert polygon.attributes["sightings"] == str(feature.sightings)
        assert polygon.attributes["accuracy"] == feature.accuracy
        heights = [float(point.attributes["local_x"]) for point in polygon]
        np.testing.assert_array_equal(heights, xyz(feature)[ring(feature), 0])


@BOTH
def test_heights_are_ellipsoidal_or_local_as_the_projector_says(tmp_path, origin):
    hd_map = street(origin)
    path = exported(tmp_path, "lanelet2", hd_map)
    z = np.concatenate([points_of(polygon)[:, 2] for polygon in load(path, origin).polygonLayer])
    expected = np.concatenate([xyz(marking)[ring(marking), 2] for marking in hd_map.markings])
    if origin is None:  # the nodes lie at height 0 of the map, and lanelet2 puts 0 at the ellipsoid
        z = np.array([float(node.find("tag[@k='ele']").get("v")) for node in nodes(path)])
        expected = np.array([height for height in z if 0.9 < height < 3.0])
    np.testing.assert_allclose(np.sort(z), np.sort(expected), atol=TENTH_OF_A_MM)
    info = yaml.safe_load(path.with_name("map_projector_info.yaml").read_text())
    assert info["projector_type"] == ("Local" if origin is None else "LocalCartesian")
    if origin is not None:
        assert info["vertical_datum"] == "WGS84"
        assert info["map_origin"]["latitude"] == origin.latitude_deg
        assert info["map_origin"]["longitude"] == origin.longitude_deg


def nodes(path):
    return ET.parse(path).getroot().findall("node")


def test_a_stop_line_has_the_regulatory_element_that_the_map_validator_asks_for(tmp_path):
    hd_map = street()
    loaded = load(exported(tmp_path, "lanelet2", hd_map), ORIGIN)
    (rule,) = loaded.regulatoryElementLayer
    assert rule.attributes["subtype"] == "traffic_sign"
    (line,), (sign,) = rule.parameters["ref_line"], rule.parameters["refers"]
    assert line.attributes["type"] == "stop_line"
    assert (sign.attributes["type"], sign.attributes["subtype"]) == ("traffic_sign", "stop_sign")
    corners = hd_map.markings[2].corners_map
    # One drives east: to stop is at the western edge of the paint.
    west = corners[np.argsort(corners[:, 0])[:2]]
    for end in points_of(line)[:, :2]:
        assert np.linalg.norm(west - end, axis=1).min() < TENTH_OF_A_MM
    (lanelet,) = [candidate for candidate in loaded.laneletLayer if candidate.regulatoryElements]
    assert [element.id for element in lanelet.regulatoryElements] == [rule.id]
    assert lanelet.leftBound.attributes["subtype"] == "dashed"
    assert lanelet.rightBound.attributes["subtype"] == "solid"


def test_lanes_between_two_lines_make_a_routing_graph_with_a_lane_change(tmp_path):
    loaded = load(exported(tmp_path, "lanelet2", street()), ORIGIN)
    assert len(loaded.laneletLayer) == 2
    rules, graph = routing(loaded)
    assert not list(graph.checkValidity())
    left, right = sorted(loaded.laneletLayer, key=lambda lanelet: lanelet.leftBound.id)
    assert (left.leftBound.id, left.rightBound.id) == (6, 7)
    assert (right.leftBound.id, right.rightBound.id) == (7, 8)
    assert graph.right(left).id == right.id
    assert graph.left(right).id == left.id
    for lanelet in (left, right):
        assert rules.canPass(lanelet)
        assert rules.isOneWay(lanelet)
        assert points_of(lanelet.centerline)[-1, 0] > points_of(lanelet.centerline)[0, 0] + 20


def test_lanelet2_ids_are_positive_unique_and_stay_when_another_feature_goes(tmp_path):
    hd_map = street()
    numbered = HDMap(
        tuple(replace(marking, id=k + 1) for k, marking in enumerate(hd_map.markings)),
        tuple(replace(lane, id=k + 6) for k, lane in enumerate(hd_map.lanes)),
        hd_map.origin,
    )
    before = identified(exported(tmp_path / "before", "lanelet2", numbered))
    after = identified(
        exported(tmp_path / "after", "lanelet2", replace(numbered, markings=numbered.markings[1:]))
    )
    assert min(before) > 0
    assert len(before) - len(after) == 5  # a polygon and its nodes
    assert all(before[key] == text for key, text in after.items())


def identified(path):
    """Every primitive of an OSM file by its id."""
    root = ET.parse(path).getroot()
    assert root[0].tag == "MetaInfo"
    assert set(root[0].attrib) == {"format_version", "map_version"}
    elements = [element for element in root if element.tag in ("node", "way", "relation")]
    by_id = {int(element.get("id", "0")): ET.tostring(element) for element in elements}
    assert len(by_id) == len(elements)
    return by_id


def test_mgrs_coordinates_are_those_of_utm_within_the_square(tmp_path):
    hd_map = street()
    path = exported(tmp_path, "lanelet2", hd_map, "MGRS")
    assert yaml.safe_load(path.with_name("map_projector_info.yaml").read_text()) == {
        "projector_type": "MGRS",
        "vertical_datum": "WGS84",
        "mgrs_grid": "51RVP",
    }
    place = lanelet2.io.Origin(ORIGIN.latitude_deg, ORIGIN.longitude_deg, 0.0)
    utm = UtmProjector(place, False, False)
    first = None
    for node in nodes(path)[:50]:
        gps = lanelet2.core.GPSPoint(float(node.get("lat", 0)), float(node.get("lon", 0)), 0.0)
        projected = utm.forward(gps)
        tags = {tag.get("k"): tag.get("v", "") for tag in node}
        local = np.array([float(tags["local_x"]), float(tags["local_y"])])
        first = local - [projected.x, projected.y] if first is None else first
        np.testing.assert_allclose(local - first, [projected.x, projected.y], atol=TENTH_OF_A_MM)
        assert tags["mgrs_code"] == f"51RVP{int(local[0]):05d}{int(local[1]):05d}"


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "square", "metres"),
    [
        (21.409796, -157.916051, "4QFJ", (12348, 67890)),  # Honolulu
        (35.6762, 139.6503, "54SUE", (77856, 48874)),  # Autoware's example
        (48.8582, 2.2945, "31UDQ", (48252, 11933)),  # Paris
        (-33.8568, 151.2153, "56HLH", (34901, 52289)),  # Sydney, south of the equator
        (60.39, 5.32, "32VKN", (97230, 510)),  # Bergen, in Norway's wider zone
        (78.2, 15.6, "33XWG", (13697, 80760)),  # Svalbard
    ],
)
def test_places_of_the_world_are_in_their_grid_squares(latitude_deg, longitude_deg, square, metres):
    squares, local = grid_places(np.array([longitude_deg]), np.array([latitude_deg]))
    assert squares == square
    np.testing.assert_allclose(local, [metres], atol=1.0)


def test_an_mgrs_projector_across_grid_squares_is_refused_in_one_line(tmp_path):
    # The equator is a border between rows.
    hd_map = street(GeodeticOrigin(0.0, 9.5, 0.0))
    with pytest.raises(ConfigError, match="spans the MGRS squares 32MNE, 32NNF, and") as caught:
        exported(tmp_path, "lanelet2", hd_map, "MGRS")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.rglob("*.osm"))


@pytest.mark.parametrize(
    ("origin", "projector", "message"),
    [
        (None, "MGRS", "the map has no origin"),
        (None, "LocalCartesian", "the map has no origin"),
        (ORIGIN, "mgrs", "unknown projector 'mgrs'"),
        (GeodeticOrigin(85.0, 0.0, 0.0), "MGRS", "MGRS ends at"),
    ],
)
def test_a_projector_that_does_not_suit_the_map_is_refused(tmp_path, origin, projector, message):
    with pytest.raises(ConfigError, match=message):
        exported(tmp_path, "lanelet2", street(origin), projector)


def test_lines_bound_a_lane_where_a_truck_but_not_two_fit_between_them():
    x = np.arange(0.0, 40.0, 0.5)

    def line(y, order=1):
        return np.column_stack([x, np.full(len(x), y)])[::order]

    assert not closed_lanes([line(0.0), line(2.0)])
    assert not closed_lanes([line(0.0), line(5.5)])
    assert not closed_lanes([line(0.0), line(7.0), line(0.3)])
    (lane,) = closed_lanes([line(0.0), line(3.5, -1)])
    assert (lane.left[0], lane.right[0]) == (1, 0)
    assert lane.left[1][0] == len(x) - 1
    # A line between two others parts their lanes; a crossing stripe bounds none.
    across = np.column_stack([np.full(9, 20.0), np.linspace(0.5, 3.0, 9)])
    lanes = closed_lanes([line(0.0), line(3.5), line(7.0)])
    assert [(lane.left[0], lane.right[0]) for lane in lanes] == [(1, 0), (2, 1)]
    assert len(closed_lanes([line(0.0), line(3.5), across])) == 1


def test_a_map_without_an_origin_says_that_a_gis_takes_it_for_degrees(tmp_path, caplog):
    write_map(street(None), tmp_path, "map", ["geojson", "gpkg"])
    assert [record.levelname for record in caplog.records if record.name.startswith("v2hdm")] == ["WARNING"]
    assert "map.geojson: the drive has no origin" in caplog.text
    caplog.clear()
    write_map(street(), tmp_path, "map", ["geojson"])
    assert "origin" not in caplog.text


@pytest.mark.parametrize(("file_format", "package"), [("gpkg", "pyogrio"), ("dxf", "ezdxf")])
def test_a_package_that_is_not_installed_is_one_line_that_names_the_extra(file_format, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=rf"{file_format} needs {package}: .*v2hdm\[gis\]"):
        check_formats([file_format], "export")


def test_classes_of_ones_own_with_signs_in_their_names_are_written(tmp_path):
    marking = replace(street().markings[0], kind='pad <&"/ 7>', covariance_m2=None, relative_sigma_m=None)
    names: dict[str, Callable[[Path], str]] = {
        "dxf": lambda path: next(iter(ezdxf.readfile(path).modelspace())).dxf.layer,
        "lanelet2": lambda path: load(path, ORIGIN).polygonLayer[1].attributes["subtype"],
    }
    for file_format, name in names.items():
        path = exported(tmp_path, file_format, HDMap((marking,), (), ORIGIN))
        assert name(path).startswith("pad ")


def test_a_lane_beside_which_another_begins_is_cut_there_so_that_one_can_change(tmp_path):
    def line(kind, y, begin):
        x = np.arange(begin, 60.0, 0.37)
        return Lane(kind, np.column_stack([x, np.full(len(x), y)]), 3)

    lines = (line("lane_line", 0.0, 0.0), line("lane_dash", 3.5, 0.2), line("lane_line", 7.0, 21.3))
    loaded = load(exported(tmp_path, "lanelet2", HDMap((), lines, ORIGIN)), ORIGIN)
    before, beside, begins = sorted(
        loaded.laneletLayer,
        key=lambda lanelet: points_of(lanelet.centerline)[:, :2].mean(axis=0) @ [1.0, 10.0],
    )
    _, graph = routing(loaded)
    assert [lanelet.id for lanelet in graph.following(before)] == [beside.id]
    assert graph.left(beside).id == begins.id
    assert graph.right(begins).id == beside.id
    route = graph.getRoute(before, begins)
    assert [lanelet.id for lanelet in route.shortestPath()] == [before.id, beside.id, begins.id]
    assert before.leftBound[-1].id == beside.leftBound[0].id


def _destinations(tmp_path, lines):
    """Where the lanes end that a route leads to from the first lane, for lines through points (x, y)."""
    lanes = []
    for corners in lines:
        x_ends, y_ends = np.array(corners, dtype=float).T
        x = np.linspace(*x_ends[[0, -1]], int(abs(np.ptp(x_ends)) * 2) + 1)
        y = np.interp(x, x_ends, y_ends) if x[-1] > x[0] else np.interp(x, x_ends[::-1], y_ends[::-1])
        lanes.append(Lane("lane_line", np.column_stack([x, y]), 3))
    loaded = load(exported(tmp_path, "lanelet2", HDMap((), tuple(lanes), ORIGIN)), ORIGIN)
    _, graph = routing(loaded)
    firsts = [lanelet for lanelet in loaded.laneletLayer if not graph.previous(lanelet)]
    routes = {}
    for first in firsts:
        begin = points_of(first.centerline)[0, :2].round().astype(int)
        ends = [
            last
            for last in loaded.laneletLayer
            if not graph.following(last) and graph.getRoute(first, last) is not None
        ]
        reached = {tuple(points_of(last.centerline)[-1, :2].round().astype(int).tolist()) for last in ends}
        routes[tuple(begin.tolist())] = reached
    return routes


WIDENING = [[(0, 8), (90, 8)], [(0, 4), (40, 0), (90, 0)], [(30, 4), (90, 4)]]
"""A lane of 4 m whose right line bends away, until another begins in the middle between both."""


def test_a_lane_that_splits_leads_to_both_of_its_branches(tmp_path):
    assert _destinations(tmp_path, WIDENING) == {(0, 6): {(90, 2), (90, 6)}}


def test_lanes_that_merge_lead_to_the_same_one(tmp_path):
    merging = [[(90 - x, y) for x, y in reversed(line)] for line in WIDENING]
    assert _destinations(tmp_path, merging) == {(0, 2): {(90, 6)}, (0, 6): {(90, 6)}}


def test_a_lane_goes_on_where_one_of_its_lines_is_interrupted(tmp_path):
    lines = [[(0, 3.5), (40, 3.5)], [(55, 3.5), (90, 3.5)], [(0, 0), (90, 0)]]
    assert _destinations(tmp_path, lines) == {(0, 2): {(90, 2)}}


def test_no_way_is_made_up_where_both_lines_of_a_lane_end(tmp_path):
    lines = [[(begin, y), (begin + 30, y)] for y in (0, 3.5) for begin in (0, 45)]
    assert _destinations(tmp_path, lines) == {(0, 2): {(30, 2)}, (45, 2): {(75, 2)}}


@pytest.mark.parametrize("file_format", list(FORMATS))
def test_an_empty_map_can_be_written_and_read(tmp_path, file_format):
    path = exported(tmp_path, file_format, HDMap((), (), ORIGIN))
    assert path.is_file()
    if file_format in ("geojson", "gpkg"):
        assert read_map(path)[0] == HDMap((), (), ORIGIN)
