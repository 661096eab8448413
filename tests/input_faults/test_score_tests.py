"""Score tests of wrong inputs, against solving with the input freed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.adjust.scene import PIXEL_SIGMA, Scene, exp, make_scene, project, with_ground, with_late_clocks
from v2hdm.adjust import ControlPoints, KnownLengths, PoseSigma, SolveOptions, pose_innovations, solve
from v2hdm.adjust.model import Estimate, prior_residuals, rigid
from v2hdm.adjust.problem import POSE_STATES
from v2hdm.faults import Fault, table
from v2hdm.faults.jacobians import priors_by_unknowns
from v2hdm.faults.odds import is_contradicted
from v2hdm.faults.score_tests import score_faults
from v2hdm.faults.sensitivity import Sensitivity

OPTIONS = SolveOptions(coarse=False, loss="none")
POSES = PoseSigma(0.01, 0.001, 0.002, 0.005)


def scene(seed=3):
    return make_scene(seed, frames=60, every_m=3.0, jitter=POSES, start_error_deg=0.5)


def found_of(problem, fault, camera, axis=0):
    tests = score_faults(problem, solve(problem, OPTIONS))
    (test,) = [s for s in tests if (s.fault, s.camera, s.axis) == (fault, camera, axis)]
    return test


def with_focal(problem, factor, axes=(0, 1)):
    intrinsic = problem.intrinsic.copy()
    intrinsic[:, axes] *= factor
    return replace(problem, intrinsic=intrinsic)


def test_a_right_problem_contradicts_nothing():
    problem = scene().problem
    assert all(test.sigmas < 4 for test in score_faults(problem, solve(problem, OPTIONS)))


def test_the_gain_and_the_value_of_a_focal_length_are_those_of_solving_for_it():
    problem = with_focal(scene().problem, 1.002)
    step = 5e-4
    low, middle, high = (2 * solve(with_focal(problem, 1 + p), OPTIONS).cost for p in (-step, 0.0, step))
    curvature, slope = (high - 2 * middle + low) / step**2, (high - low) / (2 * step)
    test = found_of(problem, table.FOCAL, -1)
    assert test.value == pytest.approx(-slope / curvature, rel=0.05)
    assert test.sigma == pytest.approx((2 / curvature) ** 0.5, rel=0.3), "by what the stretches disagree"
    assert 0 < test.gain < slope**2 / (4 * curvature), "stretches that the others predict gain less"
    assert test.value == pytest.approx(-0.002, abs=4 * test.sigma)


def test_an_error_of_a_lens_moves_the_corners_as_solving_with_it_does():
    problem = scene().problem
    test_of = {
        (test.fault, test.camera, test.axis): test for test in score_faults(problem, solve(problem, OPTIONS))
    }
    step = 1e-3
    wrong, right = (solve(with_focal(problem, 1 + p), OPTIONS).corners_map for p in (step, 0.0))
    moved_m = np.sqrt(np.mean(np.sum((wrong - right) ** 2, axis=1)))
    assert test_of[table.FOCAL, -1, 0].moves_m == pytest.approx(moved_m / step, rel=0.05)
    assert test_of[table.CROWN, -1, 0].moves_m == 0.0


def test_fy_is_contradicted_where_an_error_of_both_focal_lengths_would_be_too_small_to_matter():
    street = make_scene(3, frames=150, every_m=3.0, jitter=POSES, start_error_deg=0.5)
    problem = with_focal(street.problem, 1.02, (1,))
    of_focal = [test for test in score_faults(problem, solve(problem, OPTIONS)) if test.fault is table.FOCAL]
    of_both, fy = (
        next(test for test in of_focal if (test.camera, test.axis) == (-1, axis)) for axis in (0, 1)
    )
    assert of_both.sigmas > 5
    assert not is_contradicted(of_both)
    assert is_contradicted(fy)
    assert fy.value == pytest.approx(-0.02, abs=3 * fy.sigma)


def test_a_late_clock_is_found_and_named_first():
    late = with_late_clocks(scene(), np.array([0.06, 0.0])).problem
    tests = score_faults(late, solve(late, OPTIONS))
    assert (tests[0].fault, tests[0].camera) == (table.CLOCK, 0)
    assert tests[0].value == pytest.approx(0.06, abs=0.01)
    assert tests[0].sigmas > 7


def test_stamps_that_jitter_do_not_look_like_positions_that_are_stretched():
    street = scene()
    recorded = street.problem.map_from_vehicle.copy()
    jitter_m = np.random.default_rng(1).normal(0.0, 6 * POSES.position_m, (len(recorded), 1))
    recorded[:, :3, 3] += jitter_m * recorded[:, :3, 0]
    test = found_of(replace(street.problem, map_from_vehicle=recorded), table.SCALE, -1)
    assert test.sigmas < 2.5
    stretched = street.problem.map_from_vehicle.copy()
    stretched[:, :2, 3] *= 1.1
    test = found_of(replace(street.problem, map_from_vehicle=stretched), table.SCALE, -1)
    assert test.value == pytest.approx(-0.1, abs=0.02)
    assert test.sigmas > 4


def test_a_survey_is_held_against_what_the_drive_says_without_it():
    problem = scene().problem
    assert problem.centre_vehicle is not None
    centre = problem.centre_vehicle + np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    wrong = replace(problem, centre_vehicle=centre)
    sigma = problem.centre_sigma_m.copy()  # type: ignore[union-attr]
    sigma[0, 2] = 1e3
    free = solve(replace(wrong, centre_sigma_m=sigma), OPTIONS)
    rotation, translation = free.cam_from_vehicle[0, :3, :3], free.cam_from_vehicle[0, :3, 3]
    without_m = float((-rotation.T @ translation)[2])
    test = found_of(wrong, table.SURVEY, 0, 2)
    assert test.value == pytest.approx(without_m - centre[0, 2], abs=0.02)
    assert test.sigmas > 5


def test_centres_that_are_all_off_alike_are_laid_to_the_point_of_the_poses():
    problem = scene().problem
    assert problem.centre_vehicle is not None
    off = replace(problem, centre_vehicle=problem.centre_vehicle + np.array([1.2, 0.0, 0.0]))
    first = score_faults(off, solve(off, OPTIONS))[0]
    assert (first.fault, first.axis) == (table.LEVER, 0)
    assert first.value == pytest.approx(-1.2, abs=0.1)


def test_known_sizes_that_the_paint_does_not_have_are_told_with_those_that_it_has():
    street = scene()
    side_m = 0.35 * 2**0.5
    corners = street.corners_map
    first = np.flatnonzero(np.abs(np.linalg.norm(np.diff(corners, axis=0), axis=1) - side_m) < 1e-6)
    stated = KnownLengths(first, first + 1, np.full(len(first), side_m - 0.05), np.full(len(first), 0.005))
    problem = replace(street.problem, lengths=stated)
    test = score_faults(problem, solve(problem, OPTIONS))[0]
    assert test.fault is table.SIZE
    assert test.value == pytest.approx(0.05, abs=0.005)


def test_one_surveyed_point_off_is_told_from_all_off():
    street = scene()
    chosen = np.arange(0, len(street.corners_map), 12)
    points = street.corners_map[chosen].copy()
    points[1] += (0.2, 0.0)
    control = ControlPoints(chosen, points, np.full((len(chosen), 2), 0.01))
    test = score_faults(p := replace(street.problem, control=control), solve(p, OPTIONS))[0]
    assert (test.fault, test.item) == (table.CONTROL, 1)
    assert test.value == pytest.approx(0.2, abs=0.05)


def test_a_pose_that_nothing_was_seen_from_is_as_uncertain_as_stated_and_others_less():
    problem = scene().problem
    vague = replace(
        problem,
        observations=replace(problem.observations, covariance_px=1e8 * problem.observations.covariance_px),
    )
    stated = POSES.by_state() ** 2
    np.testing.assert_allclose(
        solve(vague, OPTIONS).covariance.poses(),
        np.tile(stated, (len(problem.map_from_vehicle), 1)),
        rtol=0.05,
    )
    sigmas = solve(problem, OPTIONS).covariance.poses()
    assert (np.median(sigmas, axis=0) < 0.7 * stated).all()


def test_the_pulls_on_poses_are_at_most_one_where_their_sigmas_are_right_and_more_where_not():
    problem = scene().problem
    right = pose_innovations(solve(problem, OPTIONS))
    assert np.sqrt(np.mean(right.normalised**2, axis=0)).max() < 1.2
    small = replace(problem, pose_sigma=PoseSigma(0.01, 0.0001, 0.002, 0.005))
    innovations = pose_innovations(solve(small, OPTIONS))
    heading = innovations.normalised[:, innovations.state == POSE_STATES.index("heading")]
    assert np.sqrt(np.mean(heading**2, axis=0)).max() > 1.4


def test_observations_that_the_loss_has_switched_off_do_not_vote():
    """Wrong associations put corners into the camera's plane, where residuals and derivatives are huge."""
    street = scene()
    problem, observations = street.problem, street.problem.observations
    cam_from_map = street.cam_from_vehicle[0] @ np.linalg.inv(problem.map_from_vehicle)
    row = cam_from_map[:, 2]
    depth_m = street.corners_map @ row[:, :2].T + row[:, 3]
    corner, frame = (rows[:6] for rows in np.nonzero((depth_m > 0.01) & (depth_m < 0.1)))
    assert len(corner) == 6
    more = replace(
        observations,
        camera=np.append(observations.camera, np.zeros(6, dtype=observations.camera.dtype)),
        frame=np.append(observations.frame, frame),
        corner=np.append(observations.corner, corner),
        pinhole_px=np.vstack([observations.pinhole_px, np.full((6, 2), 300.0)]),
        covariance_px=np.concatenate([observations.covariance_px, np.tile(np.eye(2), (6, 1, 1))]),
    )
    wrong, robust = replace(problem, observations=more), replace(OPTIONS, loss="cauchy")
    assert all(test.sigmas < 5 for test in score_faults(wrong, solve(wrong, robust)))


