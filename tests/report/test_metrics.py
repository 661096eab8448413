"""Metrics, figures and check points of a report, worked out by hand."""

import csv
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.cameras import mounted
from tests.report.scene import diamond_at, make_truth
from tests.report.yard import OWN_M, SHARED_M, SURVEY_M, checked, point, yard
from v2hdm.geometry.ipm import apply_in_front, ipm_from_extrinsic
from v2hdm.records import DIAMOND, LANE_DASH, HDMap, Lane, Marking
from v2hdm.report import photos, style
from v2hdm.report.metrics import (
    corner_errors,
    driven_past,
    extrinsic_metrics,
    headline,
    lane_metrics,
    marking_metrics,
)
from v2hdm.report.photos import save_overlay
from v2hdm.report.terminal import METHODS, changes_table, results_table
from v2hdm.survey.check_points import COLUMNS, write_check_points


def test_what_a_camera_saw_unoccluded_inside_its_region_of_interest_counts_as_driven_past():
    drive, truth = make_truth()
    assert driven_past(drive, truth, ["front"]).tolist() == [True, False]
    assert not driven_past(drive, truth, ["rear"]).any()
    assert not driven_past(*make_truth(visibility=0.5), ["front"]).any()


def test_a_shift_of_three_and_four_centimetres_is_an_error_and_a_bias_of_five():
    _, truth = make_truth()
    result = marking_metrics(HDMap((diamond_at(10.03, 0.04),)), truth, np.array([True, False]))
    assert result.corner_rmse_m == pytest.approx(0.05)
    assert result.corner_bias_m == pytest.approx(0.05)
    assert (result.markings, result.false_markings, result.expected, result.recall) == (1, 0, 1, 1.0)


def test_one_rmse_leaves_out_accuracy_c_while_that_is_the_lesser_part():
    _, truth = make_truth()
    sure = [replace(diamond_at(10.03, y), accuracy="A") for y in (0, 40)]
    third = replace(truth, map=HDMap((*truth.map.markings, diamond_at(10, 80))))
    expected = np.array([True, True, True])
    vague = replace(diamond_at(10.5, 80), accuracy="C")
    figures = marking_metrics(HDMap((*sure, vague)), third, expected)
    assert figures.well_known_rmse_m == pytest.approx(0.03)
    assert figures.corner_rmse_m == pytest.approx(np.sqrt((2 * 0.03**2 + 0.5**2) / 3))
    all_vague = HDMap(tuple(replace(marking, accuracy="C") for marking in (*sure, vague)))
    coarse = marking_metrics(all_vague, third, expected)
    assert coarse.well_known_rmse_m == pytest.approx(figures.corner_rmse_m)


def test_the_cyclic_start_of_the_corners_does_not_matter():
    mapped = diamond_at(10, 0)
    rolled = Marking(DIAMOND, np.roll(mapped.corners_map, 3, axis=0), 3)
    assert np.abs(corner_errors([rolled], [mapped])).max() == 0.0


def test_a_duplicate_and_a_wrong_class_are_false_and_opposite_errors_have_no_bias():
    _, truth = make_truth()
    duplicate = diamond_at(10.2, 0)
    wrong_class = Marking(LANE_DASH, diamond_at(10, 40).corners_map, 3)
    result = marking_metrics(
        HDMap((diamond_at(10, 0), duplicate, wrong_class)), truth, np.array([True, True])
    )
    assert result.false_markings == 2
    assert result.recall == 0.5
    pair = marking_metrics(HDMap((diamond_at(10.1, 0), diamond_at(9.9, 40))), truth, np.array([True, True]))
    assert pair.corner_rmse_m == pytest.approx(0.1)
    assert pair.corner_bias_m == pytest.approx(0.0, abs=1e-12)


def test_an_empty_map_has_no_recall_and_no_error():
    _, truth = make_truth()
    result = marking_metrics(HDMap(()), truth, np.array([True, False]))
    assert result.recall == 0.0
    assert np.isnan(result.corner_rmse_m)


def test_extrinsic_error_is_the_angle_and_the_distance_of_the_centres():
    rotation = Rotation.from_euler("y", 2.0, degrees=True).as_matrix()
    true, estimate = np.eye(4), np.eye(4)
    estimate[:3, :3] = rotation
    estimate[:3, 3] = -rotation @ [0.03, 0.0, 0.04]
    result = extrinsic_metrics(estimate, true)
    assert result["rotation_error_deg"] == pytest.approx(2.0)
    assert result["translation_error_m"] == pytest.approx(0.05)


def test_a_lane_five_centimetres_aside_over_the_visible_half_is_all_of_what_was_visible():
    _, truth = make_truth()
    lane = Lane("lane_line", np.array([[0.0, 2.05], [10.0, 2.05]]), 5)
    result = lane_metrics([lane], truth)
    assert result.mean_lateral_error_m == pytest.approx(0.05, abs=1e-6)
    assert result.mapped_fraction == 1.0
    assert result.false_length_m == 0.0


