"""Polygons in the plane."""

import numpy as np

from v2hdm.geometry.planar import are_simple, inverse_2x2, is_simple


def test_quadrilaterals_are_simple_all_at_once_as_each_is_alone():
    rng = np.random.default_rng(5)
    quads = rng.normal(size=(300, 4, 2))
    together = are_simple(quads)
    assert together.tolist() == [is_simple(quad) for quad in quads]
    assert 0 < together.sum() < 300
    assert are_simple(np.zeros((0, 4, 2))).shape == (0,)


def test_small_inverses_are_those_of_numpy():
    matrices = np.random.default_rng(6).normal(size=(50, 3, 2, 2))
    np.testing.assert_allclose(inverse_2x2(matrices), np.linalg.inv(matrices), rtol=1e-9)
