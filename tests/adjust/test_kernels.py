"""The compiled kernels do what torch does, whatever the model, the loss and the number of threads."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.adjust.scene import make_scene, with_late_clocks
from v2hdm.adjust import ControlPoints, Drift, KnownLengths, PoseSigma, SolveOptions, solve
from v2hdm.adjust.descent import Objective
from v2hdm.adjust.engines import numba as fast
from v2hdm.adjust.engines.numba import pool
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.problem import LOSSES, POSE_STATES
from v2hdm.adjust.reduced import ReducedSystem, Spread, make_plan
from v2hdm.adjust.residuals import Estimate, Loss, pair_from_clock, pair_from_state, squared_residuals
from v2hdm.adjust.start import back_project
from v2hdm.adjust.whitening import _eliminate, factorise
from v2hdm.geometry import tensors as transform

if fast.available():
    from v2hdm.adjust.engines.numba.motion import move
    from v2hdm.adjust.engines.numba.prepare import median

pytestmark = pytest.mark.skipif(not fast.available(), reason="numba, the extra 'fast', is not installed")

POSES = PoseSigma(position_drift=Drift(0.01, 10.0), roll_pitch_drift=Drift(0.003, 2.0))
MODELS = [((), False), ((), True), (("roll", "pitch"), True), (POSE_STATES, False), (POSE_STATES, True)]


def example(*, lengths=True, frames=40):
    """A drive with all that a model can know: clocks, drifts, a survey, lengths, covariances of any shape."""
    scene = with_late_clocks(make_scene(3, frames=frames, outliers=0.05), np.array([0.02, -0.01]))
    problem, rng = scene.problem, np.random.default_rng(0)
    root = rng.normal(0, 0.1, (len(problem.observations.corner), 2, 2)) + 0.7 * np.eye(2)
    count = problem.corner_count
    diamonds = 4 * np.arange(count // 8)
    first = np.concatenate([diamonds, diamonds + 1, diamonds[:3] + 2])
    second = np.concatenate([diamonds + 1, diamonds + 2, diamonds[:3] + 3])
    known = KnownLengths(first, second, np.full(len(first), 0.5), np.full(len(first), 0.004))
    control = ControlPoints(
        np.array([3, 17]), scene.corners_map[[3, 17]] + 0.01, np.array([[0.02, 0.03], [0.05, 0.01]])
    )
    return replace(
        problem,
        observations=replace(problem.observations, covariance_px=root @ root.transpose(0, 2, 1)),
        pose_sigma=POSES,
        control=control,
        lengths=known if lengths else None,
    )


def both(problem, pose_states, clock):
    """The problem laid out for the kernels and for torch."""
    arrays = make_arrays(problem, pose_states, "cpu", clock)
    with fast.reference():
        by_torch = make_arrays(problem, pose_states, "cpu", clock)
        assert by_torch.passes is None
    return arrays, by_torch


def estimate_of(arrays, problem, generator, behind=True):
    """Somewhere near the start, with states and clocks of their own, and a corner behind its camera."""
    corners, _ = back_project(arrays, torch.as_tensor(problem.cam_from_vehicle))
    corners = corners.clone()
    corners[5] -= 100.0 if behind else 0.0
    state = 0.01 * torch.randn(arrays.state_information_root.shape, generator=generator, dtype=torch.float64)
    clock = 0.01 * torch.randn(arrays.no_clock().shape, generator=generator, dtype=torch.float64)
    return Estimate(torch.as_tensor(problem.cam_from_vehicle), state, corners, clock)


def assert_same(one, other, share=1e-12):
    """Equal to a share of the largest of all."""
    if other.numel():
        assert float((one - other).abs().max()) <= share * float(other.abs().max())


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize(("pose_states", "clock"), MODELS)
def test_the_normal_equations_are_those_of_torch(pose_states, clock, loss):
    problem = example()
    arrays, other_arrays = both(problem, pose_states, clock)
    estimate = estimate_of(arrays, problem, torch.Generator().manual_seed(1))
    plan = replace(make_plan(other_arrays), most_tiles=make_plan(arrays).most_tiles)
    spread = Spread(pair_from_state(arrays, estimate), pair_from_clock(arrays, estimate))
    system, by_torch = ReducedSystem(arrays, plan, spread), ReducedSystem(other_arrays, plan, spread)
    found = arrays.passes.eliminate(system, estimate, Loss(loss, 3.0), 0.01)
    expected = _eliminate(by_torch, estimate, Loss(loss, 3.0), 0.01)
    for name in ("observations", "control", "lengths", "wrench"):
        assert_same(getattr(found.sums, name), getattr(expected.sums, name))
    assert_same(found.whitened, expected.whitened)
    assert_same(found.coupled.frame_state, expected.coupled.frame_state)
    assert_same(found.coupled.camera, expected.coupled.camera)
    lone = ~arrays.joined & ~arrays.joined.roll(-1)
    assert_same(found.corner_factor.lower[:, lone], expected.corner_factor.lower[:, lone])
    for group, other in zip(found.corner_factor.joint, expected.corner_factor.joint, strict=True):
        assert torch.equal(group.begin, other.begin)
        assert_same(group.factor, other.factor)
    assert_same(system._own, by_torch._own)
    for tile, other in zip(system.matrix.diagonal, by_torch.matrix.diagonal, strict=True):
        assert_same(tile.tril(), other.tril())
    for panel, other in zip(system.matrix.panels, by_torch.matrix.panels, strict=True):
        assert_same(panel, other)
    assert_same(system.matrix.tip.tril(), by_torch.matrix.tip.tril())


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize(("pose_states", "clock"), MODELS)
def test_an_evaluation_is_that_of_torch_under_the_same_factors(pose_states, clock, loss):
    problem = example()
    arrays, other_arrays = both(problem, pose_states, clock)
    generator = torch.Generator().manual_seed(1)
    estimate = estimate_of(arrays, problem, generator, behind=False)
    objective = Objective(factorise(arrays, make_plan(arrays), estimate, Loss(loss, 3.0)))
    step = 0.001 * torch.randn(objective.whitening.size, generator=generator, dtype=torch.float64)
    cost, gradient = objective(step)
    moved = objective.point(step).estimate
    objective = Objective(replace(objective.whitening, arrays=other_arrays))
    expected_cost, expected_gradient = objective(step)
    expected_moved = objective.point(step).estimate
    assert_same(moved.corners_map, expected_moved.corners_map)
    torch.testing.assert_close(cost, expected_cost, rtol=1e-12, atol=0.0)
    corners = objective.whitening.corner_part
    assert_same(corners(gradient), corners(expected_gradient))
    # Differences of large sums; and along what is hardly known their last digits count a thousand times.
    assert_same(gradient, expected_gradient, 1e-9)


@pytest.mark.parametrize(("pose_states", "clock"), MODELS)
def test_back_projection_and_residuals_are_those_of_torch(pose_states, clock):
    problem = example(lengths=False)
    # A pixel above the horizon fixes nothing.
    problem.observations.pinhole_px[0, 1] = -5000.0
    arrays, other_arrays = both(problem, pose_states, clock)
    corners, fixed = back_project(arrays, torch.as_tensor(problem.cam_from_vehicle))
    estimate = estimate_of(arrays, problem, torch.Generator().manual_seed(2))
    squared = squared_residuals(arrays, estimate)
    expected, expected_fixed = back_project(other_arrays, torch.as_tensor(problem.cam_from_vehicle))
    expected_squared = squared_residuals(other_arrays, estimate)
    # Where a ray meets the ground at 700 m, its last digit is a picometre times the steepness of that.
    torch.testing.assert_close(corners, expected, rtol=1e-10, atol=1e-12)
    assert bool((fixed == expected_fixed).all())
    torch.testing.assert_close(squared, expected_squared, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("pose_states", "clock"), MODELS)
def test_a_solve_ends_where_that_of_torch_ends(pose_states, clock):
    problem = example()
    options = SolveOptions(pose_states=pose_states, clock_offset=clock, gap_tolerance=1e-13)
    found = solve(problem, options)
    with fast.reference():
        expected = solve(problem, options)
    assert found.cost == pytest.approx(expected.cost, rel=1e-10)
    assert found.status is expected.status
    np.testing.assert_allclose(found.corners_map, expected.corners_map, atol=1e-5)
    np.testing.assert_allclose(
        found.extrinsic_covariance, expected.extrinsic_covariance, rtol=1e-4, atol=1e-12
    )
    groups = np.array([[0, 1, 2, 3], [20, 21, 22, 23]])
    np.testing.assert_allclose(
        found.corner_covariance(groups), expected.corner_covariance(groups), rtol=1e-4, atol=1e-12
    )
    np.testing.assert_array_equal(found.verdict, expected.verdict)


@pytest.mark.parametrize("pose_states", [(), POSE_STATES])
def test_results_do_not_depend_on_the_number_of_threads(pose_states, monkeypatch):
    """To the last bit: many small chunks, side by side or one after the other."""
    monkeypatch.setattr("v2hdm.adjust.arrays._RUN", 200)
    monkeypatch.setattr(pool, "_WORTH_THREADS", 1)
    problem = example()
    options = SolveOptions(pose_states=pose_states)
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(solve(problem, options))
    finally:
        torch.set_num_threads(before)
    for one in found[1:]:
        assert one.cost == found[0].cost
        np.testing.assert_array_equal(one.corners_map, found[0].corners_map)
        np.testing.assert_array_equal(one.map_from_vehicle, found[0].map_from_vehicle)


@pytest.mark.parametrize("count", [1, 2, 5, 1000, 1001])
def test_the_median_is_that_of_numpy(count):
    values = np.random.default_rng(count).chisquare(2, count) * 10.0 ** np.arange(count % 7)[-1:].sum()
    values[: count // 4] = 0.0
    assert median(values) == pytest.approx(np.median(values), rel=1e-6)
    values[0] = np.nan
    assert np.isnan(median(values))


def test_cameras_move_as_they_do_in_torch():
    rng = np.random.default_rng(0)
    tangents = np.concatenate([np.zeros((1, 6)), rng.normal(0, 1e-6, (1, 6)), rng.normal(0, 0.5, (3, 6))])
    base = transform.exp(torch.as_tensor(rng.normal(0, 1, (5, 6))))
    moved, jacobian = move(tangents, base.numpy())
    expected = transform.exp(torch.as_tensor(tangents)) @ base
    torch.testing.assert_close(torch.from_numpy(moved), expected, rtol=1e-13, atol=1e-13)
    expected = transform.left_jacobian(torch.as_tensor(tangents))
    torch.testing.assert_close(torch.from_numpy(jacobian), expected, rtol=1e-13, atol=1e-13)


def test_what_is_no_number_stays_none():
    problem = example()
    arrays = make_arrays(problem, (), "cpu")
    estimate = estimate_of(arrays, problem, torch.Generator().manual_seed(0))
    whitening = factorise(arrays, make_plan(arrays), estimate, Loss("cauchy", 3.0))
    cost, _ = Objective(whitening)(torch.full_like(whitening.gradient, float("nan")))
    assert bool(cost.isnan())
