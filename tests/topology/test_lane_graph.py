"""The lane graph of a made site, against what truly leads where; and laws of any lane graph."""

from dataclasses import replace

import numpy as np
import pytest

from examples.lanes.site import DRIVES, made_site, trajectory
from tests.topology.scenes import ENDS, LANES, NEAR_M, UNDRIVEN, WAYS, lanes_of, matched, ways_of
from v2hdm.records import HDMap, Lane, Trajectory
from v2hdm.topology.build import lane_graph
from v2hdm.topology.graph import Direction, Right, Turn


def graph_of(site):
    return lane_graph(site.hd_map, site.trajectories)


def straight(kind, y, begin=0.0, end=60.0):
    x = np.linspace(begin, end, int((end - begin) * 2) + 1)
    return Lane(kind, np.column_stack([x, np.full(len(x), y)]), 3)


def one_lane():
    return HDMap((), (straight("lane_line", 3.5), straight("lane_line", 0.0)))


def driven(corners, seed=0):
    return trajectory(corners, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(4))
def test_every_lane_and_way_of_the_site_is_found_and_none_other(seed):
    graph = graph_of(made_site(seed))
    assert len(lanes_of(graph)) == len(LANES)
    assert matched(lanes_of(graph), LANES) == LANES
    assert len(ways_of(graph)) == len(WAYS)
    assert matched(ways_of(graph), WAYS) == WAYS
    assert all(lane.direction is Direction.DRIVEN for lane in graph.lanes)


def test_what_no_drive_took_is_asked_and_nothing_else():
    graph = graph_of(made_site())
    questions = [question for question in graph.questions if question.subject == "connection"]
    places = [(question.place_map, question.to_map) for question in questions]
    truth = {(ENDS[before], ENDS[after]) for before, after in UNDRIVEN}
    assert len(questions) == len(truth)
    assert matched(places, truth) == truth
    assert {question.subject for question in graph.questions} == {"connection", "speed", "right of way"}


def test_a_turn_that_only_one_drive_took_is_asked_without_it():
    left_turn = DRIVES[4]
    assert left_turn[-1][1] == 80
    graph = graph_of(made_site(drives=(0, 1, 2, 3, 5, 6, 7, 8, 9)))
    way = (ENDS["west in"], ENDS["north out"])
    assert matched(ways_of(graph), WAYS) == WAYS - {way}
    questions = [
        (question.place_map, question.to_map)
        for question in graph.questions
        if question.subject == "connection"
    ]
    assert way in matched(questions, {way})


def test_ways_turn_as_the_drives_did_and_splits_do_not_turn():
    graph = graph_of(made_site())
    expected = {
        ("west in", "north out"): Turn.LEFT,
        ("west in", "south out"): Turn.RIGHT,
        ("west in", "east out"): Turn.STRAIGHT,
        ("minor right in", "T east out"): Turn.RIGHT,
        ("T east in", "minor out"): Turn.LEFT,
    }
    for (before, after), turn in expected.items():
        ends = np.array([ENDS[before], ENDS[after]])
        (lane,) = [
            lane
            for lane in graph.lanes
            if lane.is_connecting and np.linalg.norm(lane.centre_map[[0, -1]] - ends, axis=1).max() < NEAR_M
        ]
        assert lane.turn is turn
    splits = [junction for junction in graph.junctions if not junction.is_crossing]
    assert len(splits) == 2
    assert {graph.lanes[number].turn for junction in splits for number in junction.lanes} == {None}
    assert sorted(len(junction.lanes) for junction in graph.junctions if junction.is_crossing) == [6, 8]


def test_stop_lines_end_their_lanes_and_give_way_lines_yield_to_what_they_cross():
    graph = graph_of(made_site())
    ends = [[graph.lanes[lane].centre_map[-1] for lane in stop.lanes] for stop in graph.stop_lines]
    for places, name in zip(ends, ("north in", "south in", "minor left in", "minor right in"), strict=True):
        (place,) = places
        assert np.linalg.norm(place - ENDS[name]) < NEAR_M
    rights = [stop.right for stop in graph.stop_lines]
    assert rights == [Right.STOP, Right.STOP, Right.GIVE_WAY, Right.GIVE_WAY]
    left, right = graph.stop_lines[2:]
    yields_to = {
        (tuple(graph.lanes[k].centre_map[0].round()), tuple(graph.lanes[k].centre_map[-1].round()))
        for k in left.yields_to
    }
    assert len(yields_to) == 3  # both ways along the road, and the turn into the minor road
    (straight_on,) = right.yields_to
    assert np.linalg.norm(graph.lanes[straight_on].centre_map[-1] - ENDS["T east out"]) < NEAR_M


def test_lanes_begin_where_those_before_them_end():
    graph = graph_of(made_site())
    for before, after in graph.links:
        for side in ("left", "right"):
            end = getattr(graph.lanes[before], side).xyz_map[-1]
            start = getattr(graph.lanes[after], side).xyz_map[0]
            np.testing.assert_allclose(end, start, atol=1e-9)


def test_the_left_side_lies_on_the_left():
    for lane in graph_of(made_site()).lanes:
        ahead = np.gradient(lane.centre_map, axis=0)[0]
        left = lane.left.points_map[0] - lane.right.points_map[0]
        assert ahead[0] * left[1] - ahead[1] * left[0] > 0


