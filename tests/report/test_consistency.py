"""Stated sigmas against errors whose size is known."""

from dataclasses import replace

import numpy as np
import pytest

from v2hdm.records import Marking
from v2hdm.report.consistency import consistency_of

SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


def row(count, relative_sigma_m, covariance_m2):
    """Squares 8 m apart."""
    return [
        Marking("diamond", SQUARE + np.array([8.0 * k, 0.0]), 5, covariance_m2, relative_sigma_m)
        for k in range(count)
    ]


def moved(markings, offsets):
    return [
        replace(m, corners_map=m.corners_map + offset) for m, offset in zip(markings, offsets, strict=True)
    ]


def test_what_all_markings_share_is_an_error_of_place_and_not_beside_neighbours():
    true = row(400, 0.001, 1e-4 * np.eye(8))
    shared = consistency_of(moved(true, np.full((400, 2), 0.01)), true)
    assert shared.place == pytest.approx(4.0, rel=1e-6)
    assert shared.beside == pytest.approx(0.0, abs=1e-6)
    assert shared.shape == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("factor", "nees"), [(1.0, 1.0), (2.0, 0.25)])
def test_scatter_of_its_stated_size_has_a_nees_of_one_beside_neighbours(factor, nees):
    rng = np.random.default_rng(2)
    true = row(2000, 0.003 * factor, (0.006 * factor) ** 2 * np.eye(8))
    stated = consistency_of(moved(true, rng.normal(0.0, 0.003, (2000, 2))), true)
    assert stated.place == pytest.approx(nees, rel=0.08)
    assert stated.beside == pytest.approx(nees, rel=0.08)


def test_a_covariance_belongs_to_its_corner_whichever_comes_first():
    sigmas_m = np.repeat([0.01, 0.02, 0.03, 0.04], 2)
    (true,) = row(1, None, None)
    off = SQUARE * sigmas_m.reshape(4, 2)
    marking = replace(true, corners_map=SQUARE + off, covariance_m2=np.diag(sigmas_m**2))
    turned = replace(
        marking,
        corners_map=np.roll(marking.corners_map, 1, axis=0),
        covariance_m2=np.diag(np.roll(sigmas_m, 2) ** 2),
    )
    first, second = (consistency_of([m], [true]) for m in (marking, turned))
    assert second.shape == pytest.approx(first.shape)
    assert second.nees == pytest.approx(first.nees)
    assert first.nees == pytest.approx(0.25)


def test_a_neighbour_that_is_known_badly_is_not_held_against_a_marking():
    true = row(3, 0.001, 1e-4 * np.eye(8))
    true[1] = replace(true[1], relative_sigma_m=0.2)
    stated = consistency_of(moved(true, [[0.0, 0.0], [0.2, 0.0], [0.0, 0.0]]), true)
    assert stated.beside < 0.6


def test_without_markings_nothing_is_told():
    stated = consistency_of([], [])
    assert stated.corners == 0
    assert np.isnan([stated.nees, stated.inside_95, stated.place, stated.beside, stated.shape]).all()
