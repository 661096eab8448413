"""Recovery of known streets, and the optimum against an independent solver."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from tests.adjust.reference import reference_residuals, truth_of
from tests.adjust.scene import make_scene, rows_of, with_late_clocks
from v2hdm.adjust import (
    ControlPoints,
    Drift,
    KnownLengths,
    Observations,
    PoseSigma,
    SolveOptions,
    Status,
    solve,
)

PAPER = SolveOptions(pose_states=(), loss="none")
POSES = PoseSigma()
REAL = PoseSigma(position_m=0.02, heading_rad=0.0017, roll_pitch_rad=0.005, height_m=0.01)


def reference_optimum(scene):
    """The least cost that scipy finds from the truth."""

    def residuals(x):
        return np.concatenate([part.ravel() for part in reference_residuals(scene.problem, x).values()])

    exact = {"jac": "3-point", "x_scale": "jac", "ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15}
    return float(least_squares(residuals, truth_of(scene), **exact).cost)


def sides(scene, sigma_m, error_m=0.0):
    """Two sides and a diagonal of every other diamond of which all corners are seen, off by ``error_m``."""
    corners = scene.corners_map
    whole = [k for k in range(len(corners) - 3) if np.ptp(corners[k : k + 4], axis=0).max() < 0.75][::2]
    first, second = np.add.outer(whole, [0, 1, 0]).ravel(), np.add.outer(whole, [1, 2, 2]).ravel()
    length_m = np.linalg.norm(corners[first] - corners[second], axis=1) + error_m
    return KnownLengths(first, second, length_m, np.full(len(first), sigma_m))


@pytest.mark.parametrize("sigma_m", [None, 0.02, 0.0005])
def test_the_cost_is_that_of_an_independent_least_squares_solver_to_nine_digits(sigma_m):
    rng = np.random.default_rng(0)
    scene = make_scene(1, frames=12, step_m=1.2, jitter=POSES, every_m=3.0)
    root = rng.normal(0, 0.4, (len(scene.problem.observations.corner), 2, 2)) + 0.8 * np.eye(2)
    observations = replace(scene.problem.observations, covariance_px=root @ root.transpose(0, 2, 1))
    scene = replace(scene, problem=replace(scene.problem, observations=observations))
    if sigma_m is not None:
        scene = replace(scene, problem=replace(scene.problem, lengths=sides(scene, sigma_m, 0.01)))
    solution = solve(scene.problem, SolveOptions(loss="none"))
    expected = reference_optimum(scene)
    assert solution.status is Status.CONVERGED
    assert abs(solution.cost - expected) <= 1e-9 * expected


@pytest.mark.parametrize("start_error_deg", [3.0, 10.0])
@pytest.mark.parametrize("turn_deg_per_m", [0.0, 4.0])
@pytest.mark.parametrize("cameras", [1, 2])
def test_the_papers_model_recovers_a_street_with_perfect_poses(start_error_deg, turn_deg_per_m, cameras):
    settings = {"start_error_deg": start_error_deg, "turn_deg_per_m": turn_deg_per_m, "cameras": cameras}
    scene = make_scene(5, frames=70, prior_sigma_m=0.005, start_error_m=0.3, **settings)
    solution = solve(scene.problem, PAPER)
    assert solution.status is Status.CONVERGED
    assert scene.corner_rmse_m(solution.corners_map) < 0.02
    assert scene.rotation_error_deg(solution.cam_from_vehicle).max() < 0.02
    assert solution.chi2_per_dof == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("start_error_deg", [3.0, 10.0])
def test_pose_states_absorb_what_the_papers_model_must_put_into_the_map(start_error_deg):
    scene = make_scene(6, frames=80, jitter=REAL, start_error_deg=start_error_deg, prior_sigma_m=0.01)
    states, paper = solve(scene.problem), solve(scene.problem, PAPER)
    assert states.status is Status.CONVERGED
    assert scene.corner_rmse_m(states.corners_map) < 0.02
    assert scene.corner_rmse_m(states.corners_map) < 0.4 * scene.corner_rmse_m(paper.corners_map)
    assert scene.rotation_error_deg(states.cam_from_vehicle).max() < 0.1
    assert states.chi2_per_dof == pytest.approx(1, abs=0.05)
    assert paper.chi2_per_dof > 1.5


@pytest.mark.parametrize(("loss", "factor"), [("huber", 2.0), ("cauchy", 1.3), ("geman_mcclure", 1.3)])
def test_a_robust_loss_shrugs_off_three_percent_of_wrong_associations(loss, factor):
    clean, soiled = (make_scene(7, frames=60, jitter=POSES, outliers=share) for share in (0.0, 0.03))
    best = clean.corner_rmse_m(solve(clean.problem).corners_map)
    robust = solve(soiled.problem, SolveOptions(loss=loss))
    plain = solve(soiled.problem, SolveOptions(loss="none"))
    assert robust.status is Status.CONVERGED
    assert soiled.corner_rmse_m(robust.corners_map) < factor * best
    assert soiled.corner_rmse_m(plain.corners_map) > 3 * best
    wrong = robust.mahalanobis2 > 100
    assert 0.02 < wrong.mean() < 0.035


def test_knowing_that_rtk_errors_drift_slowly_helps():
    white = replace(POSES, position_m=0.04)
    drifting = replace(white, position_drift=Drift(0.04, 30.0))
    plain, correlated = [], []
    for seed in range(2):
        scene = make_scene(seed, frames=60, jitter=drifting, prior_sigma_m=0.005)
        unaware = replace(scene.problem, pose_sigma=white)
        plain.append(scene.corner_rmse_m(solve(unaware).corners_map))
        correlated.append(scene.corner_rmse_m(solve(scene.problem).corners_map))
    assert np.mean(correlated) < np.mean(plain)


def test_a_second_lap_over_the_same_markings_joins_the_first():
    scene = make_scene(9, frames=50, step_m=0.8, jitter=POSES)
    observations, again = scene.problem.observations, make_scene(9, frames=50, step_m=0.8, jitter=POSES)
    noise = np.random.default_rng(1).normal(0, 0.7, observations.pinhole_px.shape)
    of_both_laps = Observations(
        np.tile(observations.camera, 2),
        np.concatenate([observations.frame, observations.frame + 50]),
        np.tile(observations.corner, 2),
        np.concatenate([observations.pinhole_px, again.problem.observations.pinhole_px + noise]),
        np.tile(observations.covariance_px, (2, 1, 1)),
    )
    poses = np.tile(scene.problem.map_from_vehicle, (2, 1, 1))
    solution = solve(replace(scene.problem, observations=of_both_laps, map_from_vehicle=poses))
    assert solution.status is Status.CONVERGED
    assert scene.corner_rmse_m(solution.corners_map) < 0.02


def test_the_same_problem_gives_the_same_bits_and_another_order_the_same_optimum():
    problem = make_scene(10, frames=40, jitter=POSES, outliers=0.02).problem
    first, second = solve(problem), solve(problem)
    assert np.array_equal(first.corners_map, second.corners_map)
    assert np.array_equal(first.cam_from_vehicle, second.cam_from_vehicle)
    observations = problem.observations
    order = np.random.default_rng(0).permutation(len(observations.corner))
    third = solve(replace(problem, observations=rows_of(observations, order)))
    np.testing.assert_allclose(third.corners_map, first.corners_map, atol=1e-9)
    np.testing.assert_allclose(third.mahalanobis2, first.mahalanobis2[order], atol=1e-6)
    np.testing.assert_allclose(third.residual_px, first.residual_px[order], atol=1e-6)


def test_the_residuals_are_projected_minus_observed_pixels():
    scene = make_scene(11, frames=40, pixel_sigma=0.0, start_error_deg=0.5)
    moved = scene.problem.observations.pinhole_px.copy()
    moved[17] += [0.0, 5.0]
    observations = replace(scene.problem.observations, pinhole_px=moved)
    problem = replace(scene.problem, observations=observations, centre_vehicle=None, centre_sigma_m=None)
    solution = solve(problem, SolveOptions(pose_states=(), loss="geman_mcclure"))
    np.testing.assert_allclose(solution.residual_px[17], [0, -5], atol=0.1)
    assert np.delete(np.abs(solution.residual_px), 17, axis=0).max() < 0.1


def test_the_corners_may_be_given_a_start():
    scene = make_scene(12, frames=40)
    problem = replace(scene.problem, corners_start=scene.corners_map)
    free, from_start = solve(scene.problem, PAPER), solve(problem, replace(PAPER, coarse=False))
    assert from_start.cost == pytest.approx(free.cost, rel=1e-9)


def test_a_newton_step_of_the_cameras_leads_to_a_start_from_which_few_evaluations_do():
    """Corners that are given are not back-projected anew, and so cannot follow such a step."""
    problem = make_scene(0, frames=30, start_error_deg=1.0).problem
    solution = solve(problem, PAPER)
    aside_m = np.random.default_rng(0).normal(0, 0.1, solution.corners_map.shape)
    other = solve(replace(problem, corners_start=solution.corners_map + aside_m), PAPER)
    assert solution.evaluations < other.evaluations
    assert solution.cost == pytest.approx(other.cost, rel=1e-10)


def test_the_cost_is_the_sum_of_its_named_terms():
    solution = solve(make_scene(13, frames=40, jitter=POSES).problem)
    priors = "camera_centre ground_planes frame_states clock_offsets control_points known_lengths"
    assert set(solution.cost_terms) == {"observations", *priors.split()}
    assert solution.cost == pytest.approx(sum(solution.cost_terms.values()))
    assert solution.gap <= 1e-11


def test_a_camera_whose_clock_is_late_is_found_out():
    """The speed swings, so an offset in time is no offset in place."""
    offset_s = np.array([0.03, -0.01])
    scene = with_late_clocks(make_scene(14, frames=80, turn_deg_per_m=8.0, prior_sigma_m=0.01), offset_s)
    problem = scene.problem
    punctual, with_clocks = solve(problem, PAPER), solve(problem, replace(PAPER, clock_offset=True))
    assert with_clocks.status is Status.CONVERGED
    sigma_s = np.sqrt(with_clocks.covariance.clock_s2())
    assert np.all(sigma_s < 0.002)
    assert np.all(np.abs(with_clocks.clock_offset_s - offset_s[:, None]) < 4 * sigma_s)
    assert with_clocks.chi2_per_dof == pytest.approx(1, abs=0.05)
    assert punctual.chi2_per_dof > 1.2
    assert scene.corner_rmse_m(with_clocks.corners_map) < 0.5 * scene.corner_rmse_m(punctual.corners_map)


def test_two_control_points_undo_the_drift_of_the_receiver():
    """A shift of all positions is invisible to the cameras; surveyed corners at both ends show it."""
    sigma = PoseSigma(position_m=0.05, position_drift=Drift(0.05, 300.0))
    scene = make_scene(15, frames=60, jitter=sigma, prior_sigma_m=0.005)
    chosen = np.array([0, 5, scene.problem.corner_count - 2])
    control = ControlPoints(chosen, scene.corners_map[chosen], np.full((3, 2), 0.002))
    free, tied = solve(scene.problem), solve(replace(scene.problem, control=control))
    assert tied.status is Status.CONVERGED
    assert scene.corner_rmse_m(tied.corners_map) < 0.5 * scene.corner_rmse_m(free.corners_map)
    assert np.abs(tied.corners_map[chosen] - scene.corners_map[chosen]).max() < 0.006
    stated = tied.corner_covariance(chosen[:, None])
    assert np.sqrt(stated.trace(axis1=1, axis2=2)).max() < 0.003
    assert tied.chi2_per_dof == pytest.approx(1, abs=0.07)


def far_marking(seed):
    """A street on which one diamond, the corners that are returned, is only seen from beyond 18 m."""
    scene = make_scene(seed, frames=60, max_range_m=30.0, cameras=1, prior_sigma_m=0.005, start_error_deg=1.0)
    observations, corners = scene.problem.observations, scene.corners_map
    range_m = np.linalg.norm(
        corners[observations.corner] - scene.map_from_vehicle[observations.frame, :2, 3], axis=1
    )
    whole = [k for k in range(40, len(corners) - 3) if np.ptp(corners[k : k + 4], axis=0).max() < 0.75]
    mine = np.arange(whole[0], whole[0] + 4)
    keep = ~np.isin(observations.corner, mine) | (range_m > 18)
    return replace(scene, problem=replace(scene.problem, observations=rows_of(observations, keep))), mine


def test_known_sizes_make_a_far_marking_better_and_its_covariance_says_how_much():
    free, tied, surprise = [], [], []
    for seed in range(8):
        scene, mine = far_marking(30 + seed)
        first, second = mine[[0, 1, 2, 3, 0]], mine[[1, 2, 3, 0, 2]]
        length_m = np.linalg.norm(scene.corners_map[first] - scene.corners_map[second], axis=1)
        told_m = length_m + np.random.default_rng(seed).normal(0, 0.002, 5)
        lengths = KnownLengths(first, second, told_m, np.full(5, 0.002))
        plain, with_lengths = (
            solve(replace(scene.problem, lengths=known_lengths), PAPER) for known_lengths in (None, lengths)
        )
        assert with_lengths.status is Status.CONVERGED
        error = (with_lengths.corners_map - scene.corners_map)[mine]
        free.append(np.mean((plain.corners_map - scene.corners_map)[mine] ** 2))
        tied.append(np.mean(error**2))
        covariance = with_lengths.corner_covariance(mine)
        surprise.append(error.ravel() @ np.linalg.solve(covariance, error.ravel()))
        # A corner alone says the same as within its marking, whatever it is tied to.
        alone = with_lengths.corner_covariance(mine[[2]])
        np.testing.assert_allclose(alone, covariance[4:6, 4:6], rtol=1e-6)
        direction = (scene.corners_map[mine[0]] - scene.corners_map[mine[2]]) / length_m[4]
        along = np.concatenate([direction, 0 * direction, -direction, 0 * direction])
        assert np.sqrt(along @ covariance @ along) < 0.0021
    assert np.sqrt(np.mean(tied) / np.mean(free)) < 0.8
    # Eight draws of a chi-square with eight degrees of freedom; three standard errors.
    assert np.mean(surprise) == pytest.approx(8, abs=3 * np.sqrt(16 / 8))
