"""Our adjustment beside native Ceres on the same problem, from the same start.

``python -m tests.benchmarks.adjust_peers [observations ...] [--threads N]`` prints time (set-up and solve
apart; wall, and CPU for a machine that is busy otherwise), final cost and memory of each. Ceres runs
natively, through pyceres with pycolmap's compiled cost functions and the Schur complement that suits few
cameras; where these are not installed (the extra ``bench``), it is left out and said so. SciPy's trust region
knows the Jacobian's sparsity, and is left out beyond the size that it can manage.

The model is the paper's, extrinsics and corners. Our six states a frame are a row of their own, and beside
it Ceres with a pose a frame under the same prior.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix
from scipy.spatial.transform import Rotation

from tests.adjust.scene import make_scene
from tests.benchmarks.adjust_ceres import ABSENT, CeresOptions, solve_ceres
from tests.benchmarks.adjust_scaling import driven_on
from v2hdm.adjust import PoseSigma, Problem, SolveOptions, solve
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.start import back_project

SCIPY_LIMIT = 120_000
"""Observations above which SciPy takes minutes: its steps solve the whole system iteratively."""

CERES_POSES_LIMIT = 400_000
"""Of a million observations' frame poses CHOLMOD finds the matrix not positive, over and over for minutes."""

PAPER = SolveOptions(pose_states=(), loss="none", coarse=False)


@dataclass(frozen=True)
class Row:
    """One solver's figures; times in s, ``cpu_s`` that of the solve."""

    name: str
    setup_s: float
    solve_s: float
    cpu_s: float
    cost: float
    note: str
    same_model: bool = True


