"""Double lines: one boundary, along the middle where both strands run and else along the one that goes on."""

from dataclasses import replace

import numpy as np
import pytest

from tests.detection.pictures import foreground_of, make_camera
from tests.detection.test_lane_lines import anchors_of, off_px, painted, straight
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes.lines import link_anchors
from v2hdm.detection.lanes.score import Appearance
from v2hdm.records import LANE_DASH, LANE_LINE

LEFT_M, RIGHT_M = 1.9, 1.5
ENDS_M = 14.0


@pytest.fixture
def view() -> CameraView:
    return CameraView(make_camera())


def distance_m(view, lane):
    return view.ground(view.undistort(lane.points_px))[:, 0]


def as_seen(view, from_m, kind):
    """A line seen from 4 m on, all of it solid, and its second strand, seen from a distance on."""
    whole, part = straight(view, RIGHT_M), straight(view, LEFT_M)
    part = part[view.ground(view.undistort(part))[:, 0] >= from_m]
    rows = anchors_of(view, [whole, part])
    paint = [(painted(whole, view, 4, 26), LANE_LINE), (painted(part, view, from_m, 26), kind)]
    return rows, [replace(lane, kind=name) for lane, name in paint], [whole, part]


def painted_on(view, lines_px):
    """What the network says of paint: log odds of 5 on lines (N, 2) and -5 elsewhere."""
    odds = np.full((view.info.height // 2, view.info.width // 2), -5.0, dtype=np.float32)
    for line_px in lines_px:
        at = np.linspace(0, len(line_px) - 1, 16 * len(line_px))
        for u, v in zip(
            *(np.interp(at, np.arange(len(line_px)), line_px[:, k]) for k in (0, 1)), strict=True
        ):
            if 0 <= u < view.info.width and 0 <= v < view.info.height:
                odds[int(v / 2), max(int(u / 2) - 2, 0) : int(u / 2) + 3] = 5.0
    return Appearance(None, foreground_of(odds, np.zeros(odds.shape, dtype=np.int32), 0))


def test_where_one_strand_has_ended_the_line_passes_to_the_other(view):
    rows, paint, lines = as_seen(view, ENDS_M, LANE_LINE)
    (lane,) = link_anchors(rows, view, paint, appearance=painted_on(view, lines))
    away_m = distance_m(view, lane)
    near, far = away_m < ENDS_M - 3, (away_m > ENDS_M + 3) & (away_m < 24)
    assert np.abs(off_px(lane, straight(view, RIGHT_M))[near]).max() < 2
    assert np.abs(off_px(lane, straight(view, (LEFT_M + RIGHT_M) / 2))[far]).max() < 1
    assert np.abs(np.diff(lane.points_px[:, 0], 2)).max() < 12, "without a step"


@pytest.mark.parametrize(("kind", "reaches_m"), [(LANE_LINE, 4.0), (LANE_DASH, ENDS_M)])
def test_strand_that_goes_on_unseen_keeps_the_line_in_the_middle(view, kind, reaches_m):
    """Be it that the image shows its paint farther than its points, or that it is dashes."""
    rows, paint, lines = as_seen(view, ENDS_M, kind)
    looks = painted_on(view, [lines[0], as_seen(view, reaches_m, kind)[2][1]])
    (lane,) = link_anchors(rows, view, paint, appearance=looks)
    near = distance_m(view, lane) < ENDS_M - 3
    assert np.abs(off_px(lane, straight(view, (LEFT_M + RIGHT_M) / 2))[near]).max() < 2


def test_sure_dash_beside_an_unsure_solid_line_makes_a_double_one(view):
    rows, paint, _ = as_seen(view, ENDS_M, LANE_DASH)
    unsure = [replace(paint[0], score=0.5), painted(straight(view, LEFT_M), view, ENDS_M, 17)]
    rows = [replace(row, odds=np.where(np.arange(len(row.odds)) == 0, 0.3, 4.0)) for row in rows]
    (lane,) = link_anchors(rows, view, unsure)
    near = distance_m(view, lane) < ENDS_M
    assert np.abs(off_px(lane, straight(view, (LEFT_M + RIGHT_M) / 2))[near]).max() < 2
