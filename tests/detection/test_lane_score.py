"""The score of a lane's line: what speaks for it, and that it is the logistic function of its file."""

import json

import numpy as np
import pytest

from tests.detection.pictures import make_camera
from tests.detection.test_anchors import anchors_of, painted, straight
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes import score
from v2hdm.detection.lanes.anchors import link_anchors
from v2hdm.detection.sight import AnchorRow


@pytest.fixture
def view() -> CameraView:
    return CameraView(make_camera())


def score_of(view, rows, paint=()):
    (lane,) = link_anchors(rows, view, paint)
    return lane.score


def test_the_file_holds_a_weight_for_each_feature_and_no_other():
    content = json.loads(score.SCORE_FILE.read_text(encoding="utf-8"))
    assert tuple(content["weights"]) == score.FEATURES
    assert np.isfinite(list(content["weights"].values())).all()


def test_paint_speaks_for_a_line(view):
    line = straight(view, 1.6)
    rows = anchors_of(view, [line])
    assert score_of(view, rows, [painted(line, view, 5, 20)]) > score_of(view, rows) + 0.1


def test_doubtful_crossings_make_a_doubtful_line(view):
    rows = anchors_of(view, [straight(view, 1.6)])
    doubtful = [AnchorRow(row.v_px, row.u_px, row.odds - 2.0) for row in rows]
    assert score_of(view, doubtful) < score_of(view, rows) - 0.1


def test_crossings_all_over_the_ground_make_no_line_surer(view):
    rows = anchors_of(view, [straight(view, 1.6)])
    rng = np.random.default_rng(3)
    clutter = [
        AnchorRow(
            row.v_px, np.append(row.u_px, rng.uniform(0, view.info.width, 8)), np.append(row.odds, [0.1] * 8)
        )
        for row in rows
    ]
    surest = max(lane.score for lane in link_anchors(clutter, view))
    assert surest < score_of(view, rows) + 0.02


def test_half_the_row_anchors_make_a_line_as_sure(view):
    rows = anchors_of(view, [straight(view, 1.6)])
    assert score_of(view, rows[::2]) == pytest.approx(score_of(view, rows), abs=0.05)
