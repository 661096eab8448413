"""Where contrast is sampled: inside an outline, beside it, and on bare ground next to it."""

import numpy as np
import pytest

from v2hdm.site.contrast import places_aside, samples_of, usual_contrast

DASH = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 0.2], [0.0, 0.2]])
DIAMOND = np.array([[-0.6, 0.0], [0.0, -0.3], [0.6, 0.0], [0.0, 0.3]])


def test_samples_lie_within_an_outline_and_beside_it_at_their_distances():
    inside, beside = samples_of(DASH, (0.1, 0.25))
    assert len(inside) == 49
    assert (inside > [0.5, 0.03]).all()
    assert (inside < [2.5, 0.17]).all()
    off = np.maximum(np.maximum(-beside, beside - [3.0, 0.2]), 0.0).max(axis=1)
    assert set(np.round(off, 6)) == {0.1, 0.25}
    assert len(beside) == 2 * 4 * 7


def test_bare_places_lie_across_the_longest_extent():
    left, right = places_aside(DIAMOND[None])
    np.testing.assert_allclose(left - DIAMOND, [[0.0, -1.3]] * 4)
    np.testing.assert_allclose(right - DIAMOND, [[0.0, 1.3]] * 4)
    dash, _ = places_aside(DASH[None])
    assert np.linalg.norm(dash - DASH, axis=1) == pytest.approx(1.3)


def test_one_strange_place_does_not_change_what_is_usual():
    values = np.append(np.linspace(-0.1, 0.1, 41), 5.0)
    middle, sigma = usual_contrast(values)
    assert middle == pytest.approx(0.0, abs=0.01)
    assert sigma == pytest.approx(1.4826 * 0.05, rel=0.1)
    assert usual_contrast(np.zeros(9)).sigma == 0.02
