"""PASS means a goal: how well map and mountings have to be known, by what they state of themselves."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from tests.cameras import mounted
from tests.verdict.drives import INFO, square_at
from v2hdm.cli.commands.map import _map
from v2hdm.cli.compose import Job
from v2hdm.errors import ConfigError
from v2hdm.faults import Contradiction, table
from v2hdm.geometry.rigid import camera_centre, exp
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.results import AdjustedPoses, MethodResult, SolveEvidence
from v2hdm.pipeline.config import RunConfig, check_choice
from v2hdm.pipeline.grades import graded
from v2hdm.pipeline.map_drive import map_drive
from v2hdm.pipeline.run import RunResult
from v2hdm.records import Calibration, Exclusion, HDMap
from v2hdm.site.accuracy import absolute_radii_m, objection_to
from v2hdm.site.candidates import TOO_UNCERTAIN
from v2hdm.verdict import Finding, Status, Verdict
from v2hdm.verdict.results.accuracy import check_goal, ground_ahead, told_once
from v2hdm.verdict.verdict import passed

SURE = np.diag([0.003**2] * 3 + [1e-4**2] * 3)


def marking(number, shared_m=0.01, own_m=0.002):
    """A marking whose corners share an error, and have one of their own; sigmas of a coordinate."""
    covariance = shared_m**2 * np.kron(np.ones((4, 4)), np.eye(2)) + own_m**2 * np.eye(8)
    return replace(square_at(3.0 * number, 0.0), covariance_m2=covariance, relative_sigma_m=own_m)


def calibrated(covariance=SURE, pitch_deg=15.0):
    return Calibration(INFO, mounted((1.0, 0.2, 2.4), pitch_deg, 10.0, 2.0), covariance)


def mapped(markings, calibration=None, position_m=0.003):
    still = np.tile(np.eye(4), (5, 1, 1))
    sigma, is_seen = np.full((5, 6), position_m), np.ones(5, dtype=bool)
    poses = AdjustedPoses(np.arange(5.0), still, still, sigma, is_seen, {}, np.zeros(5, dtype=np.int64))
    calibrations = {"front": calibration or calibrated()}
    hd_map = graded(HDMap(tuple(markings)), 0.05)
    return MethodResult("Opt", ("front",), hd_map, calibrations, poses=poses)


def with_clocks(clock_m):
    """Evidence of a solve that leaves corners open by clocks alone."""
    return SolveEvidence(
        score_tests=(), corrected=(), pose_model="heave", held_out={}, fits={}, variance_factor=1.0,
        pose_noise={}, worst_innovation=0.0, worst_innovation_s=0.0, clock_m=clock_m,
    )  # fmt: skip


def judged(result, goal_m=0.05):
    return Verdict.of(check_goal(result, goal_m, "poses"))


def of_map(result, goal_m=0.05):
    return next(finding for finding in judged(result, goal_m).findings if finding.about == "map")


def test_a_good_map_passes_and_says_how_good_it_is_first():
    verdict = judged(mapped([marking(n) for n in range(40)]))
    says = (
        "95 % of the corners of 40 markings within 2.5 cm in the frame of the poses, "
        "0.5 cm from marking to marking; goal 5 cm"
    )
    assert verdict.headline == f"PASS: {says}"
    assert verdict.lines == (f"verdict: PASS (nothing raised, 2 checks passed): {says}",)
    assert verdict.as_json()["headline"] == verdict.headline


def test_a_straight_drive_with_70_cm_of_uncertainty_is_no_pass_and_names_the_mounting():
    straight = calibrated(np.diag([0.28**2] * 3 + [1e-4**2] * 3))
    verdict = judged(mapped([marking(n, shared_m=0.28) for n in range(34)], straight))
    assert verdict.status is Status.WARN
    assert verdict.headline.startswith(
        "WARN: 95 % of the corners of 34 markings within 69 cm in the frame of the poses, 0.5 cm"
    )
    says = {finding.about: finding.says for finding in verdict.raised}
    assert "0 % of the markings meet the goal; the largest part" in says["map"]
    assert all("include a turn, or survey the camera's place" in words for words in says.values())


@pytest.mark.parametrize(("coarse", "status"), [(2, Status.PASS), (12, Status.WARN)])
def test_one_corner_in_twenty_may_miss_the_goal(coarse, status):
    markings = [marking(n, own_m=0.002 if n >= coarse else 0.039) for n in range(100)]
    finding = of_map(mapped(markings))
    assert finding.status is status
    assert (finding.limit, finding.unit) == (5.0, "cm")
    if status is Status.WARN:
        assert "88 % of the markings meet the goal" in finding.says
        assert "is each marking's own views: pass them closer" in finding.says


def test_the_radius_of_all_corners_holds_for_errors_drawn_from_their_covariances():
    markings = [
        marking(n, shared_m=0.001, own_m=own_m) for n, own_m in enumerate(np.geomspace(0.003, 0.04, 60))
    ]
    radius_m = of_map(mapped(markings)).value / 100
    rng, inside = np.random.default_rng(3), []
    for mapped_marking in markings:
        errors = rng.multivariate_normal(np.zeros(8), mapped_marking.covariance_m2, 500).reshape(-1, 2)
        inside.append(np.mean(np.hypot(*errors.T) < radius_m))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.01)


def test_poses_that_drift_are_named_as_the_largest_part():
    finding = of_map(mapped([marking(n, shared_m=0.05) for n in range(30)], position_m=0.045))
    assert "the largest part, 11 cm, is the poses: tie them down by mapping.survey" in finding.says


def test_clocks_that_leave_more_open_than_the_goal_are_named_first_and_no_pass():
    unknown = replace(mapped([marking(n, shared_m=0.1) for n in range(30)]), evidence=with_clocks(0.2))
    verdict = judged(unknown)
    assert verdict.status is Status.WARN
    first, of_all = verdict.raised[:2]
    assert first.line.startswith("WARN clock (all cameras): whether all clocks are late or fast cannot")
    assert "pose_noise.clock_s" in first.says
    assert (first.value, first.limit, first.unit) == (20.0, 5.0, "cm")
    assert "the largest part, 20 cm, is the clocks" in of_all.says
    assert judged(unknown, goal_m=0.3).status is Status.PASS


def test_clocks_are_told_once_beside_what_else_the_drive_cannot_tell():
    unknown = replace(mapped([marking(n, shared_m=0.1) for n in range(30)]), evidence=with_clocks(0.2))
    of_goal = list(check_goal(unknown, 0.05, "poses"))
    cannot_tell = [
        passed(check, "all cameras", "include a turn") for check in ("slope", "clock", "clock drift")
    ]
    assert told_once(cannot_tell, of_goal) == (cannot_tell[:1], of_goal)
    met = list(check_goal(unknown, 0.3, "poses"))
    assert told_once(cannot_tell, met) == (cannot_tell, met)


def of_lens(sigma_px, cameras=("front", "rear"), sigmas=0.5, fault=table.PRINCIPAL):
    """A test of the principal point, of which one pixel moves the corners by 4 mm."""
    p_value = float(2 * norm.sf(sigmas))
    sigmas_px = {"value": sigmas * sigma_px, "sigma": sigma_px, "model_sigma": sigma_px}
    return Contradiction(fault.name, -1, 0, -1, **sigmas_px, p_value=p_value, moves_m=0.004, cameras=cameras)


def with_lens(*tests):
    evidence = replace(with_clocks(None), score_tests=tests)
    return replace(mapped([marking(n) for n in range(30)]), evidence=evidence)


def test_what_no_marking_shows_of_a_lens_is_told_where_it_makes_the_map_miss_the_goal():
    (unobservable,) = judged(with_lens(of_lens(6.0))).unobservable
    assert (unobservable.check, unobservable.about, unobservable.status) == (
        "principal point",
        "front, rear",
        Status.PASS,
    )
    assert "would show from 24 px on, and moves the corners by 9.6 cm until then" in unobservable.says
    assert not judged(with_lens(of_lens(3.0))).unobservable
    assert not judged(with_lens(of_lens(6.0)), goal_m=0.1).unobservable
    assert not judged(with_lens(of_lens(math.inf))).unobservable
    assert not judged(with_lens(of_lens(6.0, fault=table.CLOCK))).unobservable


def test_of_a_lens_the_worst_is_told_and_nothing_once_it_is_named_as_wrong():
    (unobservable,) = judged(with_lens(of_lens(4.0, ("front",)), of_lens(6.0))).unobservable
    assert "24 px" in unobservable.says
    named = with_lens(of_lens(4.0, sigmas=9.0), of_lens(6.0))
    assert not judged(named).unobservable


def test_markings_are_not_said_to_agree_with_a_lens_whose_errors_they_do_not_show():
    unseen = with_lens(of_lens(6.0))
    agrees = Finding("principal point", Status.PASS, 0.5, None, "sigmas", "agree", "front, rear")
    solved, of_goal = told_once([agrees], check_goal(unseen, 0.05, "poses"))
    assert solved == []
    assert [finding.check for finding in of_goal if finding.is_unobservable] == ["principal point"]


def test_a_clock_that_is_named_as_wrong_is_not_unknown():
    unknown = replace(mapped([marking(n, shared_m=0.1) for n in range(30)]), evidence=with_clocks(0.2))
    fast = Finding("clock drift", Status.FAIL, 5.0, 4.0, "sigmas", "runs fast", "front")
    findings, of_goal = told_once([fast], check_goal(unknown, 0.05, "poses"))
    assert findings == [fast]
    assert {finding.check for finding in of_goal} == {"coarse"}


def test_what_the_map_leaves_out_as_too_uncertain_is_said_beside_the_share():
    left_out = (
        Exclusion("diamond", np.zeros(2), 3, TOO_UNCERTAIN),
        Exclusion("diamond", np.zeros(2), 3, str(objection_to("C", "B"))),
        Exclusion("diamond", np.zeros(2), 3, "odd"),
    )
    one = replace(mapped([marking(n) for n in range(9)]), excluded=left_out)
    assert judged(one).headline.endswith("goal 5 cm; 2 more left out as too uncertain")


def test_markings_of_accuracy_c_are_told_beside_the_statement_as_long_as_they_are_fewer():
    sure = [marking(n) for n in range(30)]
    coarse = [marking(n, own_m=0.2) for n in range(100, 126)]
    finding = of_map(mapped([*sure, *coarse]))
    assert finding.status is Status.PASS
    assert finding.says == (
        "95 % of the corners of 30 markings within 2.5 cm in the frame of the poses, "
        "0.5 cm from marking to marking; goal 5 cm; 26 more are known less well (accuracy C)"
    )
    assert "; 1 more is known less well (accuracy C)" in of_map(mapped([*sure, coarse[0]])).says


def test_markings_of_accuracy_c_count_where_they_are_as_many_as_the_others():
    markings = [marking(n, own_m=0.002 if n % 2 else 0.2) for n in range(40)]
    finding = of_map(mapped(markings))
    assert finding.status is Status.WARN
    assert finding.says.startswith("95 % of the corners of 40 markings within 43 cm")
    assert "known less well" not in finding.says
    assert "50 % of the markings meet the goal" in finding.says


def test_what_states_no_covariance_promises_nothing():
    unknown = [replace(marking(n), covariance_m2=None, relative_sigma_m=None) for n in range(3)]
    for one in (mapped(unknown), mapped(unknown, calibrated(None))):
        verdict = judged(one)
        assert verdict.status is Status.WARN
        assert "within an unknown distance" in verdict.headline
        json.dumps(verdict.as_json(), allow_nan=False)
    assert "it saw no marking" in next(f.says for f in judged(one).raised if f.about == "front")


def test_the_terminal_ends_with_how_good_the_map_is(monkeypatch, capsys):
    verdict = judged(mapped([marking(n, shared_m=0.05) for n in range(30)]))
    result = RunResult(Path("out"), {"results": {}}, (), verdict)
    monkeypatch.setattr("v2hdm.pipeline.run.run", lambda *_: result)
    assert _map(Job(RunConfig(name="yard"), "")) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    assert [line.split(":")[0] for line in lines] == ["WARN coarse (map)", "results in out", "verdict"]
    assert "95 % of the corners of 30 markings within 12 cm" in lines[-1]


def test_a_failed_run_promises_no_accuracy():
    wrong = Finding("focal length", Status.FAIL, 40.0, 5.0, "sigmas", "4.5 % shorter: mend it", "front")
    verdict = Verdict.of([*check_goal(mapped([marking(1)]), 0.05, "poses"), wrong])
    assert verdict.headline == "FAIL: no accuracy can be promised, see focal length (front)"
    assert verdict.lines[0].startswith("verdict: FAIL (1 finding, 2 checks passed): no accuracy")


@pytest.mark.parametrize("ratio", [0.0, 0.2, 0.5, 0.8, 1.0])
def test_of_a_hundred_corners_95_are_within_the_radius(ratio):
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    worst = turn @ np.diag([0.02, 0.02 * ratio]) ** 2 @ turn.T
    covariance = np.zeros((8, 8))
    covariance[2:4, 2:4] = worst
    radius_m = absolute_radii_m([replace(marking(0), covariance_m2=covariance)]).max()
    errors = np.random.default_rng(1).normal(size=(400_000, 2)) * [0.02, 0.02 * ratio]
    assert np.mean(np.hypot(*errors.T) < radius_m) == pytest.approx(0.95, abs=0.002)


@pytest.mark.parametrize(("pitch_deg", "ahead_m"), [(2.0, 10.0), (-5.0, 10.0), (20.0, 6.59), (90.0, 0.0)])
def test_a_mounting_moves_the_ground_ahead_as_far_as_its_covariance_says(pitch_deg, ahead_m):
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6)) * ([[0.01]] * 3 + [[0.001]] * 3)
    calibration = calibrated(root @ root.T, pitch_deg)
    cam_from_vehicle = calibration.cam_from_vehicle
    centre, axis = camera_centre(cam_from_vehicle), cam_from_vehicle[2, :3]
    level = axis[:2] / max(float(np.hypot(*axis[:2])), 1e-12)
    ground = np.append(centre[:2] + ahead_m * level, 0.0)
    ray_cam = cam_from_vehicle[:3, :3] @ (ground - centre)
    moved = np.stack([exp(root @ one) @ cam_from_vehicle for one in rng.normal(size=(4000, 6))])
    rays, centres = np.einsum("nji,j->ni", moved[:, :3, :3], ray_cam), camera_centre(moved)
    hit = centres[:, :2] - rays[:, :2] * (centres[:, 2] / rays[:, 2])[:, None]
    off_m = np.linalg.norm(hit - ground[:2], axis=1)
    assert ground_ahead(calibration)[0] == pytest.approx(np.quantile(off_m, 0.95), rel=0.06)


@pytest.mark.parametrize("goal_cm", [0.0, -1.0, math.nan, math.inf])
def test_a_goal_without_size_is_refused_before_any_work(goal_cm):
    with pytest.raises(ConfigError, match=r"accuracy_goal_cm is .*: set more than 0"):
        check_choice(MappingOptions(), 1, False, goal_cm)
    with pytest.raises(ConfigError, match="accuracy_goal_cm"):
        map_drive("no such drive", accuracy_goal_cm=goal_cm)
