"""Engines agree: compiled kernels, in closed form, with the model's page, differentiated by autograd."""

from collections import Counter
from dataclasses import is_dataclass, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.adjust.scene import HEIGHT, make_scene, with_ground, with_late_clocks
from v2hdm import native
from v2hdm.adjust import (
    ControlPoints,
    Drift,
    KnownLengths,
    PoseSigma,
    SolveOptions,
    Status,
    model,
    reduced,
    solve,
)
from v2hdm.adjust.checks import check_options
from v2hdm.adjust.descent import Objective
from v2hdm.adjust.engine import WEIGHT_FLOOR, Pairs, TorchEngine, View
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.model import Estimate, Loss
from v2hdm.adjust.problem import LOSSES, POSE_STATES
from v2hdm.adjust.reduced import ReducedSystem
from v2hdm.adjust.whitening import factorise
from v2hdm.faults.score_tests import score_faults
from v2hdm.geometry.tensors import NEAR_M

POSES = PoseSigma(position_drift=Drift(0.01, 10.0), roll_pitch_drift=Drift(0.003, 2.0))
MODELS = [((), False), ((), True), (("roll", "pitch"), True), (POSE_STATES, False), (POSE_STATES, True)]


@pytest.fixture(params=["C++", "numba"], scope="module", autouse=True)
def compiler(request):
    """Each test runs with kernels compiled by either compiler."""
    if request.param == "C++":
        if native.kernels() is None:
            pytest.skip(native.which_runs())
        yield
        return
    with native.numpy_alone():
        yield


