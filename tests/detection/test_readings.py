"""Paint read at other log odds: only what that changes is found again."""

import numpy as np

from tests.detection.test_shapes import sight_of
from v2hdm.detection.paint.blobs import Reading, find_blobs
from v2hdm.detection.sight import Sight
from v2hdm.records import PAINT_CLASSES

DIAMOND = 1 + PAINT_CLASSES.index("diamond")


def two_and_one() -> Sight:
    """Two diamonds that paint of log odds 0.6 joins, and a sure one far from them."""
    labels = np.zeros((60, 100), dtype=int)
    labels[5:25, 5:25] = labels[5:25, 29:49] = labels[20:24, 25:29] = DIAMOND
    labels[30:50, 70:95] = DIAMOND
    sight = sight_of(labels)
    sight.paint[20:24, 25:29] = 0.6
    return sight


def read_further(sight: Sight, odds: float) -> Reading:
    first = find_blobs(sight, PAINT_CLASSES, 2, 0)
    return find_blobs(sight, PAINT_CLASSES, 2, 0, 0, odds, first)


def test_what_runs_together_comes_apart_at_higher_odds_and_the_rest_is_not_told_again() -> None:
    blobs, owner, _ = read_further(two_and_one(), 1.0)
    assert len(blobs) == 2
    left, right = sorted(float(blob.outline_px[:, 0].mean()) for blob in blobs)
    assert abs(left - 2 * 14.5) < 2
    assert abs(right - 2 * 38.5) < 2
    assert set(np.unique(owner[5:25, 5:49])) == {0, 1, 2}
    assert not owner[30:50, 70:95].any(), "the sure one is the same at all odds"


def test_the_outline_is_where_the_network_says_those_odds() -> None:
    sight = two_and_one()
    sight.paint[5:25, 5:25] = np.linspace(3.0, -1.0, 20)[:, None]
    blobs, *_ = read_further(sight, 1.0)
    lowest = min(blobs, key=lambda blob: float(blob.outline_px[:, 0].mean()))
    expected = 2 * (5 + 2.0 / 4.0 * 19) + 0.5
    assert abs(float(lowest.outline_px[:, 1].max()) - expected) < 0.5


def test_what_is_doubtful_is_found_at_lower_odds_only() -> None:
    sight = two_and_one()
    sight.paint[30:50, 70:95] = -0.5
    assert len(find_blobs(sight, PAINT_CLASSES, 2, 0)[0]) == 1
    (found,), owner, _ = read_further(sight, -1.0)
    np.testing.assert_allclose(np.ptp(found.outline_px, axis=0), [50, 40], atol=3)
    assert owner[40, 80] == 1


def test_nothing_new_is_nothing() -> None:
    empty = sight_of(np.zeros((60, 100), dtype=int))
    for sight, odds in ((empty, 1.0), (empty, -1.0), (two_and_one(), 0.1)):
        blobs, owner, _ = read_further(sight, odds)
        assert blobs == []
        assert not owner.any()


def test_a_piece_that_was_split_by_its_classes_is_not_split_again() -> None:
    labels = np.zeros((60, 100), dtype=int)
    labels[10:30, 10:40] = DIAMOND
    labels[10:16, 40:90] = 1 + PAINT_CLASSES.index("lane_line")
    sight = sight_of(labels)
    assert len(find_blobs(sight, PAINT_CLASSES, 2, 0).blobs) == 2
    assert read_further(sight, 1.0).blobs == []
