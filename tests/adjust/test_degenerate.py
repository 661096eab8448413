"""Bad input is refused by name or reported as a status; nothing that comes back is NaN."""

from dataclasses import replace

import numpy as np
import pytest

from tests.adjust.scene import make_scene, rows_of
from tests.cameras import mounted
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
from v2hdm.errors import AdjustError

PAPER = SolveOptions(pose_states=(), loss="none")


def street(**changes):
    return make_scene(1, frames=30, **changes).problem


def with_observations(problem, **changes):
    return replace(problem, observations=replace(problem.observations, **changes))


def changed(values, index, value):
    out = values.copy()
    out[index] = value
    return out


def lengths(first=(0, 4), second=(1, 6), length_m=(0.5, 0.7), sigma_m=(0.01, 0.01)):
    return KnownLengths(np.array(first), np.array(second), np.array(length_m), np.array(sigma_m))


def bad_lengths():
    return {
        "known length 1 is from corner 4 to itself": lengths(second=(1, 4)),
        "the distance of corners 4 and 6 is given twice": lengths(first=(4, 6), second=(6, 4)),
        "known length 1 names corners 4 and 9999; one does not exist": lengths(second=(1, 9999)),
        "known length 0 names corners -1 and 1; one does not exist": lengths(first=(-1, 4)),
        "known length 0 is -0.5 m: give one above 0": lengths(length_m=(-0.5, 0.7)),
        "known length 1 is nan m: give one above 0": lengths(length_m=(0.5, np.nan)),
        "sigma_m of known length 0 is not above 0 and finite": lengths(sigma_m=(0.0, 0.01)),
        "sigma_m of known length 1 is not above 0 and finite": lengths(sigma_m=(0.01, np.nan)),
        "known lengths: 2 first corners need as many second": lengths(sigma_m=(0.01,)),
        "known lengths join 300 corners": lengths(
            np.arange(299), np.arange(1, 300), np.ones(299), np.ones(299)
        ),
    }


def seen_in(problem, keep):
    """Only the observations ``keep``, all of them of camera 0, and the corners that these are of."""
    corners, corner = np.unique(problem.observations.corner[keep], return_inverse=True)
    observations = replace(rows_of(problem.observations, keep), corner=corner)
    return replace(problem, observations=observations, corner_count=len(corners))


def bad_problems():
    problem = street()
    observations = problem.observations

    def off(name, index, value):
        """With a wrong entry in an array of the problem or of its observations."""
        if name in vars(observations):
            return with_observations(problem, **{name: changed(getattr(observations, name), index, value)})
        return replace(problem, **{name: changed(getattr(problem, name), index, value)})

    def surveyed(corners, sigma_m):
        return replace(problem, control=ControlPoints(np.array(corners), np.zeros((2, 2)), np.array(sigma_m)))

    twice = rows_of(observations, np.append(np.arange(len(observations.corner)), 5))
    drifting = PoseSigma(position_drift=Drift(0.03, 10.0))
    one_more = replace(problem, corner_count=problem.corner_count + 1)
    skew = np.array([[1.0, 0.5], [-0.5, 1.0]])
    mirrored = -problem.cam_from_vehicle[1, 0]
    return {
        "observations 5 and": replace(problem, observations=twice),
        "pinhole_px of observation 7 is not finite": off("pinhole_px", (7, 1), np.nan),
        "map_from_vehicle of frame 3 is not finite": off("map_from_vehicle", (3, 0, 3), np.inf),
        "covariance_px of observation 2 is not positive": off("covariance_px", 2, -np.eye(2)),
        "observation 4 names frame 999": off("frame", 4, 999),
        "observation 4 names camera -1": off("camera", 4, -1),
        "camera 1 has no observation": seen_in(problem, observations.camera == 0),
        f"corner {problem.corner_count} has no observation": one_more,
        "cam_from_vehicle 1 is not a rigid transform": off("cam_from_vehicle", (1, 0), mirrored),
        "map_from_vehicle 2 is not a rigid transform: its last row": off("map_from_vehicle", (2, 3, 0), 1.0),
        "covariance_px of observation 6 is not symmetric": off("covariance_px", 6, skew),
        "pinhole_px of observation 3 lies 1.11e.06 focal lengths": off("pinhole_px", (3, 0), 1e9),
        "observations.corner holds float64": with_observations(
            problem, corner=observations.corner.astype(float)
        ),
        "observations.pinhole_px is a list": with_observations(
            problem, pinhole_px=observations.pinhole_px.tolist()
        ),
        "intrinsic of camera 0 has a focal length": off("intrinsic", (0, 1), 0.0),
        "centre_sigma_m of camera 1 must be above 0": off("centre_sigma_m", (1, 2), 0.0),
        "belong together": replace(problem, centre_sigma_m=None),
        "pose_sigma must be above 0": replace(problem, pose_sigma=PoseSigma(heading_rad=0.0)),
        "must be part of its pose_sigma 0.02": replace(problem, pose_sigma=drifting),
        "intrinsic has shape": replace(problem, intrinsic=np.eye(3)),
        "twist_vehicle has shape": replace(problem, twist_vehicle=np.zeros((3, 6))),
        "control point 1 names corner -1": surveyed([0, -1], np.ones((2, 2))),
        "control point 0 is not finite": surveyed([0, 1], [[1.0, 0.0], [1.0, 1.0]]),
        "there are no observations": replace(problem, observations=rows_of(observations, slice(0))),
    }


