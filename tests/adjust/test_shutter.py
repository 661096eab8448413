"""Rolling shutters: each row of an image has the pose of its own time."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.adjust.scene import HEIGHT, PIXEL_SIGMA, Scene, exp, make_scene, project, with_late_clocks
from v2hdm.adjust import PoseSigma, SolveOptions, Status, solve
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.model import Estimate
from v2hdm.adjust.problem import POSE_STATES
from v2hdm.adjust.solve import coarse_extrinsics
from v2hdm.errors import AdjustError

PAPER = SolveOptions(pose_states=(), loss="none")


def share_of(row: np.ndarray) -> np.ndarray:
    """When in the read-out a row is read."""
    return row / (HEIGHT - 1) - 0.5


def rolling(read_out_s: np.ndarray, speed_mps: float = 10.0, noise: float = PIXEL_SIGMA, **street) -> Scene:
    """A street as cameras with ``read_out_s`` (C,) see it: every corner by the pose at which its row is read.

    The row is found by brute force: the pixel gives the row, the row the time, the time the pose, and that
    the pixel, until nothing changes.
    """
    scene = with_late_clocks(make_scene(**street), np.zeros(2))
    problem, observations = scene.problem, scene.problem.observations
    twist = problem.twist_vehicle * (speed_mps / 6.0)
    poses, truth = problem.map_from_vehicle[observations.frame], scene.cam_from_vehicle[observations.camera]
    pixel = observations.pinhole_px
    for _ in range(30):
        late_s = read_out_s[observations.camera] * share_of(pixel[:, 1])
        then = poses @ exp(twist[observations.frame] * late_s[:, None])
        pixel = project(truth @ np.linalg.inv(then), scene.corners_map[observations.corner])
    share = share_of(pixel[:, 1])
    pixel = pixel + noise * np.random.default_rng(5).standard_normal(pixel.shape)
    return replace(
        scene,
        problem=replace(
            problem,
            twist_vehicle=twist,
            observations=replace(observations, pinhole_px=pixel, row_share=share),
            read_out_s=read_out_s,
        ),
    )


READ_OUT_S = np.array([0.03, 0.02])
STREET = {"seed": 14, "frames": 80, "turn_deg_per_m": 8.0, "prior_sigma_m": 0.01}


@pytest.mark.parametrize("name", ["native", "torch"])
def test_the_residual_is_that_of_each_row_s_own_pose(name):
    """The poses err, the clock is off, and the read-out time is not the stated one."""
    scene = rolling(READ_OUT_S, **STREET)
    problem = replace(scene.problem, read_out_s=READ_OUT_S - 0.01)
    observations, rng = problem.observations, np.random.default_rng(1)
    arrays = make_arrays(problem, POSE_STATES, "cpu", True, True)
    state, late_s = rng.normal(0, 0.01, (80, 6)), np.array([[0.004], [-0.003]])
    estimate = Estimate(
        *(torch.as_tensor(array) for array in (scene.cam_from_vehicle, state, scene.corners_map)),
        torch.as_tensor(np.column_stack([late_s, [0.01, 0.01]])),
    )
    corners = replace(estimate, corners_map=estimate.corners_map[arrays.corner_order])
    residual_px, _, _ = make_engine(name, arrays).report(corners, problem.intrinsic[:, :2])
    for k in rng.integers(0, len(observations.frame), 200):
        c, j = observations.camera[k], observations.frame[k]
        time_s = late_s[c, 0] + READ_OUT_S[c] * observations.row_share[k]
        pose = problem.map_from_vehicle[j] @ exp(state[j]) @ exp(problem.twist_vehicle[j] * time_s)
        expected = project(
            (scene.cam_from_vehicle[c] @ np.linalg.inv(pose))[None],
            scene.corners_map[[observations.corner[k]]],
        )
        np.testing.assert_allclose(residual_px[k], expected[0] - observations.pinhole_px[k], atol=1e-8)


def test_a_known_read_out_time_costs_no_accuracy():
    """30 ms at 10 m/s: corners as of a global shutter; a mapper that does not know of it is far off."""
    stated = rolling(np.array([0.03, 0.03]), **STREET)
    still = rolling(np.zeros(2), **STREET)
    solution, expected = solve(stated.problem, PAPER), solve(still.problem, PAPER)
    ignorant = solve(replace(stated.problem, read_out_s=None), PAPER)
    assert solution.status is Status.CONVERGED
    rmse_m = stated.corner_rmse_m(solution.corners_map)
    assert rmse_m < 1.1 * still.corner_rmse_m(expected.corners_map)
    assert stated.corner_rmse_m(ignorant.corners_map) > 2 * rmse_m
    np.testing.assert_array_equal(solution.read_out_s, [0.03, 0.03])


@pytest.mark.parametrize("true_s", [READ_OUT_S, np.zeros(2)], ids=["rolling", "global"])
@pytest.mark.parametrize("engine", ["native", "torch"])
def test_an_estimated_read_out_time_is_the_true_one(engine, true_s):
    scene = rolling(true_s, **STREET)
    unknown = replace(scene.problem, read_out_s=None)
    solution = solve(unknown, replace(PAPER, read_out=True, engine=engine))
    sigma_s = np.sqrt(solution.covariance.clock_s2()[:, -1])
    assert solution.status is Status.CONVERGED
    assert (np.abs(solution.read_out_s - true_s) < 1e-3).all()
    assert (np.abs(solution.read_out_s - true_s) < 3 * sigma_s).all()
    assert (sigma_s < 5e-4).all()
    assert (solution.clock_offset_s == 0).all()


def test_a_read_out_time_is_found_beside_clocks_and_pose_errors():
    poses = PoseSigma(0.01, 0.0005, 0.001, 0.005)
    scene = rolling(READ_OUT_S, **STREET)
    problem = replace(scene.problem, read_out_s=np.zeros(2), clock_sigma_s=0.05, pose_sigma=poses)
    solution = solve(problem, SolveOptions(clock_offset=True, read_out=True))
    sigma_s = np.sqrt(solution.covariance.clock_s2())
    assert sigma_s.shape == (2, 2)
    assert (np.abs(solution.read_out_s - READ_OUT_S) < 3 * sigma_s[:, 1]).all()
    assert (np.abs(solution.clock_offset_s[:, 0]) < 3 * sigma_s[:, 0]).all()


def test_a_coarse_start_knows_the_read_out_time():
    scene = rolling(READ_OUT_S, **STREET, start_error_deg=8.0)
    arrays = make_arrays(scene.problem, POSE_STATES, "cpu", True, True)
    start = torch.as_tensor(scene.problem.cam_from_vehicle)
    improved, _ = coarse_extrinsics(make_engine("native", arrays), start)
    assert scene.rotation_error_deg(improved.numpy()).max() < 0.2


@pytest.mark.parametrize(
    ("change", "options", "said"),
    [
        ({"read_out_s": np.array([-0.01, 0.0])}, {}, "read_out_s of camera 0 is -0.01 s"),
        ({"read_out_s": np.array([0.0, np.nan])}, {}, "read_out_s of camera 1 is not finite"),
        ({"read_out_s": np.zeros(3)}, {}, "read_out_s has shape"),
        ({"twist_vehicle": None}, {}, "a read-out time needs twist_vehicle"),
        ({"row_share": None}, {}, "a read-out time needs row_share"),
        ({"read_out_sigma_s": 0.0}, {"read_out": True}, "read_out_sigma_s is 0.0"),
    ],
)
def test_a_read_out_time_that_cannot_be_is_refused(change, options, said):
    problem = rolling(READ_OUT_S, seed=1, frames=20).problem
    if "row_share" in change:
        change = {"observations": replace(problem.observations, **change)}
    problem = replace(problem, **change)
    with pytest.raises(AdjustError, match=said):
        solve(problem, replace(PAPER, **options))
