"""A solve's debt to the ground is taken out of it before its markings are held against the ground."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from tests.adjust.scene import make_scene, with_ground
from v2hdm.adjust import PoseSigma, SolveOptions, solve
from v2hdm.geometry.rigid import exp
from v2hdm.mapping.ground_evidence import off_ground

OPTIONS = SolveOptions(loss="none")


def bundle_of(problem):
    return SimpleNamespace(
        problem=problem, solution=solve(problem, OPTIONS), camera_index={"front": 0, "rear": 1}
    )


def scene(tilt_deg=0.0, higher_m=0.0):
    """A street whose ground, as texture shows it, is tilted and lower by so much."""
    street = make_scene(4, frames=60, every_m=3.0, jitter=PoseSigma(0.01, 0.001, 0.002, 0.005))
    street = with_ground(street, 0.05, 0.005)
    ground = street.problem.ground
    plane = ground.plane_cam.copy()
    turns = exp(np.array([[0.0, 0, 0, 0, 0, np.deg2rad(tilt_deg)]] * 2))[:, :3, :3]
    plane[:, :3] = (turns @ plane[:, :3, None])[..., 0]
    plane[:, 3] += higher_m
    return replace(street.problem, ground=replace(ground, plane_cam=plane))


def test_the_markings_alone_are_those_of_a_solve_without_ground_and_survey():
    problem = scene(tilt_deg=0.1, higher_m=0.01)
    differences = off_ground(bundle_of(problem))
    sigma_m = problem.centre_sigma_m.copy()
    sigma_m[:, 2] = np.inf
    alone = solve(replace(problem, ground=None, centre_sigma_m=sigma_m), OPTIONS).cam_from_vehicle
    for c, name in enumerate(("front", "rear")):
        height_m = -alone[c, :3, 2] @ alone[c, :3, 3]
        assert abs(differences[name].up_m - (height_m - problem.ground.plane_cam[c, 3])) < 1e-3
        turn = np.cross(problem.ground.plane_cam[c, :3], alone[c, :3, 2])
        expected_deg = -np.rad2deg(alone[c, :3, :3].T @ turn)
        np.testing.assert_allclose(differences[name].turn_deg, expected_deg, atol=0.01)


def test_a_right_ground_agrees_and_one_off_by_half_a_degree_does_not():
    assert all(difference.sigmas < 2.5 for difference in off_ground(bundle_of(scene())).values())
    assert all(difference.sigmas > 4.0 for difference in off_ground(bundle_of(scene(tilt_deg=0.5))).values())


def test_without_ground_there_is_nothing_to_compare():
    assert off_ground(bundle_of(replace(scene(), ground=None))) == {}
