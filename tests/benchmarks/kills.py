"""A run that is killed at any instant goes on, and ends in the byte-identical map.

``python -m tests.benchmarks.kills [--kills 50] [--images 16] [--scratch FOLDER] [--seed 1]`` renders a small
drive and maps it in one go. Then, again and again: a run of the same with an empty cache, ``kill -9`` at an
instant drawn evenly over the time that a whole run takes, and a run that goes on. It must end in the same
``map.geojson``, and leave nothing half done behind. Runs are forked from a process that has loaded everything
already, so that the kills fall into the work and not into imports; with ``--door`` each is a process of its
own, ``python -m v2hdm.map``, imports included. The exit code is 1 if any map differs.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

import v2hdm.pipeline.work  # noqa: F401  # loaded once, before any run is forked
from tests.pipeline.test_run import short_port
from v2hdm.caching.pruning import items_of
from v2hdm.pipeline import DriveConfig, RunConfig, run
from v2hdm.simulate import render_drive

Start = Callable[[Path, Path, int], int]
"""Starts a run of a drive within a folder, of so many images a camera; returns its process."""


def forked(drive: Path, folder: Path, images: int) -> int:
    """A run in a fork of this process."""
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        os.setsid()
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
        config = DriveConfig(path=str(drive), limit=images)
        run(
            RunConfig(
                name="run", drive=config, output=str(folder / "out"), cache=str(folder / "cache"), workers=1
            )
        )
        code = 0
    finally:
        os._exit(code)


def through_the_door(drive: Path, folder: Path, images: int) -> int:
    """A run as users start it."""
    settings = [f"drive.path={drive}", f"drive.limit={images}", "name=run", "workers=1"]
    places = [f"output={folder / 'out'}", f"cache={folder / 'cache'}"]
    command = [sys.executable, "-m", "v2hdm.map", *settings, *places]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True).pid


def finish(process: int) -> None:
    """Wait for a run, which must end well (a FAIL is a verdict)."""
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    if code not in (0, 3):
        raise SystemExit(f"a run ended with {code}")


def kill_after(process: int, seconds: float) -> bool:
    """Kill a run and what it has started after a time; whether it was still at work."""
    time.sleep(seconds)
    done, status = os.waitpid(process, os.WNOHANG)
    if done:
        return False
    os.killpg(process, signal.SIGKILL)
    _, status = os.waitpid(process, 0)
    return os.WIFSIGNALED(status)


def digest(folder: Path) -> str:
    return hashlib.sha256((folder / "out" / "run" / "map.geojson").read_bytes()).hexdigest()


def timed(start: Start, drive: Path, folder: Path, images: int) -> float:
    begin_s = time.perf_counter()
    finish(start(drive, folder, images))
    return time.perf_counter() - begin_s


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--images", type=int, default=16, help="of each of the two cameras")
    parser.add_argument("--scratch", type=Path, default=Path("cache/kills"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--door", action="store_true", help="start each run as a process of its own")
    parsed = parser.parse_args()
    start: Start = through_the_door if parsed.door else forked
    scratch = parsed.scratch.resolve()
    drive = scratch / "drive"
    if not (drive / "drive.yaml").is_file():
        render_drive(short_port(), drive, 1, lambda done, total: None)

    def fresh(name: str) -> Path:
        shutil.rmtree(scratch / name, ignore_errors=True)
        return scratch / name

    timed(start, drive, fresh("whole"), parsed.images)  # the first run warms the disk's cache
    whole_s = timed(start, drive, fresh("whole"), parsed.images)
    expected = digest(scratch / "whole")
    pieces = Counter(item.kind for item in items_of(scratch / "whole" / "cache"))
    print(f"in one go: {whole_s:.1f} s, {dict(pieces)}", flush=True)
    rng = np.random.default_rng(parsed.seed)
    same = killed = 0
    resumed_s, reached, left = [], Counter[str](), 0
    while killed < parsed.kills:
        folder, at_s = fresh("killed"), float(rng.uniform(0, whole_s))
        if not kill_after(start(drive, folder, parsed.images), at_s):
            continue
        killed += 1
        kept = Counter(item.kind for item in items_of(folder / "cache"))
        furthest = [stage for stage in ("map", "detect", "own_vehicle", "check") if kept[stage]]
        reached[f"{furthest[0]} {kept[furthest[0]]}" if furthest else "nothing"] += 1
        took_s = timed(start, drive, folder, parsed.images)
        resumed_s.append(took_s)
        is_same = digest(folder) == expected
        same += is_same
        left += len([path for path in (folder / "out").iterdir() if path.name != "run"])
        print(f"kill {killed} at {at_s:.2f} s, kept {dict(kept)}: {took_s:.1f} s more, {is_same}", flush=True)
    print(f"maps byte-identical after a kill: {same} of {killed}; {left} files left beside the results")
    print(f"kept at the kill, by the last stage reached: {dict(reached)}")
    print(
        f"a run that goes on takes {np.mean(resumed_s) / whole_s:.2f} of one in one go on average, "
        f"{min(resumed_s) / whole_s:.2f} at best"
    )
    return int(same < killed)


if __name__ == "__main__":
    sys.exit(main())
