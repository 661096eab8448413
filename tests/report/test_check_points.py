"""Check points beside a map: which corner they are of, and figures that anybody can compute again."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.report.yard import OWN_M, SHARED_M, SURVEY_M, checked, point, yard
from v2hdm.report.check_points import COLUMNS, write_check_points


def test_a_check_point_is_of_the_nearest_corner_within_reach_and_the_others_say_why_not() -> None:
    table = checked(yard(), point(5.98, 0.06, "A"), point(6.2, 0.0, "B"), point(20.5, 7.0, "C"))
    (one,) = table.compared
    assert (one.point.id, one.marking, one.marking_id, one.corner) == ("A", 1, 2, 1)
    np.testing.assert_allclose(one.off_m, [0.02, -0.06], atol=1e-12)
    reasons = {which.id: why for which, why in table.unmatched}
    assert reasons["B"] == "A fits the only corner within reach better, of diamond 2"
    assert reasons["C"].startswith(
        "no corner within 0.25 m: the nearest, of diamond 5, is 6.02 m away, the route"
    )
    assert table.figures()["unmatched"] == reasons


def test_figures_are_those_of_map_minus_survey() -> None:
    table = checked(yard(), point(0.02, 0.01, "A"), point(5.0, 0.03, "B"))
    figures = table.figures()
    assert figures["rmse_m"] == pytest.approx(np.sqrt((0.02**2 + 0.01**2 + 0.03**2) / 2))
    assert (figures["mean_x_m"], figures["mean_y_m"]) == pytest.approx((-0.01, -0.02))
    assert figures["degrees_of_freedom"] == 4
    one = table.compared[0]
    sigma_m = np.sqrt(OWN_M**2 + SHARED_M**2 + SURVEY_M**2)
    assert one.normalised == pytest.approx(np.hypot(0.02, 0.01) / sigma_m)
    assert one.is_inside
    assert "2 of 2 compared, RMSE 2.6 cm, mean -1.0 cm in x and -2.0 cm in y" in table.headline


def test_differences_as_large_as_stated_have_a_nees_of_one_however_much_they_share() -> None:
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


def test_heights_are_compared_where_both_have_them_and_said_not_to_be_otherwise() -> None:
    flat = yard()
    lifted = replace(flat, markings=tuple(replace(m, heights_m=np.full(4, 2.0)) for m in flat.markings))
    table = checked(lifted, point(0.0, 0.0, "A", height_m=1.9), point(5.0, 0.0, "B"))
    assert [one.off_height_m for one in table.compared] == [pytest.approx(0.1), None]
    assert table.figures()["height"] == {
        "compared": 1,
        "mean_z_m": pytest.approx(0.1),
        "rmse_z_m": pytest.approx(0.1),
    }
    assert checked(flat, point(0.0, 0.0, "A", height_m=1.9)).figures()["height"]["compared"] == 0


def test_the_table_of_a_customer_holds_every_point_once_and_reads_back(tmp_path: Path) -> None:
    table = checked(yard(), point(5.98, 0.06, "A"), point(99.0, 0.0, "C"))
    write_check_points(table, tmp_path / "check_points.csv")
    with (tmp_path / "check_points.csv").open(newline="") as file:
        first, second = list(csv.DictReader(file))
    assert set(first) == set(COLUMNS)
    assert (first["id"], first["marking"], first["class"], first["corner"]) == ("A", "2", "diamond", "2")
    assert float(first["distance_m"]) == pytest.approx(np.hypot(0.02, 0.06), abs=1e-4)
    assert (float(first["map_sigma_x_m"]), first["inside_95_percent"]) == (
        pytest.approx(0.0316, abs=1e-4),
        "yes",
    )
    assert (second["id"], second["dx_m"]) == ("C", "")
    assert second["not_compared_because"].startswith("no corner within 0.25 m")


def test_nothing_within_reach_is_a_table_without_figures() -> None:
    table = checked(yard(), point(500.0, 0.0))
    assert table.headline == "check points: none of 1 has a corner of the map within reach"
    assert "rmse_m" not in table.figures()