def example(*, lengths=True, rolling=False, frames=40, seed=3):
    """A drive with all that a model can know: clocks, drifts, surveys, ground, lengths, any covariances."""
    scene = with_late_clocks(make_scene(seed, frames=frames, outliers=0.05), np.array([0.02, -0.01]))
    scene = with_ground(scene, 0.3, 0.02)
    problem, rng = scene.problem, np.random.default_rng(0)
    root = rng.normal(0, 0.1, (len(problem.observations.corner), 2, 2)) + 0.7 * np.eye(2)
    count = problem.corner_count
    diamonds = 4 * np.arange(count // 8)
    first = np.concatenate([diamonds, diamonds + 1, diamonds[:3] + 2])
    second = np.concatenate([diamonds + 1, diamonds + 2, diamonds[:3] + 3])
    known_lengths = KnownLengths(first, second, np.full(len(first), 0.5), np.full(len(first), 0.004))
    control = ControlPoints(
        np.array([3, 17, 9]),
        scene.corners_map[[3, 17, 9]] + 0.01,
        np.array([[0.02, 0.03], [0.05, 0.01], [0.01, np.inf]]),
        np.array([[1.0, 0.0], [0.6, 0.8], [-0.8, 0.6]]),
    )
    observations = replace(problem.observations, covariance_px=root @ root.transpose(0, 2, 1))
    if rolling:
        observations = replace(observations, row_share=observations.pinhole_px[:, 1] / (HEIGHT - 1) - 0.5)
        problem = replace(problem, read_out_s=np.array([0.03, 0.02]))
    known_lengths = known_lengths if lengths else None
    return replace(
        problem, observations=observations, pose_sigma=POSES, control=control, lengths=known_lengths
    )


def engines(problem, pose_states, clock=False, read_out=False):
    """Kernels and autograd over a problem."""
    arrays = make_arrays(problem, pose_states, "cpu", clock, read_out)
    return make_engine("native", arrays), make_engine("torch", arrays)


def estimate_of(engine, problem, generator, size=0.01, behind=True):
    """Somewhere near the start, with states and clocks of their own, and a corner behind its camera."""

    def draw(like):
        return size * torch.randn(like.shape, generator=generator, dtype=torch.float64)

    cameras = torch.as_tensor(problem.cam_from_vehicle)
    corners, _ = engine.back_project(cameras)
    corners = corners.clone()
    corners[5] -= 100.0 if behind else 0.0
    arrays = engine.arrays
    state, clock = draw(arrays.state_information_root), draw(arrays.no_clock())
    cameras = model.rigid(draw(torch.zeros(arrays.camera_count, 6))).detach() @ cameras
    return Estimate(cameras, state, corners, clock)


def assert_same(values, other, share=1e-12):
    """Equal to a share of the largest of all, in tensors and in records of them."""
    if isinstance(values, dict):
        assert list(values) == list(other)
        for name in values:
            assert_same(values[name], other[name], share)
    elif is_dataclass(values):
        assert_same(vars(values), vars(other), share)
    elif isinstance(values, float):
        assert values == pytest.approx(other, rel=share, abs=0)
    elif other.numel():
        assert float((values - other).abs().max()) <= share * float(other.abs().max())


def rounding_of(factor):
    """The share by which rounding parts what two engines derive by a corner factor of some condition."""
    lowers = [lower for group in factor.joint for lower in group.factor.tril()]
    for xx, yx, yy in factor.lower.T:
        lowers.append(torch.stack([xx, torch.zeros_like(xx), yx, yy]).view(2, 2))
    worst = max(float(torch.linalg.cond(lower)) ** 2 for lower in lowers)
    return max(1e-12, torch.finfo(torch.float64).eps * worst)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    model=st.sampled_from(MODELS),
    loss=st.sampled_from(LOSSES),
    size=st.sampled_from([0.0, 1e-9, 0.01]),
    lengths=st.booleans(),
    behind=st.booleans(),
    rolling=st.booleans(),
)
def test_engines_agree_on_every_kind_of_residual(seed, model, loss, size, lengths, behind, rolling):
    """Cost, gradient and all blocks, of drives with everything that a model can know, but for rounding."""
    (pose_states, clock), rng = model, np.random.default_rng(seed)
    problem = example(lengths=lengths, rolling=rolling, frames=14, seed=seed % 7)
    numba, by_torch = engines(problem, pose_states, clock, rolling and clock)
    robust = Loss(loss, float(rng.uniform(1, 4)))
    estimate = estimate_of(numba, problem, torch.Generator().manual_seed(seed), size, behind)
    assert_same(numba.poses(estimate), by_torch.poses(estimate))
    poses = numba.poses(estimate)
    assert_same(numba.residuals(poses, estimate.corners_map), by_torch.residuals(poses, estimate.corners_map))
    plan = replace(by_torch.plan(), most_tiles=numba.plan().most_tiles)
    results, systems = [], []
    for engine in (numba, by_torch):
        system = ReducedSystem(engine.arrays, plan, engine.spread(estimate))
        results.append(engine.eliminate(system, estimate, robust))
        systems.append(system)
    by_numba, other = results
    for name in ("state", "clock"):
        assert_same(getattr(systems[0].spread, name), getattr(systems[1].spread, name))
    assert_same(numba.prior_blocks(estimate), by_torch.prior_blocks(estimate), 5e-12)
    assert_same(by_numba.terms, other.terms)
    assert_same(by_torch.terms(estimate, robust), other.terms)
    for name in ("extrinsic", "frame_state", "clock_s"):
        assert_same(getattr(by_numba.gradient, name), getattr(other.gradient, name))
    # A robust loss may leave a corner next to no information: rounding grows with its factor's condition.
    share = rounding_of(other.corner_factor)
    assert_same(by_numba.whitened, other.whitened, share)
    assert_same(by_numba.coupled, other.coupled, share)
    lone = ~numba.arrays.joined & ~numba.arrays.joined.roll(-1)
    assert_same(by_numba.corner_factor.lower[:, lone], other.corner_factor.lower[:, lone])
    for group, joint in zip(by_numba.corner_factor.joint, other.corner_factor.joint, strict=True):
        assert torch.equal(group.begin, joint.begin)
        assert_same(group.factor, joint.factor, share)
    assert_same(systems[0]._of_pairs, systems[1]._of_pairs)
    for place, tile in systems[0].matrix.tiles.items():
        lower = torch.ones_like(tile).tril() if place[0] == place[1] else 1.0
        assert_same(tile * lower, systems[1].matrix.tiles[place] * lower, share)
    run = numba.arrays.gather(torch.arange(3, 12))
    corners = estimate.corners_map[3:12]
    assert_same(by_numba.coupling(run, corners), other.coupling(run, corners))
    by_residual = torch.as_tensor(rng.normal(0, 1, numba.arrays.measured.shape))
    pulled = [engine.pull(estimate, engine.spread(estimate), by_residual) for engine in (numba, by_torch)]
    assert_same(*pulled)
    by_corner = torch.as_tensor(rng.normal(0, 1, estimate.corners_map.shape))
    for mine, theirs in zip(by_numba.carry(by_corner), other.carry(by_corner), strict=True):
        assert_same(mine, theirs, share)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize(("pose_states", "clock"), MODELS)
