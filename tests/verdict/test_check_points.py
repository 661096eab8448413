"""What the verdict says of check points: chance passes; a bad point, a shifted datum, a bad map do not."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.report.yard import SURVEY_M, checked, point, yard
from v2hdm.records import FloatArray
from v2hdm.verdict import Finding, Status
from v2hdm.verdict.results.survey import SIGNIFICANCE, check_frame, check_points

COUNT = 12


def found(seed: int, off_m: FloatArray) -> Finding:
    """Of a map in error as it states, and check points that are off by ``off_m`` (12, 2) more than stated."""
    rng, truth = np.random.default_rng(seed), yard()
    points = [
        point(*(truth.markings[k].corners_map[k % 4] + SURVEY_M * rng.standard_normal(2) + off_m[k]), f"P{k}")
        for k in range(COUNT)
    ]
    return check_points(checked(yard(rng), *points))


def test_maps_as_good_as_they_state_are_contradicted_as_seldom_as_the_test_says() -> None:
    raised = [found(seed, np.zeros((COUNT, 2))).status is not Status.PASS for seed in range(400)]
    assert SIGNIFICANCE * 400 < 1
    assert sum(raised) <= 3


ONE_OFF = np.where(np.arange(COUNT)[:, None] == 7, [0.15, 0.0], 0.0)


@pytest.mark.parametrize(
    ("off_m", "status", "says"),
    [
        (ONE_OFF, Status.WARN, "^P7 lies .*the others where they should"),
        (np.tile([0.15, -0.13], (COUNT, 1)), Status.FAIL, "another datum or origin"),
        (np.random.default_rng(5).normal(0, 0.05, (COUNT, 2)), Status.FAIL, "the map is worse than it says"),
    ],
    ids=["one point", "all alike", "a worse map"],
)
def test_points_that_are_off_name_the_cause(off_m, status, says):
    finding = found(1, off_m)
    assert finding.status is status
    assert re.search(says, finding.says)
    assert finding.value > finding.limit


def test_points_that_the_map_has_nowhere_are_told_with_the_distance():
    (finding,) = check_frame({"": 0, "with x_m and y_m swapped": 0})
    assert finding.status is Status.WARN
    assert "no corner of the map has a surveyed point within reach" in finding.says
    finding = check_points(checked(yard(), point(30.5, 8.0, "Q1")))
    assert finding.status is Status.WARN
    assert re.search("none of 1.*7.02 m away", finding.says)


@pytest.mark.parametrize(
    ("counts", "status"),
    [
        ({"": 9, "with x_m and y_m swapped": 1}, Status.PASS),
        ({"": 1, "with x_m and y_m swapped": 7, "in feet": 2}, Status.WARN),
        ({"": 3}, Status.PASS),
    ],
)
def test_a_survey_that_fits_better_when_read_otherwise_is_told_how(
    counts: dict[str, int], status: Status
) -> None:
    (finding,) = check_frame(counts)
    assert finding.status is status
    assert ("7 would with x_m and y_m swapped" in finding.says) is (status is Status.WARN)
