"""Native Ceres on a problem of ours: pyceres with pycolmap's compiled cost functions.

Where these are not installed (the extra ``bench``), :data:`ABSENT` says so. The unknowns are the extrinsics,
the corners and, if wanted, a pose per frame with the prior that our six white states have: pycolmap's,
which is ours up to the second order of a pose's error.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from v2hdm.adjust import Problem

try:
    import pyceres
    import pycolmap
    from pycolmap import cost_functions
except ImportError as failure:
    ABSENT = f"Ceres is left out: {failure}; pip install 'v2hdm[bench]'"
    pyceres: Any = None
else:
    ABSENT = ""


@dataclass(frozen=True)
class CeresOptions:
    """How Ceres is to solve; ``cauchy_scale`` of 0 is least squares."""

    frame_poses: bool = False
    cauchy_scale: float = 0.0
    threads: int = 1
    tolerance: float = 1e-14
    max_steps: int = 100


@dataclass(frozen=True)
class PeerResult:
    """A peer's solution; times in s, ``cpu_s`` that of the solve; ``steps`` taken or tried."""

    setup_s: float
    solve_s: float
    cpu_s: float
    cost: float
    steps: int
    cam_from_vehicle: np.ndarray
    corners_map: np.ndarray


@dataclass(frozen=True)
class _Blocks:
    """The arrays that a Ceres problem points into and changes: quaternions (x, y, z, w) and translations."""

    turns: np.ndarray
    shifts: np.ndarray
    frame_turns: np.ndarray
    frame_shifts: np.ndarray
    points: np.ndarray
    intrinsic: np.ndarray


def solve_ceres(problem: Problem, options: CeresOptions) -> PeerResult:
    """Levenberg-Marquardt from ``problem``'s extrinsics and its ``corners_start``.

    The cameras' Schur complement is dense; where frames have poses too, it is sparse.
    """
    assert problem.corners_start is not None
    began = time.perf_counter()
    blocks = _blocks(problem)
    built = _built(problem, blocks, options)
    settings = pyceres.SolverOptions()
    solvers = pyceres.LinearSolverType
    settings.linear_solver_type = solvers.SPARSE_SCHUR if options.frame_poses else solvers.DENSE_SCHUR
    settings.num_threads = options.threads
    settings.max_num_iterations = options.max_steps
    for name in ("function_tolerance", "gradient_tolerance", "parameter_tolerance"):
        setattr(settings, name, options.tolerance)
    summary = pyceres.SolverSummary()
    ready, cpu = time.perf_counter(), time.process_time()
    pyceres.solve(settings, built, summary)
    took, cpu = time.perf_counter() - ready, time.process_time() - cpu
    return PeerResult(
        setup_s=ready - began,
        solve_s=took,
        cpu_s=cpu,
        cost=summary.final_cost,
        steps=summary.num_successful_steps + summary.num_unsuccessful_steps,
        cam_from_vehicle=_transforms(blocks.turns, blocks.shifts),
        corners_map=blocks.points[:, :2].copy(),
    )


def _blocks(problem: Problem) -> _Blocks:
    vehicle_from_map = np.linalg.inv(problem.map_from_vehicle)
    return _Blocks(
        turns=Rotation.from_matrix(problem.cam_from_vehicle[:, :3, :3]).as_quat(),
        shifts=problem.cam_from_vehicle[:, :3, 3].copy(),
        frame_turns=Rotation.from_matrix(vehicle_from_map[:, :3, :3]).as_quat(),
        frame_shifts=vehicle_from_map[:, :3, 3].copy(),
        points=np.column_stack([problem.corners_start, np.zeros(problem.corner_count)]),
        intrinsic=problem.intrinsic.copy(),
    )


def _transforms(turns: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    out = np.tile(np.eye(4), (len(turns), 1, 1))
    out[:, :3, :3], out[:, :3, 3] = Rotation.from_quat(turns).as_matrix(), shifts
    return out


def _built(problem: Problem, blocks: _Blocks, options: CeresOptions) -> Any:
    """The problem as Ceres knows it."""
    built, observations = pyceres.Problem(), problem.observations
    model = pycolmap.CameraModelId.PINHOLE
    robust = pyceres.CauchyLoss(options.cauchy_scale) if options.cauchy_scale else None
    for k in range(len(observations.corner)):
        c, j, n = observations.camera[k], observations.frame[k], observations.corner[k]
        cost = cost_functions.RigReprojErrorCost(
            model, observations.covariance_px[k], observations.pinhole_px[k]
        )
        camera, frame = (blocks.turns[c], blocks.shifts[c]), (blocks.frame_turns[j], blocks.frame_shifts[j])
        built.add_residual_block(cost, robust, [*camera, *frame, blocks.points[n], blocks.intrinsic[c]])
    _add_cameras(built, problem, blocks)
    _add_frames(built, problem, blocks, options.frame_poses)
    on_the_ground = pyceres.SubsetManifold(3, [2])
    for point in blocks.points:
        built.set_manifold(point, on_the_ground)
    return built


def _add_cameras(built: Any, problem: Problem, blocks: _Blocks) -> None:
    """The prior on the cameras' centres."""
    assert problem.centre_vehicle is not None
    assert problem.centre_sigma_m is not None
    for c in range(len(blocks.turns)):
        covariance = np.diag(problem.centre_sigma_m[c] ** 2)
        prior = cost_functions.AbsolutePosePositionPriorCost(covariance, problem.centre_vehicle[c])
        built.add_residual_block(prior, None, [blocks.turns[c], blocks.shifts[c]])
        built.set_manifold(blocks.turns[c], pyceres.EigenQuaternionManifold())
        built.set_parameter_block_constant(blocks.intrinsic[c])


def _add_frames(built: Any, problem: Problem, blocks: _Blocks, free: bool) -> None:
    """Fixed poses, or free ones with their prior, turn before translation in pycolmap's order."""
    sigma = problem.pose_sigma.by_state()
    covariance = np.diag(np.concatenate([sigma[3:], sigma[:3]]) ** 2)
    recorded = _transforms(blocks.frame_turns, blocks.frame_shifts)
    for j in np.unique(problem.observations.frame):
        pose = [blocks.frame_turns[j], blocks.frame_shifts[j]]
        if free:
            prior = cost_functions.AbsolutePosePriorCost(covariance, pycolmap.Rigid3d(recorded[j, :3]))
            built.add_residual_block(prior, None, pose)
            built.set_manifold(pose[0], pyceres.EigenQuaternionManifold())
        else:
            for block in pose:
                built.set_parameter_block_constant(block)
