"""What Ray brings on two cores, and what many drives of one way cost: times, and that maps are the same.

``python -m tests.benchmarks.fleet [--images FOLDER] [--visits FOLDERS] [--only crowd]`` prints

- detection of a drive by one actor and by two, if ``--images`` names a drive (in any format that is read);
- the adjustment of 2, 4 and 8 drives of one way, all corners eliminated first and shared ones kept;
- reading and checks of drives of one site, if ``--visits`` names them, here and by tasks on two cores.

Runs with one and two actors take turns, and the fastest of each counts: on a machine that is busy otherwise
the wall time says little. Beside it stands the CPU time of the actor with the most to do.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tests.adjust.site import site
from v2hdm.adjust import Solution, SolveOptions, solve
from v2hdm.adjust.engines.numba import engine
from v2hdm.detection.batch import with_own_vehicle
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.executor import IN_PROCESS, Executor
from v2hdm.fleet.cluster import LOCAL, cluster
from v2hdm.fleet.workers import DetectorActor, RayExecutor, detect_by
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.pipeline.config import DriveConfig, RunConfig
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.inspect import inspect_each
from v2hdm.pipeline.map_drive import read_all
from v2hdm.store.cache import key_of

OPTIONS = SolveOptions(coarse=False)
_TICKS = os.sysconf("SC_CLK_TCK")


def cpu_s(process: int) -> float:
    """CPU time of a process so far."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def off_m(one: Solution, other: Solution) -> float:
    """The largest distance of corners, camera centres' coordinates and poses of two solutions."""
    return max(
        float(np.abs(getattr(one, name) - getattr(other, name)).max())
        for name in ("corners_map", "cam_from_vehicle", "map_from_vehicle")
    )


def timed_detection(ray: Any, drive: Any, options: DetectorOptions, actors: int) -> tuple[float, float, Any]:
    """Wall time, CPU time of the busiest actor, and what it found."""
    detectors = [ray.remote(DetectorActor).options(num_cpus=1).remote(str(Path.cwd())) for _ in range(actors)]
    ray.get([one.detect.remote([ray.put(drive)], options, [0]) for one in detectors])
    processes = ray.get([one.process.remote() for one in detectors])
    before, began = [cpu_s(one) for one in processes], time.perf_counter()
    found: list[Any] = []
    detect_by(detectors, drive, options, range(len(drive.images)), 1, found.append)
    took = time.perf_counter() - began
    spent = max(cpu_s(one) - past for one, past in zip(processes, before, strict=True))
    for one in detectors:
        ray.kill(one)
    return took, spent, found


def detection(ray: Any, folder: Path, repeats: int) -> None:
    """Print the row of detection."""
    options = DetectorOptions.for_mapping()
    drive = with_own_vehicle(read_drive(folder, ReadOptions()), Detector.load(options=options))
    wall, spent, found = {1: [], 2: []}, {1: [], 2: []}, {}
    for _ in range(repeats):
        for actors in (1, 2):
            took, chain, found[actors] = timed_detection(ray, drive, options, actors)
            wall[actors].append(took)
            spent[actors].append(chain)
            print(f"  {actors} actors: {took:.2f} s, busiest {chain:.2f} s CPU", flush=True)
    same = repr(found[1]) == repr(found[2])
    print(
        f"detection of {len(drive.images)} images: {min(wall[1]):.2f} s with 1 actor, {min(wall[2]):.2f} s "
        f"with 2: {min(wall[1]) / min(wall[2]):.2f} x (asked >= 1.7); CPU of the busiest "
        f"{min(spent[1]) / min(spent[2]):.2f} x; same detections: {same}"
    )


def crowd(frames: int) -> None:
    """Print what drives of one way cost, all corners eliminated first or those that they share kept."""
    solve(site(2, 40, 10), OPTIONS)  # compiles, or loads what was compiled
    clearly_less = engine._CLEARLY_LESS
    for drives in (2, 4, 8):
        problem, spent, found = site(drives, frames, frames), [], []
        for share in (0.0, clearly_less):
            engine._CLEARLY_LESS = share
            cpu = time.process_time()
            found.append(solve(problem, OPTIONS))
            spent.append(time.process_time() - cpu)
        kept = len(found[1].covariance.whitening.plan.kept)
        print(
            f"{drives} drives of one way: {spent[0]:.2f} s CPU with corners first, {spent[1]:.2f} s with "
            f"{kept} kept; {off_m(*found):.1e} m apart",
            flush=True,
        )


def visits(folders: Sequence[Path], repeats: int) -> None:
    """Print the row of reading and checks."""
    config = RunConfig(drive=DriveConfig(path=[str(one) for one in folders]))
    wall: dict[str, list[float]] = {"here": [], "by tasks": []}
    found = {}
    for _ in range(repeats):
        executors: dict[str, Executor] = {"here": IN_PROCESS, "by tasks": RayExecutor(2, str(Path.cwd()))}
        for who, executor in executors.items():
            began = time.perf_counter()
            context = Context(workers=1, executor=executor)
            read = read_all(config.drive.paths, config.drive, context)
            found[who] = inspect_each(read.drives, read.contents, config.drive.max_gap_s, context)
            wall[who].append(time.perf_counter() - began)
            print(f"  reading and checks {who}: {wall[who][-1]:.2f} s", flush=True)
    here, there = (min(times) for times in wall.values())
    # All but how long it took.
    told = {who: [(one.drive, one.given, one.findings) for one in each] for who, each in found.items()}
    same = key_of(told["here"]) == key_of(told["by tasks"])
    print(
        f"reading and checks of {len(folders)} drives: {here:.2f} s here, {there:.2f} s by tasks on two "
        f"cores: {here / there:.2f} x; the same found: {same}"
    )


def main() -> None:
    """Print all of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--images", type=Path)
    parser.add_argument("--visits", type=Path, nargs="+")
    parser.add_argument("--only", choices=["crowd", "visits"], help="leave all else out")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.only != "visits":
        crowd(200)
    if arguments.only == "crowd":
        return
    with cluster(LOCAL, 2) as ray:
        if arguments.visits is not None:
            visits(arguments.visits, arguments.repeats)
        if arguments.only == "visits":
            return
        if arguments.images is not None:
            detection(ray, arguments.images, arguments.repeats)


if __name__ == "__main__":
    main()
