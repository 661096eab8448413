"""A run that is killed at any instant goes on, and ends in the byte-identical map.

``python -m tests.benchmarks.kills [--kills 50] [--images 16] [--one-camera] [--scratch FOLDER]`` renders a
small drive and maps it in one go. Then, again and again: a run of the same with an empty cache, ``kill -9``
at an instant drawn evenly over the processor time of a whole run, so that a busy machine moves no instant,
and a run that goes on. It must end in the same ``map.geojson``, and leave nothing half done beside it. Runs
are forked from a process that has loaded everything already, so that the kills fall into the work and not
into imports; with ``--door`` each is a process of its own, ``python -m v2hdm.map``. The exit code is 1 if any
map differs.
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

import v2hdm.pipeline.map_drive  # noqa: F401  # loaded once, before any run is forked
from tests.ports import short_port
from v2hdm.executor import HERE
from v2hdm.pipeline.config import DriveConfig, RunConfig
from v2hdm.pipeline.run import run
from v2hdm.simulate.port.drive import render_drive
from v2hdm.store.cache import items_of

Start = Callable[[Path, DriveConfig], int]
"""Starts a run of a drive within a folder; returns its process."""


def forked(folder: Path, drive: DriveConfig) -> int:
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
        places = {"output": str(folder / "out"), "cache": str(folder / "cache")}
        run(RunConfig(name="run", drive=drive, workers=1, **places))
        code = 0
    finally:
        os._exit(code)


def through_the_door(folder: Path, drive: DriveConfig) -> int:
    """A run as users start it."""
    settings = [f"drive.path={drive.path}", f"drive.limit={drive.limit}", "name=run", "workers=1"]
    settings.append(f"drive.cameras=[{','.join(drive.cameras)}]")
    places = [f"output={folder / 'out'}", f"cache={folder / 'cache'}"]
    command = [sys.executable, "-m", "v2hdm.map", *settings, *places]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True).pid


def finish(process: int) -> float:
    """Wait for a run, which must end well (a FAIL is a verdict); returns its processor time, s."""
    _, status, used = os.wait4(process, 0)
    if os.waitstatus_to_exitcode(status) not in (0, 3):
        raise SystemExit(f"a run ended with {os.waitstatus_to_exitcode(status)}")
    return used.ru_utime + used.ru_stime


def kill_at(process: int, used_s: float, rng: np.random.Generator) -> bool:
    """Kill a run and what it has started after so much processor time; whether it lived so long."""
    while processor_s(process) < used_s:
        if os.waitpid(process, os.WNOHANG)[0]:
            return False
        time.sleep(0.003)
    time.sleep(float(rng.uniform(0, 0.02)))  # the clock has ticks of 10 ms
    os.killpg(process, signal.SIGKILL)
    return os.WIFSIGNALED(os.waitpid(process, 0)[1])


def processor_s(process: int) -> float:
    """Processor time that a process has used so far, s."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def digest(folder: Path) -> str:
    return hashlib.sha256((folder / "out" / "run" / "map.geojson").read_bytes()).hexdigest()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--images", type=int, default=16, help="of each camera")
    parser.add_argument("--one-camera", action="store_true", help="the front one only: half the time")
    parser.add_argument("--scratch", type=Path, default=Path("cache/kills"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--door", action="store_true", help="start each run as a process of its own")
    parsed = parser.parse_args()
    start: Start = through_the_door if parsed.door else forked
    scratch = parsed.scratch.resolve()
    rendered = scratch / "drive"
    if not (rendered / "drive.yaml").is_file():
        render_drive(short_port(), rendered, HERE, lambda finished, total: None)
    cameras = ["front"] if parsed.one_camera else []
    drive = DriveConfig(path=str(rendered), limit=parsed.images, cameras=cameras)

    def fresh(name: str) -> Path:
        shutil.rmtree(scratch / name, ignore_errors=True)
        return scratch / name

    finish(start(fresh("whole"), drive))  # the first run warms the disk's cache
    whole_s = finish(start(fresh("whole"), drive))
    expected = digest(scratch / "whole")
    pieces = Counter(item.kind for item in items_of(scratch / "whole" / "cache"))
    print(f"in one go: {whole_s:.1f} s of processor time, {dict(pieces)}", flush=True)
    rng = np.random.default_rng(parsed.seed)
    same = killed = left = 0
    shares, reached = [], Counter[str]()
    while killed < parsed.kills:
        folder, at_s = fresh("killed"), float(rng.uniform(0, whole_s))
        if not kill_at(start(folder, drive), at_s, rng):
            continue
        killed += 1
        counts = Counter(item.kind for item in items_of(folder / "cache"))
        furthest = [stage for stage in ("finished", "map", "detect", "own_vehicle", "check") if counts[stage]]
        reached[f"{furthest[0]} {counts[furthest[0]]}" if furthest else "nothing"] += 1
        more_s = finish(start(folder, drive))
        shares.append((at_s / whole_s, more_s / whole_s))
        is_same = digest(folder) == expected
        same += is_same
        left += len([path for path in (folder / "out").iterdir() if path.name != "run"])
        print(
            f"kill {killed} at {at_s:.2f} s, kept {dict(counts)}: {more_s:.1f} s more, {is_same}", flush=True
        )
    print(f"maps byte-identical after a kill: {same} of {killed}; {left} files left beside the results")
    print(f"kept at the kill, by the last stage reached: {dict(reached)}")
    share_before, more = np.mean(shares, axis=0)
    print(
        f"killed after {share_before:.2f} of the work on average, a run that goes on does {more:.2f} of it: "
        f"{(1 - more) / share_before:.0%} of what was done was saved"
    )
    return int(same < killed)


if __name__ == "__main__":
    sys.exit(main())
