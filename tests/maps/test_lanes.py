"""Lanes of a made site with a crossing and a T, in Lanelet2 and OpenDRIVE, by readers that are not ours."""

import shutil
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import lanelet2
import numpy as np
import pytest

from examples.lanes.route import route
from examples.lanes.site import EAST, NORTH, ORIGIN, SOUTH, WEST, height_m, made_site
from tests.topology.scenes import CONNECTIONS, ENDS, NEAR_M
from v2hdm.io.maps.formats import write_map
from v2hdm.io.maps.road_curves import Course, thinned
from v2hdm.records import HDMap
from v2hdm.store.files import load_json
from v2hdm.topology.answers import Answer

pytestmark = pytest.mark.filterwarnings("ignore")  # of the readers' own libraries


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The files of the site in both formats, by their suffixes."""
    site = made_site()
    folder = tmp_path_factory.mktemp("site")
    paths = write_map(site.hd_map, folder, "map", ["lanelet2", "opendrive"], trajectories=site.trajectories)
    return {path.suffix: path for path in paths}


def loaded(path):
    origin = lanelet2.io.Origin(ORIGIN.latitude_deg, ORIGIN.longitude_deg, ORIGIN.altitude_m)
    return lanelet2.io.load(str(path), lanelet2.projection.LocalCartesianProjector(origin))


def routing(lanelets):
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    return lanelet2.routing.RoutingGraph(lanelets, rules)


def end_of(lanelet, which):
    point = lanelet.centerline[which % len(lanelet.centerline)]
    return np.array([point.x, point.y])


def end_of_line(line):
    return np.mean([[point.x, point.y] for point in line], axis=0)


def lanelet_at(lanelets, place, which):
    """The lanelet outside crossings whose end (-1) or start (0) is there."""
    close_lanelets = [
        lanelet
        for lanelet in lanelets.laneletLayer
        if np.linalg.norm(end_of(lanelet, which) - place) < NEAR_M
        and "turn_direction" not in lanelet.attributes
    ]
    (lanelet,) = close_lanelets
    return lanelet


def test_lanelet2_finds_a_valid_graph_with_the_site_s_connections(files):
    lanelets = loaded(files[".osm"])
    graph = routing(lanelets)
    assert not list(graph.checkValidity())
    for before in {before for before, _ in CONNECTIONS}:
        lane = lanelet_at(lanelets, ENDS[before], -1)
        exits = {
            tuple(end_of(graph.following(way)[0], 0).round(1)) if graph.following(way) else None
            for way in graph.following(lane)
        }
        expected = {after for name, after in CONNECTIONS if name == before}
        assert len(exits) == len(expected)
        for after in expected:
            assert min(np.linalg.norm(np.array(place) - ENDS[after]) for place in exits) < NEAR_M


@pytest.mark.parametrize(
    ("start", "end", "turns"),
    [
        ((-80, EAST), (200, EAST), ["straight", "straight"]),
        ((200, WEST), (-80, WEST), ["straight", "straight"]),
        ((NORTH, -80), (NORTH, 80), ["straight"]),
        ((SOUTH, 80), (96.325, -100), ["left", "right"]),
        ((99.975, -100), (SOUTH, -80), ["left", "left"]),
    ],
)
def test_lanelet2_routes_over_the_crossing_and_the_t(files, start, end, turns):
    lanelets = loaded(files[".osm"])
    first = lanelet_at(lanelets, start, 0)
    last = lanelet_at(lanelets, end, -1)
    path = routing(lanelets).getRoute(first, last).shortestPath()
    turns_read = [
        lanelet.attributes["turn_direction"] for lanelet in path if "turn_direction" in lanelet.attributes
    ]
    assert turns_read == turns


def test_no_route_turns_where_no_drive_did(files):
    lanelets = loaded(files[".osm"])
    first = lanelet_at(lanelets, (NORTH, -80), 0)
    assert routing(lanelets).getRoute(first, lanelet_at(lanelets, (200, EAST), -1)) is None


def test_give_way_lines_are_rules_of_right_of_way_and_stop_lines_signs(files):
    lanelets = loaded(files[".osm"])
    rules = [rule.attributes["subtype"] for rule in lanelets.regulatoryElementLayer]
    assert sorted(rules) == ["right_of_way", "right_of_way", "traffic_sign", "traffic_sign"]
    for name in ("minor left in", "minor right in"):
        lane = lanelet_at(lanelets, ENDS[name], -1)
        (rule,) = lane.regulatoryElements
        assert [held.id for held in rule.yieldLanelets()] == [lane.id]
        assert len(rule.rightOfWayLanelets()) == {"minor left in": 3, "minor right in": 1}[name]
        assert rule.stopLine is not None


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """The files of the site with a speed stated, and that from south and north one waits at the crossing."""
    site = made_site()
    stated = {"south in": "yes", "north in": "yes", "west in": "no", "east in": "no"}
    answers = [
        Answer("right of way", answer, np.array(ENDS[name], dtype=float), None, "answers, feature 1")
        for name, answer in stated.items()
    ]
    answers.append(Answer("speed", "30", np.zeros(2), None, "answers, feature 5"))
    folder = tmp_path_factory.mktemp("answered")
    formats = ["lanelet2", "opendrive"]
    paths = write_map(site.hd_map, folder, "map", formats, trajectories=site.trajectories, answers=answers)
    return {path.suffix: path for path in paths}


def test_a_stated_right_of_way_is_a_rule_that_lanelet2_reads_at_the_line_that_is_painted(answered):
    lanelets = loaded(answered[".osm"])
    assert not list(routing(lanelets).checkValidity())
    manoeuvre = lanelet2.core.ManeuverType
    for name in ("south in", "north in"):
        lane = lanelet_at(lanelets, ENDS[name], -1)
        (rule,) = [rule for rule in lane.regulatoryElements if rule.attributes["subtype"] == "right_of_way"]
        assert rule.getManeuver(lane) == manoeuvre.Yield
        first = rule.rightOfWayLanelets()
        assert len(first) >= 2
        assert {rule.getManeuver(lanelet) for lanelet in first} == {manoeuvre.RightOfWay}
        assert np.linalg.norm(end_of_line(rule.stopLine) - ENDS[name]) < 3.0
    for name in ("west in", "east in"):
        assert not lanelet_at(lanelets, ENDS[name], -1).regulatoryElements


def test_a_stated_speed_is_the_limit_of_every_lane_in_both_formats(answered):
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    lanelets = loaded(answered[".osm"])
    limits = {rules.speedLimit(lanelet).speedLimit for lanelet in lanelets.laneletLayer}
    np.testing.assert_allclose(sorted(limits), [30.0])  # km/h
    speeds = ET.parse(answered[".xodr"]).getroot().findall("road/type/speed")
    assert {(speed.get("max"), speed.get("unit")) for speed in speeds} == {("30", "km/h")}


def test_a_stated_right_of_way_gives_junction_roads_priority(files, answered):
    def priorities(path):
        return {
            (entry.get("high"), entry.get("low"))
            for entry in ET.parse(path).getroot().findall("junction/priority")
        }

    roads = {road.get("id"): road for road in ET.parse(answered[".xodr"]).getroot().findall("road")}
    stated = priorities(answered[".xodr"]) - priorities(files[".xodr"])
    assert stated
    for high, low in stated:
        start = [float(roads[low].find("planView/geometry").get(axis)) for axis in "xy"]
        assert abs(start[1]) > 9  # from the south or north
        start = [float(roads[high].find("planView/geometry").get(axis)) for axis in "xy"]
        assert abs(start[0]) > 9  # from the west or east


def test_questions_are_written_beside_the_lanes(files):
    content = load_json(files[".geojson"], ValueError)
    subjects = [feature["properties"]["subject"] for feature in content["features"]]
    assert sorted(set(subjects)) == ["connection", "right of way", "speed"]
    assert subjects.count("connection") == 8
    assert subjects.count("right of way") == 4  # arms of the crossing; at the T lines are painted
    shapes = {feature["geometry"]["type"] for feature in content["features"]}
    assert shapes == {"LineString", "Point"}


def test_pyxodr_opens_roads_and_junctions(files):
    from pyxodr.road_objects.network import RoadNetwork

    network = RoadNetwork(str(files[".xodr"]), resolution=0.5)
    roads = network.get_roads()
    assert len(roads) == 16 + 14 + 4
    assert len(network.get_junctions()) == 4
    root = ET.parse(files[".xodr"]).getroot()
    for road, element in zip(roads, root.findall("road"), strict=True):
        ends = element.findall("planView/geometry")
        start = [float(ends[0].get(axis)) for axis in "xy"]
        np.testing.assert_allclose(road.reference_line[0], start, atol=1e-6)


def test_each_way_through_a_junction_is_a_connection_between_roads_that_name_the_junction(files):
    root = ET.parse(files[".xodr"]).getroot()
    roads = {road.get("id"): road for road in root.findall("road")}
    connections = root.findall("junction/connection")
    assert len(connections) == len(CONNECTIONS) + 4
    for junction in root.findall("junction"):
        for connection in junction.findall("connection"):
            assert connection.find("laneLink").attrib == {"from": "-1", "to": "-1"}
            incoming = roads[connection.get("incomingRoad")]
            link = roads[connection.get("connectingRoad")].find("link")
            assert roads[connection.get("connectingRoad")].get("junction") == junction.get("id")
            assert link.find("predecessor").get("elementId") == incoming.get("id")
            outgoing = roads[link.find("successor").get("elementId")]
            for road, end in ((incoming, "successor"), (outgoing, "predecessor")):
                assert road.find(f"link/{end}").get("elementType") == "junction"
                assert road.find(f"link/{end}").get("elementId") == junction.get("id")


def test_give_way_lines_give_junction_roads_priority(files):
    root = ET.parse(files[".xodr"]).getroot()
    assert len(root.findall("junction/priority")) == 3 + 1


def test_elevations_are_thinned_to_a_millimetre_and_to_few_records(files):
    root = ET.parse(files[".xodr"]).getroot()
    roads = root.findall("road")
    assert len(root.findall("road/elevationProfile/elevation")) < 8 * len(roads)
    for road in roads:
        records = road.findall("elevationProfile/elevation")
        first = road.find("planView/geometry")
        place = np.array([[float(first.get("x")), float(first.get("y"))]])
        assert float(records[0].get("a")) == pytest.approx(float(height_m(place)[0]), abs=0.01)


def test_a_course_passes_its_vertices_within_two_millimetres():
    angle = np.linspace(0.0, 1.5, 60)
    circle = 20.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    ahead = np.column_stack([-np.sin(angle), np.cos(angle)])
    course = Course.through(circle, ahead)
    assert len(course.pieces) <= 4
    assert course.length_m == pytest.approx(30.0, abs=1e-3)
    np.testing.assert_allclose(np.linalg.norm(course.stations.points, axis=1), 20.0, atol=2e-3)


def test_thinned_values_are_within_the_tolerance_everywhere():
    at = np.linspace(0.0, 100.0, 401)
    values = 0.5 * np.sin(at / 9.0)
    rows = thinned(at, values, 1e-3)
    assert len(rows) < 120
    np.testing.assert_allclose(np.interp(at, at[rows], values[rows]), values, atol=1e-3)
    assert thinned(at, 3.0 - 0.02 * at, 1e-3) == [0, 400]


CHECKER = shutil.which("qc_opendrive")


@pytest.mark.skipif(CHECKER is None, reason="asam-qc-opendrive needs numpy 1: install it with pipx")
def test_asam_s_checker_has_nothing_to_say(files, tmp_path):
    config = tmp_path / "config.xml"
    config.write_text(
        f'<Config><Param name="InputFile" value="{files[".xodr"]}"/><CheckerBundle application="xodrBundle">'
        f'<Param name="resultFile" value="{tmp_path / "result.xqar"}"/></CheckerBundle></Config>'
    )
    subprocess.run([str(CHECKER), "-c", str(config)], check=True, capture_output=True, cwd=tmp_path)
    result = ET.parse(tmp_path / "result.xqar").getroot()
    assert len(list(result.iter("Checker"))) > 20
    assert [issue.attrib for issue in result.iter("Issue")] == []


def test_an_empty_map_has_no_questions(tmp_path):
    paths = write_map(HDMap((), (), ORIGIN), tmp_path, "map", ["lanelet2", "opendrive"])
    assert [Path(path).suffix for path in paths] == [".osm", ".xodr"]


def test_the_example_prints_the_turns_of_a_route_and_none_where_no_drive_went(files):
    folder = files[".osm"].parent
    steps = route(folder, (NORTH, -79), (NORTH, 79))
    assert [step.split()[1:] for step in steps] == [[], ["straight"], []]
    assert route(folder, (NORTH, -79), (199, EAST)) == []
