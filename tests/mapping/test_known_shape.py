"""A stencil laid on the corners that were seen."""

from __future__ import annotations

import numpy as np
import pytest

from v2hdm.mapping.association.groups import FusedGroups
from v2hdm.mapping.markings.completion import SolvedCorners
from v2hdm.mapping.markings.known_shape import fit_shape, with_known_shapes

DIAMOND = np.array([[0.6, 0.0], [0.0, 0.3], [-0.6, 0.0], [0.0, -0.3]])
SIGMA = np.full(4, 0.01)
OFTEN = np.full(4, 5)


def placed(turn: float = 0.7) -> np.ndarray:
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return DIAMOND @ rotation.T + [12.0, -3.0]


def covers(found: np.ndarray, true: np.ndarray) -> bool:
    return bool(np.linalg.norm(found[:, None] - true, axis=2).min(axis=1).max() < 1e-6)


@pytest.mark.parametrize("missing", [[0], [3], [1, 3], [0, 2], [2, 3]])
def test_three_corners_or_two_place_the_shape(missing: list[int]) -> None:
    seen = placed()
    seen[missing] = np.nan
    fit = fit_shape(DIAMOND, seen, SIGMA, OFTEN, placed())
    assert fit is not None
    assert covers(fit.corners_map, placed())
    assert (np.linalg.eigvalsh(fit.covariance) > 0).all()
    assert np.trace(fit.covariance) < 8 * 0.03**2


def test_two_neighbouring_corners_place_it_only_if_the_others_are_about_there() -> None:
    seen = placed()
    seen[[2, 3]] = np.nan
    along = placed()[1] - placed()[0]
    across = np.array([-along[1], along[0]])
    there = placed() + np.array([[0, 0], [0, 0], [0.15, -0.1], [-0.1, 0.15]])
    fit = fit_shape(DIAMOND, seen, SIGMA, OFTEN, there)
    assert fit is not None
    assert covers(fit.corners_map, placed())
    elsewhere = placed() + np.array([0, 0, -2, -2])[:, None] * across
    assert fit_shape(DIAMOND, seen, SIGMA, OFTEN, elsewhere) is None
    assert fit_shape(DIAMOND, seen, SIGMA, OFTEN, np.full((4, 2), np.nan)) is None


def test_one_wrong_corner_of_four_is_left_out() -> None:
    seen = placed()
    seen[1] += [0.3, 0.2]
    fit = fit_shape(DIAMOND, seen, SIGMA, OFTEN, placed())
    assert fit is not None
    assert covers(fit.corners_map, placed())


def test_corners_of_something_else_do_not_fit() -> None:
    assert fit_shape(DIAMOND, 1.4 * placed(), SIGMA, OFTEN, placed()) is None
    seen = placed()
    seen[[0, 2]] = 1.25 * (seen[[0, 2]] - seen.mean(axis=0)) + seen.mean(axis=0)
    seen[[1, 3]] = np.nan
    assert fit_shape(DIAMOND, seen, SIGMA, OFTEN, placed()) is None


def test_a_class_lends_its_shape_and_a_class_of_many_shapes_does_not() -> None:
    corners = placed() + np.arange(12)[:, None, None] * [4.0, 0.0]
    seen = corners.copy()
    seen[11, [1, 2]] = np.nan
    seen[11, 2] = corners[11, 2]
    solved = SolvedCorners(corners.copy(), np.tile(1e-4 * np.eye(8), (12, 1, 1)), np.zeros(12, dtype=bool))
    solved.corners_map[11] = np.nan
    fused = FusedGroups(seen, np.tile(1e-4 * np.eye(2), (12, 4, 1, 1)), np.full((12, 4), 3))
    kind, accepted = np.zeros(12, dtype=np.int64), np.arange(11)
    found = with_known_shapes(solved, fused, corners, np.array([11]), kind, accepted)
    assert covers(found.corners_map[11], corners[11])
    assert found.completed.tolist() == [False] * 11 + [True]
    solved.corners_map[:11] *= 1.2 ** np.arange(11)[:, None, None]
    found = with_known_shapes(solved, fused, corners, np.array([11]), kind, accepted)
    assert np.isnan(found.corners_map[11]).all()


def test_a_shape_is_not_laid_on_what_one_image_shows() -> None:
    seen = placed()
    seen[1] = np.nan
    assert fit_shape(DIAMOND, seen, SIGMA, np.array([2, 0, 1, 1]), placed()) is None


@pytest.mark.parametrize(("times", "placed_by_two"), [(3, False), (4, True)])
def test_two_corners_must_have_been_seen_oftener_than_three(times: int, placed_by_two: bool) -> None:
    seen = placed()
    seen[[2, 3]] = np.nan
    fit = fit_shape(DIAMOND, seen, SIGMA, np.full(4, times), placed())
    assert (fit is not None) == placed_by_two
    seen = placed()
    seen[3] = np.nan
    assert fit_shape(DIAMOND, seen, SIGMA, np.full(4, 3), placed()) is not None
