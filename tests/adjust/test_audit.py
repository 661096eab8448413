"""A solve begins and ends with the model and kornia, whatever computes in between."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.adjust.scene import make_scene
from v2hdm.adjust import SolveOptions, Status, model, solve
from v2hdm.adjust.audit import audit
from v2hdm.adjust.engine import TorchEngine
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.kernels import evaluate
from v2hdm.adjust.kernels.rig import make_rig
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.model import Estimate, Loss
from v2hdm.adjust.problem import POSE_STATES
from v2hdm.errors import AdjustError

PAPER = SolveOptions(pose_states=())


@pytest.fixture
def calls(monkeypatch):
    """Names of kornia's functions as the model calls them, and of the descent between."""
    names = []

    def note(owner, name, as_name=None):
        function = getattr(owner, name)

        def noted(*arguments, **named):
            names.append(as_name or name)
            return function(*arguments, **named)

        monkeypatch.setattr(owner, name, noted)

    for name in ("inverse_transformation", "transform_points", "project_points"):
        note(model, name)
    note(sys.modules["v2hdm.adjust.solve"], "descend")
    return names


@pytest.mark.parametrize("pose_states", [(), POSE_STATES])
def test_a_default_solve_starts_from_kornias_homographies_and_ends_with_its_projection(calls, pose_states):
    solution = solve(make_scene(0, frames=30).problem, SolveOptions(pose_states=pose_states))
    assert solution.status is Status.CONVERGED
    begin = len(calls) - 1 - calls[::-1].index("descend")
    assert "inverse_transformation" in calls[:begin]
    assert calls[begin + 1 :] == ["transform_points", "project_points"]


def test_all_observations_of_a_small_problem_are_audited_and_a_sample_of_a_large_one(monkeypatch):
    problem = make_scene(0, frames=30).problem
    count = len(problem.observations.corner)
    assert count > 900
    projected = []
    project = model.project_points

    def counted(points, intrinsic):
        projected.append(len(points))
        return project(points, intrinsic)

    monkeypatch.setattr(model, "project_points", counted)
    solve(problem, PAPER)
    monkeypatch.setattr("v2hdm.adjust.audit._SAMPLE", 500)
    solve(problem, PAPER)
    assert projected == [count, 500]


def with_wrong_residual(layout, table, corners, order, focal, out):
    out.residual_px[7] += 1e-3


def with_wrong_distance(layout, table, corners, order, focal, out):
    out.mahalanobis2[7] += 1e-3


def with_wrong_flag(layout, table, corners, order, focal, out):
    out.behind[7] = True


@pytest.mark.parametrize("damage", [with_wrong_residual, with_wrong_distance, with_wrong_flag])
def test_a_solve_refuses_a_kernel_that_reports_an_observation_wrongly(monkeypatch, damage):
    report = evaluate.report

    def broken(begin, end, *arguments):
        report(begin, end, *arguments)
        damage(*arguments)

    monkeypatch.setattr(evaluate, "report", broken)
    with pytest.raises(AdjustError, match=r"departs from its model: the residual of observation 7 is \("):
        solve(make_scene(0, frames=30).problem, PAPER)


@pytest.mark.parametrize("pose_states", [(), POSE_STATES])
def test_a_solve_refuses_kernels_that_minimise_something_else(monkeypatch, pose_states):
    """A tenth of a pixel aside, which moves the optimum by millimetres."""
    at = evaluate.evaluate

    def broken(begin, end, layout, *arguments):
        at(begin, end, layout._replace(measured=layout.measured + 1e-4), *arguments)

    def aside(arrays, layout):
        return make_rig(arrays, layout._replace(measured=layout.measured + 1e-4))

    monkeypatch.setattr(evaluate, "evaluate", broken)
    monkeypatch.setattr("v2hdm.adjust.kernels.engine.make_rig", aside)
    with pytest.raises(AdjustError, match="compiled adjustment departs from its model: the cost of the obs"):
        solve(make_scene(0, frames=30).problem, SolveOptions(pose_states=pose_states))


def test_torchs_engine_needs_no_kernel(monkeypatch):
    """Where neither C++ nor numba compiles one."""
    program = """
import os, sys
os.environ["V2HDM_NATIVE"] = "0"
sys.modules["numba"] = None
from tests.adjust.scene import make_scene
from v2hdm.adjust import SolveOptions, solve
found = solve(make_scene(0, frames=30).problem, SolveOptions(pose_states=()))
print(type(found.covariance.descent.engine).__name__, repr(found.cost), len(found.corner_covariance([0, 1])))
"""
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    name, cost, size = process.stdout.split()
    expected = solve(make_scene(0, frames=30).problem, PAPER)
    assert (name, size) == (TorchEngine.__name__, "4")
    assert float(cost) == pytest.approx(expected.cost, rel=1e-9)


def test_the_ground_of_a_ray_and_its_weight_are_those_of_the_projection_and_its_derivative():
    """The closed form of a homography and its derivative, from steep rays to shallow ones."""
    scene = make_scene(3, frames=12).problem
    poses = torch.as_tensor(scene.cam_from_vehicle[:1] @ np.linalg.inv(scene.map_from_vehicle[:1]))
    measured = torch.tensor([[0.3, -0.5, 0.0], [0.9, 0.2, 0.05]], dtype=torch.float64)
    root = torch.tensor([[2.0, 3.0, 1.0], [0.5, -1.0, 0.0], [1.0, 4.0, 2.0]], dtype=torch.float64)
    homography = model.ground_from_ray(poses).reshape(9, 1).expand(-1, 3)
    xx, yx, yy, x, y = model.back_projected(homography, measured, root)
    information = torch.stack([xx, yx, yx, yy], dim=1).view(-1, 2, 2)
    corners = torch.linalg.solve(information, torch.stack([x, y], dim=1)).requires_grad_()

    def residual(moved):
        return model.corner_residual(model.points_in_camera(poses.expand(3, -1, -1), moved), measured, root)

    assert float(residual(corners).detach().abs().max()) < 1e-12
    by_corner = torch.autograd.functional.jacobian(residual, corners).sum(2)
    torch.testing.assert_close(by_corner.mT @ by_corner, information)


def test_rays_above_the_horizon_say_nothing_of_the_ground():
    scene = replace(make_scene(3, frames=12).problem)
    poses = torch.as_tensor(scene.cam_from_vehicle[:1] @ np.linalg.inv(scene.map_from_vehicle[:1]))
    measured = torch.tensor([[0.0], [-1.0]], dtype=torch.float64)
    root = torch.tensor([[1.0], [0.0], [1.0]], dtype=torch.float64)
    assert not model.back_projected(model.ground_from_ray(poses).reshape(9, 1), measured, root).any()


def test_an_estimate_that_is_not_finite_is_left_to_its_status():
    scene = make_scene(0, frames=30)
    arrays = make_arrays(scene.problem, (), "cpu")
    engine = make_engine("auto", arrays)
    corners, _ = engine.back_project(torch.from_numpy(scene.problem.cam_from_vehicle))
    corners[3] = torch.nan
    state = torch.zeros_like(arrays.state_information_root)
    estimate = Estimate(torch.from_numpy(scene.problem.cam_from_vehicle), state, corners, arrays.no_clock())
    focal_px = scene.problem.intrinsic[:, :2]
    robust = Loss("cauchy", 2.0)
    cost = engine.terms(estimate, robust)["observations"]
    report = engine.report(estimate, focal_px)
    assert np.isnan(report.mahalanobis2).any()
    audit(arrays, estimate, robust, focal_px, report, cost)
