"""Three corners of a parallelogram imply the fourth, and its covariance."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.completion import complete_corners, solved_corners

DASH = np.array([[1.5, -0.075], [1.5, 0.075], [-1.5, 0.075], [-1.5, -0.075]])


@pytest.mark.parametrize("missing", range(4))
def test_any_single_missing_corner_of_a_dash_is_completed(missing: int) -> None:
    seen = DASH.copy()
    seen[missing] = np.nan
    np.testing.assert_allclose(complete_corners(seen[None])[0], DASH)


def test_two_missing_corners_stay_missing() -> None:
    seen = DASH.copy()
    seen[:2] = np.nan
    np.testing.assert_array_equal(complete_corners(seen[None])[0], seen)


@pytest.mark.parametrize("missing", range(4))
def test_the_implied_corner_has_three_times_the_variance_of_independent_ones(missing: int) -> None:
    index = np.arange(4)[None].copy()
    index[0, missing] = -1
    corners = DASH[None].copy()
    corners[0, missing] = np.nan
    solution = SimpleNamespace(
        chi2_per_dof=0.8,
        corner_covariance=lambda groups: np.tile(1e-4 * np.eye(2 * groups.shape[1]), (len(groups), 1, 1)),
    )
    bundle = SimpleNamespace(corner_index=index, corners_map=corners, solution=solution)
    solved = solved_corners(cast(Bundle, bundle))
    variance = np.diag(solved.covariance_m2[0]).reshape(4, 2)
    expected = np.full((4, 2), 1e-4)
    expected[missing] = 3e-4
    np.testing.assert_allclose(variance, expected)
    assert solved.completed.tolist() == [True]
