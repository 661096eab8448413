"""The solver's own tables: small, complete, and the same problem however they are cut."""

import dataclasses

import numpy as np
import pytest

from tests.adjust.scene import make_scene
from v2hdm.adjust import KnownLengths, PoseSigma, Problem, SolveOptions, arrays, solve
from v2hdm.adjust.problem import POSE_STATES


def street(**changes) -> Problem:
    """Corners far apart on the route, joined by lengths: 0 to 5 to 40, and 7 to 9."""
    problem = make_scene(2, frames=40, jitter=PoseSigma(), **changes).problem
    lengths = KnownLengths(np.array([0, 5, 9]), np.array([5, 40, 7]), np.full(3, 2.0), np.full(3, 9.0))
    return dataclasses.replace(problem, lengths=lengths)


@pytest.mark.parametrize("pose_states", [(), POSE_STATES])
def test_the_optimum_is_the_same_in_short_runs_and_in_one(monkeypatch, pose_states):
    options = SolveOptions(pose_states=pose_states)
    whole = solve(street(outliers=0.02), options)
    monkeypatch.setattr(arrays, "_RUN", 50)
    parts = solve(street(outliers=0.02), options)
    assert parts.cost == pytest.approx(whole.cost, rel=1e-12)
    np.testing.assert_allclose(parts.corners_map, whole.corners_map, atol=1e-9)
    np.testing.assert_allclose(parts.mahalanobis2, whole.mahalanobis2, atol=1e-6)
    groups = np.array([[0, 40], [9, 12]])
    covariance = whole.corner_covariance(groups)
    np.testing.assert_allclose(parts.corner_covariance(groups), covariance, rtol=1e-6)


def test_the_covariance_of_corners_that_lengths_join_knows_the_lengths_however_they_are_grouped():
    problem = make_scene(3, frames=30, cameras=1, start_error_deg=0.0, start_error_m=0.0).problem
    first, second = np.array([2, 3]), np.array([3, 8])
    length_m = np.array([0.5, 3.0])
    lengths = KnownLengths(first, second, length_m, np.array([0.003, 0.004]))
    solution = solve(dataclasses.replace(problem, lengths=lengths), SolveOptions(pose_states=(), loss="none"))
    joint = solution.corner_covariance(np.array([2, 3, 8, 20]))
    part = solution.corner_covariance(np.array([[8, 20], [3, 2]]))
    np.testing.assert_allclose(part[0], joint[4:, 4:], rtol=1e-9)
    np.testing.assert_allclose(part[1], joint[[2, 3, 0, 1]][:, [2, 3, 0, 1]], rtol=1e-9)
    assert np.linalg.eigvalsh(joint).min() > 0
    for k, sigma_m in enumerate((0.003, 0.004)):
        apart = solution.corners_map[first[k]] - solution.corners_map[second[k]]
        direction = apart / np.linalg.norm(apart)
        along = np.zeros(8)
        along[2 * k : 2 * k + 4] = np.concatenate([direction, -direction])
        assert np.sqrt(along @ joint @ along) < sigma_m
