"""Paint edges have the width that they were drawn with, wherever they lie."""

from __future__ import annotations

import numpy as np
import pytest

from v2hdm.mosaic.sharpness import edge_widths_m, measure_edges, paint_sides
from v2hdm.mosaic.shots import Canvas
from v2hdm.records import HdMap, Marking

CANVAS = Canvas(np.array([0.0, 6.0]), 0.02, 300, 300)
SQUARE = np.array([[2.0, 2.0], [4.0, 2.0], [4.0, 4.0], [2.0, 4.0]])
SIDES = paint_sides(HdMap((Marking("diamond", SQUARE, 3),))).ends_map


def painted(width_m: float, shift_m: float = 0.0) -> np.ndarray:
    """A square whose edges rise over ``width_m``, out of place by ``shift_m`` in x and y."""
    across = (np.arange(300) + 0.5) * 0.02 - 3 - shift_m
    rise = np.clip((1 - np.abs(across)) / width_m + 0.5, 0, 1)
    grey = 60 + 150 * np.minimum(rise[None, :], rise[::-1, None])
    return np.dstack([grey, grey, grey, np.full_like(grey, 255)]).round().astype(np.uint8)


def median_widths(*mosaics: np.ndarray) -> list[float]:
    edges = [measure_edges(rgba, CANVAS, SIDES) for rgba in mosaics]
    return [float(np.median(widths)) for widths in edge_widths_m(edges)]


@pytest.mark.parametrize("width_m", [0.06, 0.1, 0.3])
@pytest.mark.parametrize("shift_m", [0.0, 0.3])
def test_a_ramp_is_as_wide_as_it_was_drawn_though_out_of_place(width_m: float, shift_m: float) -> None:
    assert median_widths(painted(width_m, shift_m))[0] == pytest.approx(width_m, rel=0.05)


def test_paint_that_appears_twice_has_edges_twice_as_wide() -> None:
    once = painted(0.06)
    twice = (once.astype(float) / 2 + painted(0.06, 0.4).astype(float) / 2).round().astype(np.uint8)
    doubled, sharp = median_widths(twice, once)
    assert doubled == pytest.approx(2 * sharp, rel=0.1)


def test_edges_that_a_mosaic_does_not_show_whole_are_left_out_of_all() -> None:
    half = painted(0.06)
    half[:, :150, 3] = 0
    before, after = edge_widths_m([measure_edges(one, CANVAS, SIDES) for one in (half, painted(0.06))])
    assert len(before) == len(after) == 1


def test_short_sides_are_no_edges() -> None:
    assert not len(paint_sides(HdMap((Marking("diamond", 0.1 * SQUARE, 3),))).ends_map)
    assert not len(paint_sides(HdMap(())).sightings)
