"""Give-way lines of the pieces that are mapped.

lane line  =======================   x ahead, y to the left
                    []  x = 20, y = 3.2
                    []
                    []
                    []  y = 0.2
lane line  =======================
"""

from dataclasses import replace

import numpy as np
import pytest

from v2hdm.records import GIVE_WAY, HDMap, Lane, Marking
from v2hdm.site.composed import composed
from v2hdm.site.give_way import with_give_way_lines

DASH_M, GAP_M, THICK_M = 0.5, 0.25, 0.4
PIECE = np.array([[-0.2, -0.25], [0.2, -0.25], [0.2, 0.25], [-0.2, 0.25]])
LANES = tuple(
    Lane("lane_line", np.column_stack([np.arange(0.0, 31.0), np.full(31, y_m)]), 5) for y_m in (0.0, 3.5)
)


def row(count=4, kind="stop_line", step_m=DASH_M + GAP_M, piece=PIECE, first_id=11):
    """Pieces beside each other across a lane, in no order."""
    covariance = 0.01**2 * np.eye(8)
    pieces = [
        Marking(kind, piece + np.array([20.0, 0.6 + k * step_m]), 4 + k, covariance, 0.01, id=first_id + k)
        for k in range(count)
    ]
    return tuple(pieces[::2] + pieces[1::2])


@pytest.mark.parametrize("kind", ["stop_line", "lane_dash", "crosswalk_bar"])
def test_short_pieces_across_a_lane_are_one_give_way_line(kind):
    diamond = Marking("diamond", PIECE + np.array([40.0, 1.0]), 3, id=1)
    hd_map = composed(HDMap((diamond, *row(kind=kind)), LANES))
    marking, line = hd_map.markings
    assert marking is diamond
    assert (line.kind, line.variety, line.id, line.sightings) == ("stop_line", GIVE_WAY, 11, 7)
    np.testing.assert_allclose(np.ptp(line.corners_map, axis=0), [THICK_M, 3 * (DASH_M + GAP_M) + DASH_M])
    np.testing.assert_allclose(line.corners_map.min(axis=0), [19.8, 0.35])


def test_its_corners_are_counter_clockwise_and_as_uncertain_as_those_of_its_outer_pieces():
    (line,) = with_give_way_lines(HDMap(row(), LANES)).markings
    ahead = np.roll(line.corners_map, -1, axis=0) - line.corners_map
    turn = ahead[:, 0] * np.roll(ahead[:, 1], -1) - ahead[:, 1] * np.roll(ahead[:, 0], -1)
    assert (turn > 0).all()
    assert line.covariance_m2 is not None
    np.testing.assert_allclose(np.diag(line.covariance_m2), 0.01**2, rtol=0.3)
    unknown = tuple(replace(piece, covariance_m2=None) for piece in row())
    (line,) = with_give_way_lines(HDMap(unknown, LANES)).markings
    assert line.covariance_m2 is None


def test_heights_of_its_corners_are_those_of_its_outer_pieces():
    high = tuple(replace(piece, heights_m=np.full(4, float(piece.id or 0))) for piece in row())
    (line,) = with_give_way_lines(HDMap(high, LANES)).markings
    by_corner = dict(zip(line.corners_map[:, 1].round(2).tolist(), line.heights_m.tolist(), strict=True))
    assert by_corner == {0.35: 11.0, 3.1: 14.0}


@pytest.mark.parametrize(
    ("markings", "why"),
    [
        (row(count=2), "two pieces show no row"),
        (row(kind="diamond"), "diamonds stand in rows in ports"),
        (row(step_m=2.0), "the pieces stand too far apart"),
        (row(step_m=0.55), "the gaps are those of wear"),
        (row(piece=PIECE * [1, 3], step_m=2.2), "dashes of 1.5 m are a line of their own"),
        (
            tuple(replace(piece, corners_map=piece.corners_map[:, ::-1]) for piece in row()),
            "it leads along the lane",
        ),
    ],
)
def test_what_is_no_give_way_line_stays_as_it_is(markings, why):
    assert with_give_way_lines(HDMap(markings, LANES)).markings is markings, why


def test_where_no_lane_line_tells_the_direction_nothing_is_recognised():
    far = tuple(replace(lane, points_map=lane.points_map + np.array([0.0, 50.0])) for lane in LANES)
    markings = row()
    for lanes in ((), far):
        assert with_give_way_lines(HDMap(markings, lanes)).markings is markings


def test_bars_of_a_crosswalk_stay_bars():
    bar = np.array([[-1.5, -0.25], [1.5, -0.25], [1.5, 0.25], [-1.5, 0.25]])
    bars = row(count=6, kind="crosswalk_bar", step_m=1.0, piece=bar)
    hd_map = composed(HDMap(bars, LANES))
    assert {marking.kind for marking in hd_map.markings} == {"crosswalk_bar"}
    assert [symbol.kind for symbol in hd_map.symbols] == ["crosswalk"]


def test_an_earlier_give_way_line_stays():
    once = with_give_way_lines(HDMap(row(), LANES))
    assert with_give_way_lines(once).markings is once.markings
