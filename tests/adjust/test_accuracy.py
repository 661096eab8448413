"""Small editions of the benchmarks of accuracy and convergence, and the bound that they report against."""

from functools import partial

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from tests.adjust.scene import FOCAL, PIXEL_SIGMA
from tests.benchmarks.adjust_accuracy import (
    ALL_DRIFTING,
    ALL_OVER_30_M,
    DRIFTING,
    PAPER,
    PLAIN,
    ROBUST,
    WHITE,
    driven_again,
    honesty,
    root_ratio,
    squared_bound_m2,
    squared_error_m2,
    street,
    surveyed,
)
from tests.benchmarks.adjust_convergence import by_us, reaches_the_optimum

SHORT = {"frames": 40, "every_m": 3.0}
SEEDS = range(6)


@pytest.mark.parametrize("jitter", [WHITE, ALL_DRIFTING])
def test_nearly_all_corners_lie_within_their_stated_regions(jitter):
    """Corners of one drive share the camera's error, so six drives are a coarse check of 95 %."""
    found = [honesty(street(seed, jitter, **SHORT)) for seed in SEEDS]
    assert np.mean([one.corner_coverage for one in found]) > 0.8
    assert 0.3 < np.mean([one.corner_nees for one in found]) < 2.2
    assert 0.3 < np.mean([one.rotation_nees for one in found]) < 2.2


def test_the_error_is_about_the_cramer_rao_bound_and_the_papers_far_above_it():
    scenes = [street(seed, WHITE, **SHORT) for seed in SEEDS]
    bound = [squared_bound_m2(scene) for scene in scenes]
    assert 0.6 < root_ratio([squared_error_m2(scene, PLAIN) for scene in scenes], bound) < 1.5
    assert root_ratio([squared_error_m2(scene, PAPER) for scene in scenes], bound) > 2


def test_wrong_associations_cost_little():
    sound, soiled = (
        [squared_error_m2(street(seed, WHITE, share, **SHORT), ROBUST) for seed in SEEDS]
        for share in (0.0, 0.03)
    )
    assert root_ratio(soiled, sound) < 1.3


@pytest.mark.parametrize("seed", range(3))
def test_a_start_ten_degrees_away_ends_in_the_optimum(seed):
    scene = street(seed, WHITE, **{**SHORT, "start_error_deg": 10.0})
    assert reaches_the_optimum(scene, partial(by_us, options=ROBUST))


SHORTER = {"frames": 30, "every_m": 5.0}
STEP = 1e-5


def small_motions(tangents):
    """Rigid motions of small tangents (n, 6), exact to first order, translation first."""
    out = np.tile(np.eye(4), (len(tangents), 1, 1))
    out[:, :3, :3] = Rotation.from_rotvec(tangents[:, 3:]).as_matrix()
    out[:, :3, 3] = tangents[:, :3]
    return out


def residuals(scene, x):
    """Whitened residuals of observations, camera centres and survey at changes x of the truth."""
    problem, seen = scene.problem, scene.problem.observations
    cameras, frames = len(problem.intrinsic), len(problem.map_from_vehicle)
    extrinsic, state, corner = np.split(x, [6 * cameras, 6 * cameras + 6 * frames])
    cam_from_vehicle = small_motions(extrinsic.reshape(-1, 6)) @ scene.cam_from_vehicle
    map_from_vehicle = problem.map_from_vehicle @ small_motions(state.reshape(-1, 6))
    corners = scene.corners_map + corner.reshape(-1, 2)
    cam_from_map = cam_from_vehicle[seen.camera] @ np.linalg.inv(map_from_vehicle)[seen.frame]
    ground = np.column_stack([corners[seen.corner], np.zeros(len(seen.corner)), np.ones(len(seen.corner))])
    point = np.einsum("kab,kb->ka", cam_from_map, ground)
    pixel = FOCAL * point[:, :2] / point[:, 2:3] / PIXEL_SIGMA
    centre = np.linalg.inv(cam_from_vehicle)[:, :3, 3] / problem.centre_sigma_m
    parts = [pixel.ravel(), centre.ravel()]
    if problem.control is not None:
        parts.append((corners[problem.control.corner] / problem.control.sigma_m).ravel())
    return np.concatenate(parts)


def state_covariance(scene):
    """Of all frames' states (6J, 6J)."""
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
    size = 6 * cameras + 6 * frames + 2 * scene.problem.corner_count
    steps = STEP * np.eye(size)
    columns = [(residuals(scene, step) - residuals(scene, -step)) / (2 * STEP) for step in steps]
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
