"""Spans of lines: where each is painted, runs on and has ended, and what becomes of double lines."""

from dataclasses import replace

import numpy as np
import pytest

from tests.detection.pictures import (
    anchors_of,
    boundaries_of,
    make_camera,
    off_px,
    painted,
    painted_on,
    straight,
)
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.network import AnchorRow
from v2hdm.records import LANE_DASH, LANE_LINE

LEFT_M, RIGHT_M = 1.9, 1.5
ENDS_M = 14.0


@pytest.fixture
def view() -> RoadCamera:
    return RoadCamera(make_camera())


def distance_m(view, line_px):
    return view.ground(view.undistort(line_px))[:, 0]


def part_of(view, line_px, near_m, far_m):
    """The part of a line (N, 2) between two distances."""
    away_m = distance_m(view, line_px)
    return line_px[(away_m >= near_m) & (away_m <= far_m)]


def as_seen(view, from_m, kind):
    """A line seen from 4 m on, all of it solid, and its second strand, seen from a distance on."""
    whole, part = straight(view, RIGHT_M), part_of(view, straight(view, LEFT_M), from_m, 40)
    rows = anchors_of(view, [whole, part])
    paint = [(painted(whole, view, 4, 26), LANE_LINE), (painted(part, view, from_m, 26), kind)]
    return rows, [replace(lane, kind=name) for lane, name in paint], [whole, part]


def test_where_one_strand_has_ended_the_line_passes_to_the_other(view):
    rows, paint, lines = as_seen(view, ENDS_M, LANE_LINE)
    (lane,) = boundaries_of(rows, view, paint, output=painted_on(view, lines))
    middle = straight(view, (LEFT_M + RIGHT_M) / 2)
    near, far = part_of(view, straight(view, RIGHT_M), 4, ENDS_M - 3), part_of(view, middle, ENDS_M + 3, 24)
    assert np.abs(off_px(lane, near)).max() < 10, "the middle is 26 px away"
    assert np.abs(off_px(lane, far)).max() < 1
    assert np.abs(np.diff(lane.points_px[:, 0], 2)).max() < 12, "without a step"


def test_strand_whose_paint_goes_on_unseen_keeps_the_line_in_the_middle(view):
    rows, paint, lines = as_seen(view, ENDS_M, LANE_LINE)
    output = painted_on(view, [lines[0], as_seen(view, 4.0, LANE_LINE)[2][1]])
    (lane,) = boundaries_of(rows, view, paint, output=output)
    middle = straight(view, (LEFT_M + RIGHT_M) / 2)
    assert np.abs(off_px(lane, part_of(view, middle, 4, ENDS_M - 3))).max() < 2


@pytest.mark.parametrize(("paint_to_m", "ends"), [(12, True), (4, False)])
def test_solid_line_ends_where_its_paint_does(view, paint_to_m, ends):
    """A faint crossing on each row: beyond the end of a line the network fades out slowly."""
    line = straight(view, 1.6)
    solid = replace(painted(line, view, 12, 26), kind=LANE_LINE)
    sure = anchors_of(view, [part_of(view, line, 12, 40)])
    near = [row for row in anchors_of(view, [line]) if row.v_px > sure[0].v_px]
    near = [AnchorRow(row.v_px, row.u_px, np.array([-2.5])) for row in near]
    output = painted_on(view, [part_of(view, line, paint_to_m, 40)])
    (lane,) = boundaries_of([*near, *sure], view, [solid], output=output)
    if ends:
        assert lane.points_px[0, 1] < solid.points_px[0, 1] + 20
    else:
        assert lane.points_px[0, 1] > near[0].v_px - 20


@pytest.mark.parametrize("kind", [LANE_LINE, LANE_DASH])
def test_dash_is_one_of_many_however_it_is_called(view, kind):
    line = straight(view, 1.6)
    dash = replace(painted(line, view, 12, 15), kind=kind)
    output = painted_on(view, [part_of(view, line, 12, 15), part_of(view, line, 21, 24)])
    rows = anchors_of(view, [line])
    (lane,) = boundaries_of(rows, view, [dash], output=output)
    assert lane.points_px[0, 1] > dash.points_px[0, 1] + 60
