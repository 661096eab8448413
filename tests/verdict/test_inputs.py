"""All checks together: the cause is reported, its consequences are not; and ground that is no plane."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.verdict.drives import drive, estimate, noisy, pictured, poses, raised, with_yaw, yaw_of
from v2hdm.ground.results import GroundStatus, Reading
from v2hdm.records import FloatArray, Road
from v2hdm.verdict import Finding, Status, input_findings
from v2hdm.verdict.inputs.drive import HIDES, causes, check_road


def finding(check: str, about: str, status: Status = Status.FAIL) -> Finding:
    return Finding(check, status, 2.0, 1.0, "", "says", about)


def test_a_clean_drive_passes_with_and_without_ground(tmp_path: Path) -> None:
    clean = pictured(tmp_path, noisy)
    assert not raised(input_findings(clean))
    assert not raised(input_findings(clean, {"front": estimate()}))


def test_a_yaw_from_north_is_told_once_although_the_ground_does_not_match_either(tmp_path: Path) -> None:
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
    told = raised(input_findings(spoilt, {"front": ground}))
    assert list(told) == ["heading"]
    assert told["heading"].startswith("yaw counts clockwise from north")


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ("frozen images@front clock@front clock@rear", "frozen images@front clock@rear"),
        ("heading@poses ground match@front clock@rear", "heading@poses"),
    ],
    ids=["a cause in one camera hides nothing of another", "a cause in the poses hides all"],
)
def test_a_cause_hides_its_consequences(given, kept):
    def named(text):
        return [tuple(one.split("@")) for one in re.findall(r"[a-z ]+@[a-z]+", text)]

    findings = [finding(check.strip(), about) for check, about in named(given)]
    assert [(one.check, one.about) for one in causes(findings)] == [(c.strip(), a) for c, a in named(kept)]


def test_a_cause_is_as_bad_as_its_worst_consequence_and_what_passed_hides_nothing():
    warned = finding("square pixels", "front", Status.WARN)
    (kept,) = causes([warned, finding("ground residual", "front", Status.FAIL)])
    assert (kept.check, kept.status) == ("square pixels", Status.FAIL)
    assert len(causes([finding("heading", "poses", Status.PASS), finding("clock", "rear")])) == 2


def test_no_two_checks_hide_each_other() -> None:
    for check, hidden in HIDES.items():
        assert all(check not in HIDES.get(other, ()) for other in hidden), check


def road(height_m: FloatArray) -> Road:
    """A road of 60 m eastwards with heights at every metre."""
    slope = np.column_stack([np.gradient(height_m), np.zeros(61)])
    return Road(np.column_stack([np.arange(61.0), np.zeros(61)]), height_m, slope)


def test_a_drive_recorded_as_plane_and_a_long_grade_are_plane():
    assert not raised(check_road(drive(poses())))
    assert not raised(check_road(replace(drive(poses()), road=road(46.2 + 0.05 * np.arange(61.0)))))


@pytest.mark.parametrize(("grade", "status"), [(0.015, Status.WARN), (0.12, Status.FAIL)])
def test_the_foot_of_a_ramp_is_told_with_its_place(grade: float, status: Status) -> None:
    ramp = road(grade * np.maximum(np.arange(61.0) - 30, 0))
    (found,) = check_road(replace(drive(poses()), road=ramp))
    assert found.status is status
    assert found.value == pytest.approx(np.rad2deg(grade), rel=0.2)
    place_m = float(found.says.split(" m along")[0])
    assert 15 < place_m < 45
