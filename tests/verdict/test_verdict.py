"""The verdict on a run, all checks of its inputs together, and ``v2hdm check``."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.verdict.drives import drive, estimate, noisy, pictured, poses, raised, with_yaw, yaw_of
from v2hdm.cli.main import run
from v2hdm.ground.results import GroundStatus, Reading
from v2hdm.io.drive.writing import write_drive
from v2hdm.records import Road
from v2hdm.verdict import Finding, Status, Verdict, input_findings
from v2hdm.verdict.inputs.drive import HIDES, causes, check_road
from v2hdm.verdict.results.agreement import check_heights


def finding(status, check="clock", value=118.0):
    return Finding(check, status, value, 15.0, "ms", "images are 118 ms late; mend the stamps", "front")


def test_the_verdict_is_that_of_the_worst_check():
    verdict = Verdict.of([finding(Status.PASS), finding(Status.FAIL), finding(Status.WARN)])
    assert verdict.status is Status.FAIL
    assert [raised.status for raised in verdict.raised] == [Status.FAIL, Status.WARN]
    assert (Verdict.of([]).status, Verdict.of([]).headline) == (Status.PASS, "")


def test_what_passed_is_told_apart_from_what_was_raised():
    verdict = Verdict.of([finding(Status.PASS, "heading"), finding(Status.WARN, "clock")]).as_json()
    assert verdict["status"] == "WARN"
    assert [entry["check"] for entry in verdict["findings"]] == ["clock"]
    assert [entry["check"] for entry in verdict["passed"]] == ["heading"]
    assert {"check", "value", "limit", "says", "about"} <= set(verdict["findings"][0])


def test_the_terminal_shows_the_status_first_and_a_line_for_each_finding():
    lines = Verdict.of([finding(Status.PASS), finding(Status.WARN)]).lines
    assert lines[0] == "verdict: WARN (1 finding, 1 checks passed)"
    assert lines[1] == "WARN clock (front): images are 118 ms late; mend the stamps"
    assert len(lines) == 2


def test_a_check_that_the_drive_cannot_answer_is_told_apart_from_one_that_passed():
    verdict = Verdict.of([finding(Status.PASS, value=None)])
    assert verdict.status is Status.PASS
    assert not verdict.passed
    assert verdict.as_json()["unobservable"][0]["check"] == "clock"
    assert verdict.lines[1].startswith("cannot tell clock (front)")


def test_what_several_cameras_have_in_common_is_one_line():
    warning = finding(Status.WARN)
    lines = Verdict.of([warning, replace(warning, about="rear")]).lines
    assert lines[1:] == ("WARN clock (front, rear): images are 118 ms late; mend the stamps",)


def of_check(check, about, status=Status.FAIL):
    return Finding(check, status, 2.0, 1.0, "", "says", about)


def test_a_clean_drive_passes_with_and_without_ground(tmp_path):
    clean = pictured(tmp_path, noisy)
    assert not raised(input_findings(clean))
    assert not raised(input_findings(clean, {"front": estimate()}))


def test_a_yaw_from_north_is_told_once_although_the_ground_does_not_match_either(tmp_path):
    spoilt = pictured(tmp_path, noisy)
    recorded = poses()
    recorded = with_yaw(recorded, np.pi / 2 - yaw_of(recorded))
    spoilt = replace(spoilt, recorded=recorded, trajectory=recorded)
    ground = replace(
        estimate(),
        status=GroundStatus.NO_MATCH,
        reading=Reading.HEADING_FROM_PATH,
        shares={Reading.AS_GIVEN: 0.0, Reading.HEADING_FROM_PATH: 0.85},
    )
    findings = raised(input_findings(spoilt, {"front": ground}))
    assert list(findings) == ["heading"]
    assert findings["heading"].startswith("yaw counts clockwise from north")


@pytest.mark.parametrize(
    ("raised_checks", "causes_left"),
    [
        ("frozen images@front clock@front clock@rear", "frozen images@front clock@rear"),
        ("heading@poses ground match@front clock@rear", "heading@poses"),
    ],
    ids=["a cause in one camera hides nothing of another", "a cause in the poses hides all"],
)
def test_a_cause_hides_its_consequences(raised_checks, causes_left):
    def named(text):
        return [tuple(words.split("@")) for words in re.findall(r"[a-z ]+@[a-z]+", text)]

    findings = [of_check(check.strip(), about) for check, about in named(raised_checks)]
    assert [(cause.check, cause.about) for cause in causes(findings)] == [
        (c.strip(), a) for c, a in named(causes_left)
    ]


def test_a_cause_is_as_bad_as_its_worst_consequence_and_what_passed_hides_nothing():
    warned = of_check("square pixels", "front", Status.WARN)
    (cause,) = causes([warned, of_check("ground residual", "front", Status.FAIL)])
    assert (cause.check, cause.status) == ("square pixels", Status.FAIL)
    assert len(causes([of_check("heading", "poses", Status.PASS), of_check("clock", "rear")])) == 2


def test_no_two_checks_hide_each_other():
    for check, hidden in HIDES.items():
        assert all(check not in HIDES.get(other, ()) for other in hidden), check


def road(height_m):
    """A road of 60 m eastwards with heights at every metre."""
    slope = np.column_stack([np.gradient(height_m), np.zeros(61)])
    return Road(np.column_stack([np.arange(61.0), np.zeros(61)]), height_m, slope)


def test_a_drive_recorded_as_plane_and_a_long_grade_are_plane():
    assert not raised(check_road(drive(poses())))
    assert not raised(check_road(replace(drive(poses()), road=road(46.2 + 0.05 * np.arange(61.0)))))


@pytest.mark.parametrize(("grade", "status"), [(0.015, Status.WARN), (0.12, Status.FAIL)])
def test_the_foot_of_a_ramp_is_told_with_its_place(grade, status):
    ramp = road(grade * np.maximum(np.arange(61.0) - 30, 0))
    (ramp_finding,) = check_road(replace(drive(poses()), road=ramp))
    assert ramp_finding.status is status
    assert ramp_finding.value == pytest.approx(np.rad2deg(grade), rel=0.2)
    place_m = float(ramp_finding.says.split(" m along")[0])
    assert 15 < place_m < 45


@pytest.mark.parametrize("off_m", [0.0, 0.1, 0.6, 3.0])
def test_heights_that_two_passes_contradict_are_named_with_their_place_but_not_another_storey(off_m):
    outward = np.column_stack([np.arange(61.0), np.zeros(61)])
    back = outward[::-1] + np.array([0.0, 1.0])
    climb = np.tile([0.05, 0.0], (122, 1))
    points = np.concatenate([outward, back])
    height = 46.2 + 0.05 * points[:, 0] + off_m * (points[:, 1] > 0) * (points[:, 0] > 30)
    (height_finding,) = check_heights(replace(drive(poses()), road=Road(points, height, climb)))
    assert height_finding.status is (Status.WARN if off_m == 0.6 else Status.PASS)
    if off_m == 0.6:
        assert height_finding.value == pytest.approx(0.6)
        assert "the heights of two passes differ by 0.60 m" in height_finding.says
        assert int(height_finding.says.split("at x ")[1].split(" m")[0]) > 30


def written(folder, recorded):
    """A drive of one camera, an image every 2.5 m, in ``folder``."""
    (folder / "front/images").mkdir(parents=True)
    pictures = pictured(folder / "front/images", noisy, ".jpg", recorded)
    write_drive(folder, replace(pictures, name="tiny", root=folder), recorded)
    return folder


def test_a_clean_drive_ends_with_its_verdict_and_pictures(tmp_path, capsys):
    output = tmp_path / "check"
    arguments = [str(written(tmp_path / "drive", poses(4.0, 1.0))), "--no-ground", "--output", str(output)]
    assert run(["check", *arguments]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"^verdict: PASS \(nothing raised, \d+ checks passed\)$", shown, re.MULTILINE)
    assert "PASS speed" not in shown
    assert json.loads((output / "verdict.json").read_text())["status"] == "PASS"
    assert {path.name for path in output.glob("*.[jp][pn]g")} == {
        "route.png", "front_1.jpg", "front_2.jpg", "front_3.jpg",
    }  # fmt: skip
    assert run(["check", *arguments, "--all"]) == 0  # over its own earlier result
    assert "PASS speed (poses): " in capsys.readouterr().out


def test_a_drive_that_fails_exits_with_3_and_still_draws(tmp_path, capsys):
    recorded = poses(4.0, 1.0)
    folder = written(tmp_path / "drive", with_yaw(recorded, np.pi / 2 - yaw_of(recorded)))
    assert run(["check", str(folder), "--no-ground", "--output", str(tmp_path / "check")]) == 3
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("FAIL heading (poses): yaw counts clockwise from north")
    assert (tmp_path / "check" / "route.png").is_file()
