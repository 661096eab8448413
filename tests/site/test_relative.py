"""Sigmas of markings beside their neighbours."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from v2hdm.records import Marking
from v2hdm.site.relative import neighbours, with_relative_sigma

SQUARE = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])
DRIFT_M, CORNER_M, PAINT_M = 0.05, 0.002, 0.006
INDEX = np.arange(20).reshape(5, 4)


def covariance_of(own_m):
    """Corners with these own sigmas (N,), which a drift of 5 cm moves together."""
    shared = np.full((len(own_m), len(own_m)), DRIFT_M**2)
    return np.kron(shared + np.diag(np.square(own_m)), np.eye(2))


def joint_of(covariance_m2):
    """The joint covariances of a solution whose covariance (2 N, 2 N) of all corners this is."""

    def joint(groups):
        rows = (2 * groups[..., None] + np.arange(2)).reshape(len(groups), -1)
        return covariance_m2[rows[:, :, None], rows[:, None, :]]

    return joint


def street(own_m, spacing_m=5.0, paint_m=0.0):
    """Five markings, and their solution's covariance; sigmas ``own_m`` (5,) of each one's corners."""
    formal_m2 = covariance_of(np.repeat(own_m, 4))
    markings = [
        Marking(
            "diamond",
            SQUARE + np.array([spacing_m * k, 0.0]),
            9,
            formal_m2[8 * k : 8 * k + 8, 8 * k : 8 * k + 8] + paint_m**2 * np.eye(8),
        )
        for k in range(5)
    ]
    return markings, joint_of(formal_m2)


def relative_m(markings, joint, index=INDEX):
    return [marking.relative_sigma_m for marking in with_relative_sigma(markings, index, joint)]


def centre_sigma_m(marking):
    return np.sqrt(np.einsum("iaja->", marking.covariance_m2.reshape(4, 2, 4, 2)) / 32)


def test_a_drift_that_markings_share_is_no_part_of_it_but_the_neighbours_errors_are():
    markings, joint = street(np.full(5, CORNER_M))
    own_m2 = CORNER_M**2 / 4  # of a centre; the first marking has three neighbours, the third four
    found_m = relative_m(markings, joint)
    assert found_m[0] == pytest.approx(np.sqrt(own_m2 * (1 + 1 / 3)), rel=1e-3)
    assert found_m[2] == pytest.approx(np.sqrt(own_m2 * (1 + 1 / 4)), rel=1e-3)


def test_errors_of_the_paint_are_a_markings_own():
    markings, joint = street(np.full(5, CORNER_M), paint_m=PAINT_M)
    own_m = np.sqrt(centre_sigma_m(markings[2]) ** 2 - DRIFT_M**2)
    assert relative_m(markings, joint)[2] == pytest.approx(own_m * np.sqrt(1 + 1 / 4), rel=0.01)


def test_a_badly_known_neighbour_makes_no_marking_worse_known():
    sound_m = relative_m(*street(np.full(5, CORNER_M)))
    found_m = relative_m(*street(np.array([CORNER_M, CORNER_M, 0.3, CORNER_M, CORNER_M])))
    assert found_m[2] == pytest.approx(0.3 / 2, rel=0.05)
    assert np.delete(found_m, 2) == pytest.approx(np.delete(sound_m, 2), rel=0.1)


def test_what_a_class_tells_of_a_marking_counts_although_the_solution_does_not_know_it():
    """A dash's end that no image shows well: its class's length places it."""
    own_m = np.full(20, CORNER_M)
    own_m[8:10] = 0.4
    formal_m2 = covariance_of(own_m)
    markings, _ = street(np.full(5, CORNER_M))
    of_marking = slice(16, 24)
    # All but the place of the four corners together is known to a tenth of a millimetre.
    shape = np.eye(8) - np.kron(np.full((4, 4), 1 / 4), np.eye(2))
    of_shape = np.linalg.inv(formal_m2[of_marking, of_marking]) + shape / 1e-4**2
    markings[2] = replace(markings[2], covariance_m2=np.linalg.inv(of_shape))
    found_m = relative_m(markings, joint_of(formal_m2))
    # Two corners place it.
    assert found_m[2] == pytest.approx(np.sqrt(CORNER_M**2 / 2 + CORNER_M**2 / 16), rel=0.02)
    assert centre_sigma_m(markings[2]) == pytest.approx(DRIFT_M, rel=0.01)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.001, 100.0))
def test_no_marking_is_known_worse_beside_its_neighbours_than_in_the_map(seed, stated_over_formal):
    rng = np.random.default_rng(seed)
    scale_m = 10 ** rng.uniform(-3, 0, 40)
    root = scale_m[:, None] * rng.normal(size=(40, 40))
    formal_m2 = root @ root.T + 1e-8 * np.eye(40)
    roots = scale_m.reshape(5, 8, 1) * rng.normal(size=(5, 8, 8)) * np.sqrt(stated_over_formal)
    markings = [
        Marking("dash", SQUARE + rng.uniform(-6, 6, 2), 9, root @ root.T + 1e-8 * np.eye(8)) for root in roots
    ]
    for marking, sigma_m in zip(markings, relative_m(markings, joint_of(formal_m2)), strict=True):
        assert sigma_m is None or 0 < sigma_m <= centre_sigma_m(marking) * (1 + 1e-9)


def test_nothing_is_said_of_a_marking_alone_or_unseen():
    assert relative_m(*street(np.full(5, CORNER_M), spacing_m=40.0)) == [None] * 5
    index = INDEX.copy()
    index[2] = -1
    found_m = relative_m(*street(np.full(5, CORNER_M)), index)
    assert [sigma_m is None for sigma_m in found_m] == [False, False, True, False, False]


def test_the_first_neighbour_is_the_one_nearest_to_ten_metres():
    neighbours_of = neighbours(np.array([[0.0, 0.0], [3.0, 0.0], [9.0, 0.0], [14.0, 0.0], [60.0, 0.0]]))
    assert [others.tolist() for others in neighbours_of] == [[2, 3, 1], [3, 2, 0], [0, 1, 3], [1, 0, 2], []]
