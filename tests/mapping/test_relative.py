"""How sure markings are beside one another, without what moves all of them."""

from __future__ import annotations

import numpy as np
import pytest

from v2hdm.records import FloatArray, Marking
from v2hdm.site.markings import neighbours, with_relative_sigma

SQUARE = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])
DRIFT_M, CORNER_M, PAINT_M = 0.05, 0.002, 0.006


def covariance_of(corners: int) -> FloatArray:
    """Corners of 2 mm each that a drift of 5 cm moves together."""
    return DRIFT_M**2 * np.kron(np.ones((corners, corners)), np.eye(2)) + CORNER_M**2 * np.eye(2 * corners)


def joint(pairs: np.ndarray) -> FloatArray:
    return np.tile(covariance_of(4), (len(pairs), 1, 1))


def street(spacing_m: float, paint_m: float = 0.0) -> list[Marking]:
    own = covariance_of(4) + paint_m**2 * np.eye(8)
    return [Marking("diamond", SQUARE + np.array([spacing_m * k, 0.0]), 9, own) for k in range(5)]


def test_a_drift_that_markings_share_is_no_part_of_what_they_contribute() -> None:
    index = np.arange(20).reshape(5, 4)
    for marking in with_relative_sigma(street(5.0), index, joint):
        # Two corners of either marking stand for its centre.
        assert marking.relative_sigma_m == pytest.approx(CORNER_M / np.sqrt(2))


def test_errors_of_the_paint_are_a_markings_own() -> None:
    index = np.arange(20).reshape(5, 4)
    for marking in with_relative_sigma(street(5.0, PAINT_M), index, joint):
        assert marking.relative_sigma_m == pytest.approx(np.hypot(CORNER_M, PAINT_M) / 2)


def test_nothing_is_said_of_a_marking_alone_or_unseen() -> None:
    index = np.arange(20).reshape(5, 4)
    assert all(m.relative_sigma_m is None for m in with_relative_sigma(street(40.0), index, joint))
    index[2] = -1
    found = with_relative_sigma(street(5.0), index, joint)
    assert [m.relative_sigma_m is None for m in found] == [False, False, True, False, False]


def test_the_neighbour_is_the_one_nearest_to_ten_metres() -> None:
    first, second = neighbours(np.array([[0.0, 0.0], [3.0, 0.0], [9.0, 0.0], [14.0, 0.0], [60.0, 0.0]]))
    assert first.tolist() == [0, 1, 2, 3]
    assert second.tolist() == [2, 3, 0, 1]
