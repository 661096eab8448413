"""Row anchors and paint: lines come out whole, apart, in order, and numbered from the vehicle outwards."""

import numpy as np
import pytest

from tests.detection.pictures import (
    STRIDES,
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
from v2hdm.detection.network import AnchorRow
from v2hdm.records import LANE_DASH, LaneDetection


@pytest.fixture
def view() -> RoadCamera:
    return RoadCamera(make_camera())


def test_every_line_is_found_where_it_is_and_numbered_outwards(view):
    lines = {
        1: straight(view, 1.6),
        -1: straight(view, -1.8),
        2: straight(view, 5.0),
        -2: straight(view, -5.2),
    }
    paint = [painted(line, view, 5, 20) for line in lines.values()]
    found = boundaries_of(anchors_of(view, list(lines.values())), view, paint)
    assert sorted(lane.identity for lane in found) == [-2, -1, 1, 2]
    for lane in found:
        assert np.abs(off_px(lane, lines[lane.identity])).max() < 0.05
        assert (np.diff(lane.points_px[:, 1]) < 0).all(), "from near to far"
        assert lane.score > 0.85


def test_a_bend_stays_one_line(view):
    assert len(boundaries_of(anchors_of(view, [straight(view, 1.6, 0.01)]), view)) == 1


def test_a_few_missing_rows_do_not_break_a_line(view):
    lanes = anchors_of(view, [straight(view, 1.6), straight(view, -1.6)], hidden=slice(20, 23))
    assert len(boundaries_of(lanes, view)) == 2


def test_single_peaks_are_no_lines(view):
    alone = [AnchorRow(v, np.array([40.0]), np.array([3.0])) for v in (700.0, 600.0, 500.0, 400.0)]
    assert boundaries_of(alone, view) == []


def test_the_gap_between_two_dashes_does_not_break_a_line(view):
    line = straight(view, 1.6)
    rows = anchors_of(view, [line])
    ground = view.ground(view.undistort(np.array([[row.u_px[0], row.v_px] for row in rows])))
    dashed = [row for row, x in zip(rows, ground[:, 0], strict=True) if not 6.0 < x < 9.0]
    assert len(rows) - len(dashed) > 5
    (lane,) = boundaries_of(dashed, view)
    assert np.abs(np.diff(lane.points_px[:, 1])).max() < 10, "no gap is left"
    assert np.abs(off_px(lane, line)).max() < 0.5


def test_lines_that_run_side_by_side_are_not_joined_across_a_gap(view):
    near, far = straight(view, 1.6), straight(view, 3.2)
    rows = [
        row
        for line, part in ((near, lambda v: v > 230), (far, lambda v: v < 215))
        for row in anchors_of(view, [line])
        if part(row.v_px)
    ]
    paint = [painted(near, view, 4, 7), painted(far, view, 12, 16)]
    assert len(boundaries_of(rows, view, paint)) == 2


def test_a_dash_nearby_and_one_far_away_are_one_line_where_one_curve_holds_both(view):
    line = straight(view, 1.6, 0.004)
    rows = anchors_of(view, [line])
    ground = view.ground(view.undistort(np.array([[row.u_px[0], row.v_px] for row in rows])))
    two = [row for row, x in zip(rows, ground[:, 0], strict=True) if x < 6.0 or x > 22.0]
    (lane,) = boundaries_of(two, view)
    assert np.abs(off_px(lane, line)).max() < 5


def test_two_dashes_make_a_line_that_runs_on_towards_the_vehicle(view):
    line = straight(view, 1.0)
    paint = [painted(line, view, 7, 10), painted(line, view, 13, 16)]
    rows = anchors_of(view, [part.points_px for part in paint])
    output = painted_on(view, [part.points_px for part in paint])
    (lane,) = boundaries_of(rows, view, paint, output=output)
    assert lane.points_px[0, 1] > paint[0].points_px[0, 1] + 60
    assert np.abs(off_px(lane, line)).max() < 1.0
    assert lane.sigma_px[0] > 1.5 * lane.sigma_px.min(), "less is known where nothing was seen"


def test_paint_across_the_view_is_no_line_of_a_lane(view):
    across = to_image(view.camera, np.column_stack([np.full(40, 9.0), np.linspace(-3, 3, 40)]))
    assert boundaries_of([], view, [LaneDetection(LANE_DASH, 0.9, across)]) == []


def test_what_is_seen_about_the_horizon_bends_no_line(view):
    line = straight(view, 1.6)
    rows = anchors_of(view, [line])
    beyond = np.arange(rows[-1].v_px - STRIDES["lanes"], rows[-1].v_px - 40, -STRIDES["lanes"])
    hook = [AnchorRow(v, rows[-1].u_px + 30.0 * n, np.array([3.0])) for n, v in enumerate(beyond)]
    (lane,) = boundaries_of(rows + hook, view)
    assert np.abs(off_px(lane, line)).max() < 1.5


def test_crossings_too_unlikely_by_themselves_carry_a_known_line_on(view):
    line = straight(view, 1.6)
    rows = anchors_of(view, [line])
    faint = [AnchorRow(r.v_px, r.u_px, r.odds - 5.0) if r.v_px < 200 else r for r in rows]
    assert boundaries_of([r for r in faint if r.odds[0] < 0], view) == []
    (lane,) = boundaries_of(faint, view, [painted(line, view, 5, 8)])
    assert lane.points_px[-1, 1] < 130


def test_a_double_line_is_one_boundary_along_its_middle(view):
    pair = [straight(view, 1.5), straight(view, 1.9)]
    (lane,) = boundaries_of(anchors_of(view, pair), view, [painted(line, view, 5, 15) for line in pair])
    near = straight(view, 1.7)
    assert np.abs(off_px(lane, near[near[:, 1] > 200])).max() < 2


def test_a_single_dash_beside_a_long_solid_line_makes_a_double_one(view):
    pair = [straight(view, 1.5), straight(view, 1.9)]
    paint = [painted(pair[0], view, 5, 20), painted(pair[1], view, 7, 9.5)]
    (lane,) = boundaries_of(anchors_of(view, pair), view, paint)
    near = straight(view, 1.7)
    assert np.abs(off_px(lane, near[near[:, 1] > 200])).max() < 2


def test_what_a_point_errs_by_is_within_its_stated_sigma(view):
    rng = np.random.default_rng(5)
    line = straight(view, 1.6)
    normalised = []
    for _ in range(40):
        rows = anchors_of(view, [line])
        noise = np.repeat(rng.normal(0, 0.45, len(rows) // 3 + 1), 3)
        noisy = [AnchorRow(r.v_px, r.u_px + n, r.odds) for r, n in zip(rows, noise, strict=False)]
        (lane,) = boundaries_of(noisy, view)
        on = (lane.points_px[:, 1] >= line[:, 1].min()) & (lane.points_px[:, 1] <= line[:, 1].max())
        normalised.append(np.abs(off_px(lane, line) / lane.sigma_px[on]))
    assert 0.2 < np.quantile(np.concatenate(normalised), 0.95) < 2
