"""The shapes of a class."""

import numpy as np

from v2hdm.records import FloatArray
from v2hdm.site import shapes

_COUNT = 1300  # candidates, more than are compared at once


def _lengths_m() -> FloatArray:
    """Lengths (N, 4) of candidates: a third of them are of one stencil, the others of any size."""
    rng = np.random.default_rng(3)
    lengths_m = rng.uniform(0.3, 3.0, (_COUNT, 4))
    lengths_m[::3] = np.array([0.2, 1.5, 1.6, 1.6]) + rng.normal(0.0, 0.01, (len(lengths_m[::3]), 4))
    return lengths_m


def test_the_most_typical_candidate_of_thousands_is_that_of_all_pairs() -> None:
    lengths_m = _lengths_m()
    limit_m = np.maximum(shapes.MEMBER_M, 0.08 * lengths_m.max(axis=1))
    difference_m = np.abs(lengths_m[:, None] - lengths_m[None]).max(axis=2)
    expected = np.argmax((difference_m <= limit_m[:, None]).sum(axis=1) - difference_m.mean(axis=1) / limit_m)

    typical = shapes._most_typical(lengths_m, limit_m)

    assert typical == expected
    assert typical % 3 == 0


def test_one_candidate_alone_is_typical() -> None:
    assert shapes._most_typical(np.ones((1, 4)), np.ones(1)) == 0
