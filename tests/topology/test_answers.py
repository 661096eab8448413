"""Answers to the questions of a lane graph."""

import numpy as np
import pytest

from examples.lanes.site import made_site, trajectory
from tests.topology.scenes import ENDS, NEAR_M, UNDRIVEN, WAYS, matched, ways_of
from v2hdm.errors import MapFileError
from v2hdm.records import HDMap, Lane
from v2hdm.topology.answers import Answer
from v2hdm.topology.build import lane_graph
from v2hdm.topology.graph import Direction, Turn


def street():
    x = np.linspace(0.0, 60.0, 121)
    kinds = {7.0: "lane_line", 3.5: "lane_dash", 0.0: "lane_line"}
    return HDMap(
        (), tuple(Lane(kind, np.column_stack([x, np.full(len(x), y)]), 3) for y, kind in kinds.items())
    )


def eastward():
    return trajectory([(0, 1.75), (60, 1.75)], np.random.default_rng(0))


def answers_to(questions, answer, subject):
    return [
        Answer(subject, answer, question.place_map, question.to_map, "answers.geojson, feature 1")
        for question in questions
        if question.subject == subject
    ]


@pytest.mark.parametrize(("answer", "ways"), [("along", {1}), ("against", {-1}), ("both", {1, -1})])
def test_a_lane_is_driven_as_stated_along_or_against_the_line_of_its_question(answer, ways):
    questions = lane_graph(street(), [eastward()]).questions
    (question,) = [question for question in questions if question.subject == "direction"]
    way = question.to_map - question.place_map
    graph = lane_graph(street(), [eastward()], answers_to(questions, answer, "direction"))
    lanes = [lane for lane in graph.lanes if lane.centre_map[:, 1].mean() > 3.5]
    assert {int(np.sign((lane.centre_map[-1] - lane.centre_map[0]) @ way)) for lane in lanes} == ways
    assert {lane.direction for lane in lanes} == {Direction.STATED}
    assert not [question for question in graph.questions if question.subject == "direction"]


def test_a_direction_that_contradicts_a_drive_is_one_line():
    west = Answer(
        "direction", "along", np.array([30.0, 1.75]), np.array([20.0, 1.75]), "answers.geojson, feature 4"
    )
    with pytest.raises(
        MapFileError, match=r"feature 4: a drive went the other way .* \(30.0, 1.8\); answer both"
    ):
        lane_graph(street(), [eastward()], [west])
    both_ways = Answer("direction", "both", west.place_map, west.to_map, west.where)
    assert len([lane for lane in lane_graph(street(), [eastward()], [both_ways]).lanes if lane.drives]) == 1


def test_a_turn_that_is_allowed_becomes_a_way_as_round_as_an_arc():
    site = made_site()
    questions = lane_graph(site.hd_map, site.trajectories).questions
    answers = answers_to(questions, "yes", "connection")
    graph = lane_graph(site.hd_map, site.trajectories, answers)
    more = {(ENDS[before], ENDS[after]) for before, after in UNDRIVEN}
    assert matched(ways_of(graph), WAYS | more) == WAYS | more
    assert {question.subject for question in graph.questions} == {"speed", "right of way"}
    ends = np.array([ENDS["south in"], ENDS["east out"]])
    (lane,) = [
        lane for lane in graph.lanes if np.linalg.norm(lane.centre_map[[0, -1]] - ends, axis=1).max() < NEAR_M
    ]
    assert (lane.turn, lane.direction) == (Turn.RIGHT, Direction.STATED)
    radius_m = np.linalg.norm(lane.centre_map - [10.0, -10.0], axis=1)
    assert np.ptp(radius_m) < 0.3


def test_a_turn_that_is_not_allowed_is_asked_no_more():
    site = made_site()
    questions = lane_graph(site.hd_map, site.trajectories).questions
    graph = lane_graph(site.hd_map, site.trajectories, answers_to(questions, "no", "connection"))
    assert matched(ways_of(graph), WAYS) == WAYS
    assert {question.subject for question in graph.questions} == {"speed", "right of way"}


def test_a_stated_speed_is_that_of_all_lanes():
    questions = lane_graph(street(), [eastward()]).questions
    graph = lane_graph(street(), [eastward()], answers_to(questions, "30", "speed"))
    assert {lane.speed_kmh for lane in graph.lanes} == {30.0}


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (("direction", "left", (30, 5), (35, 5)), "'left' is not a direction"),
        (("direction", "along", (30, 50), (35, 50)), r"no lane lies at \(30.0, 50.0\)"),
        (("connection", "yes", (30, 5), (35, 5)), r"no lane ends at \(30.0, 5.0\)"),
        (("connection", "yes", (30, 5), None), "it has one place"),
        (("speed", "quick", (0, 0), None), "'quick' is not a speed"),
        (("speed", "-3", (0, 0), None), "'-3' is not a speed"),
    ],
)
def test_an_answer_that_cannot_be_followed_is_one_line(answer, message):
    subject, text, place, to = answer
    to_map = None if to is None else np.array(to, dtype=float)
    stated = Answer(subject, text, np.array(place, dtype=float), to_map, "a.geojson, feature 1")
    with pytest.raises(MapFileError, match=message):
        lane_graph(street(), [eastward()], [stated])
