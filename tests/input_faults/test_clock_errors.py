"""Errors by a clock that a drive does not show hold against maps that are off by one."""

from dataclasses import replace

import numpy as np
import pytest

from tests.adjust.scene import exp, make_scene, project
from v2hdm.adjust import PoseSigma, SolveOptions, solve
from v2hdm.faults.clock_errors import ClockEvidence, moves_with_clocks, second_moments
from v2hdm.records import PoseNoise

OPTIONS = SolveOptions(coarse=False, loss="none")
POSES = PoseSigma(0.01, 0.001, 0.002, 0.005)
SPEED_MPS = 5.0


def street(turn_deg_per_m=0.0):
    """Along a straight street, or one that bends after ten metres, at a constant speed."""
    scene = make_scene(
        3, frames=60, every_m=3.0, jitter=POSES, start_error_deg=0.5, straight_m=10.0,
        turn_deg_per_m=turn_deg_per_m,
    )  # fmt: skip
    poses = scene.problem.map_from_vehicle
    step = np.linalg.inv(poses[:-1]) @ poses[1:]
    step = np.concatenate([step, step[-1:]])
    twist = np.zeros((len(poses), 6))
    twist[:, 0] = SPEED_MPS
    length_m = np.linalg.norm(step[:, :2, 3], axis=1)
    twist[:, 5] = np.arctan2(step[:, 1, 0], step[:, 0, 0]) / length_m * SPEED_MPS
    return replace(scene, problem=replace(scene.problem, twist_vehicle=twist))


def seen_later(scene, later_s):
    """The problem of the scene with images taken ``later_s`` (J,) later than stamped, noise left out."""
    problem = scene.problem
    observations = problem.observations
    pixels = {}
    for share in (0.0, 1.0):
        then = scene.map_from_vehicle @ exp(share * later_s[:, None] * problem.twist_vehicle)
        cam_from_map = scene.cam_from_vehicle[observations.camera] @ np.linalg.inv(then)[observations.frame]
        pixels[share] = project(cam_from_map, scene.corners_map[observations.corner])
    moved = replace(observations, pinhole_px=observations.pinhole_px + pixels[1.0] - pixels[0.0])
    return replace(problem, observations=moved)


def corner_sigmas_m(moves):
    """Standard deviations (N, 2) that the clocks alone leave."""
    return np.sqrt(np.square(moves.corners).sum(axis=2))


def test_clocks_that_are_stated_to_be_right_leave_nothing_open():
    problem = street().problem
    solution = solve(problem, OPTIONS)
    assert moves_with_clocks(problem, solution, [PoseNoise()]) is None
    still = replace(problem, twist_vehicle=None)
    assert moves_with_clocks(still, solution, [PoseNoise(clock_s=0.03)]) is None


def test_a_straight_street_leaves_all_of_a_late_clock_in_the_map_along_the_way():
    problem = street().problem
    moves = moves_with_clocks(problem, solve(problem, OPTIONS), [PoseNoise(clock_s=0.02)])
    ahead = problem.map_from_vehicle[0, :2, 0]
    along_m = np.sqrt(np.square(np.einsum("nab,a->nb", moves.corners, ahead)).sum(axis=1))
    assert along_m == pytest.approx(0.02 * SPEED_MPS, rel=0.2)
    assert np.abs(moves.poses[:, 0, 0]) == pytest.approx(0.02 * SPEED_MPS, rel=0.2)
    across_m = np.sqrt(np.square(np.einsum("nab,a->nb", moves.corners, ahead[::-1] * [-1, 1])).sum(axis=1))
    assert across_m.max() < 0.2 * 0.02 * SPEED_MPS


def test_a_turn_shows_the_clock_and_leaves_little_open():
    straight, turning = (
        corner_sigmas_m(moves_with_clocks(s.problem, solve(s.problem, OPTIONS), [PoseNoise(clock_s=0.03)]))
        for s in (street(), street(turn_deg_per_m=4.0))
    )
    assert np.median(turning) < 0.2 * np.median(straight)


@pytest.mark.parametrize("drifts", [False, True])
def test_a_solution_moves_as_one_does_whose_images_were_taken_later(drifts):
    scene = street()
    share = np.linspace(-0.5, 0.5, 60) if drifts else np.ones(60)
    sigma_s = 1e-3  # far below what the drive tells, so that the prior is what is left
    noise = PoseNoise(clock_drift_s=sigma_s) if drifts else PoseNoise(clock_s=sigma_s)
    before = solve(scene.problem, OPTIONS)
    after = solve(seen_later(scene, sigma_s * share), OPTIONS)
    moves = moves_with_clocks(scene.problem, before, [noise])
    # The solve takes the images for earlier than they are: the true map lies where the clock would move it.
    expected_m = before.corners_map - after.corners_map
    atol = 0.1 * np.abs(expected_m).max()
    np.testing.assert_allclose(moves.corners[..., 0], expected_m, atol=atol)


def test_a_map_of_late_images_lies_inside_what_it_states_and_not_without():
    scene = street()
    late = seen_later(scene, np.full(60, 0.03))
    solution = solve(late, OPTIONS)
    off_m = solution.corners_map - scene.corners_map
    own_m2 = solution.corner_covariance(np.arange(len(off_m))[:, None])
    moves = moves_with_clocks(late, solution, [PoseNoise(clock_s=0.03)])
    with_clock_m2 = own_m2 + moves.corners @ moves.corners.swapaxes(1, 2)
    inside = [
        np.mean(np.einsum("na,nab,nb->n", off_m, np.linalg.inv(m2), off_m) < 5.99)
        for m2 in (own_m2, with_clock_m2)
    ]
    assert inside[0] < 0.1
    assert inside[1] > 0.95


def test_the_clock_of_each_session_errs_by_itself():
    problem = street().problem
    session = np.repeat([0, 1], 30)
    twice = replace(problem, session=session, pose_sigma=(POSES, POSES))
    solution = solve(twice, OPTIONS)
    first, of_both = (
        moves_with_clocks(twice, solution, [PoseNoise(clock_s=0.03), PoseNoise(clock_s=other_s)])
        for other_s in (0.0, 0.03)
    )
    assert (first.poses.shape[2], of_both.poses.shape[2]) == (1, 2)
    along_m = np.abs(first.poses[:, 0, 0])
    assert along_m[:20].min() > 3 * along_m[40:].max()


def test_second_moments_are_of_prior_and_evidence_together():
    """With the prior and 2 / (3 ms)^2 of information, a sigma of 3 ms / sqrt(3)."""
    noise = [PoseNoise(clock_s=0.003)]
    silent = ClockEvidence(np.zeros((1, 1)), np.zeros(1))
    np.testing.assert_allclose(second_moments(silent, noise), [[0.003]])
    clock_evidence = ClockEvidence(np.array([[2 * 0.003**-2.0]]), np.zeros(1))
    np.testing.assert_allclose(second_moments(clock_evidence, noise), [[0.003 / 3**0.5]])
    # The mean is two thirds of the 6 ms that the observations say: its square counts, too.
    late = ClockEvidence(np.array([[2 * 0.003**-2.0]]), np.array([2 * 0.006 / 0.003**2]))
    np.testing.assert_allclose(second_moments(late, noise), [[(0.004**2 + 0.003**2 / 3) ** 0.5]])
