"""Native Ceres on a problem of ours: a program with analytic derivatives, ``native_ceres/main.cpp``.

:func:`build` makes it with CMake, a C++ compiler and Ceres (Debian: ``cmake g++ libceres-dev``), or says why
it cannot. It has two forms: a residual block for each observation, and ``batched``, one for all observations
of a corner by a camera, which is what a rival would write who wanted the paper's model fast. The unknowns
are the extrinsics, the corners and, if wanted, six states a frame: the very cost of :mod:`v2hdm.adjust` with
white pose errors.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from v2hdm.adjust import Problem

SOURCE = Path(__file__).parent / "native_ceres"
BUILT = Path("build/native_ceres")

PAPER_SOLVERS = ("dense_schur", "sparse_schur")
"""Linear solvers that suit a problem of few cameras."""

POSE_SOLVERS = ("sparse_schur", "iterative_schur")
"""Linear solvers that suit a problem with a pose a frame; a dense Schur complement does not fit in memory."""


@dataclass(frozen=True)
class NativeOptions:
    """How Ceres is to solve; ``cauchy_scale`` of 0 is least squares.

    ``tolerance`` is that of the cost's relative decrease in a step, after which the next would gain far less:
    the figures ask for the optimum to 1e-10.
    """

    frame_poses: bool = False
    cauchy_scale: float = 0.0
    threads: int = 1
    linear_solver: str = "dense_schur"
    tolerance: float = 1e-10
    max_steps: int = 100
    is_batched: bool = False


@dataclass(frozen=True)
class NativeResult:
    """A solution by Ceres; times in s, but for ``setup_s`` of ceres::Solve; ``steps`` taken or tried."""

    setup_s: float
    solve_s: float
    cpu_s: float
    cost: float
    steps: int
    ended: str
    cam_from_vehicle: np.ndarray
    corners_map: np.ndarray


@cache
def build() -> tuple[Path | None, str]:
    """The program, or None and why it cannot be built here."""
    if shutil.which("cmake") is None:
        return (
            None,
            "native Ceres is left out: there is no cmake (Debian: apt-get install cmake g++ libceres-dev)",
        )
    BUILT.mkdir(parents=True, exist_ok=True)
    for command in (
        ["cmake", "-S", str(SOURCE), "-B", str(BUILT)],
        ["cmake", "--build", str(BUILT)],
    ):
        compiler = subprocess.run(command, capture_output=True, text=True, check=False)
        if compiler.returncode:
            lines = [line for line in (compiler.stderr or compiler.stdout).splitlines() if line.strip()]
            return None, f"native Ceres is left out: {' '.join(command)}: {lines[0] if lines else 'failed'}"
    return BUILT / "native_ceres", ""


def solve_native(problem: Problem, options: NativeOptions) -> NativeResult:
    """Levenberg-Marquardt from ``problem``'s extrinsics and its ``corners_start``.

    The program must have been built.
    """
    program, reason = build()
    assert program is not None, reason
    with tempfile.TemporaryDirectory() as folder:
        written, result = Path(folder) / "problem", Path(folder) / "result"
        _write(problem, options, written)
        command = [str(program), str(written), str(result), options.linear_solver, str(options.threads)]
        command += [str(options.tolerance), str(options.max_steps)]
        command.append("batched" if options.is_batched else "single")
        process = subprocess.run(command, capture_output=True, text=True, check=True)
        setup_s, solve_s, cpu_s, cost, steps, ended = process.stdout.split(maxsplit=5)
        values = np.fromfile(result)
    cameras = len(problem.intrinsic)
    return NativeResult(
        setup_s=float(setup_s),
        solve_s=float(solve_s),
        cpu_s=float(cpu_s),
        cost=float(cost),
        steps=int(steps),
        ended=ended.strip(),
        cam_from_vehicle=values[: 16 * cameras].reshape(cameras, 4, 4),
        corners_map=values[16 * cameras :].reshape(-1, 2),
    )


def _write(problem: Problem, options: NativeOptions, path: Path) -> None:
    """The problem as ``native_ceres/main.cpp`` reads it, sorted by corner."""
    assert problem.corners_start is not None
    assert problem.centre_vehicle is not None
    assert problem.centre_sigma_m is not None
    observations = problem.observations
    order = np.lexsort((observations.frame, observations.camera, observations.corner))
    camera, frame, corner = observations.camera[order], observations.frame[order], observations.corner[order]
    focal, principal = problem.intrinsic[camera, :2], problem.intrinsic[camera, 2:]
    covariance = observations.covariance_px[order]
    first = np.sqrt(covariance[:, 0, 0])
    below = covariance[:, 1, 0] / first
    last = np.sqrt(covariance[:, 1, 1] - below**2)
    numbers = np.empty((len(order), 5))
    numbers[:, :2] = (observations.pinhole_px[order] - principal) / focal
    numbers[:, 2] = focal[:, 0] / first
    numbers[:, 3] = -below * focal[:, 0] / (first * last)
    numbers[:, 4] = focal[:, 1] / last
    sizes = [len(problem.intrinsic), len(problem.map_from_vehicle), problem.corner_count, len(order)]
    with path.open("wb") as out:
        for values in (
            np.array([*sizes, int(options.frame_poses)], dtype=np.int64),
            np.array([options.cauchy_scale]),
            problem.cam_from_vehicle,
            np.linalg.inv(problem.map_from_vehicle),
            problem.centre_vehicle,
            1 / problem.centre_sigma_m,
            1 / problem.pose_sigma.by_state(),
            problem.corners_start,
            np.stack([camera, frame, corner], axis=1).astype(np.int32),
            numbers,
        ):
            np.ascontiguousarray(values).tofile(out)
