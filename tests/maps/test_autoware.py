"""Autoware's published requirements of a vector map, as far as XML and Lanelet2's own library can tell.

The rules are those of the pages that describe ``autoware_lanelet2_map_validator``, which is a ROS package and
in no registry of Python or Debian: vm-01-01 to vm-01-04, vm-02-02, vm-03-02, the validity of speed limits and
of local coordinates. Its rule for crosswalks (vm-05-01) is not met: Lanelet2 does not read their element.
"""

import copy
import xml.etree.ElementTree as ET
from collections import Counter

import numpy as np
import pytest

from examples.lanes.site import made_site
from tests.topology.scenes import ENDS
from v2hdm.io.maps.formats import write_map
from v2hdm.topology.answers import Answer


def tags_of(element):
    return {tag.get("k"): tag.get("v") for tag in element.findall("tag")}


def lanelets_of(root):
    roads = [relation for relation in root.findall("relation") if tags_of(relation).get("type") == "lanelet"]
    return [relation for relation in roads if tags_of(relation)["subtype"] == "road"]


def side_of(lanelet, role):
    (side,) = [member.get("ref") for member in lanelet.findall("member") if member.get("role") == role]
    return side


def ids_that_are_not_unique_and_positive(root):
    """Ids of each kind of element; relations and ways are looked up among their own."""
    issues = []
    for kind in ("node", "way", "relation"):
        counts = Counter(int(element.get("id")) for element in root.findall(kind))
        issues += [number for number, count in counts.items() if count > 1 or number < 1]
    return issues


def versions_missing(root):
    meta = root.find("MetaInfo")
    return [] if meta is not None and meta.get("format_version") and meta.get("map_version") else [meta]


def nodes_without_local_coordinates(root):
    needed = {"local_x", "local_y", "ele"}
    return [node for node in root.findall("node") if not needed <= set(tags_of(node))]


def roads_of_other_places_or_both_ways(root):
    """vm-01-01."""
    needed = {"location": "urban", "one_way": "yes"}
    return [lanelet for lanelet in lanelets_of(root) if not needed.items() <= tags_of(lanelet).items()]


def roads_closed_to_all(root):
    return [lanelet for lanelet in lanelets_of(root) if tags_of(lanelet)["participant:vehicle"] != "yes"]


def bounds_without_lane_change(root):
    """vm-01-02, which asks for it where lanelets of one direction share a line; here of every bound."""
    lines = {way.get("id"): tags_of(way) for way in root.findall("way")}
    lefts = {side_of(lanelet, "left") for lanelet in lanelets_of(root)}
    rights = {side_of(lanelet, "right") for lanelet in lanelets_of(root)}
    return [line for line in lefts | rights if lines[line].get("lane_change") not in ("yes", "no")]


def neighbours_that_share_no_line(root):
    """vm-01-03 and vm-01-04: bounds whose every node lies within 10 cm of another bound's."""
    places = {
        node.get("id"): [float(tags_of(node)[key]) for key in ("local_x", "local_y")]
        for node in root.findall("node")
    }
    lines = {
        way.get("id"): np.array([places[node.get("ref")] for node in way.findall("nd")])
        for way in root.findall("way")
    }
    sides = sorted({side_of(lanelet, role) for lanelet in lanelets_of(root) for role in ("left", "right")})
    issues = []
    for first in sides:
        for second in sides:
            apart_m = np.linalg.norm(lines[first][:, None] - lines[second][None], axis=2)
            if first != second and len(lines[first]) > 2 and (apart_m.min(axis=1) < 0.1).all():
                issues.append((first, second))
    return issues


def stop_lines_that_no_rule_refers_to(root):
    """vm-02-02."""
    rules = [relation for relation in root.findall("relation") if "regulatory" in tags_of(relation)["type"]]
    referred = {member.get("ref") for rule in rules for member in rule.findall("member")}
    stops = [way.get("id") for way in root.findall("way") if tags_of(way).get("type") == "stop_line"]
    return [stop for stop in stops if stop not in referred]


