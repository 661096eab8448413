"""Figures of made-up drives, whose errors are known, as rows, claims, tables and words."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from tests.experiment.scene import CALIBRATED, ESTIMATED, TRUE, experiment, plain_map, record
from v2hdm.experiment.measures import Measured, measure
from v2hdm.experiment.summary import claims, words, write_tables


def two_ports(opt_m: float = 0.01) -> list[Measured]:
    return [
        measure(record(port, seed, start, opt_m))
        for seed in (1, 2)
        for port, start in (("port1", CALIBRATED), ("port2", ESTIMATED))
    ]


def test_rows_hold_the_errors_that_were_put_in() -> None:
    rows = measure(record("port1", 1, CALIBRATED)).rows["both"]
    assert (rows["Opt"].markings, rows["CNI"].markings, rows["ENI"].markings) == (5, 4, 3)
    assert rows["Opt"].rmse_m == pytest.approx(0.01)
    assert rows["Opt"].bias_m == pytest.approx(0.01)
    assert rows["Opt"].spread_m == pytest.approx(0.0, abs=1e-9)
    assert (rows["Opt"].recall, rows["CNI"].recall) == (1.0, 0.8)


def test_shared_markings_are_those_that_every_method_has_mapped() -> None:
    plain = record("port1", 1, CALIBRATED)
    worse = TRUE + np.array([0.01, 0.0])
    worse[3:] += np.array([0.3, 0.0])  # the two that ENI lacks
    plain["maps"]["both"]["Opt"] = plain_map(worse)
    row = measure(plain).rows["both"]["Opt"]
    assert row.shared == 3
    assert row.shared_rmse_m == pytest.approx(0.01)
    assert row.rmse_m > 0.1


def test_errors_come_in_the_order_in_which_the_vehicle_passed() -> None:
    plain = record("port1", 1, CALIBRATED)
    shuffled = [3, 1, 4, 0, 2]
    plain["maps"]["both"]["Opt"] = plain_map(TRUE[shuffled] + 0.01)
    found = measure(plain).matched["both"]["Opt"]
    assert found.true.tolist() == [0, 1, 2, 3, 4]
    assert found.mapped.tolist() == [shuffled.index(n) for n in range(5)]


def test_claims_are_tested_where_the_start_of_the_port_allows_it() -> None:
    tested = claims(two_ports())
    assert {c.where.split(",")[0] for c in tested if "Opt / CNI" in c.text} == {"port1"}
    assert {c.where.split(",")[0] for c in tested if "ENI / Opt" in c.text} == {"port2"}
    ratio = next(c for c in tested if "ENI / Opt" in c.text)
    assert ratio.values == pytest.approx((50.0, 50.0))
    assert all(c.holds for c in tested)


def test_what_disagrees_with_the_paper_is_said_plainly() -> None:
    measured = two_ports(opt_m=0.07)
    text = words(measured, experiment("out"))
    broken = [c for c in claims(measured) if not c.holds]
    assert {c.text.rsplit(": ", 1)[1] for c in broken} == {"Opt / CNI", "ENI / Opt"}
    assert f"**{len(broken)} of {len(claims(measured))} figures disagree with the paper's claims:**" in text
    for claim in broken:
        assert f"- {claim.where}: {claim.text} is {claim.figure}, asked was {claim.limit}" in text
    assert "All 14 figures agree" in words(two_ports(), experiment("out"))


def test_a_recipe_of_which_no_map_came_is_told() -> None:
    plain = record("port1", 1, CALIBRATED)
    plain["failures"] = [["paper", "rear", "nothing to map"]]
    del plain["maps"]["rear"]["Opt, paper"]
    text = words([measure(plain)], experiment("out"))
    assert "- port1 seed 1, rear, recipe paper: nothing to map" in text


def test_tables_are_written_for_spreadsheets_and_papers(tmp_path: Path) -> None:
    write_tables(tmp_path, two_ports())
    with (tmp_path / "results.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 4 * 3 * 5
    opt = next(line for line in lines if (line["port"], line["method"]) == ("port1", "Opt"))
    assert float(opt["RMSE (cm)"]) == pytest.approx(1.0)
    latex = (tmp_path / "results.tex").read_text()
    assert latex.startswith(r"\begin{tabular}")
    assert r"1.0 $\pm$ 0.0" in latex
    columns = {line.count("|") for line in (tmp_path / "results.md").read_text().splitlines()}
    assert len(columns) == 1
    assert "Opt, paper" in (tmp_path / "calibrations.md").read_text()
