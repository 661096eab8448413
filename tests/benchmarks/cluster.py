"""A Dask scheduler and workers as a user starts them: what two workers gain, and what kills cost.

``python -m tests.benchmarks.cluster [--drives 8] [--kills 20] [--seed 1] [--scratch FOLDER]``

- ``--drives``: so many copies of a small rendered drive as a fleet, from nothing, on one worker and then on
  two; prints both times, their ratio, and whether all maps have the same bytes. Scheduler and workers run
  before.
- ``--kills``: a stage of small jobs that write files, again and again; each time a worker, the scheduler or
  the client is killed (``kill -9``) at a random instant. The stage must end in right results or in an error
  that says what is gone, no half file may be left, and of the client no process 10 s later.

The exit code is 1 where anything is otherwise.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np

from tests.executor.machines import ROOT, Machines
from tests.ports import short_port
from v2hdm.errors import WorkerError
from v2hdm.executor import HERE, open_executor
from v2hdm.fleet import FleetOptions, run_fleet
from v2hdm.progress import Progress
from v2hdm.simulate.port.drive import render_drive
from v2hdm.store.files import whole_file

JOBS = 24  # of a stage that is killed
JOB_S = 0.1  # work of one of these


def write_slowly(path: Path, progress: Progress) -> str:
    """Write a file in two halves; its name."""
    with whole_file(path) as partial:
        partial.write_text("half")
        time.sleep(JOB_S)
        partial.write_text("whole")
    return path.name


def stage(address: str, folder: Path) -> str:
    """A stage of small jobs; how it has ended."""
    names = [f"{number}.txt" for number in range(JOBS)]
    try:
        with open_executor(2, address) as executor:
            name_of_job = dict(executor.side_by_side(write_slowly, [folder / name for name in names]))
    except WorkerError as error:
        return f"said: {str(error).partition(';')[0].rpartition(':')[2].strip()}"
    return "finished" if [name_of_job[number] for number in range(JOBS)] == names else "WRONG"


def kill(whom: str, machines: Machines, folder: Path, at_s: float) -> str:
    """How a stage ends in which one is killed after so long."""
    if whom == "client":
        code = f"from tests.benchmarks.cluster import *; print(stage('', Path({str(folder)!r})))"
        client = subprocess.Popen(
            [sys.executable, "-c", f"if __name__ == '__main__': {code}"], cwd=ROOT, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        while not any(folder.iterdir()):
            time.sleep(0.01)
        time.sleep(at_s)
        client.kill()
        try:
            client.communicate(timeout=10)  # returns when the last process has closed its end
        except subprocess.TimeoutExpired:
            return "PROCESSES LEFT"
        return "no process left"
    victim = machines.scheduler if whom == "scheduler" else machines.processes[-1]

    def strike() -> None:
        while not any(folder.iterdir()):
            time.sleep(0.01)
        time.sleep(at_s)
        os.killpg(victim.pid, signal.SIGKILL)

    killer = threading.Thread(target=strike)
    killer.start()
    ended = stage(machines.address, folder)
    killer.join()
    return ended


def kills(count: int, seed: int, scratch: Path) -> bool:
    """Print how stages end whose worker, scheduler or client is killed; whether all is well."""
    rng = np.random.default_rng(seed)
    ends = Counter[str]()
    is_well = True
    for number in range(count):
        whom = "worker" if number % 4 < 2 else ("scheduler" if number % 4 == 2 else "client")
        folder = scratch / f"kill-{number}"
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "files").mkdir(parents=True)
        machines = Machines(folder)
        try:
            if whom != "client":
                for _ in range(2):
                    machines.worker()
                machines.wait_for(2)
            at_s = float(rng.uniform(0, JOBS * JOB_S / 2))
            ended = kill(whom, machines, folder / "files", at_s)
        finally:
            machines.close()
        halves = [path for path in (folder / "files").glob("[!.]*") if path.read_text() != "whole"]
        ends[f"{whom}: {ended}"] += 1
        is_well &= not halves and ended not in ("WRONG", "PROCESSES LEFT")
        print(f"{number + 1}: {whom} killed {at_s:.2f} s after the first file: {ended}", flush=True)
    print("; ".join(f"{end} ({times} times)" for end, times in sorted(ends.items())))
    return is_well


def fleets(count: int, scratch: Path) -> bool:
    """Print what a second worker gains for so many drives; whether the maps are the same."""
    drive = scratch / "drive"
    if not (drive / "drive.yaml").is_file():
        render_drive(short_port(), drive, HERE, lambda finished, total: None)
    spent_s = []
    digests = []
    for workers in (1, 2):
        folder = scratch / f"fleet-{workers}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        files = [folder / f"drive{number}.yaml" for number in range(count)]
        for file in files:
            file.write_text(
                f"# @package _global_\nname: {file.stem}\nmosaic: false\ndrive:\n  path: {drive}\n"
            )
        machines = Machines(folder)
        try:
            for _ in range(workers):
                machines.worker()
            machines.wait_for(workers)
            # Each drive finds nothing of the others.
            overrides = [f"output={folder}/out", f"cache={folder}/cache", "resume=false"]
            overrides.append(f"cluster={machines.address}")
            began_s = time.perf_counter()
            rows = run_fleet(files, overrides, FleetOptions(folder / "table"), lambda *_: None)
            spent_s.append(time.perf_counter() - began_s)
        finally:
            machines.close()
        maps = [(folder / "out" / row.drive / "map.geojson").read_bytes() for row in rows]
        digests.append({hashlib.sha256(content).hexdigest() for content in maps})
        print(f"{workers} workers: {spent_s[-1]:.1f} s; {Counter(row.status for row in rows)}", flush=True)
    is_same = digests[0] == digests[1] and len(digests[0]) == 1
    print(f"{count} drives: {spent_s[0] / spent_s[1]:.2f} x with two workers; the same bytes: {is_same}")
    return is_same


def main() -> int:
    """Do what is asked for; 1 where anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--drives", type=int, default=0)
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scratch", type=Path, default=Path("cache/cluster"))
    parsed = parser.parse_args()
    scratch = parsed.scratch.resolve()
    is_well = True
    if parsed.drives:
        is_well &= fleets(parsed.drives, scratch)
    if parsed.kills:
        is_well &= kills(parsed.kills, parsed.seed, scratch)
    return int(not is_well)


if __name__ == "__main__":
    sys.exit(main())
