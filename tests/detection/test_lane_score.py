"""The score of a lane's line: what speaks for it, and that it is the logistic function of its file."""

import json

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
from v2hdm.detection.lanes import boundaries as score
from v2hdm.detection.lanes.curves import LaneImage
from v2hdm.detection.lanes.lines import propose
from v2hdm.detection.network import AnchorRow
from v2hdm.detection.weights import LANE_SCORE_FILE


@pytest.fixture
def view() -> RoadCamera:
    return RoadCamera(make_camera())


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
    return [AnchorRow(row.v_px, *given) for row, given in zip(rows, more, strict=True)]


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
    near, away = (min(scores(view, anchors_of(view, [line, straight(view, y)]))) for y in (0.6, -1.7))
    assert away > alone + 0.05
    assert near < alone - 0.05


def test_a_line_a_lane_away_that_runs_another_way_tells_nothing(view):
    line = straight(view, 1.6)
    other = to_image(view.camera, np.linspace((6.0, -1.0), (30.0, -9.0), 100))
    found = boundaries_of(anchors_of(view, [line, other]), view)
    mine = min(found, key=lambda lane: np.abs(off_px(lane, line)).max())
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
    near = line[line[:, 1] > np.mean([rows[0].v_px, rows[-1].v_px])]
    points, lines = propose(LaneImage(view, rows), -np.inf)
    column = score.ALONE.index("paint_along")
    whole, half, none = (
        score.features_alone(lines, points, LaneImage(view, rows, (), painted_on(view, parts)))[0, column]
        for parts in ([line], [near], [])
    )
    assert whole == pytest.approx(5, abs=0.5)
    assert half == pytest.approx(0, abs=1.5)
    assert none == -5
