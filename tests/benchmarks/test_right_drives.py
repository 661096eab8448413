"""How the benchmark of right and spoilt drives judges what a user is told."""

from dataclasses import replace

import pytest

from tests.benchmarks.right_drives import Row, judge, summary_of_spoilt

CLOCKS = {"check": "clock", "status": "WARN", "about": "all cameras", "says": "clocks cannot be told: turn"}
STEP = {"check": "position step", "status": "WARN", "about": "front", "says": "the position steps: see"}
SURVEY = {"check": "survey", "status": "PASS", "about": "all cameras", "says": "nothing checks it: turn"}
INSIDE, OUTSIDE = [0.5] * 10, [9.0] * 10

CLEAN = Row(
    0, "straight", "port1", "nothing", False, False, "WARN", findings=[CLOCKS], rmse_m=0.02,
    errors={"corners": INSIDE},
)  # fmt: skip


def spoilt(name: str, rmse_m: float = 0.04, **changes: object) -> Row:
    return replace(CLEAN, spoil=name, rmse_m=rmse_m, **changes)


@pytest.mark.parametrize(("errors", "held"), [(INSIDE, True), (OUTSIDE, False)])
def test_a_wrong_map_of_which_nothing_is_said_is_silent_whether_or_not_its_sigmas_hold(errors, held):
    judgement = judge(spoilt("position step", errors={"corners": errors}), CLEAN)
    assert (judgement.silent, judgement.held) == (True, held)


def test_a_map_is_wrong_from_1_3_times_the_error_of_the_right_one_on():
    assert not judge(spoilt("position step", 0.0259), CLEAN).silent
    assert judge(spoilt("position step", 0.0261), CLEAN).silent


def test_what_the_right_drive_is_told_too_counts_only_if_it_names_the_cause():
    late = judge(spoilt("late clock"), CLEAN)
    assert (late.told, late.usual, late.silent, late.named) == (True, True, False, "first")
    step = judge(spoilt("position step", findings=[STEP, CLOCKS]), CLEAN)
    assert (step.told, step.usual, step.silent, step.named) == (True, False, False, "first")


def test_a_straight_drive_that_names_its_survey_as_unchecked_is_relied_on_and_a_turning_one_is_silent():
    straight = spoilt("survey", unobservable=[SURVEY])
    assert judge(straight, CLEAN).relied
    turning = judge(replace(straight, route="turning"), replace(CLEAN, route="turning"))
    assert turning.silent


def test_the_summary_counts_silent_maps_and_those_of_them_inside_their_sigmas():
    rows = [spoilt("position step"), spoilt("heading off", errors={"corners": OUTSIDE})]
    assert "SILENT 2, of them inside their stated sigmas 1" in summary_of_spoilt(rows, {0: CLEAN})
