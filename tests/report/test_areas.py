"""Figures of words, boxes, crosswalks and double lines, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from tests.report.scene import make_truth
from v2hdm.records import BOX, DOUBLE_LINE, LANE_LINE, TEXT, HDMap, Lane, Reading, Symbol
from v2hdm.report.areas import area_figures, area_metrics, double_metrics
from v2hdm.report.metrics import symbols_driven_past

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def area(kind, east_m, north_m):
    return Symbol(kind, SQUARE + np.array([east_m, north_m]), 3)


def read_as(text, east_m, north_m):
    return Symbol(TEXT, SQUARE + np.array([east_m, north_m]), 3, reading=Reading(text, 0.9))


@pytest.fixture
def truth():
    drive, truth = make_truth()
    symbols = (area(TEXT, 9, 0), area(TEXT, 9, 2), area(TEXT, 9, 40), area(BOX, 7, 0))
    along = np.column_stack([np.linspace(0, 20, 41), np.full(41, -2.0)])
    lane = Lane(DOUBLE_LINE, along, 0, lines=(LANE_LINE, LANE_LINE), apart_m=0.3)
    return drive, replace(
        truth,
        map=replace(truth.map, lanes=(*truth.map.lanes, lane), symbols=symbols),
        lane_visible=(*truth.lane_visible, along[:, 0] <= 10),
        symbol_visibility=np.full((3, 4), 1.0),
        texts={0: "EBH", 1: "7"},
    )


def test_a_word_is_found_where_it_overlaps_and_read_where_it_says_what_the_truth_says(truth):
    drive, true = truth
    expected = symbols_driven_past(drive, true, ["front"])
    assert expected.tolist() == [True, True, False, True], "the third is out of the region of interest"
    mapped = HDMap((), symbols=(read_as("EBH", 9.2, 0), read_as("1", 9, 2.1), read_as("X", 20, 20)))
    figures = area_metrics(mapped, true, expected, TEXT)
    assert (figures.areas, figures.false_areas, figures.expected, figures.recall) == (3, 1, 2, 1.0)
    assert figures.median_iou == pytest.approx(np.median([0.8 / 1.2, 0.9 / 1.1]))
    assert figures.readable == 2
    assert figures.read == 0.5


def test_an_area_of_another_class_or_place_is_false(truth):
    drive, true = truth
    expected = symbols_driven_past(drive, true, ["front"])
    mapped = HDMap((), symbols=(area(BOX, 9, 0), area(TEXT, 7, 0)))
    figures = area_figures(mapped, true, expected)
    assert figures[BOX]["false_areas"] == figures[TEXT]["false_areas"] == 1
    assert figures[BOX]["recall"] == figures[TEXT]["recall"] == 0.0
    assert np.isnan(figures[TEXT]["read"])


def test_a_double_line_counts_as_mapped_where_one_is_and_a_single_one_does_not(truth):
    _, true = truth
    half = Lane(
        DOUBLE_LINE, np.array([[0.0, -2.1], [5.0, -2.1]]), 3, lines=(LANE_LINE, LANE_LINE), apart_m=0.3
    )
    other = replace(half, points_map=half.points_map + np.array([0.0, 9.0]))
    single = Lane(LANE_LINE, np.array([[0.0, -2.0], [10.0, -2.0]]), 3)
    figures = double_metrics(HDMap((), (half, other)), true)
    assert figures.mapped_fraction == pytest.approx(0.5, abs=0.05)
    assert figures.false_length_m == pytest.approx(5.0, abs=0.2)
    assert double_metrics(HDMap((), (single,)), true).mapped_fraction == 0.0
