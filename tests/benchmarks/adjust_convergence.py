"""How many starts ten degrees of extrinsic error away end in the optimum: ours and native Ceres.

``python -m tests.benchmarks.adjust_convergence [--drives N] [--degrees D]`` gives each solver the same
drives, priors and starting extrinsics, under the paper's model (extrinsics and corners, least squares) and
with six states a frame and a Cauchy loss, and prints

- how many starts end in the optimum, which is where the same solver ends that starts at the true
  extrinsics: within a millionth of its cost and a millimetre of its corners;
- how much the cost of its optimum exceeds that of ours, as a share;
- the median number of iterations (ours: evaluations of cost and gradient, all stages; Ceres: steps
  taken or tried) and the CPU time of the solve, Ceres' without its set-up.

Ceres is the program of :mod:`tests.benchmarks.adjust_native`: our own cost, derivatives analytic.

Corners start at the back-projection of their rays, each weighted by how well it fixes its point: a plain
mean is worse for all. Ceres is shown a second time from the extrinsics of our coarse stage, which is what
leads home from far away; ours a second time without it. An end is told by the corners, too: where points
lie behind a camera a low cost is no optimum.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from tests.adjust.scene import Scene, make_scene
from tests.benchmarks.adjust_accuracy import PAPER, ROBUST, WHITE, street
from tests.benchmarks.adjust_native import NativeOptions, build, solve_native
from v2hdm.adjust import Problem, SolveOptions, solve
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.solve import coarse_extrinsics
from v2hdm.errors import AdjustError

# Ends are the same if their costs and their corners are: relative, and root mean square in m.
_SAME_COST = 1e-6
_SAME_CORNERS_M = 1e-3


@dataclass(frozen=True)
class End:
    """Where a solve ended, at which cost, after how many iterations and seconds of one core."""

    cost: float
    corners_map: np.ndarray
    iterations: int
    cpu_s: float

    def is_that_of(self, best: End) -> bool:
        """Whether both are the same optimum."""
        off_m = np.sqrt(np.mean(np.sum((self.corners_map - best.corners_map) ** 2, axis=1)))
        return abs(self.cost - best.cost) <= _SAME_COST * best.cost and bool(off_m <= _SAME_CORNERS_M)


Solver = Callable[[Problem], End]


def by_us(problem: Problem, options: SolveOptions) -> End:
    """Ours; its coarse stage, where it is on, is part of it."""
    began = time.process_time()
    solution = solve(problem, options)
    return End(solution.cost, solution.corners_map, solution.evaluations, time.process_time() - began)


def by_ceres(problem: Problem, options: NativeOptions, coarse: bool = False) -> End:
    """Ceres from the weighted back-projection, after our coarse stage if wanted, its time not counted."""
    extrinsics = torch.as_tensor(problem.cam_from_vehicle)
    arrays = make_arrays(problem, (), "cpu")
    engine = make_engine("auto", arrays)
    if coarse:
        extrinsics, _ = coarse_extrinsics(engine, extrinsics)
    corners, fixed = engine.back_project(extrinsics)
    if not bool(fixed.all()):
        raise AdjustError("a corner has no ray below the horizon")
    start = np.empty((problem.corner_count, 2))
    start[arrays.corner_order.numpy()] = corners.numpy()
    problem = replace(problem, cam_from_vehicle=extrinsics.numpy(), corners_start=start)
    solution = solve_native(problem, options)
    return End(solution.cost, solution.corners_map, solution.steps, solution.cpu_s)


def solvers(options: SolveOptions) -> dict[str, Solver]:
    """All that solve the problem of ``options``, by name."""
    ours = {
        "ours": options,
        "ours, without its coarse stage": replace(options, coarse=False),
    }
    rows: dict[str, Solver] = {
        name: partial(by_us, options=solve_options) for name, solve_options in ours.items()
    }
    if build()[0] is not None:
        scale = 0.0 if options.loss == "none" else options.loss_scale
        solver = "sparse_schur" if options.pose_states else "dense_schur"
        theirs = NativeOptions(
            bool(options.pose_states), scale, linear_solver=solver, tolerance=1e-12, max_steps=500
        )
        rows["ceres"] = partial(by_ceres, options=theirs)
        rows["ceres, after our coarse stage"] = partial(by_ceres, options=theirs, coarse=True)
    return rows


def attempts(scene: Scene, solver: Solver) -> tuple[End | None, End]:
    """Where a solver ends from the drive's start (None: it refuses it), and from the true extrinsics."""
    best = solver(replace(scene.problem, cam_from_vehicle=scene.cam_from_vehicle))
    try:
        return solver(scene.problem), best
    except AdjustError:
        return None, best


def reaches_the_optimum(scene: Scene, solver: Solver) -> bool:
    """Whether a solver ends where it ends from the true extrinsics."""
    end, best = attempts(scene, solver)
    return end is not None and end.is_that_of(best)


def print_model(title: str, options: SolveOptions, scenes: list[Scene]) -> None:
    """A table: a row a solver."""
    print(f"{title}, {len(scenes)} starts:", flush=True)
    usual = None
    for name, solver in solvers(options).items():
        pairs = [attempts(scene, solver) for scene in scenes]
        ends = [end for end, _ in pairs if end is not None]
        reached = sum(end is not None and end.is_that_of(best) for end, best in pairs)
        cost = np.array([best.cost for _, best in pairs])
        usual = cost if usual is None else usual
        more = np.max(cost / usual) - 1
        print(
            f"  {name:31s} {reached:3d} of {len(scenes)} in the optimum (its cost {more:+.0e}); "
            f"median {np.median([end.iterations for end in ends]):4.0f} iterations, "
            f"{np.median([end.cpu_s for end in ends]):6.3f} s CPU",
            flush=True,
        )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--drives", type=int, default=100)
    parser.add_argument("--degrees", type=float, default=10.0, help="how far off the extrinsics start")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    solve(make_scene(0, frames=30).problem)
    if build()[0] is None:
        print(build()[1])
    scenes = [street(seed, WHITE, start_error_deg=arguments.degrees) for seed in range(arguments.drives)]
    print_model("extrinsics and corners, least squares", PAPER, scenes)
    print_model("six states a frame, Cauchy loss", ROBUST, scenes)


if __name__ == "__main__":
    main()
