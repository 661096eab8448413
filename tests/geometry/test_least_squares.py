"""The one least-squares loop: recovery, what nothing observes, robust weights, damping and manifolds."""

from functools import partial

import numpy as np
import pytest

from v2hdm.geometry.least_squares import Normal, first_of_inverse, gauss_newton, normal_equations
from v2hdm.geometry.rigid import exp, inverse, log

AT = np.linspace(0.0, 2.0, 30)
TRUE = np.array([1.5, -0.8])


def curve(x, measured, weight=None):
    """``seen`` (30,) as a exp(b t), in standard deviations of .01."""
    grown = np.exp(x[1] * AT)
    slopes = np.stack([grown, x[0] * AT * grown], axis=1)
    weights = 1e4 * (np.ones(30) if weight is None else weight)
    return normal_equations((x[0] * grown - measured)[:, None], slopes[:, None], weights[:, None, None])


def noisy(seed):
    return TRUE[0] * np.exp(TRUE[1] * AT) + np.random.default_rng(seed).normal(0, 0.01, 30)


def test_a_curve_is_recovered_and_its_sigmas_hold():
    fits = [gauss_newton(partial(curve, measured=noisy(seed)), np.array([1.0, 0.0])) for seed in range(200)]
    assert all(fit.converged for fit in fits)
    squares = [(fit.x - TRUE) @ np.linalg.solve(fit.covariance, fit.x - TRUE) for fit in fits]
    assert np.mean(squares) == pytest.approx(2.0, abs=0.45)  # three deviations of a mean of 200
    assert fits[0].predicted_cost == pytest.approx(curve(fits[0].x, noisy(0)).cost, rel=1e-9)


def test_what_nothing_observes_stays_where_it_was_and_has_no_finite_sigma():
    def linearise(x):
        return normal_equations(np.array([[x[0] + x[1] - 3.0]]), np.array([[[1.0, 1.0, 0.0]]]))

    fit = gauss_newton(linearise, np.array([0.0, 0.0, 7.0]))
    np.testing.assert_allclose(fit.x, [1.5, 1.5, 7.0])
    assert np.isinf(np.diag(fit.covariance)).all()


def test_robust_weights_leave_outliers_aside():
    measured = noisy(1)
    measured[::6] += 3.0

    def linearise(x):
        off = (x[0] * np.exp(x[1] * AT) - measured) / 0.01
        return curve(x, measured, 1 / (1 + (off / 2.5) ** 2))

    assert np.abs(gauss_newton(lambda x: curve(x, measured), TRUE).x - TRUE).max() > 0.1
    assert np.abs(gauss_newton(linearise, TRUE, steps=100).x - TRUE).max() < 0.02


def test_damping_reaches_a_minimum_that_whole_steps_leap_over():
    def linearise(x):
        return normal_equations(np.arctan(x)[None], (1 / (1 + x**2))[None, None])

    far = np.array([3.0])
    with np.errstate(over="ignore", invalid="ignore"):
        assert not abs(gauss_newton(linearise, far, steps=8).x[0]) < 1
    fit = gauss_newton(linearise, far, steps=60, damping=1e-3)
    assert fit.converged
    assert abs(fit.x[0]) < 1e-8


def test_at_a_minimum_up_to_rounding_damping_begins_anew():
    """Near 0 the gradient is wrong, as rounding is, by more than a short step: each step raises the cost."""
    limited = partial(np.clip, a_min=-1.0, a_max=1.0)

    def linearise(x):
        return Normal(np.eye(1), x + 0.03, 0.5 * float(x @ x))

    fit = gauss_newton(linearise, np.array([8.0]), limit=limited, steps=60, tolerance=0.02, damping=1e-3)
    assert fit.converged
    # Eight steps of 1 lower the damping to 1e-11, one fails there, and four raise it from 1e-3 to 1.
    assert fit.steps == 13


def test_a_motion_is_found_on_its_manifold():
    rng = np.random.default_rng(2)
    true, points = exp(rng.normal(0, 0.5, 6)), rng.normal(0, 3, (9, 3))
    moved = points @ true[:3, :3].T + true[:3, 3]

    def linearise(x):
        now = points @ x[:3, :3].T + x[:3, 3]
        turn = np.cross(np.eye(3), now[:, None]).swapaxes(1, 2)
        return normal_equations(
            now - moved, np.concatenate([np.broadcast_to(np.eye(3), (9, 3, 3)), turn], axis=2)
        )

    fit = gauss_newton(linearise, np.eye(4), retract=lambda x, step: exp(step) @ x)
    assert fit.converged
    np.testing.assert_allclose(log(fit.x @ inverse(true)), 0.0, atol=1e-9)


def test_a_problem_that_is_not_finite_ends_at_once_and_costs_infinitely_much():
    fit = gauss_newton(lambda x: normal_equations(np.array([[np.nan]]), np.ones((1, 1, 1))), np.zeros(1))
    assert not fit.converged
    assert np.isinf(fit.predicted_cost)


def test_steps_are_limited_and_counted():
    def linearise(x):
        return normal_equations((x - 10.0)[None], np.ones((1, 1, 1)))

    fit = gauss_newton(linearise, np.zeros(1), limit=lambda step: np.clip(step, -3.0, 3.0))
    assert fit.steps == 5  # 3, 3, 3, 1 and one of nothing
    np.testing.assert_allclose(fit.x, 10.0)


@pytest.mark.parametrize("least", [1.0, -1.0])
def test_the_first_of_an_inverse_is_a_corner_of_it_definite_or_not(least):
    axes = np.linalg.qr(np.random.default_rng(3).normal(size=(30, 30)))[0]
    information = axes * np.r_[least, np.linspace(1.0, 1e4, 29)] @ axes.T
    np.testing.assert_allclose(
        first_of_inverse(information, 7), np.linalg.inv(information)[:7, :7], rtol=1e-8
    )
