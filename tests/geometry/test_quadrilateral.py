"""Cyclic alignment of quadrilaterals."""

from __future__ import annotations

import numpy as np
import pytest

from v2hdm.geometry.planar import signed_area
from v2hdm.geometry.quadrilateral import align, diameters, is_convex

DIAMOND = np.array([[0.6, 0.0], [0.0, 0.3], [-0.6, 0.0], [0.0, -0.3]])
OFFSET = np.array([0.1, -0.05])
ALL = np.ones(4, dtype=bool)


@pytest.mark.parametrize("shift", range(4))
def test_a_cyclic_shift_is_found_and_undone(shift: int) -> None:
    turned = np.roll(DIAMOND, shift, axis=0) + OFFSET
    found = align(DIAMOND, ALL, turned, ALL)
    assert found.shift == shift
    np.testing.assert_allclose(found.offset, OFFSET)
    np.testing.assert_allclose(turned[(np.arange(4) + found.shift) % 4], DIAMOND + OFFSET)
    assert found.deformation_m == pytest.approx(0.0, abs=1e-12)


def test_corners_that_are_not_valid_take_no_part() -> None:
    broken = DIAMOND.copy()
    broken[2] = np.nan
    found = align(DIAMOND, ALL, broken, np.array([True, True, False, True]))
    assert found.shift == 0
    assert found.common == 3
    assert found.deformation_m == pytest.approx(0.0, abs=1e-12)


def test_with_one_common_corner_nothing_can_be_said() -> None:
    found = align(DIAMOND, ALL, DIAMOND, np.array([True, False, False, False]))
    assert np.isinf(found.deformation_m)


def test_another_shape_shows_as_deformation() -> None:
    assert align(DIAMOND, ALL, 1.5 * DIAMOND, ALL).deformation_m == pytest.approx(0.3)


def test_alignment_broadcasts_over_tracks_and_detections() -> None:
    tracks = np.stack([DIAMOND, DIAMOND + 5.0, DIAMOND - 3.0])[:, None]
    found = align(tracks, np.ones((3, 1, 4), bool), np.stack([DIAMOND] * 2), np.ones((2, 4), bool))
    assert found.shift.shape == (3, 2)
    np.testing.assert_allclose(found.offset[:, 0, 0], [0.0, -5.0, 3.0], atol=1e-12)


def test_area_sense_and_diameter_of_a_diamond() -> None:
    assert signed_area(DIAMOND) == pytest.approx(0.36)
    assert is_convex(DIAMOND)
    assert not is_convex(DIAMOND[::-1])
    assert diameters(DIAMOND, ALL) == pytest.approx(1.2)
