"""Evidence of bare ground rests on the inputs too: both name a wrong input, and it hides behind neither."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.adjust.scene import FOCAL, make_scene, with_ground
from v2hdm.adjust import PoseSigma, SolveOptions, solve
from v2hdm.faults import table
from v2hdm.faults.odds import is_contradicted
from v2hdm.faults.score_tests import score_faults

OPTIONS = SolveOptions(coarse=False, loss="none")
POSES = PoseSigma(0.01, 0.001, 0.002, 0.005)
BY_LENS = np.array([[[0.0, 0.0, 0.0, -1.6], [0.0, -0.02, -0.01, 0.2]]])
SHRUNK = 0.06  # by as much are the recorded positions too close together


def street():
    """A straight street past few markings, which leave much to survey and ground."""
    scene = make_scene(
        7, frames=40, turn_deg_per_m=0.0, every_m=7.0, cameras=1, jitter=POSES, start_error_deg=0.3
    )
    problem = with_ground(scene, 0.05, 0.005).problem
    return replace(problem, ground=replace(problem.ground, by_lens=BY_LENS))


def with_plane(problem, plane):
    return replace(problem, ground=replace(problem.ground, plane_cam=plane))


def zoomed(problem, value):
    """The problem, and what texture showed, with a focal length that is longer by a share."""
    intrinsic = problem.intrinsic.copy()
    intrinsic[:, :2] *= 1 + value
    plane = problem.ground.plane_cam + value * BY_LENS[:, 0]
    return with_plane(replace(problem, intrinsic=intrinsic), plane)


def shifted(problem, value):
    """The same with a principal point farther down, through which all seems to lie higher."""
    intrinsic = problem.intrinsic.copy()
    intrinsic[:, 3] += value
    plane = problem.ground.plane_cam.copy()
    plane[:, :3] = Rotation.from_euler("x", value / FOCAL).apply(plane[:, :3])
    return with_plane(replace(problem, intrinsic=intrinsic), plane)


def stretched(problem, value):
    """The same with positions that are farther apart by a share of adjusted ones, and so a height."""
    recorded = problem.map_from_vehicle.copy()
    adjusted = solve(problem, OPTIONS).map_from_vehicle[:, :3, 3]
    recorded[:, :3, 3] += value * (adjusted - adjusted.mean(axis=0))
    plane = problem.ground.plane_cam.copy()
    plane[:, 3] *= 1 + value
    return with_plane(replace(problem, map_from_vehicle=recorded), plane)


def scores_of(problem):
    return {
        (test.fault, test.axis): test
        for test in score_faults(problem, solve(problem, OPTIONS))
        if test.camera <= 0
    }


@pytest.mark.parametrize(
    ("fault", "axis", "moved", "step"),
    [
        (table.FOCAL, 0, zoomed, 1e-3),
        (table.PRINCIPAL, 1, shifted, 2.0),
        (table.SCALE, 0, stretched, 2e-3),
    ],
)
def test_value_and_sigma_are_those_of_solving_with_the_input_and_the_ground_that_it_shows(
    fault, axis, moved, step
):
    problem = street()
    low, middle, high = (2 * solve(moved(problem, p), OPTIONS).cost for p in (-step, 0.0, step))
    curvature, slope = (high - 2 * middle + low) / step**2, (high - low) / (2 * step)
    test = scores_of(problem)[fault, axis]
    assert test.model_sigma == pytest.approx((2 / curvature) ** 0.5, rel=0.1)
    assert test.value == pytest.approx(-slope / curvature, abs=0.2 * test.model_sigma)


def test_a_right_ground_contradicts_no_input():
    assert not any(is_contradicted(test) for test in scores_of(street()).values())


def test_a_ground_by_positions_too_close_together_shows_their_scale():
    """Without its column the ground's height would testify to the scale that it rests on."""
    scale = scores_of(stretched(street(), -SHRUNK))[table.SCALE, 0]
    assert scale.value == pytest.approx(SHRUNK, abs=4 * scale.sigma)
    assert scale.sigma < SHRUNK / 3
