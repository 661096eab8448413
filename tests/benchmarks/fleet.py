"""What Ray brings on two cores, and what a site in parts costs: times, bytes, and that maps are the same.

``python -m tests.benchmarks.fleet [--drives 8] [--frames 600] [--images FOLDER] [--visits FOLDERS]`` prints

- detection of a drive by one actor and by two, if ``--images`` names a drive (in any format that is read);
- the adjustment of a synthetic site of so many drives by :func:`v2hdm.adjust.solve`, in parts in this
  process, and in parts by one actor and by two; how far their corners are from the first's, and those of two
  actors one of which is killed in the middle;
- the bytes that travel for an evaluation and for a whitening, by drive;
- the adjustment of 2, 4 and 8 drives of one way, together and in parts, one after the other in this process;
- reading and checks of drives of one site, if ``--visits`` names them, here and by tasks on two cores.

Runs with one and two actors take turns, and the fastest of each counts: on a machine that is busy otherwise
the wall time tells little. Beside it stands the CPU time of the longest chain: the head's, and that of the
actor with the most to do.
"""

from __future__ import annotations

import argparse
import os
import signal
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tests.adjust.site import site
from v2hdm.adjust import Problem, Solution, SolveOptions, solve
from v2hdm.adjust.parts import Local, solve_in_parts
from v2hdm.adjust.parts.choice import cost_in_parts, cost_together
from v2hdm.adjust.parts.split import split
from v2hdm.detection.batch import with_own_vehicle
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.fleet.cluster import LOCAL, cluster
from v2hdm.fleet.crew import RayCrew
from v2hdm.fleet.eyes import Eyes, detect_by
from v2hdm.fleet.parts import RayTeam
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.mapping.crew import ALONE, Crew
from v2hdm.pipeline.config import DriveConfig, RunConfig
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.inspect import inspect_each
from v2hdm.pipeline.map_drive import read_all
from v2hdm.store.cache.keys import key_of

OPTIONS = SolveOptions(coarse=False)
_TICKS = os.sysconf("SC_CLK_TCK")


def cpu_s(process: int) -> float:
    """CPU time of a process so far."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


class Weighed(Local):
    """A team in this process that counts the bytes of numbers that would travel, by question."""

    def start(self, parts: Sequence[Any]) -> Any:
        """Begin to count."""
        self.down, self.up, self.asked = Counter(), Counter(), Counter()
        return super().start(parts)

    def ask(self, question: str, bases: Sequence[Any], *arguments: Sequence[Any]) -> list[Any]:
        """Ask, and count what goes down and comes up."""
        answers = super().ask(question, bases, *arguments)
        if question != "move":
            self.up[question] += sum(map(number_bytes, answers))
        self.down[question] += sum(number_bytes(one) for argument in arguments for one in argument)
        self.asked[question] += 1
        return answers


def number_bytes(value: Any) -> int:
    """Bytes of the arrays in a record of records."""
    if isinstance(value, torch.Tensor):
        return value.numel() * value.element_size()
    inside = (
        value.values()
        if isinstance(value, dict)
        else vars(value).values()
        if hasattr(value, "__dict__")
        else value
    )
    return sum(map(number_bytes, inside)) if isinstance(inside, (list, tuple)) or inside is not value else 0


class Mortal(RayTeam):
    """A team one of whose actors is killed in the middle of the descent."""

    def ask(self, question: str, bases: Sequence[Any], *arguments: Sequence[Any]) -> list[Any]:
        """Ask; the third time for an evaluation the first actor is killed."""
        import ray

        self.evaluations = getattr(self, "evaluations", 0) + (question == "evaluate")
        if question == "evaluate" and self.evaluations == 3:
            os.kill(ray.get(self.actors[0].process.remote()), signal.SIGKILL)
        return super().ask(question, bases, *arguments)


def off_m(one: Solution, other: Solution) -> float:
    """The largest distance of corners, camera centres' coordinates and poses of two solutions."""
    return max(
        float(np.abs(getattr(one, name) - getattr(other, name)).max())
        for name in ("corners_map", "cam_from_vehicle", "map_from_vehicle")
    )


def timed_detection(ray: Any, drive: Any, options: DetectorOptions, actors: int) -> tuple[float, float, Any]:
    """Wall time, CPU time of the busiest actor, and what it found."""
    eyes = [ray.remote(Eyes).options(num_cpus=1).remote(str(Path.cwd())) for _ in range(actors)]
    ray.get([one.detect.remote([ray.put(drive)], options, [0]) for one in eyes])
    processes = ray.get([one.process.remote() for one in eyes])
    before, began = [cpu_s(one) for one in processes], time.perf_counter()
    found: list[Any] = []
    detect_by(eyes, drive, options, range(len(drive.images)), 1, found.append)
    took = time.perf_counter() - began
    spent = max(cpu_s(one) - past for one, past in zip(processes, before, strict=True))
    for one in eyes:
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


