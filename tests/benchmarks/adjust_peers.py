"""Our adjustment beside its peers on the same problem, from the same start.

``python -m tests.benchmarks.adjust_peers [observations ...] [--threads N] [--rounds N] [--states]`` prints
time (wall, and CPU for a machine that is busy otherwise: the least of several rounds, in which the solvers
take turns), final cost and the ratio to *native Ceres*: a program of our own with analytic derivatives,
written for this very problem (``native_ceres/``), of whose linear solvers and forms (a residual block for
each observation, or *batched*: one for all observations of a corner by a camera) the fastest counts, and of
whose time that of ``ceres::Solve`` alone. Ours is all of ``solve()``, with checks, layout and report.

The other peers are slower and solve once: Ceres through pyceres with pycolmap's compiled cost functions and
GTSAM (the extra ``bench``), and SciPy's trust region, which knows the Jacobian's sparsity and is left out
beyond the size that it can manage. GTSAM holds the poses to 10 um, so its cost ends a little below the least.

The model is the paper's, extrinsics and corners. ``--states`` gives every frame six states, and Ceres a pose
a frame under the same prior.
"""

from __future__ import annotations

import argparse
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
from tests.benchmarks.adjust_gtsam import ABSENT as GTSAM_ABSENT
from tests.benchmarks.adjust_gtsam import solve_gtsam
from tests.benchmarks.adjust_native import (
    PAPER_SOLVERS,
    POSE_SOLVERS,
    NativeOptions,
    build,
    solve_native,
)
from tests.benchmarks.adjust_scaling import driven_on
from v2hdm.adjust import PoseSigma, Problem, SolveOptions, solve
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.layout import make_arrays

GTSAM_LIMIT = 120_000
"""Observations above which GTSAM takes gigabytes: a factor object each."""

SCIPY_LIMIT = 120_000
"""Observations above which SciPy takes minutes: its steps solve the whole system iteratively."""

CERES_POSES_LIMIT = 400_000
"""Observations above which pycolmap with frame poses fails: CHOLMOD finds its matrix not positive."""

SAME_COST = 1e-8
"""Share of the cost by which a linear solver may miss the optimum and still count as a peer."""

STREET = 25_000
"""Observations, about, of the street that larger problems repeat; smaller ones are its beginning."""

PAPER = SolveOptions(pose_states=(), loss="none")


@dataclass(frozen=True)
class Row:
    """One solver's figures; times in s, ``solve_s`` and ``cpu_s`` those of the solve."""

    name: str
    setup_s: float
    solve_s: float
    cpu_s: float
    cost: float
    note: str