def test_of_a_lane_with_sigmas_the_share_within_95_percent_is_that_of_its_vertices():
    _, truth = make_truth()
    points, sigma_m = np.array([[0.0, 2.05], [5.0, 2.03], [10.0, 2.01]]), np.array([0.02, 0.02, 0.02])
    result = lane_metrics([Lane("lane_line", points, 5, sigma_m=sigma_m)], truth)
    assert result.inside_95 == pytest.approx(2 / 3)
    assert 0.01 < result.rms_lateral_error_m < 0.05
    assert np.isnan(lane_metrics([Lane("lane_line", points, 5)], truth).inside_95)


def test_a_lane_where_there_is_none_is_false_length():
    _, truth = make_truth()
    result = lane_metrics([Lane("lane_line", np.array([[0.0, -5.0], [10.0, -5.0]]), 5)], truth)
    assert result.false_length_m == pytest.approx(10.1)
    assert result.mapped_fraction == 0.0
    assert np.isnan(result.mean_lateral_error_m)


def test_the_overlay_draws_the_marking_where_the_camera_sees_it(tmp_path):
    drive, _ = make_truth()
    info = drive.cameras["front"].info
    # 2 m above the ground, optical axis level and forward: ground at (10, 0) projects to v = 240 + 100.
    views = {"Opt": partial(apply_in_front, np.linalg.inv(ipm_from_extrinsic(info, mounted([0, 0, 2]))))}
    black = np.zeros((480, 640, 3), np.uint8)
    save_overlay(tmp_path / "overlay.png", black, info, HDMap((diamond_at(10, 0),)), np.zeros(2), views)
    drawn = cv2.imread(str(tmp_path / "overlay.png"))
    assert len(drawn) > 480  # the legend stands below
    drawn = drawn[:480].any(axis=2)
    rows, columns = np.nonzero(drawn)
    assert abs(columns.mean() - 320) < 2
    assert 240 + 1000 / 10.5 - 3 <= rows.min() <= rows.max() <= 240 + 1000 / 9.5 + 3


def test_before_and_after_differ_in_dashes_and_not_in_colour_alone(tmp_path):
    drive, truth = make_truth()
    info = drive.cameras["front"].info
    lane = HDMap((), truth.map.lanes)
    view = partial(apply_in_front, np.linalg.inv(ipm_from_extrinsic(info, mounted([0, 0, 2]))))
    covered = {}
    for name in ("ENI", "Opt"):
        black = np.zeros((480, 640, 3), np.uint8)
        save_overlay(tmp_path / "a.png", black, info, lane, np.zeros(2), {name: view})
        covered[name] = np.count_nonzero(cv2.imread(str(tmp_path / "a.png"))[:480].max(axis=2) > 60)
    assert 0.3 < covered["ENI"] / covered["Opt"] < 0.85


def test_every_method_has_a_colour_of_its_own():
    for look in (style.WORDS, style.METHOD):
        assert set(look) == set(METHODS)
        assert len({str(colour) for colour in look.values()}) == len(METHODS)


def test_the_table_shows_every_method_and_camera_set_once():
    row = {"markings": 3, "recall": 1.0, "false_markings": 0, "corner_rmse_m": 0.0123, "corner_bias_m": 0.001}
    table = results_table("t", {"front": {"Opt": row, "CNI": row}, "both": {"Opt": row}})
    assert list(table.columns[0].cells) == ["CNI", "Opt", "Opt"]
    assert list(table.columns[5].cells) == ["1.2", "1.2", "1.2"]


def test_a_check_point_is_of_the_nearest_corner_within_reach_and_the_others_say_why_not():
    table = checked(yard(), point(5.98, 0.06, "A"), point(6.2, 0.0, "B"), point(20.5, 7.0, "C"))
    (compared,) = table.compared
    assert (compared.point.id, compared.marking, compared.marking_id, compared.corner) == ("A", 1, 2, 1)
    np.testing.assert_allclose(compared.off_m, [0.02, -0.06], atol=1e-12)
    reasons = {which.id: why for which, why in table.unmatched}
    assert reasons["B"] == "A fits the only corner within reach better, of diamond 2"
    assert reasons["C"].startswith("no corner within 0.25 m: the nearest, of diamond 5, is 6.02 m away, the")
    assert table.figures()["unmatched"] == reasons


