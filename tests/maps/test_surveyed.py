"""Surveyed points find their corners in a map that lies off by half the width of its paint, and more."""

from __future__ import annotations

import numpy as np
import pytest

from v2hdm.io.maps.surveyed import match
from v2hdm.records import FloatArray

DASH = np.array([[1.0, 0.06], [-1.0, 0.06], [-1.0, -0.06], [1.0, -0.06]])
DRIFT_M, OWN_M = 0.1, 0.01


def dashes(count: int = 12) -> FloatArray:
    """Corners (4 count, 2) of dashes 12 cm wide, every 6 m along x and along y by turns."""
    turned = [DASH if k % 2 else DASH[:, ::-1] for k in range(count)]
    return np.concatenate([one + np.array([6.0 * k, 0.0]) for k, one in enumerate(turned)])


def covariance(count: int, drift_m: float = DRIFT_M) -> FloatArray:
    return np.kron(np.full((count, count), drift_m**2) + OWN_M**2 * np.eye(count), np.eye(2))


def test_a_shift_by_more_than_half_a_dash_is_seen_through_and_the_nearest_corner_is_not() -> None:
    corners, rng, right, nearest = dashes(), np.random.default_rng(2), [], []
    for _ in range(50):
        chosen = 4 * rng.permutation(12)[:8] + rng.integers(4, size=8)
        shift = rng.uniform(0.07, 0.1) * np.array([np.cos(angle := rng.uniform(0, 6.3)), np.sin(angle)])
        points = corners[chosen] - shift + OWN_M * rng.standard_normal((8, 2))
        right.append((match(points, corners, 0.25, covariance(8)) == chosen).all())
        apart = np.linalg.norm(points[:, None] - corners, axis=-1)
        nearest.append((apart.argmin(axis=1) == chosen).all())
    assert np.mean(right) > 0.9
    assert np.mean(nearest) < 0.3


@pytest.mark.parametrize("drift_m", [0.0, DRIFT_M])
def test_a_point_that_is_off_is_matched_all_the_same_and_moves_no_other(drift_m: float) -> None:
    corners = dashes()
    chosen = np.array([0, 5, 10, 15, 20])
    points = corners[chosen].copy()
    points[3] += 0.2, 0.0
    found = match(points, corners, 0.25, covariance(5, drift_m))
    np.testing.assert_array_equal(found[[0, 1, 2, 4]], chosen[[0, 1, 2, 4]])
    assert found[3] >= 0


def test_no_corner_has_two_points_and_none_is_out_of_reach() -> None:
    corners = np.array([[0.0, 0.0], [9.0, 0.0]])
    points = np.array([[0.05, 0.0], [0.01, 0.0], [9.3, 0.0]])
    assert match(points, corners, 0.25, covariance(3, 0.0)).tolist() == [-1, 0, -1]
    assert match(points[:0], corners, 0.25, np.zeros((0, 0))).tolist() == []


def test_a_survey_of_another_datum_finds_its_corners_in_a_map_that_states_no_drift() -> None:
    corners, rng, right = dashes(), np.random.default_rng(6), []
    for _ in range(50):
        chosen = 4 * rng.permutation(12)[:8] + rng.integers(4, size=8)
        points = corners[chosen] - np.array([0.12, -0.12]) + OWN_M * rng.standard_normal((8, 2))
        right.append((match(points, corners, 0.25, covariance(8, 0.0)) == chosen).all())
    assert np.mean(right) > 0.9
