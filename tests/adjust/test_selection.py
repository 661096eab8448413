"""Which model of pose errors a drive asks for, what it leaves open, and what a solve leaves out."""

from dataclasses import replace

import numpy as np
import pytest

from tests.adjust.scene import make_scene, rows_of, with_late_clocks
from v2hdm.adjust import MODELS, PoseSigma, SolveOptions, Verdict, observability, select_model, solve
from v2hdm.adjust.selection import restrict
from v2hdm.errors import AdjustError

STILL = PoseSigma(position_m=1e-5, heading_rad=1e-6, roll_pitch_rad=1e-6, height_m=1e-5)


@pytest.mark.parametrize(
    ("jitter", "expected"),
    [
        (STILL, {"paper"}),
        (replace(STILL, roll_pitch_rad=0.004), {"roll_pitch"}),
        (PoseSigma(position_m=0.03, heading_rad=0.003, height_m=1e-5), {"full"}),
        (PoseSigma(position_m=0.03, heading_rad=0.003, height_m=0.03), {"heave"}),
    ],
)
def test_the_model_is_chosen_that_made_the_drive(jitter, expected):
    scene = make_scene(30, frames=60, jitter=jitter, start_error_deg=0.2, start_error_m=0.01)
    stated = replace(scene.problem, pose_sigma=PoseSigma(position_m=0.03, heading_rad=0.003, height_m=0.03))
    selection = select_model(stated, SolveOptions(loss_scale=2.0), ("paper", "roll_pitch", "full", "heave"))
    assert selection.name in expected
    assert set(selection.scores) == {"paper", "roll_pitch", "full", "heave"}
    assert repr(selection.name) in selection.sentence


def test_an_unknown_model_is_refused_with_the_choices():
    with pytest.raises(AdjustError, match="unknown model 'm5': choose from paper, roll_pitch, full"):
        select_model(make_scene(31, frames=20).problem, SolveOptions(), ("m5",))


def test_a_clock_needs_the_vehicles_motion_and_is_else_left_out():
    scene = make_scene(32, frames=20, start_error_deg=0.2)
    assert set(select_model(scene.problem, SolveOptions(), ("paper", "clock")).scores) == {"paper"}
    assert MODELS["clock"].clock_offset


@pytest.mark.parametrize(("late_s", "expected"), [(0.0, "heave"), (0.03, "clock")])
def test_a_clock_offset_is_estimated_where_there_is_one(late_s, expected):
    scene = make_scene(35, frames=50, turn_deg_per_m=8.0, start_error_deg=0.2, start_error_m=0.01)
    problem = with_late_clocks(scene, np.array([late_s, 0.0])).problem
    stated = replace(problem, pose_sigma=PoseSigma(0.01, 0.0005, 0.001, 0.003))
    assert select_model(stated, SolveOptions(), ("heave", "clock")).name == expected


def test_too_few_observations_leave_the_richest_model():
    problem = make_scene(34, frames=6, start_error_deg=0.2).problem
    observations = problem.observations
    part, _ = restrict(problem, observations.frame < 2)
    selection = select_model(part, SolveOptions())
    assert (selection.name, selection.scores) == ("heave", {})
    assert "too few observations" in selection.sentence


def test_a_part_of_a_problem_has_the_residuals_of_the_whole():
    problem = make_scene(33, frames=40, start_error_deg=0.5).problem
    observations = problem.observations
    keep = (observations.frame >= 10) & (observations.frame < 30)
    keep &= np.bincount(observations.corner[keep], minlength=problem.corner_count)[observations.corner] >= 2
    part, corners = restrict(problem, keep)
    assert len(part.map_from_vehicle) <= 20
    assert part.corner_count == len(corners)
    np.testing.assert_array_equal(corners[part.observations.corner], observations.corner[keep])
    assert solve(part, SolveOptions(pose_states=(), loss="none")).chi2_per_dof == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("cameras", [1, 2])
def test_a_straight_drive_leaves_forward_and_left_to_the_survey(cameras):
    scene = make_scene(1, frames=40, turn_deg_per_m=0.0, cameras=cameras, jitter=PoseSigma())
    for camera in observability(scene.problem, solve(scene.problem)):
        assert camera.unobserved == ("forward", "left")
        # The direction is common to both cameras, so two surveys halve its variance.
        assert camera.sigma[0] == pytest.approx(0.03 / np.sqrt(cameras), rel=0.1)
        assert "turn" in camera.sentence("front")


def test_turns_fix_all_offsets():
    scene = make_scene(1, frames=90, turn_deg_per_m=8.0)
    for camera in observability(scene.problem, solve(scene.problem)):
        assert camera.unobserved == ()
        assert camera.sigma[:3].max() < 0.015
        assert "the drive determines both" in camera.sentence("rear")


def test_what_is_said_of_the_centre_holds():
    scene = make_scene(2, frames=60, turn_deg_per_m=0.0, cameras=1)
    solution = solve(scene.problem)
    (camera,) = observability(scene.problem, solution)
    truth, estimated = (
        -m[0, :3, :3].T @ m[0, :3, 3] for m in (scene.cam_from_vehicle, solution.cam_from_vehicle)
    )
    assert np.all(np.abs(estimated - truth) < 4 * camera.sigma[:3])


def test_wrong_associations_are_contradicted_and_few_others_are():
    clean = make_scene(7, frames=50, jitter=PoseSigma()).problem
    soiled = make_scene(7, frames=50, jitter=PoseSigma(), outliers=0.03).problem
    off = np.linalg.norm(soiled.observations.pinhole_px - clean.observations.pinhole_px, axis=1)
    solution = solve(soiled)
    assert not solution.accepted[off > 10].any()
    assert np.mean(~solution.accepted[off == 0]) < 2e-3
    assert solution.verdict[solution.mahalanobis2.argmax()] == Verdict.CONTRADICTS


def test_of_two_observations_that_disagree_neither_is_believed():
    problem = make_scene(8, frames=40, jitter=PoseSigma()).problem
    observations = problem.observations
    mine = np.flatnonzero(observations.corner == 20)
    keep = np.ones(len(observations.corner), dtype=bool)
    keep[mine[1:-1]] = False
    pair = replace(problem, observations=rows_of(observations, keep))
    assert solve(pair).accepted[pair.observations.corner == 20].all()
    moved = pair.observations.pinhole_px.copy()
    first, second = np.flatnonzero(pair.observations.corner == 20)
    moved[first] += [60.0, -40.0]
    verdict = solve(replace(pair, observations=replace(pair.observations, pinhole_px=moved))).verdict
    assert Verdict.ACCEPTED not in verdict[[first, second]]
    assert Verdict.CONTRADICTS in verdict[[first, second]]


def test_the_gate_loses_the_share_of_sound_observations_that_it_is_told():
    problem = make_scene(9, frames=60).problem
    solution = solve(problem, SolveOptions(pose_states=(), gate_probability=0.05))
    assert abs(np.mean(~solution.accepted) - 0.05) < 0.015
