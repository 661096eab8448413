"""Metrics against a truth, and dashes on rows, whose figures can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.report.scene import diamond_at, make_truth
from v2hdm.records import DIAMOND, LANE_DASH, HdMap, Lane, Marking
from v2hdm.report.metrics import (
    corner_errors,
    dash_spacing,
    driven_past,
    extrinsic_metrics,
    lane_metrics,
    marking_metrics,
)


def test_only_the_marking_inside_the_region_of_interest_counts_as_driven_past() -> None:
    drive, truth = make_truth()
    assert driven_past(drive, truth, ["front"]).tolist() == [True, False]


def test_an_occluded_marking_is_not_expected() -> None:
    drive, truth = make_truth(visibility=0.5)
    assert not driven_past(drive, truth, ["front"]).any()


def test_another_camera_saw_nothing() -> None:
    drive, truth = make_truth()
    assert not driven_past(drive, truth, ["rear"]).any()


def test_a_shift_of_three_and_four_centimetres_is_an_error_and_a_bias_of_five() -> None:
    _, truth = make_truth()
    result = marking_metrics(HdMap((diamond_at(10.03, 0.04),)), truth, np.array([True, False]))
    assert result.corner_rmse_m == pytest.approx(0.05)
    assert result.corner_bias_m == pytest.approx(0.05)
    assert (result.markings, result.false_markings, result.expected, result.recall) == (1, 0, 1, 1.0)


def test_the_cyclic_start_of_the_corners_does_not_matter() -> None:
    mapped = diamond_at(10, 0)
    rolled = Marking(DIAMOND, np.roll(mapped.corners_map, 3, axis=0), 3)
    assert np.abs(corner_errors([rolled], [mapped])).max() == 0.0


def test_a_duplicate_and_a_wrong_class_are_false_and_opposite_errors_have_no_bias() -> None:
    _, truth = make_truth()
    duplicate = diamond_at(10.2, 0)
    wrong_class = Marking(LANE_DASH, diamond_at(10, 40).corners_map, 3)
    result = marking_metrics(
        HdMap((diamond_at(10, 0), duplicate, wrong_class)), truth, np.array([True, True])
    )
    assert result.false_markings == 2
    assert result.recall == 0.5
    pair = marking_metrics(HdMap((diamond_at(10.1, 0), diamond_at(9.9, 40))), truth, np.array([True, True]))
    assert pair.corner_rmse_m == pytest.approx(0.1)
    assert pair.corner_bias_m == pytest.approx(0.0, abs=1e-12)


def test_an_empty_map_has_no_recall_and_no_error() -> None:
    _, truth = make_truth()
    result = marking_metrics(HdMap(()), truth, np.array([True, False]))
    assert result.recall == 0.0
    assert np.isnan(result.corner_rmse_m)


def test_extrinsic_error_is_the_angle_and_the_distance_of_the_centres() -> None:
    rotation = Rotation.from_euler("y", 2.0, degrees=True).as_matrix()
    true, estimate = np.eye(4), np.eye(4)
    estimate[:3, :3] = rotation
    estimate[:3, 3] = -rotation @ [0.03, 0.0, 0.04]
    result = extrinsic_metrics(estimate, true)
    assert result.rotation_error_deg == pytest.approx(2.0)
    assert result.translation_error_m == pytest.approx(0.05)


def test_a_lane_five_centimetres_aside_over_the_visible_half_is_all_of_what_was_visible() -> None:
    _, truth = make_truth()
    lane = Lane("lane_line", np.array([[0.0, 2.05], [10.0, 2.05]]), 5)
    result = lane_metrics([lane], truth)
    assert result.mean_lateral_error_m == pytest.approx(0.05, abs=1e-6)
    assert result.mapped_fraction == 1.0
    assert result.false_length_m == 0.0


def test_a_lane_where_there_is_none_is_false_length() -> None:
    _, truth = make_truth()
    result = lane_metrics([Lane("lane_line", np.array([[0.0, -5.0], [10.0, -5.0]]), 5)], truth)
    assert result.false_length_m == pytest.approx(10.1)
    assert result.mapped_fraction == 0.0
    assert np.isnan(result.mean_lateral_error_m)


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
