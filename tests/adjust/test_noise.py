"""The noise of the poses by the drive itself."""

from dataclasses import replace

import numpy as np
import pytest

from tests.adjust.scene import correlated, exp, make_scene, project
from v2hdm.adjust import Drift, PoseSigma, SolveOptions, estimate_noise, solve
from v2hdm.adjust.solution import noise_scale

STATED = PoseSigma(0.01, 0.001, 0.002, 0.005, roll_pitch_drift=Drift(0.0015, 5.0))


def test_a_sigma_that_is_stated_four_times_too_small_is_found():
    street = make_scene(1, frames=120, every_m=3.0, jitter=None, start_error_deg=0.2)
    rng, observations = np.random.default_rng(1), street.problem.observations
    tangent = np.zeros((120, 6))
    tangent[:, 3:5] = 0.008 * np.column_stack([correlated(rng, 120, 1, 0.9)[:, 0] for _ in range(2)])
    poses = (street.map_from_vehicle @ exp(tangent))[observations.frame]
    pixel = project(
        street.cam_from_vehicle[observations.camera] @ np.linalg.inv(poses),
        street.corners_map[observations.corner],
    )
    pixel += rng.normal(0, 0.7, pixel.shape)
    problem = replace(street.problem, pose_sigma=STATED, observations=replace(observations, pinhole_px=pixel))
    (noise,) = estimate_noise(problem, solve(problem, SolveOptions(coarse=False, loss="none")))
    assert noise.roll_pitch_rad == pytest.approx(0.008, rel=0.4)
    assert noise.roll_pitch_rad > noise.roll_pitch_drift.sigma > 0.003
    assert noise.position_m < STATED.position_m / 2, "these are exact"


def test_a_right_statement_stays():
    street = make_scene(2, frames=120, every_m=3.0, jitter=STATED, start_error_deg=0.2)
    problem = replace(street.problem, pose_sigma=STATED)
    (noise,) = estimate_noise(problem, solve(problem, SolveOptions(coarse=False, loss="none")))
    assert noise.roll_pitch_rad == pytest.approx(STATED.roll_pitch_rad, rel=0.35)
    assert noise.heading_rad == pytest.approx(STATED.heading_rad, rel=0.5)


def test_without_states_of_the_frames_nothing_is_estimated():
    street = make_scene(2, frames=40, every_m=3.0, jitter=None)
    options = SolveOptions(coarse=False, loss="none", pose_states=())
    assert estimate_noise(street.problem, solve(street.problem, options)) == street.problem.pose_sigmas


@pytest.mark.parametrize("count", [1, 2, 7, 1000])
@pytest.mark.parametrize("factor", [0.3, 0.999, 1.0, 1.001, 4.0])
def test_the_variance_factor_is_the_medians_and_at_least_one(count, factor):
    squared = factor * np.random.default_rng(count).chisquare(2, count)
    expected = max(1.0, float(np.median(squared)) / (2 * np.log(2)))
    assert noise_scale(squared) == pytest.approx(expected, rel=1e-6)
    assert noise_scale(np.full(count, 1.5 * 2 * np.log(2))) == pytest.approx(1.5)
