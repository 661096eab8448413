"""The incremental map from ten markings to ten thousand: time per marking, and how far from the batch.

``python -m tests.benchmarks.adjust_incremental [markings]`` drives two cameras past so many and takes
them up one by one under the paper's model. It prints the CPU time of a marking up to each decade, without and
with the share of solving all anew, beside a warm solve of the whole, and the largest distance from the batch
optimum in sigmas just before the last solve of all.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np
import torch

from tests.adjust.scene import make_scene
from tests.benchmarks.adjust_scaling import driven_on
from v2hdm.adjust import Observations, Problem, Solution, SolveOptions, solve
from v2hdm.adjust.incremental import IncrementalMap, Sighted
from v2hdm.adjust.selection import restrict

CORNERS = 4
DECADES = (10, 100, 1000, 10_000)
OPTIONS = SolveOptions(pose_states=(), loss="none")


@dataclass(frozen=True)
class Growth:
    """CPU times (N,) of taking up each marking, s, and the corners (N, 4, 2) that result."""

    took_s: np.ndarray
    corners_map: np.ndarray


def street(markings: int) -> Problem:
    """At least so many markings of four corners, each seen in a few images by two cameras."""
    lap = make_scene(0, frames=400, every_m=1.0, max_range_m=12.0, start_error_deg=1.0, min_views=3).problem
    return driven_on(lap, -(-markings * CORNERS // lap.corner_count))


def by_marking(problem: Problem, markings: int) -> list[Sighted]:
    """The observations of the first markings: four corners each, in the order of the route."""
    observations = problem.observations
    order = np.argsort(observations.corner, kind="stable")
    bounds = np.searchsorted(observations.corner[order], CORNERS * np.arange(markings + 1))
    out = []
    for marking in range(markings):
        rows = order[bounds[marking] : bounds[marking + 1]]
        of_marking = Observations(
            observations.camera[rows],
            observations.frame[rows],
            observations.corner[rows] - CORNERS * marking,
            observations.pinhole_px[rows],
            observations.covariance_px[rows],
        )
        out.append(Sighted(of_marking))
    return out


def grow(problem: Problem, markings: list[Sighted]) -> Growth:
    """Take the markings up one by one."""
    grown = IncrementalMap(problem, OPTIONS)
    took_s = np.zeros(len(markings))
    for marking, sighted in enumerate(markings):
        began = time.process_time()
        grown.observe(marking, sighted)
        took_s[marking] = time.process_time() - began
    return Growth(took_s, np.stack([grown.corners_map(m) for m in range(len(markings))]))


def largest_distance(best: Solution, growth: Growth) -> float:
    """The largest distance of a corner's coordinate from the batch optimum, in standard deviations."""
    count = len(growth.corners_map)
    groups = np.arange(CORNERS * count).reshape(count, CORNERS)
    sigma = np.sqrt(np.diagonal(best.corner_covariance(groups), axis1=1, axis2=2))
    return float(np.max(np.abs((growth.corners_map - best.corners_map[groups]).reshape(count, -1)) / sigma))


def restricted(problem: Problem, markings: int) -> Problem:
    """The problem of the first markings alone."""
    return restrict(problem, problem.observations.corner < CORNERS * markings)[0]


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("markings", nargs="?", type=int, default=DECADES[-1])
    count = parser.parse_args().markings
    torch.set_num_threads(1)
    problem = restricted(street(count), count)
    solve(restricted(problem, 10), OPTIONS)
    growth = grow(problem, by_marking(problem, count))
    best = solve(problem, OPTIONS)
    usual = None
    for decade in (size for size in DECADES if size <= count):
        around = growth.took_s[max(decade // 2, 5) : decade]
        median_ms, mean_ms = 1000 * np.median(around), 1000 * around.mean()
        usual = usual or median_ms
        warm = replace(restricted(problem, decade), cam_from_vehicle=best.cam_from_vehicle)
        began = time.process_time()
        solve(warm, replace(OPTIONS, coarse=False))
        whole_ms = 1000 * (time.process_time() - began)
        print(
            f"  to {decade:6d} markings: {median_ms:6.2f} ms a marking, {median_ms / usual:4.2f} x the first "
            f"(asked <= 1.2), {mean_ms:6.2f} ms with solves of all; a warm solve of all: {whole_ms:6.2f} ms"
        )
    print(f"  largest distance from the batch: {largest_distance(best, growth):.4f} sigma; asked <= 0.01")


if __name__ == "__main__":
    main()