def seen_again(scene, cam_from_vehicle, map_from_vehicle, z_m=0.0):
    """The scene's observations (K,) by cameras (K, 4, 4) at poses (K, 4, 4), their corners at heights."""
    observations = scene.problem.observations
    pixel = project(
        cam_from_vehicle @ np.linalg.inv(map_from_vehicle), scene.corners_map[observations.corner], z_m
    )
    pixel += np.random.default_rng(0).normal(0, PIXEL_SIGMA, pixel.shape)
    return replace(scene.problem, observations=replace(observations, pinhole_px=pixel))


def turned(deg: float, axis: int):
    return exp(np.eye(6)[3 + axis] * np.deg2rad(deg))


def knocked(scene: Scene):
    """The first camera is turned by .6 deg in yaw, about its centre, halfway."""
    observations = scene.problem.observations
    cameras = scene.cam_from_vehicle[observations.camera].copy()
    poses = cameras[0]
    turn = poses @ turned(0.6, 2) @ np.linalg.inv(poses)
    turn[:3, 3] = 0.0
    later = (observations.camera == 0) & (observations.frame >= len(scene.map_from_vehicle) // 2)
    cameras[later] = turn @ cameras[later]
    return seen_again(scene, cameras, scene.map_from_vehicle[observations.frame])


def loaded(scene: Scene):
    """The vehicle, and all cameras with it, pitches by .6 deg halfway."""
    observations = scene.problem.observations
    poses = scene.map_from_vehicle.copy()
    poses[len(poses) // 2 :] = poses[len(poses) // 2 :] @ turned(0.6, 1)
    return seen_again(scene, scene.cam_from_vehicle[observations.camera], poses[observations.frame])


def stepped(scene: Scene):
    """Recorded positions step by 30 cm halfway."""
    poses = scene.problem.map_from_vehicle.copy()
    poses[len(poses) // 2 :, 0, 3] -= 0.3
    return replace(scene.problem, map_from_vehicle=poses)


def wandering(scene: Scene):
    """Recorded positions wander off by 30 cm within an eighth of the way, and stay there."""
    poses = scene.problem.map_from_vehicle.copy()
    poses[:, 0, 3] -= 0.3 * np.clip(np.linspace(-4.0, 4.0, len(poses)) + 0.5, 0.0, 1.0)
    return replace(scene.problem, map_from_vehicle=poses)


def scaled(scene: Scene):
    """Recorded positions lie 15 % too far apart, as in Web Mercator at 30 degrees of latitude."""
    poses = scene.problem.map_from_vehicle.copy()
    poses[:, :3, 3] *= 1.15
    return replace(scene.problem, map_from_vehicle=poses)


def crowned(scene: Scene):
    """The ground falls by 3 % to both sides of the route."""
    observations = scene.problem.observations
    poses = scene.map_from_vehicle
    away = scene.corners_map[:, None] - poses[None, :, :2, 3]
    nearest = np.linalg.norm(away, axis=2).argmin(axis=1)
    aside = np.abs(np.einsum("na,na->n", away[np.arange(len(away)), nearest], poses[nearest, :2, 1]))
    return seen_again(
        scene,
        scene.cam_from_vehicle[observations.camera],
        poses[observations.frame],
        -0.03 * aside[observations.corner],
    )


def drifting(scene: Scene):
    """Clocks of both cameras go wrong by .1 s from the first image to the last."""
    late = with_late_clocks(scene, np.zeros(2))
    observations, twist = late.problem.observations, late.problem.twist_vehicle
    assert twist is not None
    share = observations.frame / (len(scene.map_from_vehicle) - 1) - 0.5
    then = late.problem.map_from_vehicle[observations.frame] @ exp(
        twist[observations.frame] * 0.1 * share[:, None]
    )
    again = seen_again(scene, scene.cam_from_vehicle[observations.camera], then)
    return replace(late.problem, observations=again.observations)


def slipping(scene: Scene):
    """Headings are the course of an antenna, off by .01 rad for each m/s2 to the side."""
    problem = with_late_clocks(scene, np.zeros(2)).problem
    twist = problem.twist_vehicle
    assert twist is not None
    turn = np.zeros((len(twist), 6))
    turn[:, 5] = -0.01 * np.hypot(twist[:, 0], twist[:, 1]) * twist[:, 5]
    poses = problem.map_from_vehicle @ exp(turn)
    return replace(problem, map_from_vehicle=poses, pose_sigma=PoseSigma(heading_slip=0.005))


@pytest.mark.parametrize(
    ("change", "fault", "value"),
    [
        (slipping, table.SLIP, 0.01),
        (knocked, table.KNOCK, 0.0105),
        (loaded, table.KNOCK, 0.0105),
        (stepped, table.STEP, 0.3),
        (wandering, table.STEP, 0.3),
        (scaled, table.SCALE, 0.13),
        (crowned, table.CROWN, 0.03),
        (drifting, table.CLOCK_DRIFT, 0.1),
    ],
)
def test_a_fault_that_begins_or_grows_on_the_way_is_the_likeliest(change, fault: Fault, value: float):
    street = make_scene(3, frames=80, every_m=3.0, jitter=None, start_error_deg=0.3)
    problem = change(street)
    first = score_faults(problem, solve(problem, OPTIONS))[0]
    assert first.fault is fault
    assert abs(first.value) == pytest.approx(value, rel=0.25)
    assert first.sigmas > 5


def test_headings_that_were_measured_do_not_slip():
    street = make_scene(3, frames=40, every_m=3.0, jitter=None, start_error_deg=0.3)
    problem = replace(slipping(street), pose_sigma=PoseSigma())
    tests = score_faults(problem, solve(problem, OPTIONS))
    assert not any(test.fault is table.SLIP for test in tests)


def test_noise_that_goes_together_along_the_route_contradicts_nothing():
    """Attitudes wander smoothly, three times as far as stated: sigmas of the tests grow with them."""
    worst = []
    for seed in range(3):
        street = make_scene(seed, frames=80, every_m=3.0, jitter=None, start_error_deg=0.3)
        rng, observations = np.random.default_rng(seed), street.problem.observations
        smooth = np.array([np.convolve(row, np.hanning(9), "same") for row in rng.normal(size=(2, 80))])
        smooth *= 0.006 / smooth.std()
        tangent = np.zeros((80, 6))
        tangent[:, 3:5] = smooth.T
        poses = street.map_from_vehicle @ exp(tangent)
        problem = seen_again(street, street.cam_from_vehicle[observations.camera], poses[observations.frame])
        worst.append(max(test.sigmas for test in score_faults(problem, solve(problem, OPTIONS))))
    assert max(worst) < 5


def narrowing(score_tests, fault: Fault, axis: int) -> float:
    """Median of what the tests of a change take off the sigma under the stated noise."""
    tests = [
        test for test in score_tests if (test.fault, test.axis) == (fault, axis) and np.isfinite(test.sigma)
    ]
    return float(np.median([test.sigma / test.model_sigma for test in tests]))


def test_positions_and_headings_that_err_less_than_stated_leave_the_noise_of_pitch_as_it_is():
    true = PoseSigma(0.0025, 0.00025, 0.004, 0.005)
    stated = replace(true, position_m=0.02, heading_rad=0.002)
    of_pitch, of_position = [], []
    for seed in range(3):
        street = make_scene(seed, frames=80, every_m=3.0, jitter=true, start_error_deg=0.3)
        problem = replace(street.problem, pose_sigma=stated)
        tests = score_faults(problem, solve(problem, OPTIONS))
        of_pitch.append(narrowing(tests, table.KNOCK, 1))
        of_position.append(narrowing(tests, table.STEP, 0))
    assert np.median(of_position) < 0.7
    assert np.median(of_pitch) > 0.8


def test_an_answer_grows_with_its_column_however_large():
    # Where almost nothing determines a camera, a fault turns it by far more than poses can be turned.
    solved = Sensitivity.at(solve(scene().problem, OPTIONS).covariance.whitening)
    generator = torch.Generator().manual_seed(2)
    column = {
        name: torch.randn(row.shape, generator=generator, dtype=row.dtype)
        for name, row in solved.residuals.items()
    }
    answer = solved.flat(solved.efficient(column))
    many = solved.flat(solved.efficient({name: 1e25 * row for name, row in column.items()}))
    np.testing.assert_allclose(many / 1e25, answer, atol=1e-6 * np.abs(answer).max())


def test_columns_that_are_solved_for_together_are_those_of_each_alone():
    problem = scene().problem
    solution = solve(problem, OPTIONS)
    solved = Sensitivity.at(solution.covariance.whitening)
    generator = torch.Generator().manual_seed(5)
    columns = [
        {name: torch.randn(row.shape, generator=generator, dtype=row.dtype) for name, row in kinds}
        for kinds in (solved.residuals.items(), [("observations", solved.residuals["observations"])])
    ]
    together = solved.efficient_columns(columns)
    for column, row in zip(columns, together, strict=True):
        np.testing.assert_allclose(row, solved.flat(solved.efficient(column)), atol=1e-10)
        # What is left of a column is at right angles to all that the unknowns explain.
        again = solved.efficient_columns([dict(zip(solved.places, split(solved, row), strict=True))])
        np.testing.assert_allclose(again[0], row, atol=1e-6 * np.abs(row).max())


def test_the_derivatives_of_the_priors_are_those_of_small_steps():
    street = scene()
    problem = with_ground(with_late_clocks(street, np.array([0.02, -0.01])), 0.05, 0.005).problem
    corners = street.corners_map
    stated = KnownLengths(np.array([0, 5]), np.array([1, 6]), np.array([0.4, 0.5]), np.array([0.01, 0.02]))
    control = ControlPoints(np.array([2, 9]), corners[[2, 9]] + 0.03, np.array([[0.01, 0.02], [0.03, 0.01]]))
    problem = replace(problem, lengths=stated, control=control)
    solution = solve(problem, replace(OPTIONS, clock_offset=True))
    solved = Sensitivity.at(solution.covariance.whitening)
    base = solved.whitening.estimate
    generator = torch.Generator().manual_seed(1)
    step = {
        name: 1e-4 * torch.randn(shape, generator=generator, dtype=torch.float64)
        for name, shape in {
            "extrinsic": (len(base.cam_from_vehicle), 6),
            "frame_state": base.frame_state.shape,
            "corners_map": base.corners_map.shape,
            "clock_s": base.clock_s.shape,
        }.items()
    }

    def after(share):
        moved = Estimate(
            rigid(share * step["extrinsic"]) @ base.cam_from_vehicle,
            *(getattr(base, name) + share * step[name] for name in ("frame_state", "corners_map", "clock_s")),
        )
        return torch.cat([row.flatten() for row in prior_residuals(solved.arrays, moved).values()])

    by_unknowns = priors_by_unknowns(solved.arrays, base)
    expected = ((after(1.0) - after(-1.0)) / 2).detach().numpy()
    along = by_unknowns @ torch.cat([part.flatten() for part in step.values()]).numpy()
    np.testing.assert_allclose(along, expected, atol=1e-6 * np.abs(expected).max())


def split(solved, row):
    """A row (R,) by the kinds of residuals."""
    return [
        torch.as_tensor(row[place].copy()).view_as(solved.residuals[name])
        for name, place in solved.places.items()
    ]


def test_covariances_of_many_groups_are_those_of_each_alone():
    solution = solve(scene().problem, OPTIONS)
    corners = np.random.default_rng(3).permutation(len(solution.corners_map))[:24].reshape(6, 4)
    groups = np.concatenate([corners, corners[:, ::-1]])
    alone = np.concatenate([solution.covariance.corners(group[None]) for group in groups])
    np.testing.assert_allclose(solution.covariance.corners(groups), alone, rtol=1e-9, atol=1e-15)
