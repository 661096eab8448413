"""Centre lines of lane paint against truth."""

import numpy as np
import pytest

from tests.detection.pictures import bar, brightness_model, diamond, make_camera, picture
from v2hdm.catalogue import LANE_CLASSES
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions


def lanes_of(tmp_path, shapes, kind="lane_line", lens="plumb_bob", **options):
    """Kind and points on the ground of the pieces of lane paint found."""
    camera = make_camera(lens)
    detector = Detector.load(brightness_model(tmp_path, kind), DetectorOptions(**options))
    _, lanes = detector.detect(picture(camera, shapes), camera)
    view = RoadCamera(camera)
    pieces = [lane for lane in lanes if lane.kind in LANE_CLASSES]
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
    assert [lane.kind for lane in lanes if lane.kind in LANE_CLASSES] == ["lane_dash"]


def test_paint_too_long_for_a_dash_is_a_line(tmp_path):
    ((kind, _),) = lanes_of(tmp_path, [bar(10.5, 0.5, 15.0, 0.15)], kind="lane_dash")
    assert kind == "lane_line"


def test_a_compact_marking_is_never_lane_paint_whatever_the_network_says(tmp_path):
    camera = make_camera()
    detector = Detector.load(brightness_model(tmp_path, "lane_dash"), DetectorOptions(min_confidence=0.1))
    markings, lanes = detector.detect(picture(camera, [diamond(8.0, 0.5), diamond(10.0, -1.0)]), camera)
    assert {m.kind for m in markings} == {"diamond"}
    assert lanes == ()
