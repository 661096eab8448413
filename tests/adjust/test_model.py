"""The model's residuals and their derivatives, near zero rotation, near the horizon and behind the camera."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.adjust.scene import make_scene
from v2hdm.adjust import model
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.model import Estimate, Loss
from v2hdm.adjust.problem import LOSSES, POSE_STATES, ControlPoints, Drift, KnownLengths, PoseSigma
from v2hdm.adjust.whitening import factorise

POSES = PoseSigma(position_drift=Drift(0.016, 10.0), heading_drift=Drift(0.0006, 5.0))


def example(pose_states=POSE_STATES, size=0.0, max_range_m=15.0, frames=14, clock=False):
    scene = make_scene(3, frames=frames, jitter=POSES, max_range_m=max_range_m)
    twist = np.tile([5.0, 0.1, 0.0, 0.0, 0.0, 0.4], (frames, 1)) * np.linspace(0.8, 1.2, frames)[:, None]
    control = ControlPoints(
        np.array([2, 5]),
        scene.corners_map[[2, 5]] + 0.01,
        np.array([[0.01, np.inf], [0.02, 0.005]]),
        np.array([[0.8, 0.6], [1.0, 0.0]]),
    )
    lengths = KnownLengths(np.array([0, 7, 6]), np.array([1, 4, 7]), np.full(3, 0.5), np.full(3, 0.01))
    problem = replace(scene.problem, twist_vehicle=twist, control=control, lengths=lengths)
    arrays = make_arrays(problem, pose_states, "cpu", clock)
    generator = torch.Generator().manual_seed(0)
    state = size * torch.randn(arrays.state_information_root.shape, generator=generator, dtype=torch.float64)
    corners = torch.as_tensor(scene.corners_map)[arrays.corner_order]
    clock_s = arrays.no_clock() + 0.3 * size
    return arrays, Estimate(torch.as_tensor(scene.problem.cam_from_vehicle), state, corners, clock_s)


def moved(estimate, extrinsic, state, corners, clock=None):
    turn = model.rigid(extrinsic)
    return Estimate(
        (turn if extrinsic.requires_grad else turn.detach()) @ estimate.cam_from_vehicle,
        estimate.frame_state + state,
        estimate.corners_map + corners,
        estimate.clock_s if clock is None else estimate.clock_s + clock,
    )


def residuals(arrays, estimate):
    pairs = model.cam_from_map(arrays, estimate.cam_from_vehicle, estimate.frame_state, estimate.clock_s)
    points = model.points_in_camera(
        pairs.flatten(0, 1)[arrays.pair.long()], estimate.corners_map[arrays.corner.long()]
    )
    return model.corner_residual(points, arrays.measured, arrays.root_information).T


@pytest.mark.parametrize("engine", ["native", "torch"])
@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("size", [0.0, 1e-8, 0.05])
@pytest.mark.parametrize(
    ("pose_states", "clock"), [((), False), (("roll", "pitch"), False), (POSE_STATES, True)]
)
def test_the_gradient_is_that_of_finite_differences(engine, name, size, pose_states, clock):
    arrays, estimate = example(pose_states, size, clock=clock)
    engine_state, robust = make_engine(engine, arrays), Loss(name, 3.0)
    by_torch = make_engine("torch", arrays)
    gradient = factorise(by_torch, by_torch.plan(), estimate, robust).linearised.gradient
    generator = torch.Generator().manual_seed(1)
    parts = (gradient.extrinsic, gradient.frame_state, gradient.corners_map, gradient.clock_s)
    along = [torch.randn(part.shape, generator=generator, dtype=torch.float64) for part in parts]
    cost = [
        sum(engine_state.terms(moved(estimate, *(sign * 1e-6 * step for step in along)), robust).values())
        for sign in (1.0, -1.0)
    ]
    expected = sum(float((part * step).sum()) for part, step in zip(parts, along, strict=True))
    assert (cost[0] - cost[1]) / 2e-6 == pytest.approx(expected, rel=1e-5, abs=1e-3)


@pytest.mark.parametrize(("distance_m", "pitch"), [(6.0, 0.0), (200.0, 0.0), (2000.0, 1e-3)])
def test_gradcheck_of_the_observation_residual_holds_up_to_the_horizon(distance_m, pitch):
    arrays, estimate = example(("roll", "pitch"), frames=2)
    arrays, corners = arrays.take(torch.arange(len(arrays.corner)) < 6)
    ahead = torch.tensor([distance_m, 0.0], dtype=torch.float64)
    estimate = replace(estimate, corners_map=estimate.corners_map[corners] + ahead)
    inputs = [torch.zeros(2, 6, dtype=torch.float64), torch.full((2, 2), pitch, dtype=torch.float64)]
    inputs.append(torch.zeros_like(estimate.corners_map))
    for value in inputs:
        value.requires_grad_()

    def residual(*steps):
        return residuals(arrays, moved(estimate, *steps))

    assert torch.autograd.gradcheck(residual, inputs, eps=1e-6, atol=1e-5, rtol=1e-4)


def test_behind_the_camera_the_residual_grows_on_and_leads_back_to_the_front():
    depth = torch.linspace(0.3, -3.0, 34, dtype=torch.float64)
    points = torch.stack([torch.full_like(depth, 0.2), torch.full_like(depth, -0.1), depth], dim=1)
    points.requires_grad_()
    root = torch.tensor([[1.0], [0.0], [1.0]], dtype=torch.float64)
    residual = model.corner_residual(points, torch.zeros(2, 1, dtype=torch.float64), root)
    assert bool(residual.isfinite().all())
    assert bool((residual[:, 0].diff() > 0).all())
    (slope,) = torch.autograd.grad(residual[:, 0].sum(), points)
    assert bool((slope[:, 2] < 0).all())


def test_a_corner_that_a_survey_holds_in_one_direction_is_free_across_it():
    arrays, estimate = example(())
    corners = estimate.corners_map.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda moved: model.control_residual(arrays, moved), corners)
    across = torch.zeros_like(estimate.corners_map)
    across[arrays.corner_order == 2] = torch.tensor([-0.6, 0.8], dtype=torch.float64)
    moved = model.control_residual(arrays, estimate.corners_map + across)
    torch.testing.assert_close(moved, model.control_residual(arrays, estimate.corners_map))


@pytest.mark.parametrize("apart_m", [30.0, 1e-3])
def test_the_derivative_of_a_known_length_is_the_numerical_one_for_corners_that_all_but_coincide_too(apart_m):
    arrays, estimate = example(())
    corners = apart_m * torch.randn(estimate.corners_map.shape, dtype=torch.float64)
    corners.requires_grad_()
    lengths = arrays.lengths

    def residual(moved):
        return model.length_residual(arrays, moved[lengths.first], moved[lengths.second])

    eps = 1e-5 * apart_m
    assert torch.autograd.gradcheck(residual, corners, eps=eps, atol=1e-6, rtol=1e-6)


def test_two_corners_in_one_place_have_a_finite_residual_and_no_direction():
    arrays, estimate = example(())
    here = estimate.corners_map[arrays.lengths.first].requires_grad_()
    residual = model.length_residual(arrays, here, here.detach().clone())
    torch.testing.assert_close(residual, -arrays.lengths.length_m * arrays.lengths.information_root)
    (slope,) = torch.autograd.grad(residual.sum(), here)
    assert not slope.any()


@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_starts_as_least_squares_and_its_weight_is_its_slope(name):
    squared = torch.tensor([0.0, 1e-6, 1.0, 8.9, 9.1, 400.0], dtype=torch.float64, requires_grad=True)
    rho, weight = model.robustified(Loss(name, 3.0), squared)
    torch.testing.assert_close(torch.autograd.grad(rho.sum(), squared)[0], weight)
    torch.testing.assert_close(rho[:2], squared[:2], rtol=1e-6, atol=0)
    assert bool((weight <= 1).all())


def test_a_position_error_has_the_covariance_of_white_noise_and_a_gauss_markov_process_in_the_map():
    scene = make_scene(3, frames=12, turn_deg_per_m=8.0, straight_m=2.0, jitter=POSES)
    arrays = make_arrays(scene.problem, POSE_STATES, "cpu")
    shape, count = arrays.state_information_root.shape, arrays.state_information_root.numel()
    root = torch.autograd.functional.jacobian(
        lambda s: model.state_residual(arrays, s).flatten(), torch.zeros(shape, dtype=torch.float64)
    ).reshape(count, count)
    states = torch.linalg.inv(root.T @ root).reshape(*shape, *shape)
    # Which state acts on which column of the tangent, (6, S).
    onto = torch.eye(6, dtype=torch.float64)[:, list(arrays.states)]
    covariance = torch.einsum("as,jskt,bt->jakb", onto, states, onto)
    turned = torch.as_tensor(scene.problem.map_from_vehicle[:, :2, :2])
    in_map = torch.einsum("jab,jbkc,kdc->jkad", turned, covariance[:, :2, :, :2], turned)
    apart_m = 0.5 * (torch.arange(12)[:, None] - torch.arange(12)).abs().to(torch.float64)
    white, drift = 0.012**2 * torch.eye(12, dtype=torch.float64), 0.016**2 * torch.exp(-apart_m / 10.0)
    expected = (white + drift)[..., None, None] * torch.eye(2, dtype=torch.float64)
    torch.testing.assert_close(in_map, expected, atol=1e-12, rtol=1e-6)
    pitch, heading = POSE_STATES.index("pitch"), POSE_STATES.index("heading")
    assert covariance[0, pitch, 1, pitch] == 0
    assert float(covariance[0, heading, 1, heading]) == pytest.approx(0.0006**2 * np.exp(-0.1))
    assert float(covariance[5, heading, 5, heading]) == pytest.approx(0.001**2)


def test_the_centre_prior_does_not_mind_a_rotation_about_the_camera():
    arrays, estimate = example(())
    turn = torch.tensor([0, 0, 0, 0.1, -0.2, 0.3], dtype=torch.float64)
    turned = replace(estimate, cam_from_vehicle=model.rigid(turn).detach() @ estimate.cam_from_vehicle)
    before, after = (model.centre_residual(arrays, state.cam_from_vehicle) for state in (estimate, turned))
    torch.testing.assert_close(after, before)
