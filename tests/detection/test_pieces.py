"""Pieces of paint that are joined, completed and parted."""

import numpy as np

from tests.detection.test_shapes import sight_of
from v2hdm.detection.paint.blobs import Blob, find_blobs
from v2hdm.detection.sight import Sight
from v2hdm.records import PAINT_CLASSES

DIAMOND = 1 + PAINT_CLASSES.index("diamond")


def blobs_of(labels: np.ndarray, odds: list[tuple[slice, slice, float]]) -> list[Blob]:
    """Blobs of a confident network that is less so in some parts of the picture (rows, columns)."""
    sight = sight_of(labels)
    for rows, columns, value in odds:
        sight.paint[rows, columns] = value
    return find_blobs(Sight(sight.paint, sight.kinds, []), PAINT_CLASSES, 2, 0)[0]


def test_a_marking_that_a_doubtful_strip_parts_is_one():
    labels = np.zeros((40, 60), dtype=int)
    labels[10:30, 10:50] = DIAMOND
    (blob,) = blobs_of(labels, [(slice(10, 30), slice(28, 33), -1.0)])
    np.testing.assert_allclose(np.ptp(blob.outline_px, axis=0), [80, 40], atol=3)


def test_markings_that_only_a_doubtful_bridge_joins_stay_two():
    labels = np.zeros((40, 60), dtype=int)
    labels[5:15, 5:25] = labels[25:35, 35:55] = DIAMOND
    blobs = blobs_of(labels, [(slice(10, 30), slice(24, 36), -1.0)])
    assert len(blobs) == 2


def test_a_marking_whose_larger_part_is_doubtful_is_completed():
    labels = np.zeros((40, 60), dtype=int)
    labels[10:30, 10:50] = DIAMOND
    (blob,) = blobs_of(labels, [(slice(10, 30), slice(26, 50), -1.0)])
    assert np.ptp(blob.outline_px[:, 0]) > 75


def test_a_speck_of_paint_in_a_doubtful_field_stays_a_speck():
    labels = np.zeros((40, 60), dtype=int)
    labels[18:22, 28:33] = DIAMOND
    odds = [(slice(5, 35), slice(5, 55), -1.0), (slice(18, 22), slice(28, 33), 5.0)]
    (blob,) = blobs_of(labels, odds)
    assert np.ptp(blob.outline_px[:, 0]) < 14


def test_markings_that_run_into_each_other_come_apart_where_the_network_is_less_sure():
    labels = np.zeros((60, 60), dtype=int)
    labels[5:25, 5:25] = labels[30:55, 30:55] = DIAMOND
    labels[22:34, 22:34] = DIAMOND
    bridge = [(slice(25, 30), slice(22, 34), 1.0), (slice(22, 34), slice(25, 30), 1.0)]
    blobs = blobs_of(labels, bridge)
    sizes = sorted(float(np.ptp(blob.outline_px[:, 0])) for blob in blobs)[-2:]
    assert len(blobs) >= 2
    assert sizes[1] < 66, "neither spans both"


def test_sure_pieces_are_left_as_they_are():
    labels = np.zeros((40, 60), dtype=int)
    labels[10:30, 5:25] = labels[10:30, 35:55] = DIAMOND
    sight = sight_of(labels)
    blobs, owner = find_blobs(sight, PAINT_CLASSES, 2, 0)
    assert len(blobs) == 2
    np.testing.assert_array_equal(owner > 0, labels > 0)