@pytest.mark.parametrize("message", bad_problems())
def test_a_malformed_problem_is_refused_by_name(message):
    problem = bad_problems()[message]
    with pytest.raises(AdjustError, match=message) as caught:
        solve(problem)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("message", bad_lengths())
def test_a_known_length_that_cannot_be_is_refused_by_name(message):
    problem = make_scene(1, frames=200, every_m=1.0).problem
    with pytest.raises(AdjustError, match=message):
        solve(replace(problem, lengths=bad_lengths()[message]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pose_states": ("yaw",)}, "unknown pose state 'yaw'"),
        ({"loss": "l1"}, "unknown loss 'l1'"),
        ({"loss_scale": 0.0}, "loss_scale is 0.0"),
        ({"gate_probability": 1.0}, "gate_probability is 1.0"),
        ({"gap_tolerance": 0.0}, "gap_tolerance is 0.0"),
        ({"max_evaluations": 0}, "max_evaluations is 0"),
        ({"clock_offset": True}, "a clock offset needs twist_vehicle"),
    ],
)
def test_an_unknown_option_is_refused_with_the_choices(change, message):
    with pytest.raises(AdjustError, match=message):
        solve(street(), SolveOptions(**change))


def test_an_extrinsic_that_looks_at_the_sky_is_refused_with_advice():
    problem = street(cameras=1)
    with pytest.raises(AdjustError, match="no ray of corner 0 meets the ground"):
        solve(replace(problem, cam_from_vehicle=mounted((1.5, 0.0, 2.4), -80)[None]))


def finite(solution):
    parts = (solution.cam_from_vehicle, solution.map_from_vehicle, solution.corners_map, solution.residual_px)
    return all(bool(np.isfinite(part).all()) for part in (*parts, solution.extrinsic_covariance))


def test_without_a_prior_on_a_straight_road_the_solution_is_called_undetermined():
    scene = make_scene(3, frames=40, turn_deg_per_m=0.0, start_error_deg=1.0)
    free = replace(scene.problem, centre_vehicle=None, centre_sigma_m=None)
    solution = solve(free, PAPER)
    assert solution.status is Status.UNDETERMINED
    assert "turn" in solution.status.advice
    assert finite(solution)
    assert solve(scene.problem, PAPER).status is Status.CONVERGED


def test_a_corner_seen_once_is_mapped_and_says_so_by_its_covariance():
    scene = make_scene(4, frames=40)
    observations = scene.problem.observations
    keep = (observations.corner != 10) | (
        np.arange(len(observations.corner)) == np.flatnonzero(observations.corner == 10)[-1]
    )
    solution = solve(replace(scene.problem, observations=rows_of(observations, keep)), PAPER)
    assert solution.status is Status.CONVERGED
    assert finite(solution)
    once, often = solution.corner_covariance(np.array([[10], [11]]))
    assert np.trace(once) > 2 * np.trace(often)


