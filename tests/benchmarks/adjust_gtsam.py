"""GTSAM on a problem of ours, through its Python package and its own compiled factors.

A pose of the vehicle, a mounting and a point make an observation (``ProjectionFactorPPPCal3_S2``). Poses and
the points' heights are held by tight priors, each camera's centre by the prior of its survey: the paper's
model. Levenberg-Marquardt eliminates in GTSAM's own order.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from tests.benchmarks.adjust_ceres import PeerResult
from v2hdm.adjust import Problem

try:
    import gtsam
    import gtsam_unstable
except ImportError:
    ABSENT = "gtsam is left out: it is not installed (pip install 'v2hdm[bench]')"
else:
    ABSENT = ""

_LOOSE = 1e3
"""Sigma of what a prior says nothing about, m."""

_HELD = 1e-5
"""Sigma of what is held, m and rad: tight constraints leave GTSAM's elimination ill-conditioned."""


def solve_gtsam(problem: Problem, tolerance: float = 1e-12, max_steps: int = 100) -> PeerResult:
    """Levenberg-Marquardt from ``problem``'s extrinsics and its ``corners_start``."""
    assert not ABSENT, ABSENT
    began = time.perf_counter()
    graph, start = _observed(problem), _start(problem)
    _add_priors(problem, graph)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(tolerance)
    parameters.setAbsoluteErrorTol(0.0)
    parameters.setMaxIterations(max_steps)
    ready, cpu = time.perf_counter(), time.process_time()
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
    values = optimiser.optimize()
    took, cpu = time.perf_counter() - ready, time.process_time() - cpu
    cameras = range(len(problem.intrinsic))
    return PeerResult(
        setup_s=ready - began,
        solve_s=took,
        cpu_s=cpu,
        cost=float(graph.error(values)),
        steps=int(optimiser.iterations()),
        cam_from_vehicle=np.array([np.linalg.inv(values.atPose3(_camera(c)).matrix()) for c in cameras]),
        corners_map=np.array([values.atPoint3(_corner(k))[:2] for k in range(problem.corner_count)]),
    )


def _camera(number: int) -> int:
    return int(gtsam.symbol("c", number))


def _frame(number: int) -> int:
    return int(gtsam.symbol("x", number))


def _corner(number: int) -> int:
    return int(gtsam.symbol("p", number))


def _observed(problem: Problem) -> Any:
    graph, observations = gtsam.NonlinearFactorGraph(), problem.observations
    lenses = [gtsam.Cal3_S2(fx, fy, 0.0, cx, cy) for fx, fy, cx, cy in problem.intrinsic]
    for camera, frame, corner, px, covariance in zip(
        observations.camera.tolist(),
        observations.frame.tolist(),
        observations.corner.tolist(),
        observations.pinhole_px,
        observations.covariance_px,
        strict=True,
    ):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        keys = _frame(frame), _camera(camera), _corner(corner)
        graph.add(gtsam_unstable.ProjectionFactorPPPCal3_S2(px, noise, *keys, lenses[camera]))
    return graph


def _add_priors(problem: Problem, graph: Any) -> None:
    """Poses as they are recorded, points on the ground, and the surveyed centres."""
    assert problem.centre_vehicle is not None
    assert problem.centre_sigma_m is not None
    for number in np.unique(problem.observations.frame).tolist():
        pose = gtsam.Pose3(problem.map_from_vehicle[number])
        graph.add(gtsam.PriorFactorPose3(_frame(number), pose, gtsam.noiseModel.Isotropic.Sigma(6, _HELD)))
    on_ground = gtsam.noiseModel.Diagonal.Sigmas(np.array([_LOOSE, _LOOSE, _HELD]))
    assert problem.corners_start is not None
    for number, (x, y) in enumerate(problem.corners_start):
        graph.add(gtsam.PriorFactorPoint3(_corner(number), np.array([x, y, 0.0]), on_ground))
    for number, (centre, sigma_m) in enumerate(
        zip(problem.centre_vehicle, problem.centre_sigma_m, strict=True)
    ):
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigma_m)
        graph.add(gtsam.PoseTranslationPrior3D(_camera(number), centre, noise))


def _start(problem: Problem) -> Any:
    values = gtsam.Values()
    for number in np.unique(problem.observations.frame).tolist():
        values.insert(_frame(number), gtsam.Pose3(problem.map_from_vehicle[number]))
    for number, cam_from_vehicle in enumerate(problem.cam_from_vehicle):
        values.insert(_camera(number), gtsam.Pose3(np.linalg.inv(cam_from_vehicle)))
    assert problem.corners_start is not None
    for number, (x, y) in enumerate(problem.corners_start):
        values.insert(_corner(number), np.array([x, y, 0.0]))
    return values
