"""Row anchors and paint become lines of lanes: whole, apart, in order, scored and numbered outwards."""

import json

import numpy as np
import pytest

from tests.detection.pictures import (
    STRIDES,
    anchors_of,
    bar,
    boundaries_of,
    brightness_model,
    diamond,
    make_camera,
    off_px,
    painted,
    painted_on,
    picture,
    straight,
    to_image,
)
from v2hdm.catalogue import SHIPPED
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.detector import Detector
from v2hdm.detection.lanes import score
from v2hdm.detection.lanes.curves import LaneImage
from v2hdm.detection.lanes.lines import propose
from v2hdm.detection.network import AnchorRow
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.weights import LANE_SCORE_FILE
from v2hdm.records import LANE_DASH, LaneDetection


@pytest.fixture
def view():
    return RoadCamera(make_camera())


def test_every_line_is_found_where_it_is_and_numbered_outwards(view):
    lines = {
        1: straight(view, 1.6),
        -1: straight(view, -1.8),
        2: straight(view, 5.0),
        -2: straight(view, -5.2),
    }
    paint = [painted(line, view, 5, 20) for line in lines.values()]
    lines_found = boundaries_of(anchors_of(view, list(lines.values())), view, paint)
    assert sorted(lane.identity for lane in lines_found) == [-2, -1, 1, 2]
    for lane in lines_found:
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
    near_line, far = straight(view, 1.6), straight(view, 3.2)
    rows = [
        row
        for line, part in ((near_line, lambda v: v > 230), (far, lambda v: v < 215))
        for row in anchors_of(view, [line])
        if part(row.v_px)
    ]
    paint = [painted(near_line, view, 4, 7), painted(far, view, 12, 16)]
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
    true_line = straight(view, 1.7)
    assert np.abs(off_px(lane, true_line[true_line[:, 1] > 200])).max() < 2


def test_a_single_dash_beside_a_long_solid_line_makes_a_double_one(view):
    pair = [straight(view, 1.5), straight(view, 1.9)]
    paint = [painted(pair[0], view, 5, 20), painted(pair[1], view, 7, 9.5)]
    (lane,) = boundaries_of(anchors_of(view, pair), view, paint)
    true_line = straight(view, 1.7)
    assert np.abs(off_px(lane, true_line[true_line[:, 1] > 200])).max() < 2


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


def score_of(view, rows, paint=()):
    (lane,) = boundaries_of(rows, view, paint)
    return lane.score


def test_the_file_holds_a_weight_for_each_feature_and_no_other():
    content = json.loads(LANE_SCORE_FILE.read_text(encoding="utf-8"))
    assert tuple(content) == ("alone", "among")
    for part, names in (("alone", score.ALONE), ("among", score.AMONG)):
        assert tuple(content[part]["weights"]) == names
        assert np.isfinite([content[part]["bias"], *content[part]["weights"].values()]).all()


def test_paint_speaks_for_a_line(view):
    line = straight(view, 1.6)
    rows = anchors_of(view, [line])
    assert score_of(view, rows, [painted(line, view, 5, 20)]) > score_of(view, rows) + 0.1


def test_doubtful_crossings_make_a_doubtful_line(view):
    rows = anchors_of(view, [straight(view, 1.6)])
    doubtful = [AnchorRow(row.v_px, row.u_px, row.odds - 2.0) for row in rows]
    assert score_of(view, doubtful) < score_of(view, rows) - 0.1


def cluttered(view, rows, seed, odds):
    """The rows with eight crossings of such log odds on each, anywhere."""
    rng, width = np.random.default_rng(seed), view.info.width
    more = ((np.append(row.u_px, rng.uniform(0, width, 8)), np.append(row.odds, [odds] * 8)) for row in rows)
    return [AnchorRow(row.v_px, *columns) for row, columns in zip(rows, more, strict=True)]


def scores(view, rows):
    return [lane.score for lane in boundaries_of(rows, view)]


def test_crossings_all_over_the_ground_make_lines_less_sure(view):
    rows = anchors_of(view, [straight(view, 1.6)])
    alone = score_of(view, rows)
    surest = [[max(scores(view, cluttered(view, rows, seed, odds)), default=0.0) for seed in range(8)]
              for odds in (0.1, 1.0)]  # fmt: skip
    assert np.mean(surest, axis=1).max() < alone - 0.05
    assert np.max(surest) < alone + 0.15, "by chance some are on the line and make it longer"


def test_a_line_a_lane_away_makes_one_surer_and_one_too_near_does_not(view):
    line = straight(view, 1.6)
    alone = score_of(view, anchors_of(view, [line]))
    too_near, away = (min(scores(view, anchors_of(view, [line, straight(view, y)]))) for y in (0.6, -1.7))
    assert away > alone + 0.05
    assert too_near < alone - 0.05


