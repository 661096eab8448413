"""Times of a fleet, and of many drives of one way.

``python -m tests.benchmarks.fleet [--fleet FILES] [--workers N]`` prints

- the adjustment of 2, 4 and 8 drives of one way, all corners eliminated first and shared ones kept;
- the time of a fleet of the run files, from nothing, if ``--fleet`` names some.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from tests.adjust.site import site
from v2hdm.adjust import Solution, SolveOptions, solve
from v2hdm.adjust.kernels import engine
from v2hdm.fleet import FleetOptions, run_fleet

OPTIONS = SolveOptions(coarse=False)


def off_m(solution: Solution, other: Solution) -> float:
    """The largest distance of corners, camera centres' coordinates and poses of two solutions."""
    return max(
        float(np.abs(getattr(solution, name) - getattr(other, name)).max())
        for name in ("corners_map", "cam_from_vehicle", "map_from_vehicle")
    )


def crowd(frames: int) -> None:
    """Print what drives of one way cost, all corners eliminated first or those that they share kept."""
    solve(site(2, 40, 10), OPTIONS)  # compiles, or loads what was compiled
    clearly_less = engine._CLEARLY_LESS
    for drives in (2, 4, 8):
        problem, spent, solutions = site(drives, frames, frames), [], []
        for share in (0.0, clearly_less):
            engine._CLEARLY_LESS = share
            cpu = time.process_time()
            solutions.append(solve(problem, OPTIONS))
            spent.append(time.process_time() - cpu)
        corners = len(solutions[1].covariance.whitening.plan.kept_corners)
        print(
            f"{drives} drives of one way: {spent[0]:.2f} s CPU with corners first, {spent[1]:.2f} s with "
            f"{corners} kept; {off_m(*solutions):.1e} m apart",
            flush=True,
        )


def fleet(files: Sequence[Path], workers: int) -> None:
    """Print how long a fleet takes that finds nothing in its cache."""
    with TemporaryDirectory() as folder:
        overrides = [f"output={folder}/out", f"cache={folder}/cache"]
        began = time.perf_counter()
        rows = run_fleet(files, overrides, FleetOptions(Path(folder, "table"), workers), lambda *_: None)
        took = time.perf_counter() - began
    print(f"{len(files)} drives: {took:.1f} s; {', '.join(row.status for row in rows)}")


def main() -> None:
    """Print all of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--fleet", type=Path, nargs="+", metavar="FILE")
    parser.add_argument("--workers", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.fleet is not None:
        fleet(arguments.fleet, arguments.workers)
        return
    torch.set_num_threads(1)
    crowd(200)


if __name__ == "__main__":
    main()