def street(observations: int) -> Problem:
    """At least so many observations by two cameras, started one degree off; corners from back-projection."""
    one = make_scene(0, frames=400, every_m=1.0, jitter=None, max_range_m=12.0, start_error_deg=1.0).problem
    problem = driven_on(one, -(-observations // len(one.observations.corner)))
    arrays = make_arrays(problem, (), "cpu")
    corners, _ = back_project(arrays, torch.as_tensor(problem.cam_from_vehicle))
    start = np.empty((problem.corner_count, 2))
    start[arrays.corner_order.numpy()] = corners.numpy()
    return replace(problem, corners_start=start)


def ours(problem: Problem, options: SolveOptions, name: str) -> Row:
    """Our solver; what it lays out is part of the solve."""
    began, cpu = time.perf_counter(), time.process_time()
    solution = solve(problem, options)
    took, cpu = time.perf_counter() - began, time.process_time() - cpu
    note = f"{solution.evaluations} evaluations, gap {solution.gap:.0e}"
    return Row(name, 0.0, took, cpu, solution.cost, note)


def ceres(problem: Problem, options: CeresOptions, name: str) -> Row:
    """Native Ceres: Levenberg-Marquardt on the Schur complement."""
    found = solve_ceres(problem, options)
    return Row(name, found.setup_s, found.solve_s, found.cpu_s, found.cost, f"{found.steps} steps")


def scipy_trf(problem: Problem) -> Row:
    """SciPy's trust region reflective, differences coloured by the Jacobian's sparsity, LSMR steps."""
    began = time.perf_counter()
    cameras, seen = len(problem.intrinsic), problem.observations
    vehicle_from_map = np.linalg.inv(problem.map_from_vehicle)[seen.frame]
    root = np.linalg.inv(np.linalg.cholesky(seen.covariance_px))
    intrinsic, start = problem.intrinsic[seen.camera], problem.cam_from_vehicle
    assert problem.corners_start is not None

    def residuals(x: np.ndarray) -> np.ndarray:
        """Of all observations, then of the priors; x holds turn and centre of each camera, then corners."""
        turn, centre = x[: 6 * cameras].reshape(-1, 2, 3).transpose(1, 0, 2)
        corner = x[6 * cameras :].reshape(-1, 2)[seen.corner]
        ground = np.column_stack([corner, np.zeros(len(corner)), np.ones(len(corner))])
        vehicle = np.einsum("kab,kb->ka", vehicle_from_map[:, :3], ground) - centre[seen.camera]
        rotation = Rotation.from_rotvec(turn).as_matrix() @ start[:, :3, :3]
        point = np.einsum("kab,kb->ka", rotation[seen.camera], vehicle)
        off = intrinsic[:, :2] * point[:, :2] / point[:, 2:] + intrinsic[:, 2:] - seen.pinhole_px
        prior = (centre - problem.centre_vehicle) / problem.centre_sigma_m
        return np.concatenate([np.einsum("kab,kb->ka", root, off).ravel(), prior.ravel()])

    centre = -np.einsum("cba,cb->ca", start[:, :3, :3], start[:, :3, 3])
    x = np.concatenate(
        [np.stack([np.zeros_like(centre), centre], axis=1).ravel(), problem.corners_start.ravel()]
    )
    ready, cpu = time.perf_counter(), time.process_time()
    found = least_squares(
        residuals, x, jac_sparsity=_sparsity(problem), x_scale="jac", ftol=1e-12, xtol=1e-12, gtol=1e-12
    )
    took, cpu = time.perf_counter() - ready, time.process_time() - cpu
    return Row("scipy, trf", ready - began, took, cpu, float(found.cost), f"{found.nfev} steps")


def _sparsity(problem: Problem) -> coo_matrix:
    """Which unknowns each residual of :func:`scipy_trf` depends on."""
    cameras, seen = len(problem.intrinsic), problem.observations
    of_camera = 6 * seen.camera[:, None] + np.arange(6)
    of_corner = 6 * cameras + 2 * seen.corner[:, None] + np.arange(2)
    columns = np.concatenate([of_camera, of_corner], axis=1).repeat(2, axis=0)
    rows = np.arange(len(columns))[:, None].repeat(8, axis=1)
    prior = np.arange(3 * cameras)
    rows = np.concatenate([rows.ravel(), len(columns) + prior])
    columns = np.concatenate([columns.ravel(), 6 * (prior // 3) + 3 + prior % 3])
    return coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)))


def main() -> None:
    """Print a table per size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("observations", nargs="*", type=int, default=[100_000, 1_000_000])
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    solve(make_scene(0, frames=30).problem)
    if ABSENT:
        print(ABSENT)
    for size in arguments.observations:
        problem = street(size)
        print(f"{len(problem.observations.corner)} observations, {arguments.threads} threads", flush=True)
        rows = [shown(row) for row in solved(problem, arguments.threads)]
        least = min(row.cost for row in rows if row.same_model)
        peer = next((row for row in rows if row.name == "ceres"), None)
        for row in rows:
            above = f"cost above the least {row.cost / least - 1:8.1e}" if row.same_model else "another model"
            ratio = "" if peer is None else f"{row.solve_s / peer.solve_s:6.2f} x Ceres' time, "
            ratio += "" if peer is None else f"{row.cpu_s / peer.cpu_s:6.2f} x its CPU time; "
            print(f"  {row.name:22s} {ratio}{above}")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(f"  peak memory of all of it {peak:.2f} GB")


def solved(problem: Problem, threads: int) -> Iterator[Row]:
    """All solvers, one after another."""
    yield ours(problem, PAPER, "ours")
    states = replace(problem, pose_sigma=PoseSigma())
    row = ours(states, SolveOptions(loss="none", coarse=False), "ours, 6 states a frame")
    yield replace(row, same_model=False)
    if not ABSENT:
        yield ceres(problem, CeresOptions(threads=threads), "ceres")
    if not ABSENT and len(problem.observations.corner) <= CERES_POSES_LIMIT:
        row = ceres(states, CeresOptions(frame_poses=True, threads=threads), "ceres, a pose a frame")
        yield replace(row, same_model=False)
    yield ours(problem, replace(PAPER, solver="lm"), "ours, lm")
    if len(problem.observations.corner) <= SCIPY_LIMIT:
        yield scipy_trf(problem)
    else:
        print(f"  scipy is left out: beyond {SCIPY_LIMIT} observations it takes minutes to hours")


def shown(row: Row) -> Row:
    """Print a row as soon as it is there."""
    print(
        f"  {row.name:22s} set-up {row.setup_s:6.2f} s  solve {row.solve_s:6.2f} s ({row.cpu_s:6.2f} s CPU)  "
        f"cost {row.cost:.9e}  {row.note}",
        flush=True,
    )
    return row


if __name__ == "__main__":
    main()