def test_a_line_a_lane_away_that_runs_another_way_tells_nothing(view):
    line = straight(view, 1.6)
    other = to_image(view.camera, np.linspace((6.0, -1.0), (30.0, -9.0), 100))
    lines_found = boundaries_of(anchors_of(view, [line, other]), view)
    mine = min(lines_found, key=lambda lane: np.abs(off_px(lane, line)).max())
    assert mine.score == pytest.approx(score_of(view, anchors_of(view, [line])), abs=0.05)


def test_half_the_row_anchors_make_a_line_as_sure(view):
    rows = anchors_of(view, [straight(view, 1.6)])
    assert score_of(view, rows[::2]) == pytest.approx(score_of(view, rows), abs=0.05)


def test_paint_that_the_network_sees_along_it_makes_a_line_surer(view):
    line = straight(view, 1.6)
    rows, paint = anchors_of(view, [line]), [painted(line, view, 5, 8)]
    whole, piece = (
        boundaries_of(rows, view, paint, output=painted_on(view, [part]))[0].score
        for part in (line, paint[0].points_px)
    )
    assert whole > piece + 0.01


def test_the_paint_along_a_line_is_the_mean_of_where_it_is_seen(view):
    line = straight(view, 1.6)
    rows = anchors_of(view, [line])
    near_part = line[line[:, 1] > np.mean([rows[0].v_px, rows[-1].v_px])]
    points, lines = propose(LaneImage(view, rows), -np.inf)
    column = score.ALONE.index("paint_along")
    whole, half, none = (
        score.features_alone(lines, points, LaneImage(view, rows, (), painted_on(view, parts)))[0, column]
        for parts in ([line], [near_part], [])
    )
    assert whole == pytest.approx(5, abs=0.5)
    assert half == pytest.approx(0, abs=1.5)
    assert none == -5


def lanes_of(tmp_path, shapes, kind="lane_line", lens="plumb_bob", **options):
    """Kind and points on the ground of the pieces of lane paint found."""
    camera = make_camera(lens)
    detector = Detector.load(brightness_model(tmp_path, kind), DetectorOptions(**options))
    _, lanes = detector.detect(picture(camera, shapes), camera)
    view = RoadCamera(camera)
    pieces = [lane for lane in lanes if lane.kind in SHIPPED.lane_paint]
    return [(lane.kind, view.ground(view.undistort(lane.points_px))) for lane in pieces]


@pytest.mark.parametrize("lens", ["pinhole", "plumb_bob", "equidistant"])
@pytest.mark.parametrize("y", [-2.0, 0.0, 1.5])
def test_points_lie_on_the_centre_line(tmp_path, lens, y):
    ((kind, points),) = lanes_of(tmp_path, [bar(9.0, y, 14.0, 0.15)], lens=lens)
    assert kind == "lane_line"
    assert len(points) > 15
    assert np.abs(points[:, 1] - y).max() < 0.03


def test_points_run_from_near_to_far_at_the_chosen_step(tmp_path):
    ((_, points),) = lanes_of(tmp_path, [bar(8.0, 1.0, 9.0, 0.15)], lane_step_m=1.0)
    gaps = np.diff(points[:, 0])
    assert (gaps > 0).all()
    assert np.median(gaps) == pytest.approx(1.0, abs=0.2)


def test_a_line_across_the_view_is_traced_too(tmp_path):
    lanes = lanes_of(tmp_path, [bar(7.0, 0.0, 5.0, 0.2, yaw_deg=88.0)])
    points = np.concatenate([points for _, points in lanes])
    assert np.ptp(points[:, 1]) > 4.0
    assert np.abs(points[:, 0] - 7.0 - np.tan(np.deg2rad(2.0)) * points[:, 1]).max() < 0.06


def test_two_lines_give_two_rows_of_points(tmp_path):
    lanes = lanes_of(tmp_path, [bar(9.0, y, 12.0, 0.12) for y in (-0.5, 0.5)])
    assert sorted(round(float(np.median(points[:, 1])), 1) for _, points in lanes) == [-0.5, 0.5]


def test_a_dash_is_a_marking_and_a_piece_of_lane(tmp_path):
    camera = make_camera()
    detector = Detector.load(brightness_model(tmp_path, "lane_dash"))
    markings, lanes = detector.detect(picture(camera, [bar(6.0, 0.5, 3.0, 0.2)]), camera)
    assert [m.kind for m in markings] == ["lane_dash"]
    assert [lane.kind for lane in lanes if lane.kind in SHIPPED.lane_paint] == ["lane_dash"]


def test_paint_too_long_for_a_dash_is_a_line(tmp_path):
    ((kind, _),) = lanes_of(tmp_path, [bar(10.5, 0.5, 15.0, 0.15)], kind="lane_dash")
    assert kind == "lane_line"


def test_a_compact_marking_is_never_lane_paint_whatever_the_network_says(tmp_path):
    camera = make_camera()
    detector = Detector.load(brightness_model(tmp_path, "lane_dash"), DetectorOptions(min_confidence=0.1))
    markings, lanes = detector.detect(picture(camera, [diamond(8.0, 0.5), diamond(10.0, -1.0)]), camera)
    assert {m.kind for m in markings} == {"diamond"}
    assert lanes == ()
