"""The bound that benchmarks report against, beside a dense one that shares no code with the solver.

Numbers of the information are differences of a projection written down here; the drift's prior is the
covariance sigma^2 exp(-d / over_m) between any two frames, not a chain from one to the next; nothing is
eliminated but by one inverse of everything.
"""

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from tests.adjust.scene import FOCAL, PIXEL_SIGMA, Scene
from tests.benchmarks.adjust_accuracy import (
    ALL_DRIFTING,
    ALL_OVER_30_M,
    DRIFTING,
    WHITE,
    driven_again,
    squared_bound_m2,
    street,
    surveyed,
)

SHORT = {"frames": 30, "every_m": 5.0}
STEP = 1e-5


def small_motions(tangents: np.ndarray) -> np.ndarray:
    """Rigid motions of small tangents (n, 6), exact to first order, translation first."""
    out = np.tile(np.eye(4), (len(tangents), 1, 1))
    out[:, :3, :3] = Rotation.from_rotvec(tangents[:, 3:]).as_matrix()
    out[:, :3, 3] = tangents[:, :3]
    return out


def residuals(scene: Scene, x: np.ndarray) -> np.ndarray:
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


def state_covariance(scene: Scene) -> np.ndarray:
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


def dense_bound_m2(scene: Scene) -> float:
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
    scene = street(0, jitter, turn_deg_per_m=turn_deg_per_m, **SHORT)
    assert squared_bound_m2(scene) == pytest.approx(dense_bound_m2(scene), rel=1e-6)


def test_more_passes_and_a_survey_lower_the_bound_as_one_dense_inverse_says():
    scene = street(1, DRIFTING, **SHORT)
    bound = squared_bound_m2(scene)
    twice, fixed = driven_again(scene, 2), surveyed(scene, 2)
    assert squared_bound_m2(twice) == pytest.approx(dense_bound_m2(twice), rel=1e-6)
    assert squared_bound_m2(fixed) == pytest.approx(dense_bound_m2(fixed), rel=1e-6)
    assert max(squared_bound_m2(twice), squared_bound_m2(fixed)) < bound
