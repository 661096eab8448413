"""Compiled kernels and numpy compute residuals, slopes and distances of pairs alike."""

import numpy as np
import pytest

from tests.localization.driven import MOUNT, cameras, drive, mapped, yard
from v2hdm.geometry.rigid import heading_rad
from v2hdm.localization import belief
from v2hdm.localization.joint import Pairs, Scene, _distances, _whitened, candidates
from v2hdm.localization.motion import MotionNoise
from v2hdm.localization.paint import Paint
from v2hdm.localization.seeing import expect_points, sighted
from v2hdm.native import kernels, numpy_alone

compiled = pytest.mark.skipif(kernels() is None, reason="nothing is compiled")


def twice(compute):
    """The results of a function compiled, and by numpy alone."""
    with numpy_alone():
        by_numpy = compute()
    return compute(), by_numpy


class Before:
    """A vehicle before a map, some of whose markings' errors are states."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        painted = yard(seed)
        driven = drive(painted, seed, seconds=0.5)
        look = driven.looks[0][0]
        self.calibration = cameras()["front"]
        paint = Paint(mapped(painted, seed))
        pose = np.array([*driven.poses[0, :2, 3], heading_rad(driven.poses[0])])
        start = belief.start(0.0, pose, np.full(3, 0.02), [MOUNT, MOUNT], MotionNoise())
        near_numbers = paint.near(start.mean[:2], 20.0)[::2].tolist()
        held = belief.with_markings(start, near_numbers, [paint.centre_m2[number] for number in near_numbers])
        mean = held.mean + held.root @ (0.05 * rng.standard_normal(len(held.mean)))
        self.belief = belief.replace(held, mean=mean)
        quads = sighted(look, self.calibration)
        self.scene = Scene(quads, paint, belief.Plane(0.002, (0.0005, -0.001)), 0, self.calibration, 2.0)


@compiled
@pytest.mark.parametrize("seed", range(3))
def test_points_are_expected_at_the_same_pixels_with_the_same_derivatives(seed):
    before = Before(seed)
    points = before.scene.paint.corners_map  # some of these lie behind the camera
    arguments = (before.belief, before.scene.plane, 0, before.calibration, points)
    for array, by_numpy in zip(*twice(lambda: expect_points(*arguments)), strict=True):
        np.testing.assert_allclose(array, by_numpy, rtol=1e-9, atol=1e-9)


@compiled
@pytest.mark.parametrize("seed", range(3))
def test_pairs_have_the_same_noise_and_distance(seed):
    before = Before(seed)
    (pairs, loss), (pairs_too, loss_too) = twice(lambda: candidates(before.belief, before.scene))
    assert len(pairs.marking) >= 3
    for array, by_numpy in zip(pairs, pairs_too, strict=True):
        np.testing.assert_array_equal(array, by_numpy)
    np.testing.assert_allclose(loss, loss_too, rtol=1e-8)
    expected = before.scene.expect(before.belief, pairs.marking)
    spread, spread_too = twice(lambda: before.scene.spread(before.belief, expected, pairs.marking))
    np.testing.assert_allclose(spread, spread_too, atol=1e-9)
    noise, noise_too = twice(lambda: before.scene.noise(pairs, expected, before.belief))
    np.testing.assert_allclose(noise, noise_too, rtol=1e-9, atol=1e-12)
    residual = before.scene.residual(pairs, expected)
    for array, by_numpy in zip(*twice(lambda: _whitened(noise, residual, spread)), strict=True):
        np.testing.assert_allclose(array, by_numpy, rtol=1e-8, atol=1e-8)


@compiled
def test_a_covariance_that_is_none_fits_nothing():
    residual = np.ones((1, 8))
    distance = _distances(-np.eye(8)[None], residual, np.zeros((1, 8, 3)))
    assert np.isnan(distance.squared).all()


def test_states_of_markings_are_found_where_these_are_held():
    before = Before(4)
    markings = np.arange(len(before.scene.paint))
    states = before.belief.states_of(markings)
    for marking, state in zip(markings.tolist(), states.tolist(), strict=True):
        assert state == (-1 if marking not in before.belief.markings else before.belief.state_of(marking))
    assert (states >= 0).sum() == len(before.belief.markings)


def test_kernels_refuse_what_would_lead_beyond_their_arrays():
    if kernels() is None:
        pytest.skip("nothing is compiled")
    with pytest.raises(ValueError, match="beyond the root"):
        kernels().spread(
            np.eye(17), np.zeros((1, 8, 17)), np.zeros((1, 8, 2)), np.array([16]), belief.VEHICLE
        )
    order = np.arange(8)[None]
    with pytest.raises(ValueError, match="beyond the look"):
        kernels().pair_noise(
            np.zeros((1, 8, 8)), np.array([1]), order, 1.0, np.zeros((1, 8, 8)), np.zeros((1, 8, 2))
        )


def test_without_any_pair_nothing_is_computed():
    before = Before(5)
    none = Pairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 8), np.int64))
    expected = before.scene.expect(before.belief, none.marking)
    for noise in twice(lambda: before.scene.noise(none, expected, before.belief)):
        assert noise.shape == (0, 8, 8)
