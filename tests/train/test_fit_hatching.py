"""The fit of what tells hatched boxes from writing."""

import numpy as np
import pytest

from train.fit_hatching import Piece, fitted
from v2hdm.detection.hatching import box_probability

NAMED_TEXT = (80.0, 20.0)  # sums of the probability of text and of box over a piece


def pieces(weight, count=4000, seed=3):
    """Pieces whose meshes say as much as ``weight`` claims."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        text_cells, box_cells = rng.uniform(5, 100, 2)
        netted = float(rng.uniform(0, 1))
        is_box = bool(rng.random() < box_probability(text_cells, box_cells, netted, weight))
        out.append(Piece(text_cells, box_cells, netted, is_box))
    return out


@pytest.mark.parametrize("weight", [0.0, 2.0, 5.0])
def test_the_weight_that_made_pieces_is_fitted_to_them(weight):
    assert fitted(pieces(weight)) == pytest.approx(weight, abs=0.35)


def test_meshes_outweigh_a_name_and_their_absence_says_nothing():
    assert box_probability(*NAMED_TEXT, netted=1.0) > 0.5
    assert box_probability(*NAMED_TEXT, netted=0.0) == pytest.approx(0.2, abs=0.01)
