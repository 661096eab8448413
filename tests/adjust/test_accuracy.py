"""The error beside the Cramer-Rao bound, and that bound beside one dense inverse."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from tests.adjust.reference import reference_residuals, truth_of
from tests.benchmarks.adjust_accuracy import (
    ALL_DRIFTING,
    ALL_OVER_30_M,
    DRIFTING,
    PAPER,
    PLAIN,
    WHITE,
    driven_again,
    root_ratio,
    squared_bound_m2,
    squared_error_m2,
    street,
    surveyed,
)

SHORT = {"frames": 40, "every_m": 3.0}
SEEDS = range(6)


def test_the_error_is_about_the_cramer_rao_bound_and_the_papers_far_above_it():
    scenes = [street(seed, WHITE, **SHORT) for seed in SEEDS]
    bound = [squared_bound_m2(scene) for scene in scenes]
    assert 0.6 < root_ratio([squared_error_m2(scene, PLAIN) for scene in scenes], bound) < 1.5
    assert root_ratio([squared_error_m2(scene, PAPER) for scene in scenes], bound) > 2


SHORTER = {"frames": 30, "every_m": 5.0}
STEP = 1e-5


def state_covariance(scene):
    """The prior covariance (6J, 6J) of all frames' states."""
    sigma, poses = scene.problem.pose_sigma, scene.problem.map_from_vehicle
    steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    driven_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    apart_m = np.abs(np.subtract.outer(driven_m, driven_m))
    out = np.zeros((6 * len(poses), 6 * len(poses)))
    for column, (total, drift) in enumerate(zip(sigma.by_state(), sigma.drift_by_state(), strict=True)):
        white = (total**2 - drift.sigma**2) * np.eye(len(poses))
        fading = drift.sigma**2 * np.exp(-apart_m / drift.over_m)
        out[column::6, column::6] = white + fading
    # The position errs along the map's axes, the state is along the vehicle's.
    turn = np.tile(np.eye(6), (len(poses), 1, 1))
    turn[:, :2, :2] = poses[:, :2, :2].transpose(0, 2, 1)
    turn = block_diag(*turn)
    return turn @ out @ turn.T


def dense_bound_m2(scene):
    """Mean trace of the corners' blocks of the whole inverse information."""
    cameras, frames = len(scene.problem.intrinsic), len(scene.problem.map_from_vehicle)
    truth = truth_of(scene)

    def residuals(x):
        parts = reference_residuals(scene.problem, x)
        return np.concatenate([part.ravel() for name, part in parts.items() if name != "states"])

    steps = STEP * np.eye(len(truth))
    columns = [(residuals(truth + step) - residuals(truth - step)) / (2 * STEP) for step in steps]
    jacobian = np.stack(columns, axis=1)
    information = jacobian.T @ jacobian
    states = slice(6 * cameras, 6 * cameras + 6 * frames)
    information[states, states] += np.linalg.inv(state_covariance(scene))
    corners = np.linalg.inv(information)[states.stop :, states.stop :]
    return float(np.trace(corners)) / scene.problem.corner_count


@pytest.mark.parametrize("jitter", [WHITE, DRIFTING, ALL_DRIFTING, ALL_OVER_30_M])
@pytest.mark.parametrize("turn_deg_per_m", [0.0, 4.0])
def test_the_bound_is_that_of_one_dense_inverse(jitter, turn_deg_per_m):
    scene = street(0, jitter, turn_deg_per_m=turn_deg_per_m, **SHORTER)
    assert squared_bound_m2(scene) == pytest.approx(dense_bound_m2(scene), rel=1e-6)


def test_more_passes_and_a_survey_lower_the_bound_as_one_dense_inverse_says():
    scene = street(1, DRIFTING, **SHORTER)
    bound = squared_bound_m2(scene)
    twice, fixed = driven_again(scene, 2), surveyed(scene, 2)
    assert squared_bound_m2(twice) == pytest.approx(dense_bound_m2(twice), rel=1e-6)
    assert squared_bound_m2(fixed) == pytest.approx(dense_bound_m2(fixed), rel=1e-6)
    assert max(squared_bound_m2(twice), squared_bound_m2(fixed)) < bound