@pytest.mark.parametrize("options", [PAPER, SolveOptions()])
@pytest.mark.parametrize("which", ["one observation", "one frame", "every corner once"])
def test_too_few_observations_leave_the_solution_undetermined(which, options):
    problem = street(cameras=1)
    observations = problem.observations
    rows = {
        "one observation": np.arange(1),
        "one frame": np.flatnonzero(observations.frame == 10),
        "every corner once": np.unique(observations.corner, return_index=True)[1],
    }
    solution = solve(seen_in(problem, rows[which]), options)
    assert solution.status is Status.UNDETERMINED
    assert finite(solution)


def test_a_vehicle_that_never_moves_is_no_error():
    problem = street(cameras=1)
    of_frame = seen_in(problem, problem.observations.frame == 10)
    observations, frames = of_frame.observations, len(problem.map_from_vehicle)
    pixel = np.tile(observations.pinhole_px, (frames, 1))
    again = Observations(
        np.tile(observations.camera, frames),
        np.repeat(np.arange(frames), len(observations.corner)),
        np.tile(observations.corner, frames),
        pixel + np.random.default_rng(0).normal(0, 0.7, pixel.shape),
        np.tile(observations.covariance_px, (frames, 1, 1)),
    )
    still = np.tile(problem.map_from_vehicle[10], (frames, 1, 1))
    solution = solve(replace(of_frame, map_from_vehicle=still, observations=again), PAPER)
    assert solution.status is Status.UNDETERMINED
    assert finite(solution)


@pytest.mark.parametrize("options", [PAPER, SolveOptions()])
def test_in_utm_coordinates_the_solution_is_the_same(options):
    """Half a million metres east and five millions north: what is left of doubles there is a nanometre."""
    scene = make_scene(3, frames=40, jitter=PoseSigma(), start_error_deg=3.0)
    utm = np.array([500_000.0, 5_500_000.0])
    control = ControlPoints(np.array([2]), scene.corners_map[2:3], np.array([[0.01, 0.02]]))
    here = replace(scene.problem, control=control)
    poses = here.map_from_vehicle.copy()
    poses[:, :2, 3] += utm
    far_away = replace(
        here, map_from_vehicle=poses, control=replace(control, points_map=control.points_map + utm)
    )
    solved_here, far = solve(here, options), solve(far_away, options)
    assert far.status is solved_here.status is Status.CONVERGED
    assert far.evaluations == solved_here.evaluations
    np.testing.assert_allclose(far.corners_map - utm, solved_here.corners_map, rtol=0, atol=1e-7)
    np.testing.assert_allclose(far.cam_from_vehicle, solved_here.cam_from_vehicle, rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        far.map_from_vehicle[:, :2, 3] - utm, solved_here.map_from_vehicle[:, :2, 3], rtol=0, atol=1e-7
    )
    groups = np.arange(here.corner_count)[:, None]
    np.testing.assert_allclose(
        far.corner_covariance(groups), solved_here.corner_covariance(groups), rtol=1e-4
    )


def test_an_observation_behind_the_camera_is_reported():
    scene = make_scene(5, frames=40, cameras=1, start_error_deg=0.5)
    observations = scene.problem.observations
    # The corner of the last observation is claimed to be in view of a frame far beyond it.
    last = len(scene.problem.map_from_vehicle) - 1
    first_corner = int(observations.corner[np.argmin(observations.frame)])
    problem = with_observations(
        scene.problem,
        camera=np.append(observations.camera, 0),
        frame=np.append(observations.frame, last),
        corner=np.append(observations.corner, first_corner),
        pinhole_px=np.vstack([observations.pinhole_px, [640, 500]]),
        covariance_px=np.concatenate([observations.covariance_px, observations.covariance_px[:1]]),
    )
    solution = solve(problem, SolveOptions(pose_states=(), loss="geman_mcclure"))
    assert solution.status is Status.BEHIND_CAMERA
    assert finite(solution)
    assert solution.mahalanobis2[-1] > 1e4


def test_too_few_evaluations_are_reported():
    solution = solve(street(start_error_deg=5.0), replace(PAPER, coarse=False, max_refreshes=1))
    assert solution.status is Status.EVALUATIONS_EXHAUSTED
    assert finite(solution)