def test_a_lane_runs_as_its_drives_whatever_its_lines():
    for ends in ([(0, 1.75), (60, 1.75)], [(60, 1.75), (0, 1.75)]):
        graph = lane_graph(one_lane(), [driven(ends)])
        (lane,) = graph.lanes
        assert lane.direction is Direction.DRIVEN
        assert (lane.centre_map[-1] - lane.centre_map[0]) @ np.subtract(*ends[::-1]) > 0


def test_a_lane_driven_both_ways_is_two_lanes_and_asked():
    drives = [driven([(0, 1.75), (60, 1.75)]), driven([(60, 1.75), (0, 1.75)], 1)]
    graph = lane_graph(one_lane(), drives)
    assert [lane.drives for lane in graph.lanes] == [(0,), (1,)]
    assert "two ways" in [question.subject for question in graph.questions]


def test_a_vehicle_that_reverses_does_not_drive_its_lane_that_way():
    eastward = driven([(0, 1.75), (60, 1.75)])
    back = Trajectory(eastward.stamp_s, eastward.map_from_vehicle[::-1])  # the vehicle still looks east
    (lane,) = lane_graph(one_lane(), [back]).lanes
    assert lane.direction is Direction.ASKED
    (lane,) = lane_graph(one_lane(), [eastward, back]).lanes
    assert lane.drives == (0,)


def test_a_lane_beside_the_driven_one_is_asked_unless_it_goes_on_from_a_driven_one():
    lines = (straight("lane_line", 7.0), straight("lane_dash", 3.5), straight("lane_line", 0.0))
    graph = lane_graph(HDMap((), lines), [driven([(0, 1.75), (60, 1.75)])])
    directions = {round(float(lane.centre_map[:, 1].mean()), 2): lane.direction for lane in graph.lanes}
    assert directions == {5.25: Direction.ASKED, 1.75: Direction.DRIVEN}
    (question,) = [question for question in graph.questions if question.subject == "direction"]
    assert question.place_map[1] == pytest.approx(5.25, abs=0.1)


def test_a_change_of_lane_is_no_way_of_its_own():
    lines = (straight("lane_line", 7.0), straight("lane_dash", 3.5), straight("lane_line", 0.0))
    drive = driven([(0, 1.75), (25, 1.75), (40, 5.25), (60, 5.25)])
    graph = lane_graph(HDMap((), lines), [drive])
    assert not graph.links
    assert len(graph.lanes) == 2


def test_a_path_that_enters_a_lane_from_the_side_makes_it_start_there():
    lines = (straight("lane_line", 3.5, 0, 120), straight("lane_line", 0.0, 0, 120))
    lines += tuple(
        Lane("lane_line", line.points_map[:, ::-1] * [1, -1] + [x, -12], 3)
        for x, line in ((60.0, straight("lane_line", 0.0, 0, 40)), (63.5, straight("lane_line", 0.0, 0, 40)))
    )
    drives = [driven([(0, 1.75), (120, 1.75)]), driven([(61.75, -50), (61.75, 1.75), (120, 1.75)], 1)]
    graph = lane_graph(HDMap((), lines), drives)
    (merged,) = [number for number in range(len(graph.lanes)) if len(graph.before(number)) == 2]
    assert 65 < graph.lanes[merged].centre_map[0, 0] < 80
    assert {graph.lanes[number].is_connecting for number in graph.before(merged)} == {True}


def test_a_line_across_itself_bounds_nothing_and_is_asked():
    angle = np.linspace(-0.5, 2 * np.pi + 0.5, 200)
    loop = np.column_stack([30 + 8 * np.sin(angle), 8 - 8 * np.cos(angle) + 0.3 * angle])
    crossed = np.concatenate([[[0.0, 0.0]], loop, [[60.0, 0.0]]])
    hd_map = HDMap((), (straight("lane_line", 3.5), Lane("lane_line", crossed, 3, id=17)))
    graph = lane_graph(hd_map)
    assert not graph.lanes
    (question,) = graph.questions
    assert question.subject == "line"
    assert "17" in question.text


def test_without_drives_lanes_run_as_their_lines():
    graph = lane_graph(made_site().hd_map)
    assert {lane.direction for lane in graph.lanes} == {Direction.DRAWN}
    assert not [junction for junction in graph.junctions if junction.is_crossing and len(junction.lanes) > 2]


@pytest.mark.parametrize("angle", [0.7, 2.5])
def test_the_graph_moves_with_the_map(angle):
    site = made_site()
    cosine, sine = np.cos(angle), np.sin(angle)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    shift = np.array([500.0, -300.0])
    lanes = tuple(
        replace(lane, points_map=lane.points_map @ rotation.T + shift) for lane in site.hd_map.lanes
    )
    moved_from_map = np.eye(4)
    moved_from_map[:2, :2] = rotation
    moved_from_map[:2, 3] = shift
    drives = [Trajectory(t.stamp_s, moved_from_map @ t.map_from_vehicle) for t in site.trajectories]
    moved = lane_graph(replace(site.hd_map, markings=(), lanes=lanes), drives)
    graph = lane_graph(replace(site.hd_map, markings=()), site.trajectories)
    assert moved.links == graph.links
    for lane, other in zip(graph.lanes, moved.lanes, strict=True):
        np.testing.assert_allclose(lane.centre_map @ rotation.T + shift, other.centre_map, atol=1e-3)
