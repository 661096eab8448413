"""Who gives way at a crossing: asked where no give-way line is painted, written only as stated."""

import numpy as np
import pytest

from examples.lanes.site import made_site
from tests.topology.scenes import ENDS
from v2hdm.errors import MapFileError
from v2hdm.topology.answers import Answer
from v2hdm.topology.build import answered_graph, lane_graph
from v2hdm.topology.graph import RIGHT_OF_WAY

ARMS = ("west in", "east in", "south in", "north in")
SITE = made_site()


def answers(**words):
    """Answers for arms of the crossing, such as ``south="yes"``."""
    return [
        Answer(RIGHT_OF_WAY, answer, np.array(ENDS[f"{name} in"], dtype=float), None, "a.geojson, feature 1")
        for name, answer in words.items()
    ]


def graph_of(**words):
    return lane_graph(SITE.hd_map, SITE.trajectories, answers(**words))


def arm_of(graph, lane):
    end = graph.lanes[lane].centre_map[-1]
    return min(ARMS, key=lambda name: np.linalg.norm(end - ENDS[name]))


def asked_of(graph):
    return {
        arm_of(graph, question.lanes[0]) for question in graph.questions if question.subject == RIGHT_OF_WAY
    }


def crossed_arms(graph, right):
    """The arms that the ways lead from to which a lane gives way."""
    return {arm_of(graph, before) for way in right.yields_to for before in graph.before(way)}


def test_each_arm_of_a_crossing_without_give_way_lines_is_asked_about_and_the_painted_t_is_not():
    graph = graph_of()
    assert asked_of(graph) == set(ARMS)
    texts = {
        arm_of(graph, question.lanes[0]): question.text.split(";")[0]
        for question in graph.questions
        if question.subject == RIGHT_OF_WAY
    }
    assert texts["south in"] == texts["north in"] == "a line says that one stops here"
    assert texts["west in"] == texts["east in"] == "no line says who goes first"
    assert graph.stated_rights == ()


def test_a_minor_road_gives_way_to_the_ways_of_the_major_that_its_own_cross():
    graph = graph_of(south="yes", north="yes", west="no", east="no")
    assert asked_of(graph) == set()
    rights = {arm_of(graph, right.lane): right for right in graph.stated_rights}
    assert set(rights) == {"south in", "north in"}
    assert crossed_arms(graph, rights["south in"]) == {"west in", "east in"}
    turns = {graph.lanes[way].turn.value for way in rights["south in"].yields_to}
    assert "straight" in turns


def test_nothing_is_known_of_an_arm_that_nobody_spoke_of():
    graph = graph_of(south="yes")
    assert graph.stated_rights == ()
    assert asked_of(graph) == {"west in", "east in", "north in"}
    graph = graph_of(south="yes", west="no")
    (right,) = graph.stated_rights
    assert crossed_arms(graph, right) == {"west in"}


def test_where_all_give_way_nobody_goes_first():
    assert graph_of(south="yes", north="yes", west="yes", east="yes").stated_rights == ()


@pytest.mark.parametrize(
    ("answer", "place", "message"),
    [
        ("perhaps", ENDS["south in"], "'perhaps' does not say whether one gives way here; give yes or no"),
        ("yes", (50.0, 60.0), r"no lane leads into a crossing at \(50.0, 60.0\)"),
        ("no", ENDS["minor left in"], r"a give-way line is painted at \(100.0, -16.0\)"),
    ],
)
def test_an_answer_that_says_nothing_or_contradicts_the_paint_is_one_line(answer, place, message):
    stated = Answer(RIGHT_OF_WAY, answer, np.array(place), None, "a.geojson, feature 1")
    with pytest.raises(MapFileError, match=message):
        lane_graph(SITE.hd_map, SITE.trajectories, [stated])
    followed = answered_graph(SITE.hd_map, SITE.trajectories, [stated, *answers(south="yes", west="no")])
    assert len(followed.graph.stated_rights) == 1
    assert len(followed.refused) == 1
