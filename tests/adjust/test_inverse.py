"""Diagonal tiles of the inverse are those of the inverse."""

import numpy as np
import pytest
import torch

from tests.adjust.site import site
from v2hdm.adjust import SolveOptions, solve
from v2hdm.adjust.inverse import inverse_diagonal


@pytest.fixture(scope="module")
def whitening():
    """The factors of two drives of one way."""
    return solve(site(2, 40, 10), SolveOptions(coarse=False)).covariance.whitening


def tiles_of(whole, factor):
    size = len(factor.diagonal[0])
    count = len(factor.diagonal)
    return torch.stack([whole[k * size : (k + 1) * size, k * size : (k + 1) * size] for k in range(count)])


def test_the_diagonal_follows_from_the_factor(whitening):
    factor = whitening.reduced_factor
    assert len(factor.diagonal) > 3
    root = factor.solve(torch.eye(factor.size, dtype=torch.float64))
    expected = tiles_of(root.mT @ root, factor)
    tiles = inverse_diagonal(factor, whitening.plan.pattern)
    np.testing.assert_allclose(tiles, expected, rtol=1e-9, atol=1e-9 * float(expected.max()))


def test_what_is_known_of_the_last_rows_reaches_all_others(whitening):
    """If the cameras are known twice as well, all others gain as by conditioning on a measurement of them."""
    factor = whitening.reduced_factor
    root = factor.solve(torch.eye(factor.size, dtype=torch.float64))
    whole = root.mT @ root
    tip = len(factor.tip)
    measured = whole[:, -tip:] @ torch.linalg.inv(2 * whole[-tip:, -tip:]) @ whole[-tip:, :]
    inverse = whole - measured
    tiles = inverse_diagonal(factor, whitening.plan.pattern, inverse[-tip:, -tip:])
    expected = tiles_of(inverse, factor)
    np.testing.assert_allclose(tiles, expected, rtol=1e-9, atol=1e-9 * float(expected.max()))