def turns_by_other_words(root):
    """vm-03-02: of the lanelets that have a turn; those without paint at their sides cross or turn."""
    issues = []
    for lanelet in lanelets_of(root):
        turn = tags_of(lanelet).get("turn_direction")
        if turn is not None and turn not in ("left", "straight", "right"):
            issues.append(lanelet)
    return issues


def speed_limits_that_are_no_speeds(root):
    limits = [tags_of(lanelet).get("speed_limit") for lanelet in lanelets_of(root)]
    return [limit for limit in limits if limit is None or not 10.0 <= float(limit) <= 50.0]


@pytest.fixture(scope="module")
def osm(tmp_path_factory):
    """The made site as Lanelet2, its speed stated."""
    site = made_site()
    answers = [Answer("speed", "30", np.zeros(2), None, "answers, feature 1")]
    answers.append(Answer("right of way", "yes", np.array(ENDS["south in"], dtype=float), None, "feature 2"))
    answers.append(Answer("right of way", "no", np.array(ENDS["west in"], dtype=float), None, "feature 3"))
    folder = tmp_path_factory.mktemp("autoware")
    path, *_ = write_map(
        site.hd_map, folder, "map", ["lanelet2"], trajectories=site.trajectories, answers=answers
    )
    return ET.parse(path).getroot()


def first(root, kind, key, value=None):
    """The first tag of a key, and of a value, among elements of a kind."""
    return next(
        tag
        for element in root.findall(kind)
        for tag in element.findall("tag")
        if tag.get("k") == key and value in (None, tag.get("v"))
    )


def spoil_id(root):
    root.findall("way")[0].set("id", root.findall("way")[1].get("id"))


def spoil_neighbour(root):
    """The second lanelet beside a line gets a copy of it."""
    sides = Counter(side_of(lanelet, role) for lanelet in lanelets_of(root) for role in ("left", "right"))
    shared = next(side for side, count in sides.items() if count > 1)
    (way,) = [way for way in root.findall("way") if way.get("id") == shared]
    twin = copy.deepcopy(way)
    twin.set("id", "7")
    root.append(twin)
    (*_, member) = [
        member
        for lanelet in lanelets_of(root)
        for member in lanelet.findall("member")
        if member.get("ref") == shared
    ]
    member.set("ref", "7")


def spoil_rules(root):
    for relation in root.findall("relation"):
        for member in relation.findall("member"):
            if member.get("role") == "ref_line":
                relation.remove(member)


RULES = {
    ids_that_are_not_unique_and_positive: spoil_id,
    versions_missing: lambda root: root.remove(root.find("MetaInfo")),
    nodes_without_local_coordinates: lambda root: first(root, "node", "local_x").set("k", "x"),
    roads_of_other_places_or_both_ways: lambda root: first(root, "relation", "one_way").set("v", "no"),
    roads_closed_to_all: lambda root: first(root, "relation", "participant:vehicle").set("v", "no"),
    bounds_without_lane_change: lambda root: [
        tag.set("k", "change") for tag in root.iter("tag") if tag.get("k") == "lane_change"
    ],
    neighbours_that_share_no_line: spoil_neighbour,
    stop_lines_that_no_rule_refers_to: spoil_rules,
    turns_by_other_words: lambda root: first(root, "relation", "turn_direction").set("v", "u-turn"),
    speed_limits_that_are_no_speeds: lambda root: first(root, "relation", "speed_limit").set("v", "-3"),
}


@pytest.mark.parametrize("rule", RULES)
def test_a_map_has_no_issue_by_a_rule_that_a_spoilt_map_breaks(rule, osm):
    assert rule(osm) == []
    spoilt = copy.deepcopy(osm)
    RULES[rule](spoilt)
    assert rule(spoilt)


def test_every_lanelet_of_a_crossing_says_how_it_turns(osm):
    turns = Counter(tags_of(lanelet).get("turn_direction") for lanelet in lanelets_of(osm))
    assert (turns["straight"], turns["left"], turns["right"]) == (6, 5, 3)
