"""The count of hidden ends is checked on a flat road with a dash whose ends are known to be in view."""

import numpy as np

from tests.benchmarks.hidden_ends import called_hidden, visible_ends
from tests.benchmarks.real_reference import Painted
from tests.benchmarks.test_real_drive import VIEW, dash, whole
from v2hdm.detection.quads.fit import OPEN_SIGMA
from v2hdm.records import LANE_DASH, MarkingDetection


def detected(polygon_map, open_corners=(), share=1.0):
    """A dash's detection, some corners of which are open along it, by a share of an open end's sigma."""
    corners_px = VIEW.project(polygon_map)
    along = corners_px[1] - corners_px[0]
    covariance = np.eye(8)
    for k in open_corners:
        covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += (share * OPEN_SIGMA) ** 2 * np.outer(along, along)
    return MarkingDetection(LANE_DASH, 0.9, corners_px, covariance, np.ones(4, dtype=np.bool_))


def ends_of(*detections, hidden=(), x=8.0):
    reference = whole(Painted(LANE_DASH, dash(x)))
    return list(visible_ends(VIEW, reference, list(hidden), detections))


def test_an_end_is_called_hidden_if_the_detection_leaves_it_open_along_the_dash():
    assert called_hidden(detected(dash(8.0))) == (False, False)
    assert sorted(called_hidden(detected(dash(8.0), (1, 2)))) == [False, True]
    assert called_hidden(detected(dash(8.0), (0, 1, 2, 3))) == (True, True)
    assert called_hidden(detected(dash(8.0), (1, 2), share=0.1)) == (False, False)


def test_it_is_the_same_end_whichever_corner_comes_first():
    for shift in range(4):
        order = np.roll(np.arange(4), shift)
        whole_dash = detected(dash(8.0), (1, 2))
        rows = (2 * order[:, None] + np.arange(2)).ravel()
        turned = MarkingDetection(
            LANE_DASH,
            0.9,
            whole_dash.corners_px[order],
            whole_dash.covariance_px[np.ix_(rows, rows)],
            np.ones(4, dtype=np.bool_),
        )
        assert sorted(called_hidden(turned)) == [False, True]


def test_both_ends_count_of_a_dash_that_an_image_shows_and_the_detector_finds():
    assert ends_of(detected(dash(8.0))) == [False, False]
    assert sorted(ends_of(detected(dash(8.0), (0, 3)))) == [False, True]


def test_no_end_counts_of_a_dash_that_was_missed_or_is_hidden_or_far():
    assert ends_of() == []
    assert ends_of(detected(dash(14.0))) == []
    assert ends_of(detected(dash(8.0)), hidden=[np.array([0.0, 0.0, 1200.0, 600.0])]) == []
    assert ends_of(detected(dash(30.0)), x=30.0) == []