def test_engines_agree_on_a_step(pose_states, clock, loss):
    problem = example()
    numba, by_torch = engines(problem, pose_states, clock)
    generator = torch.Generator().manual_seed(1)
    estimate = estimate_of(numba, problem, generator, behind=False)
    plan = replace(by_torch.plan(), most_tiles=numba.plan().most_tiles)
    whitening = factorise(numba, plan, estimate, Loss(loss, 3.0))
    expected = factorise(by_torch, plan, estimate, Loss(loss, 3.0))
    step = whitening.step(0.001 * torch.randn(whitening.size, generator=generator, dtype=torch.float64))
    by_numba, other = (engine_state.linearised.evaluate(*step) for engine_state in (whitening, expected))
    assert_same(by_numba.estimate, other.estimate)
    assert_same(by_numba.terms, other.terms)
    # Differences of large sums; and where a corner is hardly known, last digits count a thousand times.
    for name in ("extrinsic", "frame_state", "clock_s"):
        assert_same(getattr(by_numba.gradient, name), getattr(other.gradient, name), 1e-9)
    assert_same(by_numba.whitened, other.whitened, 1e-9)
    assert_same(by_numba.coupled, other.coupled, 1e-9)


@pytest.mark.parametrize("behind", [False, True])
def test_torch_differentiates_an_observation_as_autograd_does(behind):
    problem = example(frames=14)
    _, engine = engines(problem, ())
    estimate = estimate_of(engine, problem, torch.Generator().manual_seed(3), behind=behind)
    run = engine.arrays.whole()
    view = View.of(run, Pairs.of(engine.poses(estimate)), estimate.corners_map)
    points = view.point.T.clone().requires_grad_()
    residual = model.corner_residual(points, run.measured, run.root_information)
    by_row = [torch.autograd.grad(row.sum(), points, retain_graph=True)[0].T for row in residual.unbind(1)]
    assert_same(view.by_point(), torch.stack(by_row))
    by_residual = torch.randn(view.residual.shape, generator=torch.Generator().manual_seed(4)).double()
    (force,) = torch.autograd.grad(residual, points, by_residual.T)
    assert_same(view.force(by_residual), force.T)


@pytest.mark.parametrize(("pose_states", "clock"), MODELS)
def test_engines_agree_on_the_start_and_on_the_report(pose_states, clock):
    problem = example(lengths=False)
    # A pixel above the horizon fixes nothing.
    problem.observations.pinhole_px[0, 1] = -5000.0
    numba, by_torch = engines(problem, pose_states, clock)
    (corners, fixed), (expected, expected_fixed) = (
        engine.back_project(torch.as_tensor(problem.cam_from_vehicle)) for engine in (numba, by_torch)
    )
    # Where a ray meets the ground at 700 m, its last digit is a picometre times the steepness of that.
    torch.testing.assert_close(corners, expected, rtol=1e-9, atol=1e-11)
    assert bool((fixed == expected_fixed).all())
    estimate = estimate_of(numba, problem, torch.Generator().manual_seed(2))
    focal = problem.intrinsic[:, :2]
    for value, other in zip(numba.report(estimate, focal), by_torch.report(estimate, focal), strict=True):
        np.testing.assert_allclose(value, other, rtol=1e-11, atol=1e-9)


@pytest.mark.parametrize(("pose_states", "clock"), MODELS)
def test_a_solve_ends_where_that_of_torch_ends(pose_states, clock):
    problem = example()
    options = SolveOptions(pose_states=pose_states, clock_offset=clock, gap_tolerance=1e-13)
    solution = solve(problem, options)
    expected = solve(problem, replace(options, engine="torch"))
    assert solution.cost == pytest.approx(expected.cost, rel=1e-10)
    assert solution.status is expected.status
    np.testing.assert_allclose(solution.corners_map, expected.corners_map, atol=1e-5)
    np.testing.assert_allclose(
        solution.extrinsic_covariance, expected.extrinsic_covariance, rtol=1e-4, atol=1e-12
    )
    groups = np.array([[0, 1, 2, 3], [20, 21, 22, 23]])
    np.testing.assert_allclose(
        solution.corner_covariance(groups), expected.corner_covariance(groups), rtol=1e-4, atol=1e-12
    )
    np.testing.assert_array_equal(solution.verdict, expected.verdict)


