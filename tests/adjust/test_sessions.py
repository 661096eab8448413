"""Two sessions of one street in one problem: drifts and clocks are their own, cameras and corners common."""

from dataclasses import replace

import numpy as np
import pytest

from tests.adjust.scene import exp, make_scene, pose_errors, project, with_late_clocks
from tests.adjust.site import DRIFTING, SCATTERING, site
from v2hdm.adjust import ControlPoints, KnownLengths, PoseSigma, SolveOptions, Status, solve
from v2hdm.adjust.covariance import corner_gain
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.problem import POSE_STATES
from v2hdm.errors import AdjustError
from v2hdm.faults.score_tests import score_faults


def joined(first, second):
    """Two problems of the same cameras and corners as two sessions of one problem."""
    frames = [len(problem.map_from_vehicle) for problem in (first, second)]
    observations, other = first.observations, second.observations
    other = replace(other, frame=other.frame + frames[0])
    names = ("camera", "frame", "corner", "pinhole_px", "covariance_px")
    joined_fields = {
        name: np.concatenate([getattr(observations, name), getattr(other, name)]) for name in names
    }
    twists = [problem.twist_vehicle for problem in (first, second)]
    return replace(
        first,
        map_from_vehicle=np.concatenate([first.map_from_vehicle, second.map_from_vehicle]),
        observations=replace(observations, **joined_fields),
        pose_sigma=(first.pose_sigma, second.pose_sigma),
        twist_vehicle=None if twists[0] is None else np.concatenate(twists),
        session=np.repeat([0, 1], frames),
    )


def visited_again(scene, sigma, seed):
    """The same street with poses that are off by ``sigma``, and new noise of the pixels."""
    rng, problem = np.random.default_rng(seed), scene.problem
    poses = problem.map_from_vehicle @ exp(pose_errors(problem.map_from_vehicle, sigma, 0.5, rng))
    observations = problem.observations
    pixel = project(
        scene.cam_from_vehicle[observations.camera] @ np.linalg.inv(poses)[observations.frame],
        scene.corners_map[observations.corner],
    )
    pixel += 0.7 * rng.standard_normal(pixel.shape)
    problem = replace(problem, observations=replace(observations, pinhole_px=pixel), pose_sigma=sigma)
    return replace(scene, problem=problem, map_from_vehicle=poses)


@pytest.fixture(scope="module")
def street():
    return make_scene(3, frames=60)


def test_two_sessions_together_are_better_than_one_and_say_by_how_much():
    street, errors, sigmas = make_scene(3, frames=40, prior_sigma_m=0.002), [], []
    for seed in range(10):
        sessions = [visited_again(street, DRIFTING, 10 * seed + k) for k in (1, 2)]
        problems = [session.problem for session in sessions]
        solutions = [solve(problem) for problem in (*problems, joined(*problems))]
        assert all(solution.status is Status.CONVERGED for solution in solutions)
        errors.append([np.square(solution.corners_map - street.corners_map).sum() for solution in solutions])
        every = np.arange(len(street.corners_map))[:, None]
        sigmas.append(
            [solution.corner_covariance(every).trace(axis1=1, axis2=2).sum() for solution in solutions]
        )
    first, second, together = np.mean(errors, axis=0)
    assert together < 0.75**2 * (first + second) / 2
    stated = np.sqrt(np.mean(sigmas, axis=0))
    assert stated[2] == pytest.approx(stated[0] / np.sqrt(2), rel=0.1)
    assert np.sqrt(together) == pytest.approx(stated[2], rel=0.35)


def test_the_order_of_the_sessions_changes_nothing(street):
    first = visited_again(street, DRIFTING, 1).problem
    second = visited_again(street, SCATTERING, 2).problem
    solution, other = solve(joined(first, second)), solve(joined(second, first))
    assert solution.corners_map == pytest.approx(other.corners_map, abs=1e-6)
    assert solution.cost == pytest.approx(other.cost, rel=1e-9)


def test_a_session_without_drift_beside_one_with_it_is_as_by_itself(street):
    """Far apart, and with cameras that are known, two sessions have nothing to say of each other."""
    surveyed = replace(street.problem, centre_sigma_m=np.full((2, 3), 1e-5))
    scene = replace(street, problem=surveyed)
    first, second = visited_again(scene, DRIFTING, 3).problem, visited_again(scene, SCATTERING, 4).problem
    corners = first.corner_count
    moved = replace(second.observations, corner=second.observations.corner + corners)
    separate = replace(joined(first, replace(second, observations=moved)), corner_count=2 * corners)
    cost = solve(separate).cost_terms["frame_states"]
    alone = [solve(problem).cost_terms["frame_states"] for problem in (first, second)]
    assert cost == pytest.approx(sum(alone), rel=0.1)


