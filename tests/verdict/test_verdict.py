"""The verdict on a run is that of its worst check."""

from __future__ import annotations

from dataclasses import replace

from v2hdm.verdict import Finding, Status, Verdict


def finding(status: Status, check: str = "clock", value: float | None = 118.0) -> Finding:
    return Finding(check, status, value, 15.0, "ms", "images are 118 ms late; mend the stamps", "front")


def test_a_run_without_findings_passes() -> None:
    assert Verdict.of([]).status is Status.PASS


def test_the_verdict_is_that_of_the_worst_check() -> None:
    verdict = Verdict.of([finding(Status.PASS), finding(Status.FAIL), finding(Status.WARN)])
    assert verdict.status is Status.FAIL
    assert [raised.status for raised in verdict.raised] == [Status.FAIL, Status.WARN]


def test_what_passed_is_told_apart_from_what_was_raised() -> None:
    told = Verdict.of([finding(Status.PASS, "heading"), finding(Status.WARN, "clock")]).as_json()
    assert told["status"] == "WARN"
    assert [one["check"] for one in told["findings"]] == ["clock"]
    assert [one["check"] for one in told["passed"]] == ["heading"]
    assert {"check", "value", "limit", "says", "about"} <= set(told["findings"][0])


def test_the_terminal_shows_the_status_first_and_a_line_for_each_finding() -> None:
    lines = Verdict.of([finding(Status.PASS), finding(Status.WARN)]).lines
    assert lines[0] == "verdict: WARN (1 finding, 1 checks passed)"
    assert lines[1] == "WARN clock (front): images are 118 ms late; mend the stamps"
    assert len(lines) == 2


def test_a_check_that_the_drive_cannot_answer_is_told_apart_from_one_that_passed() -> None:
    verdict = Verdict.of([finding(Status.PASS, value=None)])
    assert verdict.status is Status.PASS
    assert not verdict.passed
    assert verdict.as_json()["untold"][0]["check"] == "clock"
    assert verdict.lines[1].startswith("cannot tell clock (front)")


def test_what_several_cameras_have_in_common_is_one_line() -> None:
    one = finding(Status.WARN)
    lines = Verdict.of([one, replace(one, about="rear")]).lines
    assert lines[1:] == ("WARN clock (front, rear): images are 118 ms late; mend the stamps",)
