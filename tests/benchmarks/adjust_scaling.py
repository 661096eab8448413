"""Time and memory of the adjustment against the number of observations.

``python -m tests.benchmarks.adjust_scaling [copies ...]`` prints one row per size: a street driven
end to end ``copies`` times, with the paper's model and with all pose states, after a warm-up.
"""

from __future__ import annotations

import resource
import sys
import time
from dataclasses import replace

import numpy as np

from tests.adjust.scene import make_scene
from v2hdm.adjust import Observations, PoseSigma, Problem, SolveOptions, solve


def driven_on(problem: Problem, copies: int) -> Problem:
    """The same street ``copies`` times, each beyond the last, seen by the same cameras."""
    frames, sightings = len(problem.map_from_vehicle), problem.observations
    poses = np.tile(problem.map_from_vehicle, (copies, 1, 1))
    poses[:, 0, 3] += 1000.0 * np.repeat(np.arange(copies), frames)
    block = np.repeat(np.arange(copies), len(sightings.corner))
    observations = Observations(
        np.tile(sightings.camera, copies),
        np.tile(sightings.frame, copies) + frames * block,
        np.tile(sightings.corner, copies) + problem.corner_count * block,
        np.tile(sightings.pinhole_px, (copies, 1)),
        np.tile(sightings.covariance_px, (copies, 1, 1)),
    )
    return replace(
        problem,
        map_from_vehicle=poses,
        observations=observations,
        corner_count=copies * problem.corner_count,
    )


def main(copies: list[int]) -> None:
    """Print the table."""
    poses = PoseSigma()
    street = make_scene(0, frames=400, every_m=1.0, jitter=poses, max_range_m=12.0).problem
    solve(make_scene(0, frames=30).problem)
    print("observations  unknowns  model        CPU s  evaluations      gap  status      peak GB")
    for count in copies:
        problem = driven_on(street, count)
        for states in ((), SolveOptions().pose_states):
            began = time.process_time()
            solution = solve(problem, SolveOptions(pose_states=states))
            cpu_s = time.process_time() - began
            unknowns = 2 * problem.corner_count + 12 + len(states) * len(problem.map_from_vehicle)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
            print(
                f"{len(problem.observations.corner):12d}  {unknowns:8d}  "
                f"{'6 states' if states else 'paper':9s}  {cpu_s:7.2f}  "
                f"{solution.evaluations:11d} {solution.gap:8.1e}  {solution.status.value:10s}  {peak:7.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main([int(argument) for argument in sys.argv[1:]] or [1, 4, 36])