@pytest.mark.parametrize("states", [(), ("roll", "pitch", "heading")])
def test_every_session_has_clocks_of_its_own(states):
    offsets_s = np.array([[0.03, -0.02], [-0.01, 0.04]])
    street = make_scene(14, frames=60, turn_deg_per_m=8.0, prior_sigma_m=0.01)
    problems = [with_late_clocks(street, offsets_s[:, session]).problem for session in (0, 1)]
    options = SolveOptions(pose_states=states, clock_offset=True)
    solution = solve(joined(*problems), options)
    assert solution.status is Status.CONVERGED
    sigma_s = np.sqrt(solution.covariance.clock_s2())
    assert (sigma_s < 0.003).all()
    assert (np.abs(solution.clock_offset_s - offsets_s) < 4 * sigma_s).all()
    plain = solve(joined(*problems), replace(options, engine="torch"))
    assert plain.clock_offset_s == pytest.approx(solution.clock_offset_s, abs=1e-6)


def test_sessions_that_are_not_numbered_in_order_are_refused(street):
    problem = joined(street.problem, street.problem)
    with pytest.raises(AdjustError, match="rising along the frames"):
        solve(replace(problem, session=problem.session[::-1]))
    with pytest.raises(AdjustError, match="session 1 has no pose_sigma"):
        solve(replace(problem, pose_sigma=(PoseSigma(),)))


def with_knowledge(problem):
    """A survey and known lengths, some of them between corners of several drives and of one, and clocks."""
    start = solve(problem, SolveOptions(coarse=False)).corners_map
    first, second = np.array([0, 8, 9, 30]), np.array([1, 9, 10, problem.corner_count - 1])
    length = np.linalg.norm(start[first] - start[second], axis=1)
    surveyed = np.array([3, 40])
    twist = np.zeros((len(problem.map_from_vehicle), 6))
    twist[:, 0] = 4 + np.sin(np.arange(len(twist)) / 5)
    return replace(
        problem,
        control=ControlPoints(surveyed, start[surveyed] + 0.01, np.full((2, 2), 0.005)),
        lengths=KnownLengths(first, second, length + 0.003, np.full(len(first), 0.002)),
        twist_vehicle=twist,
    )


@pytest.mark.parametrize(("overlap", "has_clocks", "loss"), [(40, False, "cauchy"), (12, True, "huber")])
def test_drives_whose_shared_corners_are_kept_are_adjusted_as_with_all_corners_eliminated(
    overlap, has_clocks, loss, monkeypatch
):
    problem = site(3, 40, overlap)
    options = SolveOptions(coarse=False, loss=loss, clock_offset=has_clocks)
    if has_clocks:
        problem = with_knowledge(problem)
    whole = solve(problem, options)
    monkeypatch.setattr("v2hdm.adjust.kernels.engine._WORTH_ANOTHER_ORDER", 0.0)
    monkeypatch.setattr("v2hdm.adjust.kernels.engine._CLEARLY_LESS", 1e9)
    by_kept_corners = solve(problem, options)
    plans = [solution.covariance.whitening.plan for solution in (whole, by_kept_corners)]
    assert not len(plans[0].kept_corners)
    assert 0 < len(plans[1].kept_corners) <= problem.corner_count
    assert whole.status is by_kept_corners.status is Status.CONVERGED
    assert whole.evaluations == by_kept_corners.evaluations
    for name in ("corners_map", "cam_from_vehicle", "map_from_vehicle", "clock_offset_s"):
        assert getattr(by_kept_corners, name) == pytest.approx(getattr(whole, name), abs=1e-11), name
    corners = np.array([0, 7, problem.corner_count - 1])
    for name, argument in (("corner_covariance", corners), ("extrinsic_covariance", None)):
        value, other = (getattr(solution, name) for solution in (by_kept_corners, whole))
        if argument is not None:
            value, other = value(argument), other(argument)
        assert value == pytest.approx(other, rel=1e-6, abs=1e-12)
    assert corner_gain(by_kept_corners.covariance.whitening) == pytest.approx(
        corner_gain(whole.covariance.whitening), rel=1e-6, abs=1e-9
    )
    scores = [score_faults(problem, solution) for solution in (by_kept_corners, whole)]
    for value, other in zip(*scores, strict=True):
        assert (value.fault, value.camera, value.axis) == (other.fault, other.camera, other.axis)
        assert value.gain == pytest.approx(other.gain, rel=1e-5, abs=1e-6)


def test_many_drives_of_one_way_take_less_with_their_corners_kept():
    crowd = make_engine("native", make_arrays(site(6, 100, 100), POSE_STATES, "cpu"))
    plan = crowd.plan()
    eliminated = make_engine("torch", crowd.arrays).plan()
    assert len(plan.kept_corners) == crowd.arrays.corner_count
    tip = crowd.arrays.camera_count * crowd.arrays.camera_unknowns
    spent = [shape.pattern.multiplications(shape.size, tip) for shape in (plan, eliminated)]
    assert spent[0] < 0.15 * spent[1]
    chain = make_engine("native", make_arrays(site(2, 60, 10), POSE_STATES, "cpu"))
    assert not len(chain.plan().kept_corners)
