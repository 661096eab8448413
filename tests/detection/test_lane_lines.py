"""Row anchors and paint: lines come out whole, apart, in order, and numbered from the vehicle outwards."""

import numpy as np
import pytest

from tests.detection.pictures import foreground_of, make_camera, to_image
from v2hdm.detection.camera import CameraView
from v2hdm.detection.lanes.lines import link_anchors
from v2hdm.detection.network import AnchorRow
from v2hdm.records import LANE_DASH, LaneDetection

STRIDE = 8


def anchors_of(view: CameraView, lines_px: list[np.ndarray], hidden: slice = slice(0, 0)) -> list[AnchorRow]:
    """What a perfect network says of lines (N, 2), near to far, except on the ``hidden`` anchors."""
    rows = []
    for v in np.arange(view.info.height - 4.5, view.top, -STRIDE):
        u = []
        for line in lines_px:
            order = np.argsort(line[:, 1])
            u.append(np.interp(v, line[order, 1], line[order, 0], left=np.nan, right=np.nan))
        seen = np.array([x for x in u if 0 <= x < view.info.width])
        if len(seen):
            rows.append(AnchorRow(float(v), seen, np.full(len(seen), 4.0)))
    del rows[hidden]
    return rows


def straight(view: CameraView, left_m: float, curvature: float = 0.0) -> np.ndarray:
    along = np.arange(4.0, 40.0, 0.25)
    points = np.column_stack([along, left_m + 0.5 * curvature * along**2])
    return to_image(view.camera, points)


def painted(line_px: np.ndarray, view: CameraView, near_m: float, far_m: float) -> LaneDetection:
    """The centre line of a line's paint (N, 2) between two distances, a point every half a metre."""
    x = view.ground(view.undistort(line_px))[:, 0]
    seen = (x >= near_m) & (x <= far_m) & view.inside(line_px, 0)
    return LaneDetection(LANE_DASH, 0.9, line_px[seen][::2])


def off_px(lane: LaneDetection, line_px: np.ndarray) -> np.ndarray:
    """How far the points of a lane are from a true line along their rows, as far as that goes."""
    order = np.argsort(line_px[:, 1])
    u, v = lane.points_px.T
    off = np.interp(v, line_px[order, 1], line_px[order, 0], left=np.nan, right=np.nan) - u
    return off[np.isfinite(off)]


