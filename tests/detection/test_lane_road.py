"""The road that an image's lines lie along, and where each of them begins and ends."""

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
    to_image,
)
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.lanes.curves import LaneImage, LinePoints, Prior, find_road
from v2hdm.detection.lanes.lines import propose
from v2hdm.detection.network import AnchorRow
from v2hdm.records import LANE_DASH, LANE_LINE, LaneDetection


@pytest.fixture
def view():
    return RoadCamera(make_camera())


def evidence_of(view, lines_px):
    points_px = np.concatenate(lines_px)
    ones = np.ones(len(points_px))
    points = LinePoints.of(LaneImage(view, []), points_px, ones, ones, paint=False)
    ends = np.cumsum([len(line) for line in lines_px])
    groups = [np.arange(end - len(line), end) for end, line in zip(ends, lines_px, strict=True)]
    return points.evidence(view.horizon, groups), view.horizon


def seen(view, line_px):
    return line_px[view.inside(line_px, 0)]


def ahead(view, start, end):
    """A straight line on the ground between two points, in the image."""
    return seen(view, to_image(view.camera, np.linspace(start, end, 60)))


def test_several_priors_at_once_tell_what_each_does_alone(view):
    evidence, _ = evidence_of(view, [seen(view, straight(view, side)) for side in (1.6, -2.0)])
    priors = [
        Prior(np.array([5.0, 0.0, 1.0]), np.diag([1e-3, 1e-4, 1e-2])),
        Prior(np.array([-40.0, 3.0, 0.0]), np.diag([1e-2, 1e-3, 1e-3])),
    ]
    at_once = evidence.log_evidence(Prior.several(priors))
    np.testing.assert_allclose(at_once, [evidence.log_evidence(prior) for prior in priors], rtol=1e-12)
    curves = evidence.curves(priors, 640.0)
    alone = [evidence[k : k + 1].curves([prior], 640.0)[0] for k, prior in enumerate(priors)]
    for curve, other in zip(curves, alone, strict=True):
        np.testing.assert_allclose(curve.parameters, other.parameters, rtol=1e-9)
        np.testing.assert_allclose(curve.covariance, other.covariance, rtol=1e-9)


@pytest.mark.parametrize("curvature", [0.0, 0.006, -0.006])
def test_the_road_is_what_most_lines_agree_on_not_the_longest_other_one(view, curvature):
    lines = [seen(view, straight(view, side, curvature)) for side in (-5.0, -1.6, 1.8, 5.2)]
    other = ahead(view, (5.0, -3.0), (30.0, 9.0))
    evidence, horizon = evidence_of(view, [*lines, other])
    _, along = find_road(evidence, horizon).weigh(evidence)
    assert along[:4].min() > 2
    assert along[4] < -10


def test_short_dashes_far_away_point_where_the_line_beside_them_does(view):
    line, horizon = straight(view, 1.6), view.horizon
    dashes = [tilted(painted(line, view, *span), 0.7) for span in ((12, 14), (17, 19))]
    near_part = line[(line[:, 1] > 200) & view.inside(line, 0)]
    off = []
    for beside in ([], [straight(view, -1.8)]):
        points, lines = propose(LaneImage(view, anchors_of(view, beside), dashes), -np.inf)
        along, below = horizon.coordinates(view.undistort(near_part))
        curves = [
            line.curve.along(horizon.basis(below)) for line in lines if points.is_paint[line.members].all()
        ]
        off.append(min(np.abs(curve - along).max() for curve in curves))
    assert off[1] < 8
    assert off[1] < 0.6 * off[0], "by themselves they do not"


def tilted(lane, by_px):
    turn_px = np.linspace(-by_px, by_px, len(lane.points_px))
    return replace(lane, points_px=lane.points_px + np.column_stack([turn_px, np.zeros_like(turn_px)]))


def test_of_two_lines_that_cross_the_surer_one_stays(view):
    line = straight(view, 1.6)
    across = ahead(view, (9.0, 3.2), (20.0, -1.5))
    rows = anchors_of(view, [line])
    crossed = boundaries_of(rows, view, [LaneDetection(LANE_LINE, 0.9, across[::2])])
    (lane,) = crossed
    assert np.abs(off_px(lane, line)).max() < 3


def test_a_stroke_across_a_line_does_not_draw_it_to_the_middle(view):
    line = straight(view, 1.6)
    stroke = ahead(view, (10.0, 1.3), (12.5, 1.9))
    paint = [painted(line, view, 5, 20), LaneDetection(LANE_LINE, 0.9, stroke[::4])]
    (lane,) = boundaries_of(anchors_of(view, [line]), view, paint)
    assert np.abs(off_px(lane, line)).max() < 1


def test_a_line_whose_far_half_bends_away_a_little_stays_one(view):
    near_line = straight(view, 1.6)
    rows = anchors_of(view, [near_line])
    split = rows[len(rows) // 2].v_px
    bent = [AnchorRow(r.v_px, r.u_px + (4.0 if r.v_px < split else 0.0), r.odds) for r in rows]
    (lane,) = boundaries_of(bent, view)
    assert np.ptp(lane.points_px[:, 1]) > 0.9 * (rows[0].v_px - rows[-1].v_px)


LEFT_M, RIGHT_M = 1.9, 1.5
ENDS_M = 14.0


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
    near_strand, far = (
        part_of(view, straight(view, RIGHT_M), 4, ENDS_M - 3),
        part_of(view, middle, ENDS_M + 3, 24),
    )
    assert np.abs(off_px(lane, near_strand)).max() < 10, "the middle is 26 px away"
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
    near_rows = [row for row in anchors_of(view, [line]) if row.v_px > sure[0].v_px]
    near_rows = [AnchorRow(row.v_px, row.u_px, np.array([-2.5])) for row in near_rows]
    output = painted_on(view, [part_of(view, line, paint_to_m, 40)])
    (lane,) = boundaries_of([*near_rows, *sure], view, [solid], output=output)
    if ends:
        assert lane.points_px[0, 1] < solid.points_px[0, 1] + 20
    else:
        assert lane.points_px[0, 1] > near_rows[0].v_px - 20


@pytest.mark.parametrize("kind", [LANE_LINE, LANE_DASH])
def test_dash_is_one_of_many_however_it_is_called(view, kind):
    line = straight(view, 1.6)
    dash = replace(painted(line, view, 12, 15), kind=kind)
    output = painted_on(view, [part_of(view, line, 12, 15), part_of(view, line, 21, 24)])
    rows = anchors_of(view, [line])
    (lane,) = boundaries_of(rows, view, [dash], output=output)
    assert lane.points_px[0, 1] > dash.points_px[0, 1] + 60
