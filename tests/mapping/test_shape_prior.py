"""What a class has in common mends what one of its markings was seen to be."""

from __future__ import annotations

import numpy as np
import pytest

from v2hdm.mapping.markings.completion import SolvedCorners
from v2hdm.mapping.markings.paint_error import PaintError
from v2hdm.mapping.markings.shape_prior import common_shape, fuse, with_class_shapes, without_guessed_lengths

DIAMOND = np.array([[0.6, 0.0], [0.0, 0.35], [-0.6, 0.0], [0.0, -0.35]])
DASH = np.array([[1.0, 0.06], [-1.0, 0.06], [-1.0, -0.06], [1.0, -0.06]])
SIGMA_M = 0.02


def painted(shape: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Markings (N, 4, 2) of one shape, anywhere, turned any way, beginning with any corner."""
    turn, centre = rng.uniform(0, 2 * np.pi, count), rng.uniform(-50, 50, (count, 1, 2))
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]).transpose(2, 0, 1)
    placed = shape @ rotation.transpose(0, 2, 1) + centre
    return np.stack([np.roll(one, int(rng.integers(4)), axis=0) for one in placed])


def seen(true: np.ndarray, rng: np.random.Generator, sigma_m: float = SIGMA_M) -> SolvedCorners:
    """The markings as a drive would map them: each corner off by ``sigma_m``, all of it by 2 cm more."""
    count = len(true)
    shift = 0.02 * rng.standard_normal((count, 1, 2))
    corners = true + shift + sigma_m * rng.standard_normal(true.shape)
    block = sigma_m**2 * np.eye(8) + 0.02**2 * np.kron(np.ones((4, 4)), np.eye(2))
    return SolvedCorners(corners, np.tile(block, (count, 1, 1)), np.zeros(count, dtype=bool))


def shape_rmse(corners: np.ndarray, true: np.ndarray) -> float:
    """Root mean square distance of corners, common shifts of a marking taken out."""
    error = corners - true
    return float(np.sqrt(np.mean(np.sum((error - error.mean(axis=1, keepdims=True)) ** 2, axis=2))))


@pytest.mark.parametrize("shape", [DIAMOND, DASH])
def test_markings_of_one_stencil_lend_one_another_their_accuracy(shape: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    true = painted(shape, 60, rng)
    solved = seen(true, rng)
    fused = with_class_shapes(solved, np.zeros(60, dtype=np.int64), np.arange(60))
    # Of the six shape directions beside the centre five are known up to 1 cm.
    assert shape_rmse(fused.corners_map, true) < 0.7 * shape_rmse(solved.corners_map, true)
    error = (fused.corners_map - true).reshape(60, 8)
    nees = np.einsum("na,nab,nb->n", error, np.linalg.inv(fused.covariance_m2), error)
    assert nees.mean() / 8 < 1.1


def test_a_corner_taken_for_another_edge_is_put_where_the_shape_has_it() -> None:
    rng = np.random.default_rng(1)
    true = painted(DASH, 40, rng)
    solved = seen(true, rng, 0.01)
    solved.corners_map[7, 2] += 0.4 * (true[7, 2] - true[7].mean(axis=0))
    fused = with_class_shapes(solved, np.zeros(40, dtype=np.int64), np.arange(40))
    assert np.linalg.norm(fused.corners_map[7] - true[7], axis=1).max() < 0.06


def test_a_dash_of_another_length_keeps_it() -> None:
    rng = np.random.default_rng(2)
    true = painted(DASH, 40, rng)
    true[5] = painted(DASH * [0.8, 1.0], 1, rng)[0]
    solved = seen(true, rng, 0.01)
    fused = with_class_shapes(solved, np.zeros(40, dtype=np.int64), np.arange(40))
    assert shape_rmse(fused.corners_map[5:6], true[5:6]) <= shape_rmse(solved.corners_map[5:6], true[5:6])
    side = np.linalg.norm(np.diff(fused.corners_map[5], axis=0), axis=1).max()
    assert side == pytest.approx(1.6, abs=0.03)


def test_a_class_of_many_shapes_is_left_as_it_was_seen_but_for_being_parallelograms() -> None:
    rng = np.random.default_rng(3)
    true = np.concatenate([painted(DIAMOND * rng.uniform(0.5, 2.0), 1, rng) for _ in range(30)])
    solved = seen(true, rng)
    assert common_shape(solved.corners_map, solved.covariance_m2) is None
    fused = with_class_shapes(solved, np.zeros(30, dtype=np.int64), np.arange(30))
    closure = (
        fused.corners_map[:, 0] - fused.corners_map[:, 1] + fused.corners_map[:, 2] - fused.corners_map[:, 3]
    )
    assert np.abs(closure).max() < 0.1
    assert shape_rmse(fused.corners_map, true) < shape_rmse(solved.corners_map, true)


def test_paint_that_differs_is_not_made_equal() -> None:
    """Where markings of a class differ by more than they are uncertain, they stay as they are."""
    rng = np.random.default_rng(4)
    true = painted(DIAMOND, 80, rng) + 0.015 * rng.standard_normal((80, 4, 2))
    solved = seen(true, rng, 0.004)
    shape = common_shape(solved.corners_map, solved.covariance_m2)
    assert shape is not None
    assert shape.sigma_m == pytest.approx(0.015, rel=0.2)
    fused = with_class_shapes(solved, np.zeros(80, dtype=np.int64), np.arange(80))
    assert shape_rmse(fused.corners_map, true) < 1.2 * shape_rmse(solved.corners_map, true)


def test_what_fits_no_hypothesis_is_left_where_it_was_and_said_to_be_uncertain() -> None:
    rng = np.random.default_rng(5)
    true = painted(DIAMOND, 30, rng)
    solved = seen(true, rng, 0.005)
    shape = common_shape(solved.corners_map, solved.covariance_m2)
    odd = solved.corners_map[0] * 1.3
    fused, covariance = fuse(odd, solved.covariance_m2[0], shape, PaintError(0.001, 3.0))
    np.testing.assert_array_equal(fused, odd)
    assert np.trace(covariance) > 10 * np.trace(solved.covariance_m2[0])


@pytest.mark.parametrize("lengths", [(1.0,), (1.0, 0.8)])
def test_one_end_says_where_the_other_is_only_in_a_class_of_one_length(lengths: tuple[float, ...]) -> None:
    rng = np.random.default_rng(6)
    true = np.concatenate([painted(DASH * [lengths[k % len(lengths)], 1.0], 1, rng) for k in range(20)])
    placed = seen(true, rng, 0.005)
    before = SolvedCorners(placed.corners_map.copy(), placed.covariance_m2, placed.completed)
    one_end = np.argsort(np.linalg.norm(true[0] - true[0, 0], axis=1))[:2]
    before.corners_map[0] = np.nan
    seen_map = placed.corners_map.copy()
    seen_map[0, np.setdiff1d(np.arange(4), one_end)] = np.nan
    kept = without_guessed_lengths(before, placed, seen_map, np.zeros(20, dtype=np.int64), np.arange(1, 20))
    assert np.isfinite(kept.corners_map[0]).all() == (len(lengths) == 1)
    np.testing.assert_array_equal(kept.corners_map[1:], placed.corners_map[1:])
