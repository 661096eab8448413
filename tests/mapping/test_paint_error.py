"""Errors of painted edges that no number of images averages away."""

from __future__ import annotations

import numpy as np
import pytest

from v2hdm.site.shapes import PaintError, learn_paint_error

FORMAL = (0.001**2) * np.eye(5)


def test_the_scale_and_tails_of_the_deviations_are_found_again() -> None:
    rng = np.random.default_rng(0)
    scale = 0.003 * np.sqrt(4.0 / rng.chisquare(4.0, 2000))
    deviations = [rng.normal(0.0, np.hypot(sigma, 0.001), 5) for sigma in scale]
    found = learn_paint_error(deviations, [FORMAL] * len(deviations))
    assert found.sigma_m == pytest.approx(0.003, rel=0.15)
    assert 3.0 < found.freedom < 7.0


def test_paint_without_errors_of_its_own_adds_hardly_anything() -> None:
    rng = np.random.default_rng(1)
    deviations = [rng.normal(0.0, 0.001, 5) for _ in range(500)]
    found = learn_paint_error(deviations, [FORMAL] * 500)
    assert found.sigma_m < 0.0005


def test_a_marking_far_from_its_class_is_known_as_badly_as_it_deviates() -> None:
    paint = PaintError(0.001, 2.0)
    near, far = (paint.variance_m2(off * np.ones(5), FORMAL) for off in (0.001, 0.03))
    assert np.sqrt(near) == pytest.approx(np.sqrt(2 / 7) * 0.001)  # its formal sigma explains the deviation
    assert np.sqrt(far) == pytest.approx(0.03 * np.sqrt(5 / 7), rel=0.02)


def test_without_any_deviation_there_is_still_a_paint_error() -> None:
    assert learn_paint_error([], []).sigma_m > 0


def test_the_scatter_of_a_class_that_was_painted_by_hand_is_no_error_of_the_map() -> None:
    by_hand = PaintError(0.015, 30.0)
    typical = by_hand.variance_m2(0.015 * np.ones(5), FORMAL)
    assert np.sqrt(typical) < 0.006
