"""Spacing of dashes on rows laid out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from v2hdm.records import LANE_DASH, HdMap, Marking
from v2hdm.report.metrics import dash_spacing


def dash(along_m: float, across_m: float, heading_rad: float = 0.7) -> Marking:
    local = np.array([[1.5, 0.07], [-1.5, 0.07], [-1.5, -0.07], [1.5, -0.07]]) + np.array([along_m, across_m])
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    return Marking(LANE_DASH, local @ np.array([[c, s], [-s, c]]), 5)


def test_two_rows_three_metres_apart_give_the_cycle_of_each() -> None:
    rows = [dash(6.05 * n, y) for n in range(5) for y in (0.0, 3.0)]
    spacing = dash_spacing(HdMap(tuple(rows)))
    assert spacing.pairs == 8
    assert spacing.median_m == pytest.approx(6.05)
    assert spacing.deviation_m == pytest.approx(0.0, abs=1e-9)


def test_a_missing_dash_does_not_move_the_median() -> None:
    rows = [dash(6.0 * n, 0.0, heading_rad=2.3) for n in (0, 1, 2, 4, 5, 6)]
    assert dash_spacing(HdMap(tuple(rows))).median_m == pytest.approx(6.0)


def test_a_single_dash_has_no_spacing() -> None:
    spacing = dash_spacing(HdMap((dash(0.0, 0.0),)))
    assert spacing.pairs == 0
    assert np.isnan(spacing.median_m)
