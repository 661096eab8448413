"""What is left out is named with a reason; what is sound stays."""

from dataclasses import replace

import numpy as np

from tests.adjust.scene import make_scene
from v2hdm.adjust import Observations, PoseSigma, Problem, SolveOptions, Verdict, solve


def keep_rows(problem: Problem, keep: np.ndarray) -> Problem:
    seen = problem.observations
    parts = (seen.camera, seen.frame, seen.corner, seen.pinhole_px, seen.covariance_px)
    return replace(problem, observations=Observations(*(part[keep] for part in parts)))


def test_wrong_associations_are_listed_with_a_reason_and_few_others_are():
    clean = make_scene(7, frames=50, jitter=PoseSigma()).problem
    soiled = make_scene(7, frames=50, jitter=PoseSigma(), outliers=0.03).problem
    off = np.linalg.norm(soiled.observations.pinhole_px - clean.observations.pinhole_px, axis=1)
    solution = solve(soiled)
    out = solution.excluded(soiled.observations)
    assert [one.observation for one in out] == sorted(
        np.flatnonzero(~solution.accepted), key=lambda k: -solution.mahalanobis2[k]
    )
    assert not solution.accepted[off > 10].any()
    assert np.mean(~solution.accepted[off == 0]) < 2e-3
    assert out[0].verdict is Verdict.CONTRADICTS
    assert out[0].sentence.startswith(f"observation {out[0].observation} (corner {out[0].corner}, camera")
    assert out[0].distance_sigma == np.sqrt(solution.mahalanobis2[out[0].observation])


def test_of_two_observations_that_disagree_neither_is_believed():
    problem = make_scene(8, frames=40, jitter=PoseSigma()).problem
    seen = problem.observations
    mine = np.flatnonzero(seen.corner == 20)
    keep = np.ones(len(seen.corner), dtype=bool)
    keep[mine[1:-1]] = False
    pair = keep_rows(problem, keep)
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
