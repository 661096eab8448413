"""All checks together: the cause is told, its consequences are not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.verdict.drives import poses, raised, with_yaw, yaw_of
from tests.verdict.test_ground_findings import estimate
from tests.verdict.test_images import noisy, pictured
from v2hdm.ground.results import GroundStatus, Reading
from v2hdm.verdict import Finding, Status, input_findings
from v2hdm.verdict.inputs.drive import HIDES, causes


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


def test_a_cause_in_one_camera_does_not_hide_another_s_findings() -> None:
    kept = causes([finding("frozen images", "front"), finding("clock", "front"), finding("clock", "rear")])
    assert [(one.check, one.about) for one in kept] == [("frozen images", "front"), ("clock", "rear")]


def test_a_cause_in_the_poses_hides_consequences_in_every_camera() -> None:
    kept = causes([finding("heading", "poses"), finding("ground match", "front"), finding("clock", "rear")])
    assert [one.check for one in kept] == ["heading"]


def test_a_cause_is_as_bad_as_its_worst_consequence() -> None:
    warned = finding("square pixels", "front", Status.WARN)
    (kept,) = causes([warned, finding("ground residual", "front", Status.FAIL)])
    assert (kept.check, kept.status) == ("square pixels", Status.FAIL)


def test_what_passed_hides_nothing() -> None:
    assert len(causes([finding("heading", "poses", Status.PASS), finding("clock", "rear")])) == 2


def test_no_two_checks_hide_each_other() -> None:
    for check, hidden in HIDES.items():
        assert all(check not in HIDES.get(other, ()) for other in hidden), check