def test_figures_are_those_of_map_minus_survey():
    table = checked(yard(), point(0.02, 0.01, "A"), point(5.0, 0.03, "B"))
    figures = table.figures()
    assert figures["rmse_m"] == pytest.approx(np.sqrt((0.02**2 + 0.01**2 + 0.03**2) / 2))
    assert (figures["mean_x_m"], figures["mean_y_m"]) == pytest.approx((-0.01, -0.02))
    assert figures["degrees_of_freedom"] == 4
    compared = table.compared[0]
    sigma_m = np.sqrt(OWN_M**2 + SHARED_M**2 + SURVEY_M**2)
    assert compared.normalised == pytest.approx(np.hypot(0.02, 0.01) / sigma_m)
    assert compared.is_inside
    assert "2 of 2 compared, RMSE 2.6 cm, mean -1.0 cm in x and -2.0 cm in y" in table.headline


def test_differences_as_large_as_stated_have_a_nees_of_one_however_much_they_share():
    rng, truth, nees, unlikely = np.random.default_rng(3), yard(), [], []
    for _ in range(200):
        points = [
            point(*(truth.markings[k].corners_map[k % 4] + SURVEY_M * rng.standard_normal(2)), f"P{k}")
            for k in range(12)
        ]
        figures = checked(yard(rng), *points).figures()
        nees.append(figures["nees"])
        unlikely.append(figures["probability"] < 0.05)
    # 24 degrees of freedom, 200 times: the mean has a standard deviation of .02, the share one of .015.
    assert np.mean(nees) == pytest.approx(1.0, abs=0.08)
    assert np.mean(unlikely) == pytest.approx(0.05, abs=0.05)


def test_heights_are_compared_where_both_have_them_and_said_not_to_be_otherwise():
    flat = yard()
    lifted = replace(flat, markings=tuple(replace(m, heights_m=np.full(4, 2.0)) for m in flat.markings))
    table = checked(lifted, point(0.0, 0.0, "A", height_m=1.9), point(5.0, 0.0, "B"))
    assert [compared.off_height_m for compared in table.compared] == [pytest.approx(0.1), None]
    height = {"compared": 1, "mean_z_m": pytest.approx(0.1), "rmse_z_m": pytest.approx(0.1)}
    assert table.figures()["height"] == height
    assert checked(flat, point(0.0, 0.0, "A", height_m=1.9)).figures()["height"]["compared"] == 0


def test_the_table_of_a_customer_holds_every_point_once_and_reads_back(tmp_path):
    table = checked(yard(), point(5.98, 0.06, "A"), point(99.0, 0.0, "C"))
    write_check_points(table, tmp_path / "check_points.csv")
    with (tmp_path / "check_points.csv").open(newline="") as file:
        first, second = list(csv.DictReader(file))
    assert set(first) == set(COLUMNS)
    assert (first["id"], first["marking"], first["class"], first["corner"]) == ("A", "2", "diamond", "2")
    assert float(first["distance_m"]) == pytest.approx(np.hypot(0.02, 0.06), abs=1e-4)
    assert float(first["map_sigma_x_m"]) == pytest.approx(0.0316, abs=1e-4)
    assert first["inside_95_percent"] == "yes"
    assert (second["id"], second["dx_m"]) == ("C", "")
    assert second["not_compared_because"].startswith("no corner within 0.25 m")


def test_nothing_within_reach_is_a_table_without_figures():
    table = checked(yard(), point(500.0, 0.0))
    assert table.headline == "check points: none of 1 has a map corner within reach"
    assert "rmse_m" not in table.figures()


def test_a_map_without_changes_is_one_line_and_no_empty_table():
    counts = {"same": 12, "moved": 0}
    assert changes_table({"counts": counts, "listed": []}) == "changes: 12 same"


def test_a_map_without_truth_names_the_main_reasons_why_candidates_are_left_out():
    figures = {
        "markings": 13,
        "lanes": {"lanes": 1},
        "excluded": 3,
        "excluded_for": {"too far": 2, "hidden": 1},
    }
    says = "front: 13 markings, 1 lane line; 3 candidates left out, most often: too far (2); hidden (1)"
    assert headline("front", {"Opt": figures}) == says


def test_the_region_of_interest_hides_no_coordinate_of_the_grid(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(photos, "draw_lines", lambda canvas, lines, pen: drawn.append(pen))
    monkeypatch.setattr(photos, "_write", lambda canvas, text, *_: drawn.append(text))
    monkeypatch.setattr(photos, "with_legend", lambda canvas, _: canvas)
    camera = make_truth()[0].cameras["front"]
    blank, looks = np.full((480, 640, 3), 255, np.uint8), mounted([0.0, 0.0, 2.0], 15.0)
    photos.save_grid(tmp_path / "grid.jpg", blank, camera, {"guess": looks}, "front")
    assert drawn.count(photos._ROI) == 1
    assert "x 10 m" in drawn[drawn.index(photos._ROI) :]
    drawn.clear()
    photos.save_points(tmp_path / "points.png", blank, camera.info, looks, camera.roi_vehicle, [])
    assert drawn.count(photos._ROI) == 1
    assert "x 10 m" in drawn[drawn.index(photos._ROI) :]
