"""Row anchors: lines come out whole, apart, in order, and numbered from the vehicle outwards."""

import numpy as np
import pytest

from tests.detection.pictures import make_camera, to_image
from v2hdm.detection.anchors import link_anchors
from v2hdm.detection.view import CameraView

STRIDE = 8


def anchors_of(view: CameraView, lines_px: list[np.ndarray], hidden: slice = slice(0, 0)) -> np.ndarray:
    """What a perfect network says of lines (N, 2) near to far, except on the ``hidden`` rows."""
    rows, columns = view.height // STRIDE, view.info.width // STRIDE
    lanes = np.zeros((2, rows, columns), dtype=np.float32)
    lanes[0] = -5
    for line in lines_px:
        order = np.argsort(line[:, 1])
        v = STRIDE * np.arange(rows) + (STRIDE - 1) / 2 + view.top
        u = np.interp(v, line[order, 1], line[order, 0], left=np.nan, right=np.nan)
        cell = (u + 0.5) / STRIDE
        for row in np.flatnonzero((cell > 0) & (cell < columns)):
            column = int(cell[row])
            lanes[:, row, column] = 4, cell[row] - column - 0.5
            lanes[0, row, max(column - 1, 0)] = max(1, lanes[0, row, max(column - 1, 0)])
    lanes[0, hidden] = -5
    return lanes


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
    found = link_anchors(anchors_of(view, list(lines.values())), STRIDE, view)
    assert sorted(lane.identity for lane in found) == [-2, -1, 1, 2]
    for lane in found:
        true = lines[lane.identity]
        order = np.argsort(true[:, 1])
        u = np.interp(lane.points_px[:, 1], true[order, 1], true[order, 0])
        assert np.abs(u - lane.points_px[:, 0]).max() < 0.05
        assert (np.diff(lane.points_px[:, 1]) < 0).all(), "from near to far"
        assert lane.score > 0.9


def test_a_bend_stays_one_line(view):
    assert len(link_anchors(anchors_of(view, [straight(view, 1.6, 0.01)]), STRIDE, view)) == 1


def test_a_few_missing_rows_do_not_break_a_line(view):
    lanes = anchors_of(view, [straight(view, 1.6), straight(view, -1.6)], hidden=slice(20, 23))
    assert len(link_anchors(lanes, STRIDE, view)) == 2


def test_single_peaks_are_no_lines(view):
    lanes = anchors_of(view, [])
    lanes[0, ::9, 5] = 3.0
    assert link_anchors(lanes, STRIDE, view) == []
