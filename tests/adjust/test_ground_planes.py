"""The ground that texture shows is one more observation of a mounting, as sure as it says."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from tests.adjust.scene import make_scene, project, rows_of, with_ground
from v2hdm.adjust import model, solve
from v2hdm.errors import AdjustError
from v2hdm.geometry.rigid import exp


def test_the_planes_derivative_is_that_of_small_motions():
    cameras = make_scene(1, frames=4).cam_from_vehicle
    by_tangent = model.by_ground_planes(torch.as_tensor(cameras)).numpy()
    for axis, step in enumerate(1e-6 * np.eye(6)):
        moved = (model.ground_planes(torch.as_tensor(exp(way) @ cameras)) for way in (step, -step))
        high, low = moved
        np.testing.assert_allclose(by_tangent[:, :, axis], (high - low).numpy() / 2e-6, atol=1e-8)


def test_a_yaw_or_a_place_on_the_plane_is_not_the_grounds_to_tell():
    cameras = make_scene(1, frames=4).cam_from_vehicle
    moves = exp(np.array([[0.3, 0.0, 0.0, 0, 0, 0], [0, -0.4, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0.7]]))
    before = model.ground_planes(torch.as_tensor(cameras))
    for move in moves:
        torch.testing.assert_close(model.ground_planes(torch.as_tensor(cameras @ move)), before)


def few(seed):
    """A straight street with two markings, one of them false: a running board, 35 cm above the ground."""
    scene = make_scene(seed, frames=24, turn_deg_per_m=0.0, every_m=6.0, cameras=1, start_error_deg=0.5)
    observations = scene.problem.observations
    cam_from_map = scene.cam_from_vehicle[0] @ np.linalg.inv(scene.map_from_vehicle)[observations.frame]
    at_px, above_px = (
        project(cam_from_map, scene.corners_map[observations.corner], z_m) for z_m in (0.0, 0.35)
    )
    is_false = (observations.corner >= 4) & (observations.corner < 8)
    moved = replace(observations, pinhole_px=observations.pinhole_px + (above_px - at_px) * is_false[:, None])
    problem = replace(scene.problem, observations=rows_of(moved, observations.corner < 8), corner_count=8)
    return replace(scene, problem=problem, corners_map=scene.corners_map[:8])


def tilt_deg(scene, solution):
    """The angle between the ground's normals, solved and true."""
    normals = solution.cam_from_vehicle[0, :3, 2], scene.cam_from_vehicle[0, :3, 2]
    return float(np.rad2deg(np.linalg.norm(np.cross(*normals))))


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_a_false_marking_turns_a_camera_but_not_against_the_ground(seed):
    scene = few(seed)
    alone = tilt_deg(scene, solve(scene.problem))
    over_ground = tilt_deg(scene, solve(with_ground(scene, 0.13, 0.01).problem))
    assert alone > 4.0
    assert over_ground < alone / 4


def test_the_grounds_share_in_the_mountings_is_as_large_as_its_sigmas_say():
    """Squared deviations of 20 streets, whitened by what is stated, follow chi-square."""
    squared = 0.0
    for seed in range(10):
        scene = with_ground(make_scene(seed, frames=30, every_m=8.0, jitter=None), 0.05, 0.004, seed)
        solution = solve(scene.problem)
        for c in range(2):
            by_tangent = model.by_ground_planes(torch.as_tensor(solution.cam_from_vehicle))[c].numpy()
            planes = [model.ground_planes(torch.as_tensor(m))[c].numpy() for m in
                      (solution.cam_from_vehicle, scene.cam_from_vehicle)]  # fmt: skip
            across = np.linalg.svd(planes[1][None, :3])[2][1:]
            axes = np.zeros((3, 4))
            axes[:2, :3], axes[2, 3] = across, 1.0
            covariance = axes @ by_tangent @ solution.extrinsic_covariance[c] @ by_tangent.T @ axes.T
            off = axes @ (planes[0] - planes[1])
            squared += off @ np.linalg.solve(covariance, off)
    low, high = chi2.ppf([0.001, 0.999], 60)
    assert low < squared < high


def test_a_camera_without_texture_is_solved_as_before():
    scene = make_scene(2, frames=30)
    ground = with_ground(scene, 0.1, 0.01).problem.ground
    nothing = replace(ground, root_information=0 * ground.root_information)
    before = solve(scene.problem)
    after = solve(replace(scene.problem, ground=nothing))
    np.testing.assert_allclose(after.cam_from_vehicle, before.cam_from_vehicle, atol=1e-9)
    assert after.chi2_per_dof == pytest.approx(before.chi2_per_dof)


def test_a_ground_of_other_cameras_is_refused():
    problem = with_ground(make_scene(2, frames=30), 0.1, 0.01).problem
    with pytest.raises(AdjustError, match=r"ground.plane_cam has shape \(1, 4\), expected \(2, 4\)"):
        solve(replace(problem, ground=problem.ground.take(np.array([0]))))
    endless = replace(problem.ground, root_information=np.full((2, 3, 4), np.inf))
    with pytest.raises(AdjustError, match=r"ground.root_information of camera 0 is not finite"):
        solve(replace(problem, ground=endless))
