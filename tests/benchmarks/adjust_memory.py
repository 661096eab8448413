"""Memory and time of one solve against the number of observations, each size in a process of its own.

``python -m tests.benchmarks.adjust_memory [observations ...] [--states] [--loss NAME]`` prints, per size:

- ``input``: bytes an observation of the arrays that the problem consists of;
- ``solve``: bytes an observation by which the process grows from just before ``solve`` to its peak, the
  solution included. The peak is the kernel's own, reset before the solve (Linux: /proc/self/clear_refs), so
  nothing is missed between samples. A small problem is solved first, so that libraries are loaded;
- wall and CPU time of the solve, and at the end how they grow from the first size to the last.

The model is the paper's; ``--states`` gives every frame six states, whose factor grows with the frames, not
with the observations.
"""

from __future__ import annotations

import argparse
import dataclasses
import gc
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from tests.adjust.scene import make_scene
from tests.benchmarks.adjust_scaling import driven_on
from v2hdm.adjust import PoseSigma, SolveOptions, solve

WANTED_BYTES = 100.0
WANTED_GROWTH = 11.0


def status_bytes(name: str) -> int:
    """A figure of /proc/self/status, such as VmRSS or VmHWM."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return 1024 * int(line.split()[1])
    raise SystemExit(f"the kernel does not tell {name}")


def arrays_of(record: object) -> Iterator[np.ndarray]:
    """All arrays in a record of records."""
    for field in dataclasses.fields(record):  # type: ignore[arg-type]
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray):
            yield value
        elif dataclasses.is_dataclass(value):
            yield from arrays_of(value)


def measure(observations: int, options: SolveOptions) -> dict[str, float | str]:
    """Solve one problem of at least so many observations in this process."""
    solve(make_scene(0, frames=30).problem, options)
    lap = make_scene(0, frames=400, every_m=1.0, jitter=None, max_range_m=12.0, start_error_deg=1.0).problem
    problem = driven_on(lap, -(-observations // len(lap.observations.corner)))
    problem = dataclasses.replace(problem, pose_sigma=PoseSigma())
    count = len(problem.observations.corner)
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")
    before = status_bytes("VmRSS")
    began, cpu = time.perf_counter(), time.process_time()
    solution = solve(problem, options)
    took, cpu = time.perf_counter() - began, time.process_time() - cpu
    return {
        "observations": count,
        "input": sum(values.nbytes for values in arrays_of(problem)) / count,
        "solve": (status_bytes("VmHWM") - before) / count,
        "wall_s": took,
        "cpu_s": cpu,
        "evaluations": solution.evaluations,
        "gap": solution.gap,
        "status": solution.status.value,
    }


def main() -> None:
    """Print a row per size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("observations", nargs="*", type=int, default=[1_000_000, 10_000_000])
    parser.add_argument("--states", action="store_true", help="six states a frame")
    parser.add_argument("--loss", default="none", help="robust loss")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    states = SolveOptions().pose_states if arguments.states else ()
    options = SolveOptions(pose_states=states, loss=arguments.loss)
    if arguments.here:
        print(json.dumps(measure(arguments.observations[0], options)))
        return
    rows = []
    for size in arguments.observations:
        print(f"{size} observations ...", flush=True)
        flags = [f"--loss={arguments.loss}", f"--threads={arguments.threads}", "--here"]
        flags += ["--states"] if arguments.states else []
        command = [sys.executable, "-m", "tests.benchmarks.adjust_memory", str(size), *flags]
        row = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
        rows.append(row)
        print(
            f"  {row['observations']:9d}: input {row['input']:5.1f} B, solve {row['solve']:6.1f} B an "
            f"observation (asked <= {WANTED_BYTES:.0f}); {row['wall_s']:.1f} s, {row['cpu_s']:.1f} s CPU; "
            f"{row['evaluations']} evaluations, gap {row['gap']:.0e}, {row['status']}",
            flush=True,
        )
    if len(rows) > 1:
        more = rows[-1]["observations"] / rows[0]["observations"]
        wall, cpu = (rows[-1][name] / rows[0][name] for name in ("wall_s", "cpu_s"))
        print(
            f"  {more:.1f} x the observations: {wall:.1f} x the time, {cpu:.1f} x the CPU time "
            f"(asked <= {WANTED_GROWTH:.0f} for 10 x)"
        )


if __name__ == "__main__":
    main()
