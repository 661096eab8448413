"""Row anchors: lines come out whole, apart, in order, and numbered from the vehicle outwards."""

import numpy as np
import pytest

from tests.detection.pictures import make_camera, to_image
from v2hdm.detection.anchors import link_anchors
from v2hdm.detection.sight import AnchorRow
from v2hdm.detection.view import CameraView

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
    found = link_anchors(anchors_of(view, list(lines.values())), view)
    assert sorted(lane.identity for lane in found) == [-2, -1, 1, 2]
    for lane in found:
        true = lines[lane.identity]
        order = np.argsort(true[:, 1])
        u = np.interp(lane.points_px[:, 1], true[order, 1], true[order, 0])
        assert np.abs(u - lane.points_px[:, 0]).max() < 0.05
        assert (np.diff(lane.points_px[:, 1]) < 0).all(), "from near to far"
        assert lane.score > 0.9


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
    assert len(lane.points_px) == len(dashed)


def test_lines_that_run_side_by_side_are_not_joined_across_a_gap(view):
    near, far = straight(view, 1.6), straight(view, 3.2)
    rows = [
        row
        for line, part in ((near, lambda v: v > 230), (far, lambda v: v < 215))
        for row in anchors_of(view, [line])
        if part(row.v_px)
    ]
    assert len(link_anchors(rows, view)) == 2
