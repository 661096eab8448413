"""What the image shows along a line: paint on it, and ground of one colour, or of two, beside it."""

import numpy as np
import pytest

from tests.detection.pictures import foreground_of, make_camera
from tests.detection.test_lane_lines import anchors_of, straight
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes.cluster import find_road
from v2hdm.detection.lanes.curve import Horizon, Line, LinePoints
from v2hdm.detection.lanes.lines import link_anchors
from v2hdm.detection.lanes.score import APPEARANCE, UNKNOWN, Appearance

ASPHALT, GRASS = (90, 90, 92), (40, 110, 60)


@pytest.fixture
def view() -> CameraView:
    return CameraView(make_camera())


def beside(view, line_px, left_bgr, right_bgr):
    """An image of ground of one colour on the left of a line (N, 2) and of another on its right."""
    image = np.empty((view.info.height, view.info.width, 3), dtype=np.uint8)
    order = np.argsort(line_px[:, 1])
    for row, pixels in enumerate(image):
        u = np.interp(row, line_px[order, 1], line_px[order, 0])
        pixels[:] = np.where(np.arange(view.info.width)[:, None] < u, left_bgr, right_bgr)
    return image


def painted_from(view, line_px, nearest_row):
    """Log odds of paint, 5 on a line (N, 2) from a row on and -5 elsewhere."""
    odds = np.full((view.info.height // 2, view.info.width // 2), -5.0, dtype=np.float32)
    for u, v in line_px:
        if 0 <= u < view.info.width and 0 <= v < min(nearest_row, view.info.height):
            odds[int(v / 2), max(int(u / 2) - 2, 0) : int(u / 2) + 3] = 5.0
    return foreground_of(odds, np.zeros(odds.shape, dtype=np.int32), 0)


def fine(line_px):
    at = np.linspace(0, len(line_px) - 1, 8 * len(line_px))
    return np.column_stack([np.interp(at, np.arange(len(line_px)), line_px[:, k]) for k in (0, 1)])


def appearance_along(view, line_px, appearance):
    """The appearance of a line through its crossings, by name."""
    horizon = Horizon(view)
    rows = anchors_of(view, [line_px])
    at = np.array([[row.u_px[0], row.v_px] for row in rows])
    points = LinePoints.of(view, horizon, at, np.full(len(at), 4.0), np.full(len(at), 0.5))
    group = [np.arange(len(at))]
    evidence = points.evidence(horizon, group, points.slopes(group))
    prior, none = find_road(evidence, horizon).free, np.empty(0, dtype=np.int64)
    line = Line(evidence.curve(prior, horizon.centre_px), group[0], none, 0.0, prior, 0.0)
    return dict(zip(APPEARANCE, appearance.along([line], points, view, horizon)[0], strict=True))


def test_one_ground_in_light_and_in_shade_has_one_colour_and_grass_has_another(view):
    line = straight(view, 1.6)
    nothing = painted_from(view, line[:0], 0)
    shade = tuple(c // 3 for c in ASPHALT)
    grounds = {"same": ASPHALT, "shade": shade, "grass": GRASS}
    change = {}
    for name, left in grounds.items():
        appearance = Appearance.of(beside(view, line, left, ASPHALT), nothing)
        change[name] = appearance_along(view, line, appearance)["colour_change"]
    assert change["same"] == 0
    assert change["shade"] < 0.02
    assert change["grass"] == pytest.approx(0.05), "no more than that is told"


def test_paint_is_seen_along_the_line(view):
    line = fine(straight(view, 1.6))
    rows = [row.v_px for row in anchors_of(view, [line])]
    image = np.full((view.info.height, view.info.width, 3), 90, dtype=np.uint8)
    whole, half, none = (
        appearance_along(view, line, Appearance.of(image, painted_from(view, line, row)))
        for row in (np.inf, np.mean([min(rows), max(rows)]), 0)
    )
    assert whole["paint_along"] == pytest.approx(5, abs=0.5)
    assert half["paint_along"] == pytest.approx(0, abs=1.5)
    assert none["paint_along"] == -5


def test_without_an_image_nothing_is_known(view):
    first, second = (appearance_along(view, straight(view, left), UNKNOWN) for left in (1.6, -2.0))
    assert first == second


def test_another_ground_on_the_other_side_makes_a_line_less_sure(view):
    line = straight(view, 1.6)
    foreground = painted_from(view, fine(line), np.inf)
    kerb, joint = (
        link_anchors(
            anchors_of(view, [line]),
            view,
            appearance=Appearance.of(beside(view, line, left, ASPHALT), foreground),
        )
        for left in (GRASS, ASPHALT)
    )
    assert max((lane.score for lane in kerb), default=0) < joint[0].score - 0.03


def test_paint_that_the_network_sees_along_it_makes_a_line_surer(view):
    line = fine(straight(view, 1.6))
    image = beside(view, line, ASPHALT, ASPHALT)
    painted, bare = (
        link_anchors(
            anchors_of(view, [line]), view, appearance=Appearance.of(image, painted_from(view, line, row))
        )
        for row in (np.inf, 0)
    )
    assert painted[0].score > max((lane.score for lane in bare), default=0) + 0.03
