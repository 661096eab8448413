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
    frames = [len(one.map_from_vehicle) for one in (first, second)]
    one, other = first.observations, second.observations
    other = replace(other, frame=other.frame + frames[0])
    names = ("camera", "frame", "corner", "pinhole_px", "covariance_px")
    seen = {name: np.concatenate([getattr(one, name), getattr(other, name)]) for name in names}
    twists = [one.twist_vehicle for one in (first, second)]
    return replace(
        first,
        map_from_vehicle=np.concatenate([first.map_from_vehicle, second.map_from_vehicle]),
        observations=replace(one, **seen),
        pose_sigma=(first.pose_sigma, second.pose_sigma),
        twist_vehicle=None if twists[0] is None else np.concatenate(twists),
        session=np.repeat([0, 1], frames),
    )


def visited_again(scene, sigma, seed):
    """The same street with poses that are off by ``sigma``, and new noise of the pixels."""
    rng, problem = np.random.default_rng(seed), scene.problem
    poses = problem.map_from_vehicle @ exp(pose_errors(problem.map_from_vehicle, sigma, 0.5, rng))
    seen = problem.observations
    pixel = project(
        scene.cam_from_vehicle[seen.camera] @ np.linalg.inv(poses)[seen.frame], scene.corners_map[seen.corner]
    )
    pixel += 0.7 * rng.standard_normal(pixel.shape)
    problem = replace(problem, observations=replace(seen, pinhole_px=pixel), pose_sigma=sigma)
    return replace(scene, problem=problem, map_from_vehicle=poses)


@pytest.fixture(scope="module")
def street():
    return make_scene(3, frames=60)


def test_two_sessions_together_are_better_than_one_and_say_by_how_much():
    street, errors, sigmas = make_scene(3, frames=40, prior_sigma_m=0.002), [], []
    for seed in range(10):
        sessions = [visited_again(street, DRIFTING, 10 * seed + k) for k in (1, 2)]
        problems = [session.problem for session in sessions]
        solutions = [solve(one) for one in (*problems, joined(*problems))]
        assert all(one.status is Status.CONVERGED for one in solutions)
        errors.append([np.square(one.corners_map - street.corners_map).sum() for one in solutions])
        every = np.arange(len(street.corners_map))[:, None]
        sigmas.append([one.corner_covariance(every).trace(axis1=1, axis2=2).sum() for one in solutions])
    first, second, both = np.mean(errors, axis=0)
    assert both < 0.75**2 * (first + second) / 2
    stated = np.sqrt(np.mean(sigmas, axis=0))
    assert stated[2] == pytest.approx(stated[0] / np.sqrt(2), rel=0.1)
    assert np.sqrt(both) == pytest.approx(stated[2], rel=0.35)


def test_the_order_of_the_sessions_changes_nothing(street):
    first = visited_again(street, DRIFTING, 1).problem
    second = visited_again(street, SCATTERING, 2).problem
    one, other = solve(joined(first, second)), solve(joined(second, first))
    assert one.corners_map == pytest.approx(other.corners_map, abs=1e-6)
    assert one.cost == pytest.approx(other.cost, rel=1e-9)


def test_a_session_without_drift_beside_one_with_it_is_as_by_itself(street):
    """Far apart, and with cameras that are known, two sessions have nothing to say of each other."""
    known = replace(street.problem, centre_sigma_m=np.full((2, 3), 1e-5))
    scene = replace(street, problem=known)
    first, second = visited_again(scene, DRIFTING, 3).problem, visited_again(scene, SCATTERING, 4).problem
    corners = first.corner_count
    moved = replace(second.observations, corner=second.observations.corner + corners)
    apart = replace(joined(first, replace(second, observations=moved)), corner_count=2 * corners)
    cost = solve(apart).cost_terms["frame_states"]
    alone = [solve(one).cost_terms["frame_states"] for one in (first, second)]
    assert cost == pytest.approx(sum(alone), rel=0.1)


@pytest.mark.parametrize("states", [(), ("roll", "pitch", "heading")])
def test_every_session_has_clocks_of_its_own(states):
    offsets_s = np.array([[0.03, -0.02], [-0.01, 0.04]])
    street = make_scene(14, frames=60, turn_deg_per_m=8.0, prior_sigma_m=0.01)
    problems = [with_late_clocks(street, offsets_s[:, session]).problem for session in (0, 1)]
    options = SolveOptions(pose_states=states, clock_offset=True)
    found = solve(joined(*problems), options)
    assert found.status is Status.CONVERGED
    sigma_s = np.sqrt(found.covariance.clock_s2())
    assert (sigma_s < 0.003).all()
    assert (np.abs(found.clock_offset_s - offsets_s) < 4 * sigma_s).all()
    plain = solve(joined(*problems), replace(options, engine="torch"))
    assert plain.clock_offset_s == pytest.approx(found.clock_offset_s, abs=1e-6)


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


@pytest.mark.parametrize(("overlap", "known", "loss"), [(40, False, "cauchy"), (12, True, "huber")])
def test_drives_whose_shared_corners_are_kept_are_adjusted_as_with_all_corners_eliminated(
    overlap, known, loss, monkeypatch
):
    problem = site(3, 40, overlap)
    options = SolveOptions(coarse=False, loss=loss, clock_offset=known)
    if known:
        problem = with_knowledge(problem)
    whole = solve(problem, options)
    monkeypatch.setattr("v2hdm.adjust.kernels.engine._WORTH_ANOTHER_ORDER", 0.0)
    monkeypatch.setattr("v2hdm.adjust.kernels.engine._CLEARLY_LESS", 1e9)
    kept = solve(problem, options)
    plans = [one.covariance.whitening.plan for one in (whole, kept)]
    assert not len(plans[0].kept_corners)
    assert 0 < len(plans[1].kept_corners) <= problem.corner_count
    assert whole.status is kept.status is Status.CONVERGED
    assert whole.evaluations == kept.evaluations
    for name in ("corners_map", "cam_from_vehicle", "map_from_vehicle", "clock_offset_s"):
        assert getattr(kept, name) == pytest.approx(getattr(whole, name), abs=1e-11), name
    corners = np.array([0, 7, problem.corner_count - 1])
    for name, given in (("corner_covariance", corners), ("extrinsic_covariance", None)):
        one, other = (getattr(solution, name) for solution in (kept, whole))
        if given is not None:
            one, other = one(given), other(given)
        assert one == pytest.approx(other, rel=1e-6, abs=1e-12)
    assert corner_gain(kept.covariance.whitening) == pytest.approx(
        corner_gain(whole.covariance.whitening), rel=1e-6, abs=1e-9
    )
    scores = [score_faults(problem, one) for one in (kept, whole)]
    for one, other in zip(*scores, strict=True):
        assert (one.fault, one.camera, one.axis) == (other.fault, other.camera, other.axis)
        assert one.gain == pytest.approx(other.gain, rel=1e-5, abs=1e-6)


def test_many_drives_of_one_way_take_less_with_their_corners_kept():
    crowd = make_engine("native", make_arrays(site(6, 100, 100), POSE_STATES, "cpu"))
    plan = crowd.plan()
    eliminated = make_engine("torch", crowd.arrays).plan()
    assert len(plan.kept_corners) == crowd.arrays.corner_count
    tip = crowd.arrays.camera_count * crowd.arrays.camera_unknowns
    spent = [one.pattern.multiplications(one.size, tip) for one in (plan, eliminated)]
    assert spent[0] < 0.15 * spent[1]
    chain = make_engine("native", make_arrays(site(2, 60, 10), POSE_STATES, "cpu"))
    assert not len(chain.plan().kept_corners)
