"""Stated covariances are those of the errors, alone and over many drives."""

import numpy as np
import pytest

from tests.adjust.scene import make_scene
from v2hdm.adjust import Drift, PoseSigma, SolveOptions, solve


def test_covariances_agree_with_the_scatter_of_many_solves():
    """Small Monte Carlo: 24 draws of noise, states and prior on one street."""
    street = {"frames": 14, "step_m": 1.0, "jitter": PoseSigma(), "cameras": 1, "start_error_deg": 0.2}
    corners, extrinsics = [], []
    base, mark = make_scene(20, **street), np.arange(8)
    for seed in range(24):
        scene = make_scene(20, **street, noise_seed=1000 + seed)
        assert np.array_equal(scene.corners_map, base.corners_map)
        last = solve(scene.problem, SolveOptions(loss="none", coarse=False))
        corners.append((last.corners_map[mark] - scene.corners_map[mark]).ravel())
        off = last.cam_from_vehicle[0, :3, :3] @ scene.cam_from_vehicle[0, :3, :3].T
        extrinsics.append([off[2, 1], off[0, 2], off[1, 0]])
    stated = np.diag(last.corner_covariance(mark))
    found = np.mean(np.square(corners), axis=0)
    assert np.mean(found / stated) == pytest.approx(1, abs=0.3)
    rotation = np.diag(last.extrinsic_covariance[0])[3:]
    np.testing.assert_allclose(np.mean(np.square(extrinsics), axis=0) / rotation, 1, atol=0.6)


DRIFTING = PoseSigma(
    position_drift=Drift(0.018, 30.0), heading_drift=Drift(0.0007, 5.0), roll_pitch_drift=Drift(0.002, 1.2)
)


@pytest.mark.parametrize(("jitter", "drives"), [(PoseSigma(), 32), (DRIFTING, 16)])
def test_the_normalised_error_of_a_marking_is_chi_square_distributed(jitter, drives):
    squares = []
    for seed in range(drives):
        scene = make_scene(40 + seed, frames=24, step_m=0.8, jitter=jitter, start_error_deg=0.5)
        solution = solve(scene.problem, SolveOptions(coarse=False))
        groups = np.arange(scene.problem.corner_count)[:, None]
        covariance = solution.corner_covariance(groups)
        error = solution.corners_map - scene.corners_map
        squares.append(np.einsum("na,nab,nb->n", error, np.linalg.inv(covariance), error).mean())
    # Corners of one drive share the camera's error: each drive is about one draw of a chi-square with two
    # degrees of freedom, whose standard deviation is 2. Three standard errors of the mean are allowed.
    assert np.mean(squares) == pytest.approx(2, abs=3 * 2 / np.sqrt(drives))