def timed_site(ray: Any, team: RayTeam, problem: Problem) -> tuple[float, float, Solution]:
    """Wall time, CPU time of the longest chain (head, then the busiest actor), and the solution."""
    solve_in_parts(site(2, 40, 10), OPTIONS, team)
    processes = ray.get([one.process.remote() for one in team.actors])
    before, own, began = [cpu_s(one) for one in processes], time.process_time(), time.perf_counter()
    solution = solve_in_parts(problem, OPTIONS, team)
    took, own = time.perf_counter() - began, time.process_time() - own
    spent = max(cpu_s(one) - past for one, past in zip(processes, before, strict=True))
    return took, own + spent, solution


def adjustment(ray: Any, problem: Problem, repeats: int) -> None:
    """Print the rows of the site."""
    whole = solve(problem, OPTIONS)
    parts, shared = split(problem, OPTIONS.pose_states, False)
    print(
        f"site of {len(parts)} drives: {len(problem.observations.corner)} observations, "
        f"{len(problem.map_from_vehicle)} frames, {problem.corner_count} corners, {len(shared)} common"
    )
    for _ in range(2):
        began, cpu = time.perf_counter(), time.process_time()
        solve(problem, OPTIONS)
        print(f"  solve: {time.perf_counter() - began:.2f} s, {time.process_time() - cpu:.2f} s CPU")
    weighed = Weighed()
    began, cpu = time.perf_counter(), time.process_time()
    local = solve_in_parts(problem, OPTIONS, weighed)
    print(f"  in parts, here: {time.perf_counter() - began:.2f} s, {time.process_time() - cpu:.2f} s CPU")
    wall, chain, off = {1: [], 2: []}, {1: [], 2: []}, [off_m(local, whole)]
    for _ in range(repeats):
        for actors in (1, 2):
            team = RayTeam(actors)
            took, spent, solution = timed_site(ray, team, problem)
            wall[actors].append(took)
            chain[actors].append(spent)
            off.append(off_m(solution, whole))
            print(f"  {actors} actors: {took:.2f} s, longest chain {spent:.2f} s CPU", flush=True)
            for one in team.actors:
                ray.kill(one)
    killed = solve_in_parts(problem, OPTIONS, Mortal(2))
    print(
        f"site adjustment: {min(wall[1]):.2f} s with 1 actor, {min(wall[2]):.2f} s with 2: "
        f"{min(wall[1]) / min(wall[2]):.2f} x (asked >= 1.5); CPU of the longest chain "
        f"{min(chain[1]) / min(chain[2]):.2f} x"
    )
    print(f"from the joint solve in one process: {max(off):.1e} m (asked <= 1e-9)")
    print(f"with an actor killed in the middle: {off_m(killed, whole):.1e} m, {off_m(killed, local):.1e} m")
    for question in ("hand_on", "evaluate", "quantiles", "between"):
        times = weighed.asked[question] * len(parts)
        down, up = (count[question] / times / 1e3 for count in (weighed.down, weighed.up))
        asked = weighed.asked[question]
        print(f"{question}: asked {asked} times; {down:.1f} kB down and {up:.1f} kB up, a drive and time")


def crowd(frames: int) -> None:
    """Print what drives of one way cost together and in parts."""
    for solve_it in (solve, lambda problem, options: solve_in_parts(problem, options, Local())):
        solve_it(site(2, 40, 10), OPTIONS)  # compiles, or loads what was compiled
    for drives in (2, 4, 8):
        problem, spent, found = site(drives, frames, frames), [], []
        for team in (None, Local()):
            cpu = time.process_time()
            one = solve(problem, OPTIONS) if team is None else solve_in_parts(problem, OPTIONS, team)
            spent.append(time.process_time() - cpu)
            found.append(one)
        counted = cost_together(problem, OPTIONS), cost_in_parts(problem, OPTIONS)
        print(
            f"{drives} drives of one way: {spent[0]:.2f} s CPU together, {spent[1]:.2f} s in parts; "
            f"{counted[0]:.1e} and {counted[1]:.1e} multiplications a whitening; {off_m(*found):.1e} m apart",
            flush=True,
        )


def visits(folders: Sequence[Path], repeats: int) -> None:
    """Print the row of reading and checks."""
    config = RunConfig(drive=DriveConfig(path=[str(one) for one in folders]))
    wall: dict[str, list[float]] = {"here": [], "by tasks": []}
    found = {}
    for _ in range(repeats):
        crews: dict[str, Crew] = {"here": ALONE, "by tasks": RayCrew(2, str(Path.cwd()))}
        for who, crew in crews.items():
            began = time.perf_counter()
            context = Context(workers=1, executor=crew)
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
    parser.add_argument("--drives", type=int, default=8)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--overlap", type=int, default=40)
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
        problem = site(arguments.drives, arguments.frames, arguments.overlap, every_m=1.0)
        adjustment(ray, problem, arguments.repeats)


if __name__ == "__main__":
    main()