def street(observations: int) -> Problem:
    """About so many observations by two cameras, started one degree off; corners from back-projection."""
    frames = 400 if observations > STREET else max(observations // 43, 20)
    every_m, range_m = (1.0, 12.0) if observations > STREET else (2.0, 15.0)
    lap = make_scene(
        0, frames=frames, every_m=every_m, jitter=None, max_range_m=range_m, start_error_deg=1.0
    ).problem
    problem = driven_on(lap, -(-observations // len(lap.observations.corner))) if frames == 400 else lap
    arrays = make_arrays(problem, (), "cpu")
    corners, _ = make_engine("auto", arrays).back_project(torch.as_tensor(problem.cam_from_vehicle))
    start = np.empty((problem.corner_count, 2))
    start[arrays.corner_order.numpy()] = corners.numpy()
    return replace(problem, corners_start=start, pose_sigma=PoseSigma())


def ours(problem: Problem, options: SolveOptions, name: str) -> Row:
    """Our solver; all that it checks, lays out and reports is part of the solve, the corners' start too."""
    problem = replace(problem, corners_start=None)
    began, cpu = time.perf_counter(), time.process_time()
    solution = solve(problem, options)
    took, cpu = time.perf_counter() - began, time.process_time() - cpu
    note = f"{solution.evaluations} evaluations, gap {solution.gap:.0e}, {solution.status.value}"
    return Row(name, 0.0, took, cpu, solution.cost, note)


def native(problem: Problem, options: NativeOptions) -> Row:
    """Native Ceres with analytic derivatives."""
    solution = solve_native(problem, options)
    form = "batched" if options.is_batched else "single"
    name = f"native Ceres, {form}, {options.linear_solver}"
    note = f"{solution.steps} steps, {solution.ended.lower()}"
    return Row(name, solution.setup_s, solution.solve_s, solution.cpu_s, solution.cost, note)


def ceres(problem: Problem, options: CeresOptions) -> Row:
    """Ceres through pyceres: Levenberg-Marquardt on the Schur complement."""
    solution = solve_ceres(problem, options)
    return Row(
        "pyceres",
        solution.setup_s,
        solution.solve_s,
        solution.cpu_s,
        solution.cost,
        f"{solution.steps} steps",
    )


def by_gtsam(problem: Problem) -> Row:
    """GTSAM: Levenberg-Marquardt, its own factors and elimination."""
    solution = solve_gtsam(problem)
    return Row(
        "gtsam", solution.setup_s, solution.solve_s, solution.cpu_s, solution.cost, f"{solution.steps} steps"
    )


def scipy_trf(problem: Problem) -> Row:
    """SciPy's trust region reflective, differences coloured by the Jacobian's sparsity, LSMR steps."""
    began = time.perf_counter()
    cameras, observations = len(problem.intrinsic), problem.observations
    vehicle_from_map = np.linalg.inv(problem.map_from_vehicle)[observations.frame]
    root = np.linalg.inv(np.linalg.cholesky(observations.covariance_px))
    intrinsic, start = problem.intrinsic[observations.camera], problem.cam_from_vehicle
    assert problem.corners_start is not None

    def residuals(x: np.ndarray) -> np.ndarray:
        """Residuals of all observations, then priors; x holds each camera's turn and centre, then corners."""
        turn, centre = x[: 6 * cameras].reshape(-1, 2, 3).transpose(1, 0, 2)
        corner = x[6 * cameras :].reshape(-1, 2)[observations.corner]
        ground = np.column_stack([corner, np.zeros(len(corner)), np.ones(len(corner))])
        vehicle = np.einsum("kab,kb->ka", vehicle_from_map[:, :3], ground) - centre[observations.camera]
        rotation = Rotation.from_rotvec(turn).as_matrix() @ start[:, :3, :3]
        point = np.einsum("kab,kb->ka", rotation[observations.camera], vehicle)
        off = intrinsic[:, :2] * point[:, :2] / point[:, 2:] + intrinsic[:, 2:] - observations.pinhole_px
        prior = (centre - problem.centre_vehicle) / problem.centre_sigma_m
        return np.concatenate([np.einsum("kab,kb->ka", root, off).ravel(), prior.ravel()])

    centre = -np.einsum("cba,cb->ca", start[:, :3, :3], start[:, :3, 3])
    x = np.concatenate(
        [np.stack([np.zeros_like(centre), centre], axis=1).ravel(), problem.corners_start.ravel()]
    )
    ready, cpu = time.perf_counter(), time.process_time()
    result = least_squares(
        residuals, x, jac_sparsity=_sparsity(problem), x_scale="jac", ftol=1e-12, xtol=1e-12, gtol=1e-12
    )
    took, cpu = time.perf_counter() - ready, time.process_time() - cpu
    return Row("scipy, trf", ready - began, took, cpu, float(result.cost), f"{result.nfev} steps")


def _sparsity(problem: Problem) -> coo_matrix:
    """Which unknowns each residual of :func:`scipy_trf` depends on."""
    cameras, observations = len(problem.intrinsic), problem.observations
    of_camera = 6 * observations.camera[:, None] + np.arange(6)
    of_corner = 6 * cameras + 2 * observations.corner[:, None] + np.arange(2)
    columns = np.concatenate([of_camera, of_corner], axis=1).repeat(2, axis=0)
    rows = np.arange(len(columns))[:, None].repeat(8, axis=1)
    prior = np.arange(3 * cameras)
    rows = np.concatenate([rows.ravel(), len(columns) + prior])
    columns = np.concatenate([columns.ravel(), 6 * (prior // 3) + 3 + prior % 3])
    return coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)))


def in_turn(problem: Problem, states: bool, threads: int, rounds: int) -> list[Row]:
    """Ours and native Ceres in turn; of each the round that took the least CPU time."""
    options = SolveOptions(loss="none") if states else PAPER
    rows: list[Row] = []
    for _ in range(rounds):
        rows.append(ours(problem, options, "ours"))
        if build()[0] is not None:
            for name in POSE_SOLVERS if states else PAPER_SOLVERS:
                # A batch has no poses of frames.
                for is_batched in (False,) if states else (False, True):
                    native_options = NativeOptions(states, 0.0, threads, name, is_batched=is_batched)
                    rows.append(native(problem, native_options))
    names = dict.fromkeys(row.name for row in rows)
    return [min((row for row in rows if row.name == name), key=lambda row: row.cpu_s) for name in names]


def others(problem: Problem, states: bool, threads: int) -> Iterator[Row]:
    """The peers that solve once."""
    count = len(problem.observations.corner)
    if not ABSENT and not (states and count > CERES_POSES_LIMIT):
        yield ceres(problem, CeresOptions(frame_poses=states, threads=threads))
    if not GTSAM_ABSENT and not states and count <= GTSAM_LIMIT:
        yield by_gtsam(problem)
    if not states and count <= SCIPY_LIMIT:
        yield scipy_trf(problem)


def show(rows: list[Row]) -> None:
    """Print rows, and how they compare."""
    least = min(row.cost for row in rows if row.name != "gtsam")
    reached = [row for row in rows if row.name.startswith("native") and row.cost <= least * (1 + SAME_COST)]
    peer = min(reached, key=lambda row: row.cpu_s, default=None)
    for row in rows:
        ratio = "" if peer is None else f"{row.cpu_s / peer.cpu_s:6.3f} x native Ceres' CPU time "
        ratio += "" if peer is None else f"({row.solve_s / peer.solve_s:6.3f} x its wall time)  "
        print(
            f"  {row.name:37s} {ratio}solve {row.solve_s:8.4f} s, {row.cpu_s:8.4f} s CPU  "
            f"cost above the least {row.cost / least - 1:7.1e}  {row.note}",
            flush=True,
        )


def main() -> None:
    """Print a table per size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("observations", nargs="*", type=int, default=[4_000, 100_000, 1_000_000])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--states", action="store_true", help="six states a frame")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    solve(make_scene(0, frames=30).problem, SolveOptions(loss="none") if arguments.states else PAPER)
    for reason in (ABSENT, GTSAM_ABSENT, build()[1]):
        if reason:
            print(reason)
    for size in arguments.observations:
        problem = street(size)
        count, threads = len(problem.observations.corner), arguments.threads
        print(f"{count} observations, {threads} thread{'s' if threads > 1 else ''}", flush=True)
        rows = in_turn(problem, arguments.states, threads, arguments.rounds)
        show(rows + list(others(problem, arguments.states, threads)))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(f"  peak memory of this process {peak:.2f} GB")


if __name__ == "__main__":
    main()