@pytest.mark.parametrize("pose_states", [(), POSE_STATES])
def test_results_do_not_depend_on_the_number_of_threads(pose_states, monkeypatch):
    """To the last bit: many small chunks, side by side or one after the other."""
    monkeypatch.setattr("v2hdm.adjust.arrays._RUN", 200)
    monkeypatch.setattr("v2hdm.adjust.threads._WORTH_THREADS", 1)
    problem = example()
    options = SolveOptions(pose_states=pose_states)
    before, solutions = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            solutions.append(solve(problem, options))
    finally:
        torch.set_num_threads(before)
    for solution in solutions[1:]:
        assert solution.cost == solutions[0].cost
        np.testing.assert_array_equal(solution.corners_map, solutions[0].corners_map)
        np.testing.assert_array_equal(solution.map_from_vehicle, solutions[0].map_from_vehicle)


def test_what_is_no_number_stays_none():
    problem = example()
    for engine in engines(problem, ()):
        estimate = estimate_of(engine, problem, torch.Generator().manual_seed(0))
        whitening = factorise(engine, engine.plan(), estimate, Loss("cauchy", 3.0))
        cost, _ = Objective(whitening)(torch.full_like(whitening.gradient, float("nan")))
        assert np.isnan(cost)


@pytest.mark.parametrize(("pose_states", "clock"), [((), False), (POSE_STATES, True)])
def test_residuals_and_gradients_of_a_solve_by_torch_are_those_of_kornia(monkeypatch, pose_states, clock):
    """Every evaluation and every linearisation calls kornia, in each run of observations."""
    calls = Counter()

    def counted(name, function):
        def call(*arguments):
            calls[name] += 1
            return function(*arguments)

        return call

    for name in ("transform_points", "project_points"):
        monkeypatch.setattr(model, name, counted(name, getattr(model, name)))
    monkeypatch.setattr(model.Se3, "exp", staticmethod(counted("exp", model.Se3.exp)))
    evaluated = []
    at = TorchEngine.cost_and_gradient

    def cost_and_gradient(*arguments):
        before = Counter(calls)
        out = at(*arguments)
        evaluated.append(calls - before)
        return out

    monkeypatch.setattr(TorchEngine, "cost_and_gradient", cost_and_gradient)
    options = SolveOptions(pose_states=pose_states, clock_offset=clock, engine="torch")
    solution = solve(example(), options)
    assert solution.status is Status.CONVERGED
    assert len(evaluated) >= solution.evaluations
    for calls_by_name in evaluated:
        assert min(calls_by_name[name] for name in ("transform_points", "project_points", "exp")) > 0
    assert calls["project_points"] > len(evaluated)


def test_constants_of_the_kernels_in_cpp_are_those_of_python():
    if native.kernels() is None:
        pytest.skip(native.which_runs())
    assert native.kernels().adjust.CONSTANTS == {
        "NEAR_M": NEAR_M,
        "WEIGHT_FLOOR": WEIGHT_FLOOR,
        "CORNER_FLOOR": reduced.CORNER_FLOOR,
        "PIVOT_FLOOR": reduced.PIVOT_FLOOR,
        "MIN_DEPRESSION_SINE": model.MIN_DEPRESSION_SINE,
    }


def test_kernels_in_cpp_refuse_arrays_of_another_shape_or_type():
    if native.kernels() is None:
        pytest.skip(native.which_runs())
    gather = native.kernels().adjust.gather
    with pytest.raises(ValueError, match="parts: of another shape"):
        gather(np.zeros(3, np.int32), np.zeros((2, 6)), np.zeros((4, 6)))
    with pytest.raises(ValueError, match="out: of another type"):
        gather(np.zeros(2, np.int32), np.zeros((2, 6)), np.zeros((4, 6), np.float32))


def test_the_earlier_name_of_the_compiled_engine_still_chooses_it():
    arrays = make_arrays(make_scene().problem, (), "cpu")
    assert type(make_engine("numba", arrays)) is type(make_engine("native", arrays))
    check_options(SolveOptions(engine="numba"))


def test_score_tests_are_the_same_by_either_engine():
    problem = make_scene().problem
    numba, by_torch = (
        {
            (test.fault, test.camera, test.axis, test.item): test
            for test in score_faults(problem, solve(problem, options))
        }
        for options in (SolveOptions(engine="native"), SolveOptions(engine="torch"))
    )
    assert numba.keys() == by_torch.keys()
    for key, test in numba.items():
        np.testing.assert_allclose(
            [by_torch[key].value, by_torch[key].gain], [test.value, test.gain], rtol=1e-3
        )