def painted_on(view, lines_px):
    """Log odds of paint of 5 on lines (N, 2) and of -5 elsewhere."""
    odds = np.full((view.info.height // 2, view.info.width // 2), -5.0, dtype=np.float32)
    for line_px in lines_px:
        at = np.linspace(0, len(line_px) - 1, 16 * len(line_px))
        for u, v in zip(
            *(np.interp(at, np.arange(len(line_px)), line_px[:, k]) for k in (0, 1)), strict=True
        ):
            if 0 <= u < view.info.width and 0 <= v < view.info.height:
                odds[int(v / 2), max(int(u / 2) - 2, 0) : int(u / 2) + 3] = 5.0
    return foreground_of(odds, np.zeros(odds.shape, dtype=np.int32), 0)


@pytest.fixture
def view() -> CameraView:
    return CameraView(make_camera())


def test_every_line_is_found_where_it_is_and_numbered_outwards(view):
    lines = {
        1: straight(view, 1.6),
        -1: straight(view, -1.8),
        2: straight(view, 5.0),
        -2: straight(view, -5.2),
    }
    paint = [painted(line, view, 5, 20) for line in lines.values()]
    found = link_anchors(anchors_of(view, list(lines.values())), view, paint)
    assert sorted(lane.identity for lane in found) == [-2, -1, 1, 2]
    for lane in found:
        assert np.abs(off_px(lane, lines[lane.identity])).max() < 0.05
        assert (np.diff(lane.points_px[:, 1]) < 0).all(), "from near to far"
        assert lane.score > 0.85


def test_a_bend_stays_one_line(view):
    assert len(link_anchors(anchors_of(view, [straight(view, 1.6, 0.01)]), view)) == 1


def test_a_few_missing_rows_do_not_break_a_line(view):
    lanes = anchors_of(view, [straight(view, 1.6), straight(view, -1.6)], hidden=slice(20, 23))
    assert len(link_anchors(lanes, view)) == 2


def test_single_peaks_are_no_lines(view):
    alone = [AnchorRow(v, np.array([40.0]), np.array([3.0])) for v in (700.0, 600.0, 500.0, 400.0)]
    assert link_anchors(alone, view) == []


def test_the_gap_between_two_dashes_does_not_break_a_line(view):
    line = straight(view, 1.6)
    rows = anchors_of(view, [line])
    ground = view.ground(view.undistort(np.array([[row.u_px[0], row.v_px] for row in rows])))
    dashed = [row for row, x in zip(rows, ground[:, 0], strict=True) if not 6.0 < x < 9.0]
    assert len(rows) - len(dashed) > 5
    (lane,) = link_anchors(dashed, view)
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
    assert len(link_anchors(rows, view, paint)) == 2


def test_a_dash_nearby_and_one_far_away_are_one_line_where_one_curve_holds_both(view):
    line = straight(view, 1.6, 0.004)
    rows = anchors_of(view, [line])
    ground = view.ground(view.undistort(np.array([[row.u_px[0], row.v_px] for row in rows])))
    two = [row for row, x in zip(rows, ground[:, 0], strict=True) if x < 6.0 or x > 22.0]
    (lane,) = link_anchors(two, view)
    assert np.abs(off_px(lane, line)).max() < 5


def test_two_dashes_make_a_line_that_runs_on_towards_the_vehicle(view):
    line = straight(view, 1.0)
    paint = [painted(line, view, 7, 10), painted(line, view, 13, 16)]
    rows = anchors_of(view, [part.points_px for part in paint])
    foreground = painted_on(view, [part.points_px for part in paint])
    (lane,) = link_anchors(rows, view, paint, foreground=foreground)
    assert lane.points_px[0, 1] > paint[0].points_px[0, 1] + 60
    assert np.abs(off_px(lane, line)).max() < 1.0
    assert lane.sigma_px[0] > 1.5 * lane.sigma_px.min(), "less is known where nothing was seen"


def test_paint_across_the_view_is_no_line_of_a_lane(view):
    across = to_image(view.camera, np.column_stack([np.full(40, 9.0), np.linspace(-3, 3, 40)]))
    assert link_anchors([], view, [LaneDetection(LANE_DASH, 0.9, across)]) == []


def test_what_is_seen_about_the_horizon_bends_no_line(view):
    line = straight(view, 1.6)
    rows = anchors_of(view, [line])
    beyond = np.arange(rows[-1].v_px - STRIDE, rows[-1].v_px - 40, -STRIDE)
    hook = [AnchorRow(v, rows[-1].u_px + 30.0 * n, np.array([3.0])) for n, v in enumerate(beyond)]
    (lane,) = link_anchors(rows + hook, view)
    assert np.abs(off_px(lane, line)).max() < 1.5


def test_crossings_too_unlikely_by_themselves_carry_a_known_line_on(view):
    line = straight(view, 1.6)
    rows = anchors_of(view, [line])
    faint = [AnchorRow(r.v_px, r.u_px, r.odds - 5.0) if r.v_px < 200 else r for r in rows]
    assert link_anchors([r for r in faint if r.odds[0] < 0], view) == []
    (lane,) = link_anchors(faint, view, [painted(line, view, 5, 8)])
    assert lane.points_px[-1, 1] < 130


def test_a_double_line_is_one_boundary_along_its_middle(view):
    pair = [straight(view, 1.5), straight(view, 1.9)]
    (lane,) = link_anchors(anchors_of(view, pair), view, [painted(line, view, 5, 15) for line in pair])
    near = straight(view, 1.7)
    assert np.abs(off_px(lane, near[near[:, 1] > 200])).max() < 2


def test_a_single_dash_beside_a_long_solid_line_makes_a_double_one(view):
    pair = [straight(view, 1.5), straight(view, 1.9)]
    paint = [painted(pair[0], view, 5, 20), painted(pair[1], view, 7, 9.5)]
    (lane,) = link_anchors(anchors_of(view, pair), view, paint)
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
        (lane,) = link_anchors(noisy, view)
        on = (lane.points_px[:, 1] >= line[:, 1].min()) & (lane.points_px[:, 1] <= line[:, 1].max())
        normalised.append(np.abs(off_px(lane, line) / lane.sigma_px[on]))
    assert 0.2 < np.quantile(np.concatenate(normalised), 0.95) < 2
