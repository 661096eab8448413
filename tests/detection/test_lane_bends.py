"""Lines on tight bends: a dash goes on beside the line that shows how the way bends."""

import numpy as np
import pytest

from tests.detection.pictures import make_camera, to_image
from tests.detection.test_anchors import anchors_of
from train.scenes.views import random_view
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes.anchors import link_anchors
from v2hdm.detection.lanes.bends import Seen, beside_guide
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.records import LANE_BOUNDARY, LANE_LINE, Camera, LaneDetection


@pytest.fixture
def view() -> CameraView:
    return CameraView(make_camera())


def arc(view: CameraView, left_m: float, radius_m: float, to_rad: float) -> np.ndarray:
    """A line so far left of the vehicle, on a bend to the left, in the image."""
    angle = np.linspace(0.0, to_rad, 400)
    beside = radius_m - left_m
    ground = np.column_stack([beside * np.sin(angle), radius_m - beside * np.cos(angle)])
    line_px = to_image(view.camera, ground[4:])
    return line_px[view.inside(line_px, 0)]


def goes_on(view: CameraView, left_m: float, radius_m: float) -> np.ndarray:
    """Such a line as far as any is drawn."""
    return arc(view, left_m, radius_m, 1.5)


def drawn_straight(view: CameraView, line_px: np.ndarray, piece: slice) -> Seen:
    """A line of which a piece is seen, drawn on along the tangent there."""
    a, b = line_px[piece][[0, -1]]
    rows = np.arange(a[1] + 80, b[1] - 30, -8.0)
    points = np.column_stack([a[0] + (rows - a[1]) * (b[0] - a[0]) / (b[1] - a[1]), rows])
    points = points[view.inside(points, -8.0)]
    seen = (points[:, 1] <= a[1]) & (points[:, 1] >= b[1])
    return Seen(LaneDetection(LANE_BOUNDARY, 0.8, points, sigma_px=np.ones(len(points))), seen)


def whole(line_px: np.ndarray) -> Seen:
    line = LaneDetection(LANE_BOUNDARY, 0.99, line_px, sigma_px=np.ones(len(line_px)))
    return Seen(line, np.ones(len(line_px), dtype=bool))


def error_px(lane: LaneDetection, line_px: np.ndarray) -> np.ndarray:
    apart = lane.points_px[:, None] - line_px
    return np.hypot(apart[..., 0], apart[..., 1]).min(axis=1)


@pytest.mark.parametrize("radius_m", [20.0, 30.0, 60.0])
def test_a_dash_goes_on_beside_the_line_that_bends(view, radius_m):
    guide = arc(view, 2.0, radius_m, min(25.0 / radius_m, 0.9))
    line = arc(view, -1.5, radius_m, min(25.0 / radius_m, 0.9))
    dash = drawn_straight(view, line, slice(60, 110))
    true = goes_on(view, -1.5, radius_m)
    before = error_px(dash.lane, true)
    given = beside_guide([whole(guide), dash], view)
    after = error_px(given[1], true)
    assert np.ptp(given[1].points_px[:, 1]) > np.ptp(dash.lane.points_px[:, 1])
    assert after.max() < 8 < before.max()
    np.testing.assert_array_equal(given[0].points_px, guide)


def test_two_pieces_at_one_distance_from_the_guide_are_one_line(view):
    guide, line = arc(view, 2.0, 30.0, 0.8), arc(view, -1.5, 30.0, 0.8)
    pieces = [drawn_straight(view, line, piece) for piece in (slice(60, 110), slice(150, 200))]
    given = beside_guide([whole(guide), *pieces], view)
    assert len(given) == 2
    assert error_px(given[1], goes_on(view, -1.5, 30.0)).max() < 8


def test_what_runs_another_way_and_what_has_no_bend_beside_it_stays_as_it_is(view):
    guide, line = arc(view, 2.0, 30.0, 0.8), arc(view, -1.5, 30.0, 0.8)
    straight = whole(to_image(view.camera, np.linspace([6.0, -1.0], [20.0, -9.0], 60)))
    for lines in ([whole(guide), straight], [straight, drawn_straight(view, line, slice(60, 110))]):
        for was, given in zip(lines, beside_guide(lines, view), strict=True):
            np.testing.assert_array_equal(given.points_px, was.lane.points_px)


def test_the_lines_of_an_image_follow_its_bend(view):
    guide, line = arc(view, 2.0, 30.0, 0.8), arc(view, -1.5, 30.0, 0.8)
    paint = [LaneDetection(LANE_LINE, 0.9, part) for part in (guide[::8], line[60:110:8])]
    lanes = link_anchors(anchors_of(view, [guide, line[60:110]]), view, paint)
    assert len(lanes) == 2
    true = [goes_on(view, left_m, 30.0) for left_m in (2.0, -1.5)]
    for lane in lanes:
        error = min((error_px(lane, line) for line in true), key=np.max)
        # Lines are drawn a little beyond the image, the true ones are not.
        assert error[view.inside(lane.points_px, 0)].max() < 8
        assert lane.points_px[0, 1] > view.info.height - 30 or lane.points_px[0, 0] < 30


def wild_lines(rng: np.random.Generator, view: CameraView) -> list[Seen]:
    """Lines that no road has, parts of them seen."""
    lines = []
    for _ in range(rng.integers(2, 6)):
        count = rng.integers(4, 60)
        rows = np.sort(rng.uniform(max(view.top, 0) + 5, view.info.height, count))[::-1]
        kind = rng.integers(4)
        if kind == 0:
            u = np.cumsum(rng.normal(0, 30, count)) + rng.uniform(0, 1280)
        elif kind == 1:
            off = rows - rows[0]
            u = rng.uniform(0, 1280) + rng.normal(0, 3) * off + rng.normal(0, 0.01) * off**2
        elif kind == 2:
            u = np.full(count, rng.uniform(0, 1280))
        else:
            u = 640 + 400 * np.sin(rows / rng.uniform(20, 200))
        seen = rng.random(count) < rng.uniform(0.1, 1)
        if seen.sum() < 2:
            seen[:2] = True
        line = LaneDetection(LANE_BOUNDARY, 0.5, np.column_stack([u, rows]), sigma_px=np.ones(count))
        lines.append(Seen(line, seen))
    return lines


@pytest.mark.parametrize("camera", [0, 13, 20])
def test_lines_that_no_road_has_are_drawn_finite(camera):
    mounted = random_view(np.random.default_rng(camera), 1280, 720)
    ipm = ipm_from_extrinsic(mounted.info, mounted.cam_from_map)
    view = CameraView(Camera(mounted.info, {"true": ipm}, "true", make_camera().roi_vehicle))
    drawn = 0
    for seed in (916, *range(40)):
        given = wild_lines(np.random.default_rng(seed), view)
        lines = beside_guide(given, view)
        drawn += any(line is not before.lane for line, before in zip(lines, given, strict=False))
        for line in lines:
            assert np.isfinite(line.points_px).all()
            assert np.isfinite(line.sigma_px).all()
    assert drawn > 0
