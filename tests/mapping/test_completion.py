"""Three corners of a parallelogram imply the fourth, and its covariance."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.markings.completion import (
    SolvedCorners,
    complete_corners,
    solved_corners,
    without_misplaced_corners,
)
from v2hdm.mapping.options import AcceptanceOptions

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
        observation_factor=0.8,
        corner_covariance=lambda groups: np.tile(1e-4 * np.eye(2 * groups.shape[1]), (len(groups), 1, 1)),
    )
    bundle = SimpleNamespace(corner_index=index, corners_map=corners, solution=solution)
    solved = solved_corners(cast(Bundle, bundle))
    variance = np.diag(solved.covariance_m2[0]).reshape(4, 2)
    expected = np.full((4, 2), 1e-4)
    expected[missing] = 3e-4
    np.testing.assert_allclose(variance, expected)
    assert solved.completed.tolist() == [True]


def twelve_diamonds() -> SolvedCorners:
    """Diamonds of one shape, turned this way and that, each corner known to a centimetre."""
    turn = np.linspace(0, 3, 12)
    rotation = np.stack([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]).transpose(2, 0, 1)
    shape = np.array([[0.6, 0.0], [0.0, 0.3], [-0.6, 0.0], [0.0, -0.3]])
    corners = np.einsum("gij,kj->gki", rotation, shape) + np.arange(12)[:, None, None] * [4.0, 1.0]
    return SolvedCorners(corners, np.tile(1e-4 * np.eye(8), (12, 1, 1)), np.zeros(12, dtype=bool))


def mended(solved: SolvedCorners, odd: list[int]) -> SolvedCorners:
    accepted = np.setdiff1d(np.arange(12), odd)
    kind = np.zeros(12, dtype=np.int64)
    return without_misplaced_corners(solved, np.array(odd), kind, accepted, AcceptanceOptions())


@pytest.mark.parametrize("corner", range(4))
def test_a_corner_that_a_shadow_moved_is_put_back(corner: int) -> None:
    true = twelve_diamonds()
    seen = twelve_diamonds()
    seen.corners_map[5, corner] += [0.2, 0.25]
    found = mended(seen, [5])
    np.testing.assert_allclose(found.corners_map, true.corners_map, atol=1e-12)
    assert found.completed.tolist() == [group == 5 for group in range(12)]
    variance = np.diagonal(found.covariance_m2[5]).reshape(4, 2).sum(axis=1)
    expected = np.full(4, 2e-4)
    expected[corner] = 6e-4
    np.testing.assert_allclose(variance, expected)


def test_two_misplaced_corners_are_beyond_repair() -> None:
    seen = twelve_diamonds()
    seen.corners_map[5, :2] += [0.2, 0.35]
    found = mended(seen, [5])
    np.testing.assert_array_equal(found.corners_map, seen.corners_map)
    assert not found.completed.any()
