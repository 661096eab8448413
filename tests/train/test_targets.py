"""The answers that the network is trained on, worked out by hand."""

import numpy as np
import pytest

from train.scenes.scenes import TrainingSample
from train.targets import (
    IGNORE,
    kind_target,
    kind_weight,
    lane_targets,
    paint_target,
    paint_weight,
    piece_size,
    targets,
)
from v2hdm.catalogue import PAINT_CLASSES


def test_a_block_is_paint_by_most_of_its_pixels_and_a_tie_is_ignored() -> None:
    labels = np.array([[1, 1, 0, 2], [1, 0, 2, 0], [0, 0, 3, 3], [0, 4, 3, 3]], dtype=np.uint8)
    assert paint_target(labels).tolist() == [[1, IGNORE], [0, 1]]


def test_the_paint_target_moves_no_edge() -> None:
    labels = np.zeros((64, 64), dtype=np.uint8)
    labels[:, 21:] = 1
    assert paint_target(labels)[0, 9:12].tolist() == [0, IGNORE, 1]


def test_a_cell_has_the_class_of_most_of_its_paint() -> None:
    labels = np.zeros((8, 8), dtype=np.uint8)
    labels[:4, :4] = 3
    labels[0, :3] = 1
    labels[4:, 4] = 2  # a quarter of the cell is too little paint to be asked for its class
    assert kind_target(labels).tolist() == [[2, IGNORE], [IGNORE, IGNORE]]
    assert kind_target(labels).max(initial=0, where=kind_target(labels) != IGNORE) < len(PAINT_CLASSES)


def test_a_piece_of_paint_counts_as_the_root_of_its_cells() -> None:
    kinds = np.full((8, 12), IGNORE, dtype=np.uint8)
    kinds[1:5, 1:5] = 3
    kinds[1:5, 5] = 0  # of another class, though it touches
    kinds[7, 10] = 3
    weight = kind_weight(piece_size(kinds))
    assert weight[kinds == IGNORE].max() == 0
    assert weight[1:5, 1:5].sum() == pytest.approx(4)
    assert weight[1:5, 5].sum() == pytest.approx(2)
    assert weight[7, 10] == 1
    assert not kind_weight(piece_size(np.full((4, 4), IGNORE, dtype=np.uint8))).any()


def test_small_pieces_and_what_is_around_them_weigh_more() -> None:
    kinds = np.full((40, 40), IGNORE, dtype=np.uint8)
    kinds[4:8, 4:8] = 0
    kinds[30, 10] = 2
    kinds[20:30, 20:30] = 1
    weight = paint_weight(piece_size(kinds))
    assert weight[5, 5] == weight[4, 2] == 2  # the root of 64 / 16
    assert weight[4, 1] == weight[25, 25] == 1, "far from paint, or in the paint of a near marking"
    assert weight[30, 10] == weight[32, 12] == 4, "no piece weighs more"
    assert (paint_weight(piece_size(np.full((4, 4), IGNORE, dtype=np.uint8))) == 1).all()


def test_a_line_crosses_each_row_anchor_in_one_cell() -> None:
    line = np.array([[10.0, 40.0], [42.0, -10.0]])
    there, offset = lane_targets([line], 32, 64)
    assert (there == 1).sum(axis=1).tolist() == [1, 1, 1, 1]
    for row in range(4):
        (column,) = np.flatnonzero(there[row] == 1)
        u = 8 * (column + offset[row, column]) + 3.5
        assert u == pytest.approx(10 + 32 * (40 - (8 * row + 3.5)) / 50, abs=1e-5)


def test_a_crossing_near_the_next_cell_leaves_that_one_open() -> None:
    there, offset = lane_targets([np.array([[15.3, 20.0], [15.3, -5.0]])], 16, 32)
    assert there.tolist() == [[0, 1, IGNORE, 0]] * 2
    assert offset[0, 1] == pytest.approx((15.3 + 0.5) / 8 - 1.5)


def test_a_line_along_the_row_anchors_asks_for_nothing() -> None:
    there, _ = lane_targets([np.array([[2.0, 5.0], [60.0, 2.0]])], 16, 64)
    assert 1 not in there
    assert IGNORE in there


def test_a_line_behind_a_box_may_be_found_or_not() -> None:
    hidden = np.zeros((32, 64), dtype=bool)
    hidden[:16] = True
    labels = np.zeros((32, 64), dtype=np.uint8)
    sample = TrainingSample(
        np.zeros((32, 64, 3), np.uint8), labels, hidden, (np.array([[30.0, 40.0], [30.0, -5.0]]),)
    )
    there = targets(sample).lane_there.numpy()
    assert (there[:, 3] == [IGNORE, IGNORE, 1, 1]).all()
