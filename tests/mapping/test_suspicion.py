"""The marking that does not fit its class, its residuals or its sightings comes first."""

from __future__ import annotations

import numpy as np

from v2hdm.site.candidates import Counts
from v2hdm.site.markings import most_suspicious

COUNT = 40
ALL = np.arange(COUNT)


def counts(rejected=None):
    """Twelve images of four corners each, of which so many were rejected."""
    twelve, zero = np.full(COUNT, 12), np.zeros(COUNT, dtype=np.int64)
    agreeing = 4 * twelve - (zero if rejected is None else rejected)
    return Counts(
        twelve, 4 * twelve, agreeing, np.full(COUNT, 7.0), twelve, twelve, np.full((COUNT, 4), 12), zero
    )


def usual(rng):
    """Sums of squared residuals whose variance differs from marking to marking."""
    return 0.7 * rng.chisquare(88, COUNT) * 6 / rng.chisquare(6, COUNT)


def test_right_markings_are_seldom_suspicious():
    rng = np.random.default_rng(0)
    rejected = [rng.binomial(12, 0.05, COUNT) * 4 for _ in range(50)]
    worst = [
        most_suspicious(ALL, rng.uniform(size=COUNT), usual(rng), counts(share))[0].p for share in rejected
    ]
    assert min(worst) > 1e-6
    assert len(most_suspicious(ALL, rng.uniform(size=COUNT), usual(rng), counts())) == 10


def test_a_wrong_shape_large_residuals_and_disputed_sightings_each_come_first():
    rng = np.random.default_rng(1)
    misfit, squared, rejected = np.full(COUNT, 0.5), usual(rng), np.zeros(COUNT, dtype=np.int64)
    misfit[7], squared[8], rejected[9] = 1e-9, 400 * squared[8], 20
    first = most_suspicious(ALL, misfit, squared, counts(rejected))[:3]
    assert {suspect.marking for suspect in first} == {8, 9, 10}
    by_id = {suspect.marking: suspect for suspect in first}
    assert by_id[8].p == 3 * by_id[8].p_shape
    assert by_id[9].p == 3 * by_id[9].p_residuals < 1e-2
    assert by_id[10].p == 3 * by_id[10].p_sightings < 1e-2
    assert by_id[10].disputed == 20 / 48


def test_ids_count_the_accepted_candidates_alone():
    misfit = np.full(COUNT, 0.5)
    misfit[20] = 1e-9
    suspects = most_suspicious(ALL[10:], misfit, usual(np.random.default_rng(2)), counts())
    assert suspects[0].marking == 11


def test_residuals_of_a_corner_behind_the_camera_are_suspicious_and_end_in_no_traceback():
    squared = usual(np.random.default_rng(4))
    squared[[3, 5]] = np.nan, np.inf
    suspects = most_suspicious(ALL, np.ones(COUNT), squared, counts())
    assert {suspect.marking for suspect in suspects[:2]} == {4, 6}
    assert all(np.isfinite(suspect.p) for suspect in suspects)


def test_two_markings_have_no_spread_to_be_held_against():
    suspects = most_suspicious(ALL[:2], np.ones(COUNT), usual(np.random.default_rng(3)), counts())
    assert [suspect.p for suspect in suspects] == [1.0, 1.0]
